// levels_writer.cpp - encodes pages of Gaussians as a file with levels.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/levels_writer.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>
#include <numeric>
#include <optional>
#include <utility>

#include "archive/archive_encode.hpp"
#include "archive/archive_rows.hpp"
#include "file/byte_reader.hpp"
#include "file/byte_writer.hpp"
#include "file/encode_rows.hpp"
#include "file/layout_io.hpp"
#include "file/value_checks.hpp"
#include "file/workers.hpp"
#include "levels/levels_file.hpp"
#include "packed/frame_codec.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"

namespace rgs {

using namespace detail;

namespace {

// Means of a page above the leaves need no more precision than its error, which is at most a pixel wherever it is
// drawn. This loses at most a 512th of that, and packed stores the zeroed bytes for free.
void round_means(std::span<Splat> splats, float error) {
  int exponent = 0;
  std::frexp(error, &exponent);  // error < 2^exponent
  const double step = std::ldexp(1.0, exponent - 1 - 8);
  for (Splat& s : splats) {
    for (float& x : s.mean) x = static_cast<float>(std::nearbyint(static_cast<double>(x) / step) * step);
  }
}

Result<EncodePlan> plan_levels(const SceneScan& leaves, const EncodeOptions& options) {
  auto plan = make_plan(leaves, options);
  if (plan && plan->options.profile == Profile::archive && !options.chunk_step_sets) {
    return make_error(Errc::bad_argument, Error::kNone,
                      "archive with levels has a set of SH steps for each chunk: keep chunk_step_sets");
  }
  return plan;
}

// Origins for Gaussians whose means FP32 rounded, and their means relative to these, [n, 3], so that rounding these
// anew gives the same means.
struct NearMeans {
  std::vector<PageOrigin> origins;
  std::vector<float> means;
};

NearMeans near_means(std::span<const Splat> splats, float metres_per_unit) {
  NearMeans near;
  const auto has_rest = [](const Splat& s) { return std::ranges::any_of(s.mean_rest, [](float x) { return x != 0; }); };
  if (!std::ranges::any_of(splats, has_rest)) return near;
  // FP32 numbers below 4096 have steps of 2^-12: less than a quarter of a millimetre.
  const double unit = metres_per_unit > 0 ? static_cast<double>(metres_per_unit) : 1;
  const double reach = std::exp2(std::floor(std::log2(4096 / unit)));
  const auto is_near = [reach](float x, float origin) {
    const double from = static_cast<double>(origin), apart = std::fabs(static_cast<double>(x) - from);
    return apart <= (from != 0 ? std::min(reach, 0.5 * std::fabs(from)) : reach);
  };
  for (std::size_t i = 0; i < splats.size(); ++i) {
    const Splat& s = splats[i];
    bool fits = !near.origins.empty();
    for (std::size_t k = 0; k < 3 && fits; ++k) fits = is_near(s.mean[k], near.origins.back().offset[k]);
    constexpr std::size_t kMost = std::numeric_limits<std::uint16_t>::max();
    if (!fits && near.origins.size() < kMost) {
      PageOrigin& origin = near.origins.emplace_back();
      origin.first = static_cast<std::uint32_t>(i);
      const bool is_last = near.origins.size() == kMost;  // of a page of so many: FP32 alone for what is left
      for (std::size_t k = 0; k < 3; ++k) origin.offset[k] = is_last || is_near(s.mean[k], 0) ? 0 : s.mean[k];
    }
    for (std::size_t k = 0; k < 3; ++k) {
      const double mean = static_cast<double>(s.mean[k]), origin = static_cast<double>(near.origins.back().offset[k]);
      auto x = static_cast<float>(mean - origin + static_cast<double>(s.mean_rest[k]));
      // Half a step of the mean is a tie, which rounding anew may break the other way. Without its rest it is exact.
      if (static_cast<float>(origin + static_cast<double>(x)) != s.mean[k])
        x = std::nextafter(x, static_cast<float>(mean - origin));
      if (static_cast<float>(origin + static_cast<double>(x)) != s.mean[k]) x = static_cast<float>(mean - origin);
      near.means.push_back(x);
    }
  }
  return near;
}

struct PageBuffers {
  std::vector<Splat> splats;
  float smallest = 0, largest = 0;     // log-scale
  std::vector<std::byte> rows, frame;  // decoded, and coded
  EncodedPage encoded;
  ValueTotals totals;
  std::optional<FrameEncoder> encoder;
};

Status not_of_page() {
  return make_error(Errc::bad_argument, Error::kNone, "these are not the Gaussians of this page");
}

// The page's Gaussians as they will be encoded.
Status take_splats(const EncodePlan& plan, const lod::Page& page, const SplatView& splats, PageBuffers& b) {
  if (splats.n != page.count || !splats.consistent() || splats.sh_degree < plan.header.sh_degree) return not_of_page();
  const bool leaf = page.level == 0;
  b.splats.resize(splats.n);
  b.smallest = std::numeric_limits<float>::infinity();
  b.largest = -b.smallest;
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    Splat& s = b.splats[i] = splats.splat(i);
    const std::uint32_t defects = find_defects(s, plan.header.sh_degree);
    if (defects != 0 && !(leaf && plan.mends && repair(s, defects))) {
      return leaf ? source_changed()
                  : make_error(Errc::bad_value, i,
                               "a Gaussian above the finest level cannot be drawn: its mean or scale is beyond FP32");
    }
    for (const float value : s.log_scale) {
      b.smallest = std::min(b.smallest, value);
      b.largest = std::max(b.largest, value);
    }
  }
  return {};
}

// Those of a Splat before the SH that this degree does not have.
std::uint64_t splat_bytes(int sh_degree) {
  return offsetof(Splat, sh) + 3 * sizeof(float) * static_cast<std::uint64_t>(sh_coefficients(sh_degree));
}

// An archive codes all pages together: until then a page is its Gaussians' values.
void keep_splats(int sh_degree, PageBuffers& b) {
  const std::uint64_t bytes = splat_bytes(sh_degree);
  b.rows.resize(bytes * b.splats.size());
  for (std::size_t i = 0; i < b.splats.size(); ++i) std::memcpy(&b.rows[i * bytes], &b.splats[i], bytes);
  b.encoded.bytes = b.rows;
  b.encoded.xxh3 = xxh3(b.rows);
}

Status kept_splats(std::span<const std::byte> rows, int sh_degree, std::vector<Splat>& splats) {
  const std::uint64_t bytes = splat_bytes(sh_degree);
  if (rows.size() != bytes * splats.size()) return not_of_page();
  for (std::size_t i = 0; i < splats.size(); ++i) std::memcpy(&splats[i], &rows[i * bytes], bytes);
  return {};
}

// For every profile but archive.
Status encode_page(const EncodePlan& plan, const lod::Page& page, PageBuffers& b) {
  const bool leaf = page.level == 0;
  const int degree = plan.header.sh_degree;
  Header header = plan.header;
  if (!leaf) {
    round_means(b.splats, page.error);
    header.scale_exponent =
        static_cast<std::int16_t>(choose_scale_exponent(scale_from_log(b.smallest), scale_from_log(b.largest)));
  }
  const auto n = static_cast<std::uint32_t>(b.splats.size());
  const std::uint64_t n_chunks = chunks_of(n, header.chunk_size);
  const std::uint64_t n_sets = plan.options.chunk_step_sets ? n_chunks : 1;
  const PageLayout l = page_layout(n, header.chunk_size, n_sets, degree);
  b.rows.assign(l.bytes, std::byte{0});
  std::vector<ShStepSet> sets(n_chunks);
  ShMagnitudes of_page;
  if (!plan.options.chunk_step_sets) {
    for (const Splat& s : b.splats) of_page.add(s.sh, degree);
  }
  b.totals = {};
  ByteWriter entries, steps;
  for (std::uint64_t chunk = 0; chunk < n_chunks; ++chunk) {
    const std::uint64_t first = chunk * header.chunk_size;
    const auto part = std::span(b.splats).subspan(first, std::min<std::uint64_t>(header.chunk_size, n - first));
    if (plan.options.chunk_step_sets) {
      ShMagnitudes magnitudes;
      for (const Splat& s : part) magnitudes.add(s.sh, degree);
      sets[chunk] = magnitudes.steps();
    } else {
      sets[chunk] = leaf ? plan.file_steps : of_page.steps();
    }
    if (chunk < n_sets) write_step_set(steps, sets[chunk]);
    ChunkEntry entry = encode_rows(part, header, sets[chunk], &b.rows[l.means + first * kMeanBytes],
                                   &b.rows[l.geometry + first * kGeometryBytes],
                                   &b.rows[l.sh + first * sh_bytes(degree)], b.totals.counts);
    if (!std::isfinite(entry.radius)) return source_changed();
    entry.step_set = n_sets == 1 ? 0 : chunk;
    write_chunk_entry(entries, entry);
    b.totals.add({{}, entry.means, false});
  }
  std::ranges::copy(entries.bytes(), b.rows.begin() + static_cast<std::ptrdiff_t>(l.chunks));
  std::ranges::copy(steps.bytes(), b.rows.begin() + static_cast<std::ptrdiff_t>(l.steps));
  const PageRows rows = page_rows(b.rows, l, n, header.scale_exponent, degree);
  ExtentBox extent;
  for (std::uint64_t i = 0; i < n; ++i) {
    extent.add(extent_of(rows.means.data() + i * kMeanBytes, rows.geometry.data() + i * kGeometryBytes,
                         header.scale_exponent));
  }
  const NearMeans near =
      leaf && plan.options.page_origins ? near_means(b.splats, plan.options.metres_per_unit) : NearMeans();
  if (!near.origins.empty()) std::ranges::copy(std::as_bytes(std::span(near.means)), &b.rows[l.means]);
  b.encoded = {b.rows,
               0,
               static_cast<std::uint32_t>(n_sets),
               header.scale_exponent,
               {},
               extent.box(),
               static_cast<std::uint16_t>(near.origins.size())};
  if (plan.options.profile == Profile::packed) {
    if (!b.encoder) b.encoder.emplace(plan.options.level);
    b.frame = b.encoder->page(rows.steps, rows.means, rows.geometry, rows.sh, {degree, header.chunk_size, sets});
    b.encoded.bytes = b.frame;
  }
  if (!near.origins.empty()) {
    ByteWriter out;
    for (const PageOrigin& origin : near.origins) {
      out.u32(origin.first);
      for (const float x : origin.offset) out.f32(x);
    }
    std::vector<std::byte> stored = out.take();
    stored.insert(stored.end(), b.encoded.bytes.begin(), b.encoded.bytes.end());
    b.frame = std::move(stored);
    b.encoded.bytes = b.frame;
  }
  b.encoded.xxh3 = xxh3(b.encoded.bytes);
  return {};
}

// Records of PageEncoder: a head with its hash, then the stored page.
constexpr std::uint64_t kRecordHeadBytes = 4 + 4 + 4 + 4 + 24 + 24 + 32 + 8;

void write_box(ByteWriter& out, const Box& box) {
  for (const float x : box.min) out.f32(x);
  for (const float x : box.max) out.f32(x);
}

Box read_box(ByteReader& in) {
  Box box;
  for (float& x : box.min) x = in.f32();
  for (float& x : box.max) x = in.f32();
  return box;
}

std::vector<std::byte> write_record(const lod::Page& page, const PageBuffers& b) {
  ByteWriter out;
  out.u32(page.level);
  out.u32(page.count);
  out.u32(b.encoded.n_step_sets);
  out.i16(b.encoded.scale_exponent);
  out.u16(b.encoded.n_origins);
  write_box(out, b.encoded.extent);
  write_box(out, b.totals.full);
  out.u64(b.totals.counts.scale_subnormal);
  out.u64(b.totals.counts.scale_zero);
  out.u64(b.totals.counts.opacity_zero);
  out.u64(b.totals.counts.opacity_one);
  out.u64(b.encoded.xxh3);
  assert(out.bytes().size() == kRecordHeadBytes);
  out.u64(xxh3(out.bytes()));
  std::vector<std::byte> record = out.take();
  record.insert(record.end(), b.encoded.bytes.begin(), b.encoded.bytes.end());
  return record;
}

Status read_record(std::span<const std::byte> record, const lod::Page& page, EncodedPage& encoded,
                   ValueTotals& totals) {
  ByteReader in(record);
  const std::uint32_t level = in.u32(), count = in.u32();
  encoded.n_step_sets = in.u32();
  encoded.scale_exponent = in.i16();
  encoded.n_origins = in.u16();
  encoded.extent = read_box(in);
  totals = {{}, read_box(in), false};
  totals.counts.scale_subnormal = in.u64();
  totals.counts.scale_zero = in.u64();
  totals.counts.opacity_zero = in.u64();
  totals.counts.opacity_one = in.u64();
  encoded.xxh3 = in.u64();
  const std::uint64_t hash = in.u64();
  if (!in.ok()) return make_error(Errc::truncated, record.size(), "the record of an encoded page ends too early");
  encoded.bytes = record.subspan(kRecordHeadBytes + 8);
  if (xxh3(record.first(kRecordHeadBytes)) != hash || xxh3(encoded.bytes) != encoded.xxh3) {
    return make_error(Errc::checksum_mismatch, Error::kNone, "the record of an encoded page is damaged");
  }
  if (level != page.level || count != page.count) {
    return make_error(Errc::bad_argument, Error::kNone, "the record belongs to another page", page.count, count);
  }
  return {};
}

}  // namespace

