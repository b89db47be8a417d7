// info_report.cpp - collects what rgs-info prints: tables always, the payload only if asked.
// SPDX-License-Identifier: Apache-2.0
#include "info_report.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numbers>

#include "rgs/checksum.hpp"
#include "rgs/encode.hpp"
#include "rgs/ply.hpp"
#include "rgs/quantize.hpp"

namespace rgs::tool {
namespace {

struct Sample {
  float value;
  std::uint64_t count;
};

Distribution distribution(std::vector<Sample> samples, bool logarithmic) {
  Distribution d;
  d.logarithmic = logarithmic;
  std::ranges::sort(samples, {}, &Sample::value);
  for (const Sample& s : samples) {
    d.n += s.count;
    d.n_zero += s.value == 0 ? s.count : 0;
  }
  if (d.n == 0) return d;
  std::uint64_t below = 0;
  const auto middle =
      std::ranges::find_if(samples, [&](const Sample& s) { return (below += s.count) > (d.n - 1) / 2; });
  d.spread = {samples.front().value, middle->value, samples.back().value};

  if (logarithmic) {
    const auto positive = std::ranges::find_if(samples, [](const Sample& s) { return s.value > 0; });
    if (positive == samples.end()) return d;
    d.low = std::floor(std::log10(static_cast<double>(positive->value)));
    d.high = std::max(d.low + 1, std::ceil(std::log10(static_cast<double>(d.spread.max))));
  }
  for (const Sample& s : samples) {
    if (logarithmic && s.value == 0) continue;
    const double x = logarithmic ? std::log10(static_cast<double>(s.value)) : static_cast<double>(s.value);
    const auto bin = static_cast<std::size_t>((x - d.low) / (d.high - d.low) * static_cast<double>(kInfoBins));
    d.bins[std::min(bin, kInfoBins - 1)] += s.count;
  }
  return d;
}

// FP16 and INT8 codes are few enough to count each: figures are exact for any size of file.
class CodeCounter {
 public:
  explicit CodeCounter(const FileView& view)
      : view_(view),
        floats_(static_cast<std::size_t>(3 * sh_coefficients(view.header().sh_degree))),
        opacity_(kHalfCodes),
        scale_(kHalfCodes) {}

  Status add_chunk(const DirectData& data, std::uint64_t index) {
    const auto entry = view_.chunk(index);
    if (!entry) return tl::unexpected(entry.error());
    const auto steps = view_.step_set(entry->step_set);
    if (!steps) return tl::unexpected(steps.error());
    const std::uint64_t row = index * view_.header().chunk_size - data.first();
    add_geometry(data.geometry().data() + row * kGeometryBytes, entry->count);
    const auto* codes = reinterpret_cast<const std::int8_t*>(data.sh().data());
    add_sh(codes + row * sh_bytes(view_.header().sh_degree), entry->count, *steps);
    return {};
  }

  ValueStatistics result() const {
    ValueStatistics v;
    const auto legal = [&v](const std::vector<std::uint64_t>& counts, std::size_t largest, int exponent) {
      std::vector<Sample> samples;
      for (std::size_t code = 0; code < counts.size(); ++code) {
        if (counts[code] == 0) continue;
        if (code > largest) {
          v.n_illegal += counts[code];
        } else {
          samples.push_back({dequantize_scale(static_cast<std::uint16_t>(code), exponent), counts[code]});
        }
      }
      return samples;
    };
    v.opacity = distribution(legal(opacity_, 0x3C00, 0), false);
    v.scale = distribution(legal(scale_, 0x7BFF, view_.header().scale_exponent), true);
    for (std::size_t degree = 0; degree <= view_.header().sh_degree; ++degree) {
      v.sh.push_back(sh_codes(degree));
      for (const auto& channel : sh_[degree]) v.n_illegal += channel[kIllegal];
    }
    return v;
  }

 private:
  static constexpr std::size_t kHalfCodes = 65536, kIllegal = 128;  // bit pattern of -128

  void add_geometry(const std::byte* row, std::uint64_t count) {
    for (std::uint64_t i = 0; i < count; ++i, row += kGeometryBytes) {
      std::uint16_t codes[8];
      std::memcpy(codes, row, kGeometryBytes);
      for (int k = 4; k < 7; ++k) ++scale_[codes[k]];
      ++opacity_[codes[7]];
    }
  }

