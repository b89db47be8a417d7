// reader.cpp - the format library for JavaScript; src/decoder.ts calls it. Any number of files, one thread.
// SPDX-License-Identifier: Apache-2.0
//
// A function that fails returns a negative number or null; rgs_error() then gives the error. Further results are in rgs_numbers(), as
// FP64 (counts and offsets are below 2^53), and in rgs_text(). Addresses are in this module's memory. JavaScript passes the file's bytes:
// parts of its beginning, a stored page, or the whole file.

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include <zstd.h>

#include "pages/wire.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/subject_box.hpp"
#include "spz_header.hpp"

#define RGS_EXPORT(name) extern "C" [[clang::export_name(#name)]]

extern "C" [[noreturn, clang::import_module("rgs"), clang::import_name("out_of_memory")]] void rgs_out_of_memory();

namespace {

using namespace rgs;

/// Of a million pages; what JavaScript and the scheduler hold of them takes four times as much. Any header can promise more.
constexpr std::uint64_t kMostTableBytes = std::uint64_t{1} << 27;

struct Free {
  void operator()(std::byte* memory) const { std::free(memory); }
};
using Memory = std::unique_ptr<std::byte[], Free>;

/// Gaussians of a range of chunks or of a page: pointers to arrays of `n` rows.
struct Rows {
  std::uint32_t n = 0;
  const float *means = nullptr, *rotations = nullptr, *scales = nullptr,
              *opacities = nullptr;                // [n, 3], [n, 4], [n, 3], [n]
  const float *sh0 = nullptr, *sh_rest = nullptr;  // [n, 3], [n, sh_coefficients - 1, 3]
  // As stored, with chunk table and step sets. The last four are set for pages only.
  const std::byte *stored_means = nullptr, *stored_geometry = nullptr, *stored_sh = nullptr;
  const std::byte *chunks = nullptr, *steps = nullptr;
  std::uint32_t n_chunks = 0, n_step_sets = 0;
};
static_assert(sizeof(void*) == 4 && sizeof(Rows) == 14 * 4);

struct File {
  DecodeLimits limits;
  std::vector<Memory> memory;  // of the parts
  std::vector<FilePart> parts;
  Memory image;  // the whole file
  std::optional<FileView> view;
  std::optional<PagedFile> paged;
  std::unique_ptr<PageDecoder> decoder;
  // While a whole file is read.
  std::optional<Validation> validation;
  std::uint64_t next = 0;  // chunk, or page
  // Holds the rows that were decoded last.
  std::optional<DirectData> data;
  std::vector<std::byte> page;
  std::vector<float> floats;