struct LevelsWriter::State {
  EncodePlan plan;
  PageTable table;                  // Profile::archive, until it is written
  std::optional<LevelsFile> file;   // other profiles
  std::optional<ArchiveRows> rows;  // Profile::archive
  ValueTotals leaves;
  std::size_t n_added = 0;
  Status status;  // of the first add() that failed

  const std::vector<lod::Page>& pages() const { return file ? file->pages() : table.pages; }
  bool archive() const { return plan.options.profile == Profile::archive; }
};

struct LevelsWriter::Encoder::State {
  std::uint32_t page = lod::kNoPage;
  PageBuffers buffers;
};

struct PageEncoder::State {
  EncodePlan plan;
  PageBuffers buffers;
  std::vector<std::byte> record;
};

LevelsWriter::LevelsWriter(std::unique_ptr<State> state) : state_(std::move(state)) {}
LevelsWriter::LevelsWriter(LevelsWriter&& other) noexcept = default;
LevelsWriter::~LevelsWriter() = default;

Result<LevelsWriter> LevelsWriter::create(Sink sink, const SceneScan& leaves, const EncodeOptions& options,
                                          std::vector<lod::Page> pages, float quality_db) {
  return guard_memory([&]() -> Result<LevelsWriter> {
    const auto bad = [](const char* what) { return make_error(Errc::bad_argument, Error::kNone, what); };
    if (leaves.n_kept() == 0) return bad("a scene without Gaussians has no levels: write it as a file without");
    auto plan = plan_levels(leaves, options);
    if (!plan) return tl::unexpected(plan.error());
    std::uint64_t first = 0, n_leaves = 0;
    for (lod::Page& page : pages) {
      if (chunks_of(page.count, options.chunk_size) * options.chunk_size > lod::kMaxPageRows) {
        return bad("a page has more than 65,536 Gaussians");
      }
      if (options.profile == Profile::archive && page.count > kMaxArchiveRows) {
        return bad("a page of an archive has more than 32,768 Gaussians");
      }
      page.first = first;
      first += page.count;
      n_leaves += page.level == 0 ? page.count : 0;
    }
    if (const Status s = lod::check_pages(pages, options.chunk_size); !s) {
      return make_error(Errc::bad_argument, s.error().offset, s.error().what);
    }
    if (n_leaves != leaves.n_kept()) {
      return make_error(Errc::bad_argument, Error::kNone, "the leaves differ from the scan's Gaussians",
                        leaves.n_kept(), n_leaves);
    }
    if (!(quality_db >= 0 && std::isfinite(quality_db))) return bad("the quality of pages is negative or not finite");
    auto state = std::make_unique<State>(State{*std::move(plan), {}, {}, {}, {}, 0, {}});
    PageTable table;
    table.pages = std::move(pages);
    table.quality_db = quality_db;
    table.page_chunks = most_chunks(table.pages, options.chunk_size);
    if (state->archive()) {
      auto rows = ArchiveRows::create(sink, first, state->plan.header.sh_degree);
      if (!rows) return tl::unexpected(rows.error());
      state->rows = *std::move(rows);
      state->table = std::move(table);
    } else {
      state->file.emplace(sink, state->plan, std::move(table), std::span<const std::byte>());
    }
    return LevelsWriter(std::move(state));
  });
}