  void add_sh(const std::int8_t* row, std::uint64_t count, const ShStepSet& steps) {
    const std::uint64_t stride = sh_bytes(view_.header().sh_degree);
    std::array<std::int8_t, 48> low, high;
    low.fill(kShCodeMax);
    high.fill(-kShCodeMax);
    for (std::uint64_t i = 0; i < count; ++i, row += stride) {
      for (std::size_t j = 0; j < floats_; ++j) {
        low[j] = std::min(low[j], row[j]);
        high[j] = std::max(high[j], row[j]);
      }
      for (std::size_t j = 0; j < floats_; ++j) {
        ++sh_[static_cast<std::size_t>(sh_degree_of(static_cast<int>(j / 3)))][j % 3]
             [static_cast<std::uint8_t>(row[j])];
      }
    }
    for (std::size_t j = 0; j < floats_; ++j) {
      const auto degree = static_cast<std::size_t>(sh_degree_of(static_cast<int>(j / 3)));
      const float step = steps.step[degree][j % 3];
      low_[degree][j % 3] = std::min(low_[degree][j % 3], dequantize_sh(low[j], step));
      high_[degree][j % 3] = std::max(high_[degree][j % 3], dequantize_sh(high[j], step));
    }
  }

  ShCodes sh_codes(std::size_t degree) const {
    ShCodes s;
    s.min = low_[degree];
    s.max = high_[degree];
    std::array<std::uint64_t, 256> counts{};
    for (const auto& channel : sh_[degree]) {
      for (std::size_t code = 0; code < counts.size(); ++code) counts[code] += code == kIllegal ? 0 : channel[code];
    }
    for (std::size_t code = 0; code < counts.size(); ++code) {
      const std::size_t magnitude = std::min(code, 256 - code);
      s.n += counts[code];
      if (code != kIllegal) s.bins[magnitude / 4] += counts[code];
    }
    s.n_zero = counts[0];
    s.n_limit = counts[kShCodeMax] + counts[256 - kShCodeMax];
    for (const std::uint64_t count : counts) {
      if (count == 0) continue;
      const double share = static_cast<double>(count) / static_cast<double>(s.n);
      s.entropy_bits -= share * std::log2(share);
    }
    if (s.n == s.n_zero) s.entropy_bits = 0;  // not -0
    return s;
  }