  const FileView& head() const { return paged ? paged->head() : *view; }
};

Error last_error;
std::vector<double> numbers;
std::string text;
Rows rows;

int fail(const Error& error) {
  last_error = error;
  return -1;
}

// Inlined, it would be a twentieth of the module.
[[gnu::noinline]] void put_one(double value) {
  numbers.push_back(value);
}
template <class... T>
void put(T... values) {
  (put_one(static_cast<double>(values)), ...);
}
void put_hash(std::uint64_t hash) {  // as two numbers: FP64 holds 53 bits
  put(hash >> 32, hash & 0xFFFFFFFFu);
}
void put_box(const Box& box) {
  for (const float x : box.min) put(x);
  for (const float x : box.max) put(x);
}

std::span<const std::byte> beginning_of(const File& file) {
  std::span<const std::byte> most;
  for (const FilePart& part : file.parts) {
    if (part.offset == 0 && part.bytes.size() > most.size()) most = part.bytes;
  }
  return most;
}

// Bytes of the whole file, -1 if unknown.
std::optional<std::uint64_t> known(double file_bytes) {
  return file_bytes >= 0 ? std::optional(static_cast<std::uint64_t>(file_bytes)) : std::nullopt;
}

// Bytes of the whole file; if unknown (-1), those that the header states: docs/format/FORMAT.md, "Header".
std::uint64_t whole_bytes(const File& file, double file_bytes) {
  if (const auto size = known(file_bytes)) return *size;
  const auto beginning = beginning_of(file);
  std::uint64_t stated = 0;
  if (beginning.size() >= kHeaderBytes) std::memcpy(&stated, beginning.data() + 16, sizeof stated);
  return stated;
}

/// Allocates `rows` for n Gaussians as floats; null where the degree has no coefficients.
struct FloatRows {
  float *means, *rotations, *scales, *opacities, *sh0, *sh_rest;
};
FloatRows make_float_rows(File& file, std::uint32_t n) {
  const std::size_t rest = static_cast<std::size_t>(3 * sh_coefficients(file.head().header().sh_degree) - 3);
  file.floats.resize(n * (14 + rest));
  float* next = file.floats.data();
  const auto take = [&](std::size_t columns) { return std::exchange(next, next + n * columns); };
  const FloatRows f{take(3), take(4), take(3), take(1), take(3), take(rest)};
  rows = {.n = n,
          .means = f.means,
          .rotations = f.rotations,
          .scales = f.scales,
          .opacities = f.opacities,
          .sh0 = f.sh0,
          .sh_rest = f.sh_rest};
  return f;
}

/// `read(first, out)` reads Gaussians from `first` on.
template <class Read>
Status read_floats(File& file, std::uint32_t n, const Read& read) {
  const FloatRows f = make_float_rows(file, n);
  const std::size_t rest = static_cast<std::size_t>(3 * sh_coefficients(file.head().header().sh_degree) - 3);
  static std::array<ActivatedSplat, 64> buffer;
  for (std::uint32_t first = 0; first < n; first += buffer.size()) {
    const auto part = std::span(buffer).first(std::min<std::size_t>(buffer.size(), n - first));
    if (const Status s = read(first, part); !s) return s;
    for (std::size_t i = 0; i < part.size(); ++i) {
      const ActivatedSplat& g = part[i];
      const std::size_t at = first + i;
      std::copy_n(g.mean, 3, f.means + 3 * at);
      std::copy_n(g.rotation, 4, f.rotations + 4 * at);
      std::copy_n(g.scale, 3, f.scales + 3 * at);
      f.opacities[at] = g.opacity;
      std::copy_n(g.sh, 3, f.sh0 + 3 * at);
      std::copy_n(g.sh + 3, rest, f.sh_rest + rest * at);
    }
  }
  return {};
}

Status give_page(File& file, std::uint32_t page, const PageRows& decoded, bool as_stored) {
  if (!as_stored) {
    return read_floats(file, decoded.n, [&](std::uint32_t first, std::span<ActivatedSplat> out) {
      return read_page(*file.paged, page, decoded, first, out);
    });
  }
  rows = {.n = decoded.n,
          .stored_means = decoded.means.data(),
          .stored_geometry = decoded.geometry.data(),
          .stored_sh = decoded.sh.data(),
          .chunks = decoded.chunks.data(),
          .steps = decoded.steps.data(),
          .n_chunks = static_cast<std::uint32_t>(decoded.chunks.size() / kChunkEntryBytes),
          .n_step_sets = static_cast<std::uint32_t>(decoded.steps.size() / kStepSetBytes)};
  return {};
}

void put_levels(const PagedFile& paged, std::uint32_t first, std::uint32_t most) {
  const std::uint32_t n = std::min(most, paged.n_pages_in_all() - first);
  numbers.clear();
  numbers.reserve(9 + pages::kPageNumbers * n);
  put(paged.n_pages_in_all(), paged.n_levels(), paged.n_stored(), paged.page_chunks(), paged.quality_db(),
      static_cast<int>(paged.codec()), paged.is_verified(), first, n);
  for (std::uint32_t i = first; i < first + n; ++i) pages::put_page(paged.pages()[i], paged.stored(i), numbers);
}

Result<PageRows> decode_page(File& file, std::uint32_t page, std::span<const std::byte> stored) {
  if (!file.decoder) file.decoder = std::make_unique<PageDecoder>(*file.paged);
  file.page.resize(file.paged->decoded_bytes(page));
  return file.decoder->decode(page, stored, file.page);
}

// Rows of a coded frame of our writers, so that no frame is decoded twice.
std::uint64_t chunks_at_a_time(const Header& h) {
  return std::max<std::uint64_t>(1, 16384 / h.chunk_size);
}

// The next `n` chunks, whose bytes are present.
Status decode_chunks(File& file, std::uint64_t n, bool as_stored) {
  const FileView& view = *file.view;
  auto data = read_chunks(view, file.next, n, {.validate = false, .threads = 1});
  if (!data) return tl::unexpected(data.error());
  if (const Status s = file.validation->check(*data); !s) return s;
  file.next += n;
  const auto size = static_cast<std::uint32_t>(data->size());
  file.data = std::move(*data);
  if (as_stored) {
    rows = {.n = size,
            .stored_means = file.data->means().data(),
            .stored_geometry = file.data->geometry().data(),
            .stored_sh = file.data->sh().data()};
    return {};
  }
  return read_floats(file, size, [&](std::uint32_t first, std::span<ActivatedSplat> out) {
    return file.data->read(file.data->first() + first, out);
  });
}

// Some chunks of the whole file; 0 rows at its end.
Status next_chunks(File& file, bool as_stored) {
  const Header& h = file.view->header();
  if (file.next == h.n_chunks) {
    rows = {};
    return file.validation->finish();
  }
  return decode_chunks(file, std::min(chunks_at_a_time(h), h.n_chunks - file.next), as_stored);
}

constexpr std::array kOfGaussians = {SectionType::means, SectionType::geometry, SectionType::sh};

// Chunks in a group: at least one frame of each section, so that few frames are decoded twice.
std::uint64_t group_chunks(const FileView& view) {
  std::uint64_t n = chunks_at_a_time(view.header());
  for (const SectionType type : kOfGaussians) {
    n = std::max<std::uint64_t>(n, view.frames(type).rows / view.header().chunk_size);
  }
  return n;
}

// The bytes of the file from which rows first .. end - 1 of a section decode.
FileRange range_of(const FileView& view, SectionType type, std::uint64_t first, std::uint64_t end) {
  const FrameTable& table = view.frames(type);
  if (table.frames.empty()) {
    const std::uint64_t begin = view.place(type, first);
    return {begin, view.place(type, end) - begin};
  }
  const CodedFrame& last = table.frames[(end - 1) / table.rows];
  const std::uint64_t begin = table.frames[first / table.rows].offset;
  return {begin, last.offset + last.stored_bytes - begin};
}

Status next_leaf(File& file) {
  if (file.next == file.paged->n_pages()) {
    rows = {};
    return {};
  }
  const auto page = static_cast<std::uint32_t>(file.next++);
  const auto decoded = decode_page(file, page, file.paged->bytes(page));
  if (!decoded) return tl::unexpected(decoded.error());
  return give_page(file, page, *decoded, false);
}

}  // namespace