const std::vector<lod::Page>& LevelsWriter::pages() const {
  return state_->pages();
}

Status LevelsWriter::add(const Encoder& page) {
  State& s = *state_;
  if (!s.status) return s.status;
  if (!page.status_) return s.status = page.status_;
  if (!page.state_ || page.writer_ != state_.get() || page.state_->page != s.n_added) {
    return s.status = make_error(Errc::bad_argument, Error::kNone, "not the next page of this writer");
  }
  ++s.n_added;
  if (s.archive()) return {};
  if (s.pages()[page.state_->page].level == 0) s.leaves.add(page.state_->buffers.totals);
  return s.status = guard_memory([&] { return s.file->add(page.state_->buffers.encoded); });
}

Status LevelsWriter::add(std::span<const std::byte> record) {
  State& s = *state_;
  if (!s.status) return s.status;
  return s.status = guard_memory([&]() -> Status {
           if (s.n_added == s.pages().size()) {
             return make_error(Errc::bad_argument, Error::kNone, "not the next page of this writer");
           }
           EncodedPage encoded;
           ValueTotals totals;
           const lod::Page& page = s.pages()[s.n_added];
           if (Status read = read_record(record, page, encoded, totals); !read) return read;
           ++s.n_added;
           if (s.archive()) {
             std::vector<Splat> splats(page.count);
             if (Status kept = kept_splats(encoded.bytes, s.plan.header.sh_degree, splats); !kept) return kept;
             return s.rows->set(page.first, splats);
           }
           if (page.level == 0) s.leaves.add(totals);
           return s.file->add(encoded);
         });
}