  const FileView& view_;
  std::size_t floats_;
  std::vector<std::uint64_t> opacity_, scale_;
  // Separate counters per channel: consecutive increments of one counter would stall.
  std::array<std::array<std::array<std::uint64_t, 256>, 3>, 4> sh_{};
  std::array<std::array<float, 3>, 4> low_{}, high_{};
};

Result<ValueStatistics> value_statistics(const FileView& view, std::uint64_t first_chunk, std::uint64_t end_chunk) {
  const Header& h = view.header();
  CodeCounter counter(view);
  // In pieces, so that coded sections are never decoded whole.
  const std::uint64_t piece = std::max(1u, (1u << 20) / h.chunk_size);
  for (std::uint64_t first = first_chunk; first < end_chunk; first += piece) {
    const std::uint64_t end = std::min(end_chunk, first + piece);
    const auto data = read_chunks(view, first, end - first, {.validate = false});
    if (!data) return tl::unexpected(data.error());
    for (std::uint64_t i = first; i < end; ++i) {
      if (const Status s = counter.add_chunk(*data, i); !s) return tl::unexpected(s.error());
    }
  }
  ValueStatistics v = counter.result();
  v.first = std::min(first_chunk * h.chunk_size, h.n_gaussians);
  v.n = std::min(end_chunk * h.chunk_size, h.n_gaussians) - v.first;
  return v;
}

Result<StepSpreads> step_spreads(const FileView& view) {
  const Header& h = view.header();
  StepSpreads spreads{};
  std::vector<float> steps(h.n_step_sets);
  if (steps.empty()) return spreads;
  for (std::size_t degree = 0; degree <= h.sh_degree; ++degree) {
    for (std::size_t c = 0; c < 3; ++c) {
      for (std::uint64_t i = 0; i < h.n_step_sets; ++i) {
        const auto set = view.step_set(i);
        if (!set) return tl::unexpected(set.error());
        steps[i] = set->step[degree][c];
      }
      const auto middle = steps.begin() + static_cast<std::ptrdiff_t>((steps.size() - 1) / 2);
      std::ranges::nth_element(steps, middle);
      spreads[degree][c] = {*std::min_element(steps.begin(), middle + 1), *middle,
                            *std::max_element(middle, steps.end())};
    }
  }
  return spreads;
}

Result<ChunkStatistics> chunk_statistics(const FileView& view) {
  const std::uint64_t n = view.header().n_chunks;
  const auto collect = [&](bool logarithmic, auto value) -> Result<Distribution> {
    std::vector<Sample> samples(n);
    for (std::uint64_t i = 0; i < n; ++i) {
      const auto entry = view.chunk(i);
      if (!entry) return tl::unexpected(entry.error());
      samples[i] = {value(*entry), 1};
    }
    return distribution(std::move(samples), logarithmic);
  };
  const auto diagonal = [](const ChunkEntry& e) {
    double squared = 0;
    for (std::size_t k = 0; k < 3; ++k) {
      const double side = static_cast<double>(e.means.max[k]) - static_cast<double>(e.means.min[k]);
      squared += side * side;
    }
    return static_cast<float>(std::min(std::sqrt(squared), 3e38));
  };
  auto boxes = collect(true, diagonal);
  if (!boxes) return tl::unexpected(boxes.error());
  auto radii = collect(true, [](const ChunkEntry& e) { return e.radius; });
  auto opacities = collect(false, [](const ChunkEntry& e) { return e.max_opacity; });
  return ChunkStatistics{*boxes, *radii, *opacities};
}

Result<ChunkReport> chunk_report(const FileView& view, std::uint64_t index) {
  const Header& h = view.header();
  if (index >= h.n_chunks) {
    return make_error(Errc::bad_argument, Error::kNone, "the file has no such chunk; --chunk counts from 0",
                      Error::kNone, index);
  }
  const auto entry = view.chunk(index);
  if (!entry) return tl::unexpected(entry.error());
  const auto steps = view.step_set(entry->step_set);
  if (!steps) return tl::unexpected(steps.error());
  return ChunkReport{index, index * h.chunk_size, *entry, *steps};
}

// Hashes every section, so that the report names all damaged ones; checks values only if the hashes are good.
Status verify(InfoReport& report) {
  const FileView& view = *report.view;
  std::vector<std::uint64_t>& hashes = report.hashes;
  const SectionEntry* damaged = nullptr;
  for (const SectionEntry& s : view.sections()) {
    const bool present = is_present(report, s);
    hashes.push_back(present ? xxh3(view.stored(s)) : 0);
    if (damaged == nullptr && present && hashes.back() != s.xxh3) damaged = &s;
  }
  // Name the damaged page, not just the section.
  const bool pages = damaged != nullptr && damaged->type == static_cast<std::uint32_t>(SectionType::pages);
  if (damaged == nullptr || pages) {
    const Status status = report.paged ? validate(*report.paged) : validate(view);
    if (!status || damaged == nullptr) return status;
  }
  return make_error(Errc::checksum_mismatch, damaged->offset, "a section's checksum does not match", damaged->xxh3,
                    hashes[static_cast<std::size_t>(damaged - view.sections().data())]);
}

// Draws pages beside their children; damaged ones are found before.
Status verify_levels(InfoReport& report, double share) {
  if (!report.paged) return make_error(Errc::bad_argument, Error::kNone, "the file has no levels of detail");
  auto check = check_levels(*report.paged, share);
  if (!check) return tl::unexpected(check.error());
  report.levels_check = *std::move(check);
  if (report.levels_check->refuted.empty()) return {};
  return make_error(Errc::bad_value, record_offset(*report.paged, report.levels_check->refuted.front().page),
                    "the error stated for a page is smaller than the one measured against its children");
}

std::vector<LevelReport> level_reports(const PagedFile& file) {
  std::vector<LevelReport> levels(file.n_levels());
  const std::uint32_t n_present = file.n_present();
  for (std::uint32_t i = 0; i < file.n_pages(); ++i) {
    const lod::Page& page = file.pages()[i];
    LevelReport& level = levels[page.level];
    level.min_error = level.n_pages == 0 ? page.error : std::min(level.min_error, page.error);
    level.max_error = std::max(level.max_error, page.error);
    ++level.n_pages;
    level.n_present += i < n_present ? 1 : 0;
    level.n_gaussians += page.count;
    level.stored_bytes += file.stored(i).stored_bytes;
  }
  return levels;
}

// Opens a file with levels; its leaves are read only if values are wanted.
Status open_levels(std::span<const std::byte> bytes, const InfoOptions& options, bool leaves_wanted,
                   InfoReport& report) {
  auto paged = PagedFile::open(bytes, options.limits);
  if (!paged) return tl::unexpected(paged.error());
  report.view = paged->head();
  report.paged = *std::move(paged);
  report.levels = level_reports(*report.paged);
  if (!leaves_wanted || !report.paged->complete()) return {};
  auto leaves = leaves_as_file(*report.paged, {.validate = false});
  if (!leaves) return tl::unexpected(leaves.error());
  report.leaf_bytes = std::make_shared<const std::vector<std::byte>>(*std::move(leaves));
  DecodeLimits limits = options.limits;
  limits.max_file_bytes = report.leaf_bytes->size();
  auto view = FileView::open(*report.leaf_bytes, limits);
  if (!view) return tl::unexpected(view.error());
  report.leaves = *std::move(view);
  return {};
}

}  // namespace

bool is_present(const InfoReport& report, const SectionEntry& section) {
  return section.offset <= report.file_bytes && section.stored_bytes <= report.file_bytes - section.offset;
}

InfoReport inspect(const std::string& path, std::span<const std::byte> bytes, const InfoOptions& options) {
  InfoReport report;
  report.path = path;
  report.file_bytes = bytes.size();
  report.chunk_asked = options.chunk;
  report.page_asked = options.page;
  const auto failed = [&report](const Error& error) {
    if (!report.error) report.error = error;
  };
  const auto keep = [&failed](auto result, auto& place) {
    if (result) {
      place = *std::move(result);
    } else {
      failed(result.error());
    }
  };

  const bool statistics =
      options.statistics.value_or(options.chunk || (bytes.size() <= kStatisticsBytes && !options.page));
  if (has_levels(bytes)) {
    const Status opened = open_levels(bytes, options, statistics || options.chunk, report);
    if (!opened) failed(opened.error());
  } else {
    keep(FileView::open(bytes, options.limits), report.view);
  }
  if (!report.view) return report;
  if (options.verify) {
    Status status = verify(report);
    if (status && options.levels_share > 0) status = verify_levels(report, options.levels_share);
    report.verified = status.has_value();
    if (!status) failed(status.error());
  }
  if (report.paged && !report.paged->complete()) {
    const std::uint32_t n = report.paged->n_present();
    const bool all = n == report.paged->n_pages();
    failed(n == 0 ? Error{Errc::truncated, bytes.size(), "the file ends inside its first page"}
           : all  ? Error{Errc::pages_missing, bytes.size(),
                         "the end of the file is missing: all pages are present, positions in the source are lost"}
                  : Error{Errc::pages_missing, bytes.size(),
                         "the end of the file is missing; the pages present are the whole scene in less detail",
                         report.paged->n_pages(), n});
  }
  if (options.page) {
    if (!report.paged || *options.page >= report.paged->n_pages()) {
      failed({Errc::bad_argument, Error::kNone, "the file has no such page; --page counts from 0", Error::kNone,
              *options.page});
    }
    return report;
  }
  if (report.paged && !report.leaves) return report;
  const FileView& view = report.leaves ? *report.leaves : *report.view;
  const std::uint64_t n_chunks = view.header().n_chunks;
  if (options.chunk) {
    keep(chunk_report(view, *options.chunk), report.chunk);
    if (report.chunk && statistics) keep(value_statistics(view, *options.chunk, *options.chunk + 1), report.values);
    return report;
  }
  keep(step_spreads(view), report.steps);
  keep(chunk_statistics(view), report.chunks);
  if (statistics) keep(value_statistics(view, 0, n_chunks), report.values);
  return report;
}

StoredRows stored_rows(const FileView& view, SectionType type, std::uint64_t first, std::uint64_t count,
                       std::uint64_t row_bytes) {
  const FrameTable& table = view.frames(type);
  if (table.rows == 0) return {view.place(type, first), count * row_bytes, std::nullopt};
  const std::uint64_t frame = first / table.rows;
  return {table.frames[frame].offset, table.frames[frame].stored_bytes, frame};
}

std::uint32_t leaf_of_row(const PagedFile& file, std::uint64_t row) {
  const std::uint64_t wanted = file.n_stored() - file.head().header().n_gaussians + row;
  const auto after = std::ranges::upper_bound(file.pages(), wanted, {}, &lod::Page::first);
  return static_cast<std::uint32_t>(after - file.pages().begin()) - 1;
}

std::uint64_t ply_bytes(const Header& header) {
  return header.n_gaussians * ply_row_bytes(header.sh_degree);
}

double bytes_per_gaussian(std::uint64_t bytes, const Header& header) {
  return header.n_gaussians == 0 ? 0 : static_cast<double>(bytes) / static_cast<double>(header.n_gaussians);
}

std::optional<bool> right_handed(const std::array<Axis, 3>& axes) {
  if (axes[0] == Axis::undeclared) return std::nullopt;
  // Right, up, backward form a right-handed frame; map each axis to one of them or its negative.
  std::array<int, 3> index{};
  bool even = true;
  for (std::size_t i = 0; i < 3; ++i) {
    const int code = static_cast<int>(axes[i]) - 1;  // right left up down forward backward
    index[i] = code / 2;
    const bool negative = axes[i] == Axis::left || axes[i] == Axis::down || axes[i] == Axis::forward;
    even ^= negative;
  }
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = i + 1; j < 3; ++j) even ^= index[i] > index[j];
  }
  return even;
}

