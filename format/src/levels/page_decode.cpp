// page_decode.cpp - decodes a page's stored bytes to rows, and rows to Gaussians.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <bit>
#include <cassert>
#include <cmath>
#include <cstring>
#include <utility>

#include "archive/archive_codec.hpp"
#include "file/layout_io.hpp"
#include "file/read_rows.hpp"
#include "file/value_checks.hpp"
#include "levels/page_table.hpp"
#include "packed/frame_codec.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/paged_file.hpp"

namespace rgs {

using namespace detail;

struct PageDecoder::State {
  explicit State(const PagedFile& paged) : file(paged) {
    if (is_archive(file.codec())) archive.emplace(*archive_tables(file.head()));
  }

  const PagedFile& file;
  FrameDecoder frame;
  std::optional<ArchiveDecoder> archive;
  std::vector<ShStepSet> steps;

  Status packed(std::uint32_t page, std::span<const std::byte> bytes, const PageLayout& l, std::span<std::byte> out);
  Status lossy(std::uint32_t page, std::span<const std::byte> bytes, const PageLayout& l, std::span<std::byte> out);
};

PageDecoder::PageDecoder(const PagedFile& file) : state_(std::make_unique<State>(file)) {}
PageDecoder::PageDecoder(PageDecoder&&) noexcept = default;
PageDecoder& PageDecoder::operator=(PageDecoder&&) noexcept = default;
PageDecoder::~PageDecoder() = default;

// One frame: steps and means as words, geometry, SH.
Status PageDecoder::State::packed(std::uint32_t page, std::span<const std::byte> bytes, const PageLayout& l,
                                  std::span<std::byte> out) {
  const Header& h = file.head().header();
  const StoredPage& stored = file.stored(page);
  const std::uint32_t n = file.pages()[page].count, n_sets = stored.n_step_sets;
  const auto codes = static_cast<std::size_t>(3 * sh_coefficients(h.sh_degree));
  const std::size_t step_bytes = n_sets * kStepSetBytes, mean_bytes = n * kMeanBytes,
                    geometry_bytes = n * kGeometryBytes,
                    sh_content = sh_weight_bytes(static_cast<int>(codes)) + codes * n;
  const auto inflated = frame.content(bytes, stored.offset, step_bytes + mean_bytes + geometry_bytes + sh_content);
  if (!inflated) return tl::unexpected(inflated.error());
  std::span<const std::uint8_t> content = *inflated;
  const auto take = [&content](std::size_t size) { return std::exchange(content, content.subspan(size)).first(size); };
  decode_word_planes(take(step_bytes), n_sets, kStepSetBytes, out.subspan(l.steps, step_bytes));
  decode_word_planes(take(mean_bytes), n, kMeanBytes, out.subspan(l.means, mean_bytes));
  decode_geometry_planes(take(geometry_bytes), n, out.subspan(l.geometry, geometry_bytes));
  steps.clear();
  for (std::size_t i = 0; i < chunks_of(n, h.chunk_size); ++i) {
    const std::size_t set = n_sets == 1 ? 0 : i;
    steps.push_back(parse_step_set(out.subspan(l.steps + set * kStepSetBytes, kStepSetBytes)));
    if (Status s = check_step_set(steps.back(), h.sh_degree, stored.offset, true); !s) return s;
  }
  const auto rows = out.subspan(l.sh, n * sh_bytes(h.sh_degree));
  decode_sh_planes(frame.lanes(), take(sh_content), n, {h.sh_degree, h.chunk_size, steps}, rows);
  return {};
}

// Codec::archive: one stream. Codec::archive_draco: sizes of the first two of three streams, then the streams.
Status PageDecoder::State::lossy(std::uint32_t page, std::span<const std::byte> bytes, const PageLayout& l,
                                 std::span<std::byte> out) {
  const Header& h = file.head().header();
  const StoredPage& stored = file.stored(page);
  const std::uint32_t n = file.pages()[page].count;
  FrameStreams streams{{bytes, stored.offset}, {{}, stored.offset}, {{}, stored.offset}, true};
  if (file.codec() == Codec::archive_draco) {
    streams.one = false;
    ByteReader in(bytes);
    const std::uint32_t mean_bytes = in.u32(), geometry_bytes = in.u32();
    streams.means.bytes = in.bytes(mean_bytes), streams.geometry.bytes = in.bytes(geometry_bytes);
    if (!in.ok()) return make_error(Errc::corrupt_data, stored.offset, "a page ends inside its streams");
    streams.sh.bytes = in.bytes(in.remaining());
  }
  if (Status s = archive->codes(streams, n, static_cast<int>(file.pages()[page].level), stored.corner); !s) return s;
  archive->rows(stored.scale_exponent, out.subspan(l.means, n * kMeanBytes),
                out.subspan(l.geometry, n * kGeometryBytes));
  archive->sh_and_steps(h.sh_degree, h.chunk_size, out.subspan(l.steps, l.means - l.steps),
                        out.subspan(l.sh, n * sh_bytes(h.sh_degree)));
  return {};
}

namespace {

Result<std::vector<PageOrigin>> read_origins(const PagedFile& file, std::uint32_t page,
                                             std::span<const std::byte> stored) {
  std::vector<PageOrigin> origins(file.stored(page).n_origins);
  if (stored.size() < origins.size() * kPageOriginBytes)
    return make_error(Errc::corrupt_data, file.stored(page).offset, "a page ends inside its origins");
  ByteReader in(stored, file.stored(page).offset);
  std::uint64_t least = 0, most = 0;  // of `first`: 0, then beyond the one before
  for (PageOrigin& origin : origins) {
    const std::uint64_t at = in.offset();
    origin.first = in.u32();
    for (float& x : origin.offset) x = in.f32();
    const bool is_finite = std::ranges::all_of(origin.offset, [](float x) { return std::isfinite(x); });
    if (!is_finite || origin.first < least || origin.first > most)
      return make_error(Errc::corrupt_data, at, "an origin of a page is not finite, or its first row is not in order");
    least = std::uint64_t{origin.first} + 1;
    most = file.pages()[page].count - 1;
  }
  return origins;
}

// Makes means relative to the file's origin.
void place_means(std::span<const PageOrigin> origins, std::span<std::byte> means, std::vector<float>* rests) {
  std::array<double, 3> from{};
  for (std::size_t i = 0; i < means.size() / kMeanBytes; ++i) {
    if (!origins.empty() && origins.front().first == i) {
      std::ranges::copy(origins.front().offset, from.begin());
      origins = origins.subspan(1);
    }
    float mean[3];
    std::memcpy(mean, &means[i * kMeanBytes], sizeof mean);
    for (std::size_t k = 0; k < 3; ++k) {
      const double x = from[k] + static_cast<double>(mean[k]);
      mean[k] = static_cast<float>(x);
      if (rests != nullptr) rests->push_back(static_cast<float>(x - static_cast<double>(mean[k])));
    }
    std::memcpy(&means[i * kMeanBytes], mean, sizeof mean);
  }
}

}  // namespace

Result<PageRows> PageDecoder::decode(std::uint32_t page, std::span<const std::byte> bytes, std::span<std::byte> out,
                                     std::vector<float>* rests) {
  return guard_memory([&]() -> Result<PageRows> {
    State& s = *state_;
    const PagedFile& file = s.file;
    const StoredPage& stored = file.stored(page);
    const Header& h = file.head().header();
    const std::uint32_t n = file.pages()[page].count;
    const PageLayout l = page_layout(n, h.chunk_size, stored.n_step_sets, h.sh_degree);
    assert(out.size() == l.bytes);
    if (bytes.size() != stored.stored_bytes) {
      return make_error(Errc::size_mismatch, stored.offset, "these are not the stored bytes of this page",
                        stored.stored_bytes, bytes.size());
    }
    if (const std::uint64_t hash = xxh3(bytes); hash != stored.xxh3) {
      return make_error(Errc::checksum_mismatch, stored.offset, "a page's checksum does not match", stored.xxh3, hash);
    }
    const auto origins = read_origins(file, page, bytes);
    if (!origins) return tl::unexpected(origins.error());
    bytes = bytes.subspan(origins->size() * kPageOriginBytes);
    if (rests != nullptr) rests->clear();
    const auto place = [&] {
      if (!origins->empty()) place_means(*origins, out.subspan(l.means, n * kMeanBytes), rests);
    };
    if (file.codec() == Codec::none) {
      std::ranges::copy(bytes, out.begin());
      place();
    } else {
      for (const auto& [end, next] :
           {std::pair(l.means + n * kMeanBytes, l.geometry), std::pair(l.sh + n * sh_bytes(h.sh_degree), l.bytes)}) {
        std::memset(out.data() + end, 0, next - end);
      }
      const Status decoded =
          file.codec() == Codec::planes ? s.packed(page, bytes, l, out) : s.lossy(page, bytes, l, out);
      if (!decoded) return tl::unexpected(decoded.error());
      place();
      derive_chunks(out, l, n, h.chunk_size, stored.n_step_sets, stored.scale_exponent);
    }
    return page_rows(out, l, n, stored.scale_exponent, h.sh_degree);
  });
}

namespace {

// Entry and steps of a chunk of a decoded page, and their offsets in the file.
struct ChunkOfPage {
  ChunkEntry entry;
  ShStepSet steps;
};

// Offset in the file of a byte of the decoded page; of the page if it is coded.
std::uint64_t place_in_page(const PagedFile& file, std::uint32_t page, std::uint64_t decoded_offset) {
  const StoredPage& stored = file.stored(page);
  return stored.offset + (file.codec() == Codec::none ? stored.n_origins * kPageOriginBytes + decoded_offset : 0);
}

Result<ChunkOfPage> chunk_of_page(const PagedFile& file, std::uint32_t page, const PageRows& rows,
                                  std::uint64_t chunk) {
  const Header& h = file.head().header();
  const StoredPage& stored = file.stored(page);
  const PageLayout l = page_layout(rows.n, h.chunk_size, stored.n_step_sets, h.sh_degree);
  const bool coded = file.codec() != Codec::none;
  const std::uint64_t at = place_in_page(file, page, l.chunks + chunk * kChunkEntryBytes);
  const auto entry = parse_chunk_entry(rows.chunks.subspan(chunk * kChunkEntryBytes, kChunkEntryBytes), at);
  if (!entry) {
    Error error = entry.error();
    if (coded) error.offset = at;
    return tl::unexpected(error);
  }
  const std::uint64_t first = chunk * h.chunk_size, expected = std::min<std::uint64_t>(h.chunk_size, rows.n - first);
  if (entry->count != expected) {
    return make_error(Errc::bad_value, at + (coded ? 0 : 40), "a chunk's count contradicts its page", expected,
                      entry->count);
  }
  const std::uint64_t set = stored.n_step_sets == 1 ? 0 : chunk;
  if (entry->step_set != set) {
    return make_error(Errc::bad_value, at + (coded ? 0 : 32),
                      "a chunk's step set does not match its position in the page", set, entry->step_set);
  }
  const ShStepSet steps = parse_step_set(rows.steps.subspan(set * kStepSetBytes, kStepSetBytes));
  const Status legal =
      check_step_set(steps, h.sh_degree, place_in_page(file, page, l.steps + set * kStepSetBytes), coded);
  if (!legal) return tl::unexpected(legal.error());
  return ChunkOfPage{*entry, steps};
}

template <class T>
Status read_rows_of_page(const PagedFile& file, std::uint32_t page, const PageRows& rows, std::uint32_t first,
                         std::span<T> out) {
  const Header& h = file.head().header();
  assert(first <= rows.n && out.size() <= rows.n - first);
  RowReader reader(h.sh_degree, rows.scale_exponent, {rows.means, rows.geometry, rows.sh});
  std::uint64_t loaded = ~std::uint64_t{0};
  for (std::size_t k = 0; k < out.size(); ++k) {
    const std::uint64_t i = first + k;
    if (i / h.chunk_size != loaded) {
      loaded = i / h.chunk_size;
      const auto chunk = chunk_of_page(file, page, rows, loaded);
      if (!chunk) return tl::unexpected(chunk.error());
      reader.use(chunk->steps);
    }
    reader.read(i, out[k]);
  }
  return {};
}

}  // namespace

Status read_page(const PagedFile& file, std::uint32_t page, const PageRows& rows, std::uint32_t first,
                 std::span<Splat> out) {
  return read_rows_of_page(file, page, rows, first, out);
}

Status read_page(const PagedFile& file, std::uint32_t page, const PageRows& rows, std::uint32_t first,
                 std::span<ActivatedSplat> out) {
  return read_rows_of_page(file, page, rows, first, out);
}

Status detail::check_page_rows(const PagedFile& file, std::uint32_t page, const PageRows& rows, ValueTotals& totals) {
  const Header& h = file.head().header();
  const StoredPage& stored = file.stored(page);
  const PageLayout l = page_layout(rows.n, h.chunk_size, stored.n_step_sets, h.sh_degree);
  for (std::uint64_t chunk = 0; chunk < chunks_of(rows.n, h.chunk_size); ++chunk) {
    const auto of = chunk_of_page(file, page, rows, chunk);
    if (!of) return tl::unexpected(of.error());
    const std::uint64_t first = chunk * h.chunk_size;
    const auto place = [&](SectionType type, std::uint64_t row, std::uint64_t byte) {
      const std::uint64_t at = type == SectionType::chunks     ? l.chunks + chunk * kChunkEntryBytes
                               : type == SectionType::means    ? l.means + (first + row) * kMeanBytes
                               : type == SectionType::geometry ? l.geometry + (first + row) * kGeometryBytes
                                                               : l.sh + (first + row) * sh_bytes(h.sh_degree);
      return place_in_page(file, page, at + byte);
    };
    const ChunkRows chunk_rows{rows.means.data() + first * kMeanBytes,
                               rows.geometry.data() + first * kGeometryBytes,
                               rows.sh.data() + first * sh_bytes(h.sh_degree),
                               h.sh_degree,
                               rows.scale_exponent,
                               place};
    if (Status s = check_chunk_rows(chunk_rows, of->entry, of->steps, totals); !s) return s;
  }
  // The box may be short of an extent by what rounding can cost.
  const Box& box = file.pages()[page].bounds;
  const RoomInBox room(box, rows.scale_exponent);
  const std::byte *const means = rows.means.data(), *const geometry = rows.geometry.data();
  for (std::uint64_t first = 0; first < rows.n; first += 64) {
    std::uint64_t left = room.undecided(means + first * kMeanBytes, geometry + first * kGeometryBytes,
                                        std::min<std::uint64_t>(64, rows.n - first));
    for (; left != 0; left &= left - 1) {
      const std::uint64_t i = first + static_cast<std::uint64_t>(std::countr_zero(left));
      const std::byte *const mean = means + i * kMeanBytes, *const row = geometry + i * kGeometryBytes;
      if (room.is_enough(mean, row)) continue;
      const Extent e = extent_of(mean, row, rows.scale_exponent);
      for (std::size_t k = 0; k < 3; ++k) {
        if (e.mean[k] - kExtentShare * e.reach[k] >= static_cast<double>(box.min[k]) &&
            e.mean[k] + kExtentShare * e.reach[k] <= static_cast<double>(box.max[k])) {
          continue;
        }
        return make_error(Errc::bad_value, place_in_page(file, page, l.means + i * kMeanBytes + 4 * k),
                          "a Gaussian reaches beyond its page's box");
      }
    }
  }
  return {};
}

Status check_page_values(const PagedFile& file, std::uint32_t page, const PageRows& rows) {
  return guard_memory([&] {
    ValueTotals totals;
    return check_page_rows(file, page, rows, totals);
  });
}

}  // namespace rgs