Result<WrittenScene> LevelsWriter::finish() {
  State& s = *state_;
  if (!s.status) return tl::unexpected(s.status.error());
  if (s.n_added != s.pages().size()) {
    return make_error(Errc::bad_argument, Error::kNone, "pages are missing", s.pages().size(), s.n_added);
  }
  return guard_memory([&]() -> Result<WrittenScene> {
    const EncodeOptions& o = s.plan.options;
    const bool is_numbered = s.archive() || (o.keep_permutation && o.source_index.empty());
    std::vector<std::uint32_t> given(is_numbered ? s.plan.header.n_gaussians : 0);
    std::iota(given.begin(), given.end(), 0u);
    if (s.archive()) {
      const auto splats = s.rows->view();
      if (!splats) return tl::unexpected(splats.error());
      std::vector<std::byte> file;
      auto written = write_archive_levels(file, s.plan, *splats, s.table, given);
      if (!written) return written;
      if (Status replaced = s.rows->replace(file); !replaced) return tl::unexpected(replaced.error());
      return written;
    }
    Declarations d = s.plan.declarations;
    if (s.leaves.full.min != d.full.min || s.leaves.full.max != d.full.max) {
      return tl::unexpected(source_changed().error());
    }
    s.leaves.counts.declare(d);
    // Not copied: 4 bytes a Gaussian.
    const bool is_mapped = o.keep_permutation && !o.source_index.empty();
    return s.file->finish(d, is_mapped ? o.source_index : std::span<const std::uint32_t>(given));
  });
}

