// dump_file.cpp - prints everything that the library reads from an .rgs file, as raw arrays for the independent
// reader's test.
// SPDX-License-Identifier: Apache-2.0
//
// rgs_dump_file FILE > DUMP prints for each array a line `NAME TYPE SIZE...` (numpy's type codes) and its bytes,
// little-endian, row by row. For a refused file it prints `error CODE OFFSET` and exits with the code. It uses only the
// part of the library that opens and decodes a file, and is also linked with that part alone (RGS_FORMAT_PORTABLE).

#include <array>
#include <bit>
#include <cinttypes>
#include <cstdio>
#include <cstring>
#include <string_view>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"

namespace {

using namespace rgs;

static_assert(std::endian::native == std::endian::little);
constexpr std::uint64_t kSplatFloats = 3 + 4 + 3 + 1 + 48;
static_assert(sizeof(ActivatedSplat) == 4 * kSplatFloats && sizeof(Splat) == 4 * (kSplatFloats + 3));
static_assert(sizeof(ShStepSet) == 48 && sizeof(Box) == 24);

bool read_file(const char* path, std::vector<std::byte>& bytes) {
  std::FILE* file = std::fopen(path, "rb");
  if (file == nullptr) return false;
  std::array<std::byte, 4096> part;
  for (std::size_t n; (n = std::fread(part.data(), 1, part.size(), file)) != 0;) {
    bytes.insert(bytes.end(), part.begin(), part.begin() + static_cast<std::ptrdiff_t>(n));
  }
  const bool complete = std::ferror(file) == 0;
  std::fclose(file);
  return complete;
}

int report(const Error& error) {
  std::printf("error %s %" PRIu64 "\n", errc_name(error.code), error.offset);
  return exit_code(error.code);
}

/// `columns` numbers per row, of numpy's `type`; T is the rows' element type.
template <class T>
void put(const char* name, const char* type, std::uint64_t columns, std::span<const T> values) {
  const std::uint64_t item_bytes = static_cast<std::uint64_t>(type[1] - '0');
  std::printf("%s %s %" PRIu64 " %" PRIu64 "\n", name, type, values.size_bytes() / (columns * item_bytes), columns);
  if (!values.empty()) std::fwrite(values.data(), 1, values.size_bytes(), stdout);
}

void put_trained(std::span<const Splat> splats) {
  std::vector<float> values, rests;
  for (const Splat& s : splats) {
    const auto* const first = reinterpret_cast<const float*>(&s);
    values.insert(values.end(), first, first + kSplatFloats);
    rests.insert(rests.end(), s.mean_rest, s.mean_rest + 3);
  }
  put<float>("trained", "f4", kSplatFloats, values);
  put<float>("mean_rest", "f4", 3, rests);
}

void put_head(const FileView& view) {
  const Header& h = view.header();
  const std::array<std::int64_t, 8> header = {
      h.version_major,
      h.version_minor,
      static_cast<std::int64_t>(h.file_bytes),
      static_cast<std::int64_t>(h.n_gaussians),
      static_cast<std::int64_t>(h.n_step_sets),
      h.chunk_size,
      h.sh_degree,
      h.scale_exponent,
  };
  put<std::int64_t>("header", "i8", header.size(), header);

  std::vector<std::uint64_t> entries;
  for (const SectionEntry& s : view.sections())
    entries.insert(entries.end(), {s.type, s.flags, s.codec, s.offset, s.stored_bytes, s.decoded_bytes, s.xxh3});
  put<std::uint64_t>("sections", "u8", 7, entries);

  const Declarations& d = view.declarations();
  const auto byte = [](auto enumerator) { return static_cast<std::uint8_t>(enumerator); };
  const std::array<std::uint8_t, 11> enumerators = {
      byte(d.axes[0]),       byte(d.axes[1]),      byte(d.axes[2]), byte(d.colour_space),
      byte(d.sh_basis),      byte(d.kernel),       byte(d.aa_mode), byte(d.sort_metric),
      byte(d.depth_mapping), byte(d.depth_source), byte(d.order),
  };
  put<std::uint8_t>("enumerators", "u1", enumerators.size(), enumerators);
  const std::array<float, 9> constants = {
      d.z_near,    d.z_far,        d.metres_per_unit,   d.cutoff_sigma,    d.alpha_threshold,
      d.alpha_max, d.low_pass_px2, d.transmittance_min, d.robust_fraction,
  };
  put<float>("constants", "f4", constants.size(), constants);
  put<Box>("boxes", "f4", 6, std::array{d.full, d.robust});
  const std::array<std::uint64_t, 7> counts = {
      d.n_source, d.n_dropped, d.n_repaired, d.n_scale_subnormal, d.n_scale_zero, d.n_opacity_zero, d.n_opacity_one,
  };
  put<std::uint64_t>("counts", "u8", counts.size(), counts);
  put<double>("origin", "f8", d.origin.size(), d.origin);

  if (const FirstView& v = d.first_view; v != FirstView()) {
    const std::array<float, 11> numbers = {
        static_cast<float>(v.kind),
        v.position[0],
        v.position[1],
        v.position[2],
        v.pivot[0],
        v.pivot[1],
        v.pivot[2],
        v.up[0],
        v.up[1],
        v.up[2],
        v.horizontal_fov,
    };
    put<float>("first_view", "f4", numbers.size(), numbers);
  }
  if (d.crs != Crs()) {
    put<char>("crs", "u1", 1, d.crs.text);
    put<Axis>("crs_axes", "u1", 3, d.crs.axes);
  }
  if (const auto& p = view.provenance()) {
    put<std::uint64_t>("source", "u8", 2, std::array{p->source_bytes, p->source_xxh3});
    put<char>("source_name", "u1", 1, p->source_name);
    put<char>("tool", "u1", 1, p->tool);
  }
}

Status put_payload(const FileView& view) {
  const std::uint64_t n = view.header().n_gaussians;
  std::vector<ActivatedSplat> activated(n);
  std::vector<Splat> trained(n);
  if (auto ok = view.read(0, std::span(activated)); !ok) return ok;
  if (auto ok = view.read(0, std::span(trained)); !ok) return ok;
  put<ActivatedSplat>("activated", "f4", kSplatFloats, activated);
  put_trained(trained);

  std::vector<float> chunk_floats;
  std::vector<std::uint64_t> chunk_integers;
  for (std::uint64_t i = 0; i < view.header().n_chunks; ++i) {
    const auto c = view.chunk(i);
    if (!c) return tl::unexpected(c.error());
    chunk_floats.insert(chunk_floats.end(), c->means.min.begin(), c->means.min.end());
    chunk_floats.insert(chunk_floats.end(), c->means.max.begin(), c->means.max.end());
    chunk_floats.insert(chunk_floats.end(), {c->radius, c->max_opacity});
    chunk_integers.insert(chunk_integers.end(), {c->step_set, c->count});
  }
  put<float>("chunk_floats", "f4", 8, chunk_floats);
  put<std::uint64_t>("chunk_integers", "u8", 2, chunk_integers);

  std::vector<ShStepSet> sets;
  for (std::uint64_t i = 0; i < view.header().n_step_sets; ++i) {
    const auto set = view.step_set(i);
    if (!set) return tl::unexpected(set.error());
    sets.push_back(*set);
  }
  put<ShStepSet>("steps", "f4", 12, sets);

  std::vector<std::uint64_t> source_index(n);
  for (std::uint64_t i = 0; i < n; ++i) source_index[i] = view.source_index(i);
  put<std::uint64_t>("source_index", "u8", 1, source_index);
  return {};
}

// For a file with levels: the tree, then Gaussians, chunks and steps of all pages in file order.
Status put_pages(const PagedFile& file) {
  std::vector<std::uint64_t> integers, n_origins;
  std::vector<float> floats;
  std::vector<ActivatedSplat> activated;
  std::vector<Splat> trained;
  std::vector<float> chunk_floats;
  std::vector<std::uint64_t> chunk_integers;
  std::vector<std::byte> steps, memory(file.largest_decoded_bytes());
  PageDecoder decoder(file);
  for (std::uint32_t i = 0; i < file.n_pages(); ++i) {
    const lod::Page& page = file.pages()[i];
    const StoredPage& stored = file.stored(i);
    integers.insert(integers.end(), {stored.offset, stored.xxh3, stored.stored_bytes, page.count, page.parent,
                                     page.first_child, page.level, page.n_children, stored.n_step_sets,
                                     static_cast<std::uint64_t>(std::int64_t{stored.scale_exponent})});
    integers.insert(integers.end(), stored.corner.begin(), stored.corner.end());
    n_origins.push_back(stored.n_origins);
    floats.push_back(page.error);
    for (const auto& corner : {page.bounds.min, page.bounds.max, page.core.min, page.core.max}) {
      floats.insert(floats.end(), corner.begin(), corner.end());
    }
    std::vector<float> rests;
    const auto rows = decoder.decode(i, file.bytes(i), std::span(memory).first(file.decoded_bytes(i)), &rests);
    if (!rows) return tl::unexpected(rows.error());
    const std::size_t first = activated.size();
    activated.resize(first + rows->n);
    trained.resize(first + rows->n);
    if (auto ok = read_page(file, i, *rows, 0, std::span(activated).subspan(first)); !ok) return ok;
    if (auto ok = read_page(file, i, *rows, 0, std::span(trained).subspan(first)); !ok) return ok;
    for (std::size_t k = 0; k < rests.size(); ++k) trained[first + k / 3].mean_rest[k % 3] = rests[k];
    for (std::size_t at = 0; at < rows->chunks.size(); at += kChunkEntryBytes) {
      std::array<float, 8> box;  // min, radius, max, max_opacity
      std::uint64_t step_set;
      std::uint32_t count;
      std::memcpy(box.data(), rows->chunks.data() + at, 32);
      std::memcpy(&step_set, rows->chunks.data() + at + 32, 8);
      std::memcpy(&count, rows->chunks.data() + at + 40, 4);
      chunk_floats.insert(chunk_floats.end(), {box[0], box[1], box[2], box[4], box[5], box[6], box[3], box[7]});
      chunk_integers.insert(chunk_integers.end(), {step_set, std::uint64_t{count}});
    }
    steps.insert(steps.end(), rows->steps.begin(), rows->steps.end());
  }
  put<std::uint64_t>("pages", "u8", 13, integers);
  put<std::uint64_t>("n_origins", "u8", 1, n_origins);
  put<float>("page_floats", "f4", 13, floats);
  put<float>("quality", "f4", 1, std::array{file.quality_db()});
  put<ActivatedSplat>("activated", "f4", kSplatFloats, activated);
  put_trained(trained);
  put<float>("chunk_floats", "f4", 8, chunk_floats);
  put<std::uint64_t>("chunk_integers", "u8", 2, chunk_integers);
  put<std::byte>("steps", "f4", 12, steps);
  std::vector<std::uint64_t> source_index(file.head().header().n_gaussians);
  for (std::uint64_t i = 0; i < source_index.size(); ++i) source_index[i] = file.source_index(i);
  put<std::uint64_t>("source_index", "u8", 1, source_index);
  return {};
}

int dump_levels(std::span<const std::byte> bytes) {
  const auto file = PagedFile::open(bytes);
  if (!file) return report(file.error());
  if (auto ok = validate(*file); !ok) return report(ok.error());
  if (!file->complete()) return report({Errc::pages_missing, bytes.size()});
  put_head(file->head());
  if (auto ok = put_pages(*file); !ok) return report(ok.error());
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fputs("usage: rgs_dump_file FILE > DUMP\n", stderr);
    return 2;
  }
  std::vector<std::byte> bytes;
  if (!read_file(argv[1], bytes)) {
    std::fputs("rgs_dump_file: the file cannot be read\n", stderr);
    return 3;
  }
  if (has_levels(bytes)) return dump_levels(bytes);
  const auto view = FileView::open(bytes);
  if (!view) return report(view.error());
  if (auto ok = validate(*view); !ok) return report(ok.error());
  put_head(*view);
  if (auto ok = put_payload(*view); !ok) return report(ok.error());
  return 0;
}