RGS_EXPORT(rgs_start) void rgs_start() {
  std::set_new_handler([] { rgs_out_of_memory(); });
}

/// Null if out of memory.
RGS_EXPORT(rgs_allocate) void* rgs_allocate(std::uint32_t bytes) {
  return std::malloc(std::max<std::uint32_t>(bytes, 1));
}
RGS_EXPORT(rgs_free) void rgs_free(void* memory) {
  std::free(memory);
}

/// Code and text on a line each in rgs_text(); offset, expected and found as two halves each in rgs_numbers().
RGS_EXPORT(rgs_error) void rgs_error() {
  text = std::string(errc_name(last_error.code)) + "\n" + last_error.what;
  numbers.clear();
  for (const std::uint64_t value : {last_error.offset, last_error.expected, last_error.found}) put_hash(value);
}
RGS_EXPORT(rgs_numbers) const double* rgs_numbers() {
  return numbers.data();
}
RGS_EXPORT(rgs_n_numbers) std::uint32_t rgs_n_numbers() {
  return numbers.size();
}
RGS_EXPORT(rgs_text) const char* rgs_text() {
  return text.data();
}
RGS_EXPORT(rgs_n_text) std::uint32_t rgs_n_text() {
  return text.size();
}
RGS_EXPORT(rgs_rows) const Rows* rgs_rows() {
  return &rows;
}

