// interchange.cpp - detects the format and calls its reader or writer.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/interchange.hpp"

#include <algorithm>
#include <array>
#include <cctype>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <limits>
#include <string_view>
#include <utility>

#include "compressed_ply.hpp"
#include "gltf_splats.hpp"
#include "ksplat.hpp"
#include "rgs/encode.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/ply.hpp"
#include "rgs/splat_edit.hpp"
#include "sog.hpp"
#include "splat_records.hpp"
#include "spz.hpp"
#include "stated_scene.hpp"
#include "write_report.hpp"

namespace rgs {
namespace {

constexpr std::array<const char*, 9> kNames{"unknown", "rgs", "ply", "compressed.ply", "spz", "splat",
                                            "ksplat",  "sog", "glb"};

bool begins_with(std::span<const std::byte> bytes, std::span<const unsigned char> magic) {
  return bytes.size() >= magic.size() && std::memcmp(bytes.data(), magic.data(), magic.size()) == 0;
}

Result<SplatFile> decode_ply(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto ply = PlyFile::open(bytes);
  if (!ply) return tl::unexpected(ply.error());
  if (ply->size() > limits.max_gaussians) {
    return make_error(Errc::limit_exceeded, 0, "more Gaussians than the caller allows", limits.max_gaussians,
                      ply->size());
  }
  auto cloud = read_cloud(*ply);
  if (!cloud) return tl::unexpected(cloud.error());
  SplatFile file;
  detail::stated_scene(ply->declarations()).copy_to(file);
  file.cloud = *std::move(cloud);
  file.origin = ply->origin();
  file.position_rounding = ply->position_rounding();
  return file;
}

void declare_as(const Declarations& declarations, const std::optional<Provenance>& provenance, SplatFile& file) {
  detail::stated_scene(declarations).copy_to(file);
  file.declarations = declarations;
  file.provenance = provenance;
}

Result<SplatFile> decode_rgs(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto view = FileView::open(bytes, limits);
  if (!view) return tl::unexpected(view.error());
  auto cloud = decode(bytes, limits);
  if (!cloud) return tl::unexpected(cloud.error());
  SplatFile file;
  declare_as(view->declarations(), view->provenance(), file);
  if (view->find(SectionType::permutation) != nullptr && file.declarations->n_source >> 32 == 0) {
    file.source_index.resize(cloud->size());
    for (std::uint64_t i = 0; i < file.source_index.size(); ++i) {
      file.source_index[i] = static_cast<std::uint32_t>(view->source_index(i));
    }
  }
  file.cloud = std::move(*cloud);
  return file;
}

// Replaces the pages' counts by `counts`, if given; returns the sum over all leaves.
std::uint64_t count_as(std::span<const std::uint32_t> counts, std::vector<lod::Page>& pages) {
  std::uint64_t of_leaves = 0;
  for (std::size_t i = 0; i < pages.size(); ++i) {
    if (!counts.empty()) pages[i].count = counts[i];
    if (pages[i].level == 0) of_leaves += pages[i].count;
  }
  return of_leaves;
}

Result<SplatFile> decode_levels(std::span<const std::byte> bytes, const ReadOptions& options) {
  const auto paged = PagedFile::open(bytes, options.limits);
  if (!paged) return tl::unexpected(paged.error());
  std::vector<std::uint32_t> pages;
  bool is_part = false;
  if (paged->n_present() == 0) {
    return make_error(Errc::pages_missing, bytes.size(), "the end of the file is missing, and with it all pages",
                      paged->n_pages(), 0);
  }
  if (options.level_of_detail) {
    if (*options.level_of_detail >= paged->n_levels()) {
      return make_error(Errc::bad_argument, Error::kNone, "the file has no such level of detail (0 is the finest)",
                        paged->n_levels(), *options.level_of_detail);
    }
    pages = lod::pages_of_level(paged->pages(), *options.level_of_detail);
  } else if (options.max_count) {
    if (!options.page_counts.empty() && options.page_counts.size() != paged->n_pages())
      return make_error(Errc::bad_argument, Error::kNone, "page_counts must hold one count per page", paged->n_pages(),
                        options.page_counts.size());
    std::vector<lod::Page> counted = paged->pages();
    if (*options.max_count < count_as(options.page_counts, counted) || !paged->complete()) {
      pages = lod::finest_cut(counted, *options.max_count, paged->n_present());
      if (pages.empty()) {
        return make_error(Errc::bad_argument, Error::kNone,
                          options.page_counts.empty()
                              ? "the coarsest level of the file has more Gaussians than that; convert it "
                                "alone (--level-of-detail) and drop some of them"
                              : "the filters keep more Gaussians than that even of the coarsest level (--crop, "
                                "--min-opacity); convert it alone (--level-of-detail) and drop some of them",
                          *options.max_count, counted.front().count);
      }
    }
    // Pages that count 0 are free, so a cut has the finest of them, which may not fit into memory.
    is_part = !options.page_counts.empty() && !(pages.empty() && paged->has_source_index());
    if (is_part && pages.empty()) pages = lod::pages_of_level(counted, 0);
    if (is_part) std::erase_if(pages, [&](std::uint32_t i) { return counted[i].count == 0; });
  }
  if (!is_part && std::ranges::all_of(pages, [&](std::uint32_t i) { return paged->pages()[i].level == 0; })) {
    if (!paged->complete() && !options.max_count) {
      return make_error(
          Errc::pages_missing, bytes.size(),
          paged->n_present() < paged->n_pages()
              ? "the end of the file is missing, and with it some of the scene's own Gaussians "
                "(--max-count reads the levels that are present)"
              : "the end of the file is missing, and with it positions in the source, though all Gaussians "
                "are present (--max-count reads them)",
          paged->head().header().file_bytes, bytes.size());
    }
    // The leaves get all checks of a file without levels.
    const auto plain = leaves_as_file(*paged, {.validate = false});
    if (!plain) return tl::unexpected(plain.error());
    DecodeLimits limits = options.limits;
    limits.max_file_bytes = plain->size();  // the file's own size was checked above
    auto file = decode_rgs(*plain, limits);
    if (file) file->n_levels = paged->n_levels();
    return file;
  }
  auto cloud = read_pages(*paged, pages);
  if (!cloud) return tl::unexpected(cloud.error());
  SplatFile file;
  declare_as(paged->head().declarations(), paged->head().provenance(), file);
  file.n_levels = paged->n_levels();
  file.finest = false;
  file.cloud = std::move(*cloud);
  return file;
}

Result<SplatFile> decode_format(std::span<const std::byte> bytes, SplatFormat format, const ReadOptions& options) {
  const DecodeLimits& limits = options.limits;
  const bool levels = format == SplatFormat::rgs && has_levels(bytes);
  if (options.level_of_detail && !levels) {
    return make_error(Errc::bad_argument, Error::kNone, "the file has no levels of detail");
  }
  switch (format) {
    case SplatFormat::rgs: return levels ? decode_levels(bytes, options) : decode_rgs(bytes, limits);
    case SplatFormat::ply: return decode_ply(bytes, limits);
    case SplatFormat::compressed_ply: return detail::decode_compressed_ply(bytes, limits);
    case SplatFormat::spz: return detail::decode_spz(bytes, options);
    case SplatFormat::splat: return detail::decode_splat_records(bytes, limits);
    case SplatFormat::ksplat: return detail::decode_ksplat(bytes, limits);
    case SplatFormat::sog: return detail::decode_sog(bytes, limits);
    case SplatFormat::glb: return detail::decode_glb(bytes, limits);
    case SplatFormat::unknown: break;
  }
  if (detail::is_streamed_sog(bytes))
    return make_error(Errc::unsupported_feature, 0,
                      "a streamed SOG (lod-meta.json), which is not read yet: take the scene that it was made from");
  return make_error(Errc::bad_magic, 0, "is not a .rgs, .ply, .spz, .splat, .ksplat, .sog or .glb file");
}

Result<SplatFile> finish(Result<SplatFile> file, SplatFormat format, std::uint64_t bytes, const ReadOptions& options) {
  if (!file) return file;
  file->format = format;
  file->bytes = std::max(file->bytes, bytes);
  if (!options.keep_axes && std::ranges::find(file->axes, Axis::undeclared) == file->axes.end()) {
    convert_axes(file->cloud, file->axes, kAxes3dgs);
    convert_axes(file->origin, file->axes, kAxes3dgs);
    file->axes = kAxes3dgs;
    if (file->declarations) file->declarations->axes = kAxes3dgs, file->declarations->origin = file->origin;
  }
  return file;
}

std::vector<float> positions_of(const SplatView& splats, const Origin& origin) {
  std::vector<float> positions(splats.mean.begin(), splats.mean.end());
  if (origin == kNoOrigin) return positions;
  for (std::size_t i = 0; i < positions.size(); ++i) {
    positions[i] = static_cast<float>(origin[i % 3] + static_cast<double>(positions[i]));
  }
  return positions;
}

// Codes of fixed width cannot hold NaN.
Status check_sound(const SplatView& splats) {
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    if (find_defects(splats.splat(i), splats.sh_degree) != 0) {
      return make_error(Errc::bad_value, i,
                        "the Gaussian of this index is damaged; drop or repair damaged ones to write this format");
    }
  }
  return {};
}

std::vector<std::byte> encode_ply(const SplatView& splats, const detail::StatedScene& stated) {
  const Origin& origin = stated.origin;
  const std::string header = ply_header(splats.n, splats.sh_degree, stated.declarations());
  const std::uint64_t row = ply_row_bytes(splats.sh_degree, origin);
  std::vector<std::byte> file(header.size() + splats.n * row);
  std::memcpy(file.data(), header.data(), header.size());
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    const Splat s = splats.splat(i);
    encode_ply_rows({&s, 1}, splats.sh_degree, std::span(file).subspan(header.size() + i * row, row), origin);
  }
  return file;
}

}  // namespace