LevelsWriter::Encoder::Encoder(LevelsWriter& writer) : writer_(writer.state_.get()) {}
LevelsWriter::Encoder::Encoder(Encoder&& other) noexcept = default;
LevelsWriter::Encoder::~Encoder() = default;

Status LevelsWriter::Encoder::encode(std::uint32_t page, const SplatView& splats) {
  return status_ = guard_memory([&]() -> Status {
           const EncodePlan& plan = writer_->plan;
           if (page >= writer_->pages().size()) return not_of_page();
           if (!state_) state_ = std::make_unique<State>();
           PageBuffers& b = state_->buffers;
           const lod::Page& p = writer_->pages()[page];
           state_->page = page;
           if (Status s = take_splats(plan, p, splats, b); !s) return s;
           return writer_->archive() ? writer_->rows->set(p.first, b.splats) : encode_page(plan, p, b);
         });
}

PageEncoder::PageEncoder(std::unique_ptr<State> state) : state_(std::move(state)) {}
PageEncoder::PageEncoder(PageEncoder&& other) noexcept = default;
PageEncoder::~PageEncoder() = default;

Result<PageEncoder> PageEncoder::create(const SceneScan& leaves, const EncodeOptions& options) {
  return guard_memory([&]() -> Result<PageEncoder> {
    auto plan = plan_levels(leaves, options);
    if (!plan) return tl::unexpected(plan.error());
    return PageEncoder(std::make_unique<State>(State{*std::move(plan), {}, {}}));
  });
}