RGS_EXPORT(rgs_file_new)
File* rgs_file_new(double max_file_bytes, double max_gaussians, double max_decoded_bytes) {
  auto* file = new File;
  file->limits.max_file_bytes = static_cast<std::uint64_t>(max_file_bytes);
  file->limits.max_gaussians = static_cast<std::uint64_t>(max_gaussians);
  file->limits.max_decoded_bytes = static_cast<std::uint64_t>(max_decoded_bytes);
  return file;
}
RGS_EXPORT(rgs_file_free) void rgs_file_free(File* file) {
  delete file;
}

/// Takes ownership of `address`, from rgs_allocate(): the file's bytes at `offset`.
RGS_EXPORT(rgs_add_part) void rgs_add_part(File* file, double offset, std::byte* bytes, std::uint32_t size) {
  file->memory.emplace_back(bytes);
  file->parts.push_back({static_cast<std::uint64_t>(offset), {bytes, size}});
}

/// The ranges (offset, bytes) that rgs_open_parts() still needs, and their number. One part must begin at 0. `file_bytes` may be -1.
RGS_EXPORT(rgs_needs) int rgs_needs(File* file, double file_bytes) {
  const bool levels = has_levels(beginning_of(*file));
  const auto ranges = levels ? PagedFile::needs(file->parts, file->limits, known(file_bytes))
                             : FileView::head_needs(file->parts, whole_bytes(*file, file_bytes), file->limits);
  if (!ranges) return fail(ranges.error());
  numbers.clear();
  for (const FileRange& range : *ranges) put(range.offset, range.bytes);
  return static_cast<int>(ranges->size());
}

/// Returns 1 if the file has levels of detail, else 0. The parts are released.
RGS_EXPORT(rgs_open_parts) int rgs_open_parts(File* file, double file_bytes) {
  const bool levels = has_levels(beginning_of(*file));
  if (levels) {
    auto paged = PagedFile::open_beginning(file->parts, file->limits, known(file_bytes));
    if (!paged) return fail(paged.error());
    const FileRange unread = paged->unread_table();
    const std::uint64_t size = whole_bytes(*file, file_bytes);
    if (unread.offset + unread.bytes > size)
      return fail({Errc::truncated, size, "the file ends before its first page"});
    if (paged->whole_memory_bytes() > kMostTableBytes)
      return fail({Errc::limit_exceeded, unread.offset, "the table of pages needs more memory than this reader allows",
                   kMostTableBytes, paged->whole_memory_bytes()});
    if (const Status s = paged->reserve(); !s) return fail(s.error());
    file->paged = *std::move(paged);
  } else {
    auto view = FileView::open_head(file->parts, whole_bytes(*file, file_bytes), file->limits);
    if (!view) return fail(view.error());
    file->view = *std::move(view);
  }
  file->parts.clear();
  file->memory.clear();
  return levels ? 1 : 0;
}

/// PagedFile::unread_table(): offset and bytes in rgs_numbers().
RGS_EXPORT(rgs_unread_table) void rgs_unread_table(File* file, std::uint32_t below, std::uint32_t most) {
  const FileRange range = file->paged->unread_table(below, most);
  numbers.clear();
  put(range.offset, range.bytes);
}
/// PagedFile::extend(); then what may have become known, as by rgs_levels().
RGS_EXPORT(rgs_extend)
int rgs_extend(File* file, std::uint32_t below, double offset, const std::byte* bytes, std::uint32_t size) {
  PagedFile& paged = *file->paged;
  // With the pages before it that are known.
  const std::uint32_t first = below == lod::kNoPage ? paged.n_pages() : paged.pages()[below].first_child;
  const auto known = [&](const lod::Page& page) {
    return page.n_children == 0 || paged.pages()[page.first_child + page.n_children - 1].parent == below;
  };
  if (below == lod::kNoPage || !known(paged.pages()[below])) {
    const Status s = paged.extend({static_cast<std::uint64_t>(offset), {bytes, size}}, below);
    if (!s) return fail(s.error());
  }
  put_levels(paged, first, lod::kMaxChildren + size / kPageRecordBytes);
  return 0;
}