Name name_of(Axis axis) {
  switch (axis) {
    case Axis::undeclared: break;
    case Axis::right: return {"right", "right"};
    case Axis::left: return {"left", "left"};
    case Axis::up: return {"up", "up"};
    case Axis::down: return {"down", "down"};
    case Axis::forward: return {"forward", "forward"};
    case Axis::backward: return {"backward", "backward"};
  }
  return {"undeclared", "not declared"};
}

Name name_of(ColourSpace space) {
  switch (space) {
    case ColourSpace::undeclared: break;
    case ColourSpace::srgb_display: return {"srgb_display", "sRGB, display-referred"};
    case ColourSpace::linear_display: return {"linear_display", "linear, display-referred"};
  }
  return {"undeclared", "not declared"};
}

Name name_of(ShBasis basis) {
  switch (basis) {
    case ShBasis::real_3dgs: break;
  }
  return {"real_3dgs", "real, constants and signs of 3DGS"};
}

Name name_of(Kernel kernel) {
  switch (kernel) {
    case Kernel::gaussian_ewa: break;
  }
  return {"gaussian_ewa", "Gaussian, EWA"};
}

Name name_of(AaMode mode) {
  switch (mode) {
    case AaMode::undeclared: break;
    case AaMode::classic: return {"classic", "classic"};
    case AaMode::mip_splatting: return {"mip_splatting", "Mip-Splatting, opacity compensated"};
  }
  return {"undeclared", "not declared"};
}