Result<std::span<const std::byte>> PageEncoder::encode(const lod::Page& page, const SplatView& splats) {
  return guard_memory([&]() -> Result<std::span<const std::byte>> {
    State& s = *state_;
    if (Status taken = take_splats(s.plan, page, splats, s.buffers); !taken) return tl::unexpected(taken.error());
    if (s.plan.options.profile == Profile::archive) {
      keep_splats(s.plan.header.sh_degree, s.buffers);
    } else if (Status coded = encode_page(s.plan, page, s.buffers); !coded) {
      return tl::unexpected(coded.error());
    }
    s.record = write_record(page, s.buffers);
    return std::span<const std::byte>(s.record);
  });
}

Result<WrittenScene> write_levels(const lod::Levels& levels, const EncodeOptions& options, Sink sink,
                                  unsigned threads) {
  return guard_memory([&]() -> Result<WrittenScene> {
    const SplatView all = levels.splats.view();
    const auto view = [&all](std::uint64_t first, std::uint64_t count) {
      const auto values = static_cast<std::uint64_t>(3 * sh_coefficients(all.sh_degree));
      return SplatView{count,
                       all.sh_degree,
                       all.mean.subspan(3 * first, 3 * count),
                       all.log_scale.subspan(3 * first, 3 * count),
                       all.rotation.subspan(4 * first, 4 * count),
                       all.opacity_logit.subspan(first, count),
                       all.sh.subspan(values * first, values * count),
                       all.mean_rest.empty() ? all.mean_rest : all.mean_rest.subspan(3 * first, 3 * count)};
    };
    std::uint64_t n = 0;
    for (const lod::Page& page : levels.pages) n += page.count;
    if (n != all.n || !all.consistent()) {
      return make_error(Errc::bad_argument, Error::kNone, "the pages' counts differ from the levels' Gaussians", all.n,
                        n);
    }
    SceneScan scan(std::min(all.sh_degree, options.sh_degree), BadPolicy::refuse);
    for (std::uint64_t i = all.n - levels.n_leaves(); i < all.n; ++i) {
      Splat s = all.splat(i);
      scan.add(s);
    }
    auto writer = LevelsWriter::create(sink, scan, options, levels.pages, levels.quality_db);
    if (!writer) return tl::unexpected(writer.error());
    // Group by group: encodes its pages side by side, then writes them in order.
    const std::uint64_t group = 8 * std::uint64_t{worker_count(levels.pages.size(), threads)};
    std::vector<LevelsWriter::Encoder> encoders;
    for (std::uint64_t i = 0; i < group; ++i) encoders.emplace_back(*writer);
    for (std::uint64_t first = 0; first < levels.pages.size(); first += group) {
      const std::uint64_t count = std::min<std::uint64_t>(group, levels.pages.size() - first);
      const Status encoded = run_jobs(count, threads, [&](unsigned, std::uint64_t i) {
        const lod::Page& page = writer->pages()[first + i];
        return encoders[i].encode(static_cast<std::uint32_t>(first + i), view(page.first, page.count));
      });
      if (!encoded) return tl::unexpected(encoded.error());
      for (std::uint64_t i = 0; i < count; ++i) {
        if (const Status s = writer->add(encoders[i]); !s) return tl::unexpected(s.error());
      }
    }
    return writer->finish();
  });
}

}  // namespace rgs