/// Header, declarations, provenance, sections, in the order in which src/head.ts reads them.
RGS_EXPORT(rgs_head) void rgs_head(File* file) {
  const FileView& view = file->head();
  const Header& h = view.header();
  const Declarations& d = view.declarations();
  numbers.clear();
  text.clear();
  put(h.version_major, h.version_minor, h.file_bytes, h.n_gaussians, h.n_chunks, h.n_step_sets, h.chunk_size,
      h.sh_degree, h.scale_exponent);
  for (const Axis axis : d.axes) put(static_cast<int>(axis));
  put(static_cast<int>(d.colour_space), static_cast<int>(d.sh_basis), static_cast<int>(d.kernel),
      static_cast<int>(d.aa_mode), static_cast<int>(d.sort_metric), static_cast<int>(d.depth_mapping),
      static_cast<int>(d.depth_source), static_cast<int>(d.order));
  put(d.z_near, d.z_far, d.metres_per_unit, d.cutoff_sigma, d.alpha_threshold, d.alpha_max, d.low_pass_px2,
      d.transmittance_min, d.robust_fraction);
  put_box(d.full);
  put_box(d.robust);
  put(d.n_source, d.n_dropped, d.n_repaired, d.n_scale_subnormal, d.n_scale_zero, d.n_opacity_zero, d.n_opacity_one);
  for (const double x : d.origin) put(x);
  put(static_cast<int>(d.first_view.kind));
  for (const auto* vector : {&d.first_view.position, &d.first_view.pivot, &d.first_view.up}) {
    for (const float x : *vector) put(x);
  }
  put(d.first_view.horizontal_fov);
  put(d.crs.text.size());
  for (const Axis axis : d.crs.axes) put(static_cast<int>(axis));
  text = d.crs.text;
  const auto& p = view.provenance();
  put(p.has_value());
  if (p) {
    put(p->source_bytes, p->source_name.size());
    put_hash(p->source_xxh3);
    text += p->source_name + p->tool;
  }
  put(view.sections().size());
  for (const SectionEntry& s : view.sections()) {
    put(s.type, s.flags, s.codec, s.offset, s.stored_bytes, s.decoded_bytes);
    put_hash(s.xxh3);
  }
}

/// The tree of pages: one record about all of them, whether the table is verified, number of the first page and count of those that
/// follow, a record each: here all that are known. After rgs_extend() unknown ones are among them, without parent and Gaussians.
RGS_EXPORT(rgs_levels) void rgs_levels(File* file) {
  put_levels(*file->paged, 0, file->paged->n_pages());
}

/// Decodes a page from its stored bytes to rgs_rows(), and checks every value.
RGS_EXPORT(rgs_read_page)
int rgs_read_page(File* file, std::uint32_t page, const std::byte* stored, std::uint32_t size, int as_stored) {
  const auto decoded = decode_page(*file, page, {stored, size});
  if (!decoded) return fail(decoded.error());
  if (const Status s = check_page_values(*file->paged, page, *decoded); !s) return fail(s.error());
  const Status s = give_page(*file, page, *decoded, as_stored != 0);
  return s ? 0 : fail(s.error());
}