const char* format_name(SplatFormat format) {
  return kNames[static_cast<std::size_t>(format)];
}

SplatFormat detect_format(std::span<const std::byte> bytes) {
  constexpr std::array<unsigned char, 3> kPly{'p', 'l', 'y'};
  constexpr std::array<unsigned char, 4> kGlb{'g', 'l', 'T', 'F'};
  if (begins_with(bytes, kMagic)) return SplatFormat::rgs;
  if (begins_with(bytes, kPly)) {
    return detail::is_compressed_ply(bytes) ? SplatFormat::compressed_ply : SplatFormat::ply;
  }
  if (begins_with(bytes, kGlb)) return SplatFormat::glb;
  if (detail::is_spz(bytes)) return SplatFormat::spz;
  if (detail::is_sog(bytes) || detail::is_sog_meta(bytes)) return SplatFormat::sog;
  if (detail::looks_like_ksplat(bytes)) return SplatFormat::ksplat;
  if (detail::looks_like_splat_records(bytes)) return SplatFormat::splat;
  return SplatFormat::unknown;
}

SplatFormat format_of_name(const std::string& path) {
  std::string name = std::filesystem::path(path).filename().string();
  std::ranges::transform(name, name.begin(), [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  if (name == "meta.json") return SplatFormat::sog;
  for (const SplatFormat format : {SplatFormat::compressed_ply, SplatFormat::ply, SplatFormat::rgs, SplatFormat::spz,
                                   SplatFormat::ksplat, SplatFormat::splat, SplatFormat::sog, SplatFormat::glb}) {
    if (name.ends_with(std::string(".") + format_name(format))) return format;
  }
  return SplatFormat::unknown;
}

Axes format_axes(SplatFormat format) {
  return format == SplatFormat::glb ? kAxesGltf : kAxes3dgs;
}

EncodeOptions keep_declarations(EncodeOptions options, const SplatFile& file) {
  if (file.declarations) options = keep_declarations(std::move(options), *file.declarations);
  if (file.declarations) options.provenance = file.provenance;
  options.axes = file.axes;
  options.colour_space = file.colour_space;
  options.aa_mode = file.aa_mode;
  options.low_pass_px2 = file.low_pass_px2;
  options.metres_per_unit = file.metres_per_unit;
  options.origin = file.origin;
  return options;
}

bool is_writable(SplatFormat format) {
  return format == SplatFormat::ply || format == SplatFormat::compressed_ply || format == SplatFormat::spz ||
         format == SplatFormat::splat || format == SplatFormat::sog || format == SplatFormat::glb;
}

bool keeps_origin(SplatFormat format) {
  return format == SplatFormat::rgs || format == SplatFormat::ply || format == SplatFormat::glb;
}

Result<SplatFile> read_splats(std::span<const std::byte> bytes, const ReadOptions& options) {
  return detail::guard_memory([&]() -> Result<SplatFile> {
    if (bytes.size() > options.limits.max_file_bytes) {
      return make_error(Errc::limit_exceeded, 0, "the file is larger than the caller allows",
                        options.limits.max_file_bytes, bytes.size());
    }
    if (bytes.empty()) return make_error(Errc::truncated, 0, "the file is empty");
    const SplatFormat format = options.format != SplatFormat::unknown ? options.format : detect_format(bytes);
    if (format == SplatFormat::sog && detail::is_sog_meta(bytes)) {
      return make_error(Errc::unsupported_feature, 0,
                        "a SOG's meta.json without its images: name the file, or zip the folder");
    }
    return finish(decode_format(bytes, format, options), format, bytes.size(), options);
  });
}

Result<SplatFile> read_splats(const std::string& path, const ReadOptions& options) {
  return detail::guard_memory([&]() -> Result<SplatFile> {
    const auto file = MappedFile::open(path);
    if (!file) return tl::unexpected(file.error());
    if (!detail::is_sog_meta(file->bytes())) {
      auto splats = read_splats(file->bytes(), options);
      // A change of the file explains any other error.
      if (const Status s = file->check_unchanged(); !s) return tl::unexpected(s.error());
      return splats;
    }
    const std::string folder = std::filesystem::path(path).parent_path().string();
    return finish(detail::decode_sog_folder(file->bytes(), folder.empty() ? "." : folder, options.limits),
                  SplatFormat::sog, 0, options);
  });
}

Result<double> position_rounding(const SplatView& splats, SplatFormat format, const Origin& origin) {
  return detail::guard_memory([&]() -> Result<double> {
    if (keeps_origin(format) || (origin == kNoOrigin && format != SplatFormat::spz)) return 0.0;
    const std::vector<float> positions = positions_of(splats, origin);
    int bits = 0;
    if (format == SplatFormat::spz) {
      SplatView placed = splats;
      placed.mean = positions;
      const auto chosen = detail::choose_fractional_bits(placed);
      if (!chosen) return tl::unexpected(chosen.error());
      bits = *chosen;
    }
    double largest = 0;
    for (std::size_t i = 0; i < positions.size(); ++i) {
      double held = static_cast<double>(positions[i]);
      if (format == SplatFormat::spz) held = std::ldexp(std::floor(std::ldexp(held, bits) + 0.5), -bits);
      const double error = std::fabs(held - (origin[i % 3] + static_cast<double>(splats.mean[i])));
      if (std::isfinite(error)) largest = std::max(largest, error);
    }
    return largest;
  });
}

Result<std::vector<std::byte>> encode_splats(const SplatView& splats, SplatFormat format, const WriteOptions& options,
                                             WriteReport* report) {
  return detail::guard_memory([&]() -> Result<std::vector<std::byte>> {
    if (!is_writable(format)) return make_error(Errc::bad_argument, Error::kNone, "this format cannot be written");
    if (!splats.consistent()) return make_error(Errc::bad_argument, Error::kNone, "the view's array sizes disagree");
    if (splats.n > std::numeric_limits<std::uint32_t>::max()) {
      return make_error(Errc::limit_exceeded, Error::kNone, "more than 2^32 - 1 Gaussians; split the scene",
                        std::numeric_limits<std::uint32_t>::max(), splats.n);
    }
    if (report != nullptr) *report = {};
    if (format == SplatFormat::spz && (options.spz_version < 2 || options.spz_version > 4)) {
      return make_error(Errc::bad_argument, Error::kNone, "SPZ is written in version 2, 3 or 4");
    }
    const detail::StatedScene stated = detail::stated_scene(options);
    if (format == SplatFormat::ply) return encode_ply(splats, stated);
    if (const Status s = check_sound(splats); !s) return tl::unexpected(s.error());
    std::vector<float> positions;  // FP32, where the format holds no origin
    SplatView placed = splats;
    if (options.origin != kNoOrigin && !keeps_origin(format)) {
      if (options.strict) {
        return make_error(Errc::bad_value, Error::kNone,
                          "the format holds no origin: positions would be rounded to FP32; write "
                          ".rgs, .ply or .glb, or drop --strict");
      }
      positions = positions_of(splats, options.origin);
      placed.mean = positions;
    }
    if (report != nullptr || options.strict) {
      const WriteReport clamping = detail::measure_clamping(placed, format);
      if (report != nullptr) *report = clamping;
      if (const Status s = detail::refuse_clamping(clamping); options.strict && !s) return tl::unexpected(s.error());
    }
    switch (format) {
      case SplatFormat::compressed_ply: return detail::encode_compressed_ply(placed, stated, options.keep_order);
      case SplatFormat::spz: return detail::encode_spz(placed, options.aa_mode, options.spz_version);
      case SplatFormat::sog: return detail::encode_sog(placed, options);
      case SplatFormat::glb: return detail::encode_glb(placed, stated);
      default: return detail::encode_splat_records(placed);
    }
  });
}

}  // namespace rgs