Name name_of(SortMetric metric) {
  switch (metric) {
    case SortMetric::z_depth: break;
  }
  return {"z_depth", "by camera z"};
}

Name name_of(DepthMapping mapping) {
  switch (mapping) {
    case DepthMapping::linear: break;
    case DepthMapping::logarithmic: return {"logarithmic", "logarithmic"};
  }
  return {"linear", "linear"};
}

Name name_of(DepthSource source) {
  switch (source) {
    case DepthSource::cameras: return {"cameras", "from cameras"};
    case DepthSource::scene_extent: break;
    case DepthSource::by_hand: return {"by_hand", "set by hand"};
  }
  return {"scene_extent", "from the scene's extent"};
}

Name name_of(Order order) {
  switch (order) {
    case Order::input: break;
    case Order::morton: return {"morton", "Morton order"};
  }
  return {"input", "order of the source"};
}

std::string archive_name(const ArchiveParameters& p) {
  for (const auto& [options, name] : {std::pair(archive_high(), "archive:high"),
                                      {archive_small(), "archive:small"},
                                      {archive_tiny(), "archive:tiny"}}) {
    if (p.codec == Codec::archive && p.step == options.step) return name;
  }
  return "archive";
}

double scale_step(const ArchiveClass& c) {
  return c.scale_step / 65536.0 * std::numbers::ln2;
}

double dc_step(const ArchiveClass& c) {
  return c.dc_step / 65536.0;
}

const char* describe(SectionType type) {
  switch (type) {
    case SectionType::declarations: return "declarations";
    case SectionType::sh_steps: return "SH steps";
    case SectionType::chunks: return "chunk table";
    case SectionType::means: return "means";
    case SectionType::geometry: return "rotation, scale, opacity";
    case SectionType::sh: return "SH codes";
    case SectionType::archive: return "archive: steps, tables";
    case SectionType::permutation: return "source positions";
    case SectionType::provenance: return "provenance";
    case SectionType::crs: return "coordinate reference system";
    case SectionType::levels: return "levels: tree of pages";
    case SectionType::pages: return "pages of Gaussians";
  }
  return "";
}

std::string four_characters(std::uint32_t type) {
  std::string text;
  for (int i = 0; i < 4; ++i) text += static_cast<char>(type >> (8 * i) & 0xFFu);
  return text;
}

std::string codec_name(const SectionEntry& section) {
  const auto codec = static_cast<Codec>(section.codec);
  const bool known = *describe(static_cast<SectionType>(section.type)) != '\0';
  if (codec == Codec::none) return "none";
  if (codec == Codec::planes && known) return "planes";
  if (is_archive(codec) && known) return "archive";
  return "codec " + std::to_string(section.codec);
}

}  // namespace rgs::tool