/// Opens a whole file and takes ownership of its memory, from rgs_allocate(). Checks everything but the Gaussians.
RGS_EXPORT(rgs_open_whole) int rgs_open_whole(File* file, std::byte* bytes, std::uint32_t size) {
  file->image.reset(bytes);
  const std::span<const std::byte> whole(bytes, size);
  if (has_levels(whole)) {
    auto paged = PagedFile::open(whole, file->limits);
    if (!paged) return fail(paged.error());
    if (const Status s = validate(*paged); !s) return fail(s.error());
    if (!paged->complete()) {
      return fail({Errc::pages_missing, size,
                   "the end of the file is missing, and with it some of the scene's own Gaussians: pages can be read"});
    }
    file->paged = *std::move(paged);
    file->next = lod::pages_of_level(file->paged->pages(), 0).front();
    return 1;
  }
  auto view = FileView::open(whole, file->limits);
  if (!view) return fail(view.error());
  file->view = *std::move(view);
  auto validation = Validation::begin(*file->view);
  if (!validation) return fail(validation.error());
  file->validation = *std::move(validation);
  file->next = 0;
  return 0;
}

/// Opens a file without levels while it is still being read, in memory of rgs_allocate() that stays the caller's. Everything but the
/// sections MEAN, GEOM, SHI8 and PERM must be present, and the frame tables of these. rgs_numbers(): chunks in a group, then for each
/// group its ranges in MEAN, GEOM and SHI8.
RGS_EXPORT(rgs_open_early) int rgs_open_early(File* file, const std::byte* bytes, std::uint32_t size) {
  auto opened = FileView::open({bytes, size}, file->limits);
  if (!opened) return fail(opened.error());
  file->view = *std::move(opened);
  const FileView& view = *file->view;
  auto validation = Validation::begin_early(view);
  if (!validation) return fail(validation.error());
  file->validation = *std::move(validation);
  file->next = 0;
  const Header& h = view.header();
  const std::uint64_t group = group_chunks(view);
  numbers.clear();
  put(group);
  for (std::uint64_t chunk = 0; chunk < h.n_chunks; chunk += group) {
    const std::uint64_t end = std::min((chunk + group) * h.chunk_size, h.n_gaussians);
    for (const SectionType type : kOfGaussians) {
      const FileRange range = range_of(view, type, chunk * h.chunk_size, end);
      put(range.offset, range.bytes);
    }
  }
  return 0;
}

/// Decodes the next `n_chunks` of such a file as stored to rgs_rows(), with chunk table and step sets of the whole file.
RGS_EXPORT(rgs_next_early) int rgs_next_early(File* file, std::uint32_t n_chunks) {
  const Header& h = file->view->header();
  const Status s = decode_chunks(*file, std::min<std::uint64_t>(n_chunks, h.n_chunks - file->next), true);
  if (!s) return fail(s.error());
  const FileView& view = *file->view;
  rows.chunks = view.chunk_table().data();
  rows.steps = view.step_table().data();
  rows.n_chunks = static_cast<std::uint32_t>(h.n_chunks);
  rows.n_step_sets = static_cast<std::uint32_t>(h.n_step_sets);
  return 0;
}

/// Checks such a file as a whole, after all its chunks.
RGS_EXPORT(rgs_finish_early) int rgs_finish_early(File* file) {
  // Opened again, for the bytes between the sections.
  const auto whole = FileView::open(file->view->bytes(), file->limits);
  if (!whole) return fail(whole.error());
  const Status s = file->validation->finish();
  return s ? 0 : fail(s.error());
}

/// Decodes the next Gaussians of the finest level of a whole file to rgs_rows(). No rows: that was all, and the file is sound.
/// `as_stored`: only without levels.
RGS_EXPORT(rgs_next) int rgs_next(File* file, int as_stored) {
  const Status s = file->paged ? next_leaf(*file) : next_chunks(*file, as_stored != 0);
  return s ? 0 : fail(s.error());
}

/// Chunk table and step sets of a whole file without levels: chunks [n_chunks, 48] and steps [n_step_sets, 48] bytes in rgs_rows().
RGS_EXPORT(rgs_tables) void rgs_tables(File* file) {
  const FileView& view = *file->view;
  rows = {.chunks = view.chunk_table().data(),
          .steps = view.step_table().data(),
          .n_chunks = static_cast<std::uint32_t>(view.header().n_chunks),
          .n_step_sets = static_cast<std::uint32_t>(view.header().n_step_sets)};
}

/// subject_box() of the known pages of a file with levels of detail, of one that is read early, or of a whole one: min and max in rgs_numbers().
RGS_EXPORT(rgs_subject_box) void rgs_subject_box(File* file) {
  numbers.clear();
  const auto& paged = file->paged;
  put_box(paged ? subject_box(std::span(paged->pages()).first(paged->n_pages())) : subject_box(*file->view));
}
/// The same of means [n, 3] and opacities [n].
RGS_EXPORT(rgs_subject_box_of)
void rgs_subject_box_of(const float* means, const float* opacities, std::uint32_t n) {
  numbers.clear();
  put_box(subject_box({means, std::size_t{3} * n}, {opacities, n}));
}

/// Positions of the Gaussians in the source, FP64 [n], in rgs_numbers(); returns 0 if the file keeps none.
RGS_EXPORT(rgs_source_index) int rgs_source_index(File* file) {
  const FileView& view = file->head();
  numbers.clear();
  if (view.find(SectionType::permutation) == nullptr) return 0;
  for (std::uint64_t i = 0; i < view.header().n_gaussians; ++i) put(view.source_index(i));
  return 1;
}

/// Bytes that the gzip stream of an .spz of version 2 or 3 may hold, by its first 16, in rgs_numbers().
RGS_EXPORT(rgs_spz_most) int rgs_spz_most(const std::byte* beginning, double file_bytes) {
  const auto header =
      detail::parse_spz_header({beginning, detail::kSpzHeaderBytes}, {}, static_cast<std::uint64_t>(file_bytes), true);
  if (!header) return fail(header.error());
  numbers.clear();
  put(detail::kSpzHeaderBytes + header->decoded_bytes() +
      (header->has_extensions() ? detail::kSpzMostExtensionBytes : 0));
  return 0;
}

/// spz_layout(): header, axes as codes, 0 if none are declared, then offset, stored and decoded bytes of each stream.
RGS_EXPORT(rgs_spz) int rgs_spz(const std::byte* bytes, std::uint32_t size, double file_bytes, int in_gzip) {
  const auto layout = detail::spz_layout({bytes, size}, {}, static_cast<std::uint64_t>(file_bytes), in_gzip != 0);
  if (!layout) return fail(layout.error());
  const detail::SpzHeader& h = layout->header;
  numbers.clear();
  put(h.version, h.n, h.sh_degree, h.fractional_bits, h.is_antialiased());
  for (const Axis axis : layout->extensions.axes.value_or(Axes{})) put(static_cast<int>(axis));
  for (const auto& stream : layout->streams) put(stream.offset, stream.stored_bytes, stream.decoded_bytes);
  return 0;
}

/// The content of Zstandard frames. Writes to their heads. 1: they are damaged, or it is not of that size.
RGS_EXPORT(rgs_decompress)
int rgs_decompress(std::byte* frames, std::uint32_t size, std::byte* content, std::uint32_t content_size) {
  while (size > 0) {
    // For a window of 2 GB the decoder asks for 64 bits. In memory it needs no window.
    constexpr std::byte kLargestWindow{21 << 3}, kLarge{20 << 3}, kIsSingle{0x20};
    std::uint32_t magic = 0;
    if (size > 5) std::memcpy(&magic, frames, sizeof magic);
    if (magic == ZSTD_MAGICNUMBER && (frames[4] & kIsSingle) == std::byte{} &&
        (frames[5] & std::byte{0xf8}) == kLargestWindow)
      frames[5] = kLarge;
    const std::size_t frame = ZSTD_findFrameCompressedSize(frames, size);
    const std::size_t n = ZSTD_isError(frame) != 0 ? frame : ZSTD_decompress(content, content_size, frames, frame);
    if (ZSTD_isError(n) != 0) return 1;
    frames += frame, size -= static_cast<std::uint32_t>(frame);
    content += n, content_size -= static_cast<std::uint32_t>(n);
  }
  return content_size == 0 ? 0 : 1;
}
