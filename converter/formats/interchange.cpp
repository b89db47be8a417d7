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
#include <memory>
#include <string_view>
#include <system_error>
#include <utility>

#include "compressed_ply.hpp"
#include "gltf_splats.hpp"
#include "ksplat.hpp"
#include "lcc.hpp"
#include "level_choice.hpp"
#include "npz.hpp"
#include "pieces.hpp"
#include "rad.hpp"
#include "rgs/encode.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/ply.hpp"
#include "rgs/splat_edit.hpp"
#include "rgs/tileset_files.hpp"
#include "rgs/utf8_path.hpp"
#include "signature.hpp"
#include "sog.hpp"
#include "splat_records.hpp"
#include "spz.hpp"
#include "spz_georeference.hpp"
#include "stated_scene.hpp"
#include "streamed_sog.hpp"
#include "tileset.hpp"
#include "torch_checkpoint.hpp"
#include "usd_splats.hpp"
#include "write_report.hpp"

namespace rgs {
namespace {

using Bytes = std::span<const std::byte>;

Result<SplatFile> decode_ply(Bytes bytes, const ReadOptions& options) {
  const DecodeLimits& limits = options.limits;
  const auto ply = PlyFile::open(bytes);
  if (!ply) return tl::unexpected(ply.error());
  if (ply->size() > limits.max_gaussians) {
    return make_error(Errc::limit_exceeded, 0, "more Gaussians than the caller allows", limits.max_gaussians,
                      ply->size());
  }
  SplatFile file;
  detail::stated_scene(ply->declarations()).copy_to(file);
  file.origin = ply->origin();
  std::vector<Splat> rows;
  for (std::uint64_t first = 0; first < ply->size() && options.visit; first += rows.size()) {
    rows.resize(std::min(detail::kPieceRows, ply->size() - first));
    ply->read(first, rows);
    if (const Status s = detail::hand_over(rows, ply->sh_degree(), file, options); !s) return tl::unexpected(s.error());
  }
  if (options.visit) return file;
  auto cloud = read_cloud(*ply);
  if (!cloud) return tl::unexpected(cloud.error());
  file.cloud = *std::move(cloud);
  file.position_rounding = ply->position_rounding();
  return file;
}

void declare_as(const Declarations& declarations, const std::optional<Provenance>& provenance, SplatFile& file) {
  detail::stated_scene(declarations).copy_to(file);
  file.declarations = declarations;
  file.crs = declarations.crs;
  file.provenance = provenance;
}

bool is_rgs(Bytes bytes) {
  return detail::begins_with(bytes, detail::text_of(std::as_bytes(std::span(kMagic))));
}

bool is_ply(Bytes bytes) {
  return detail::begins_with(bytes, "ply");
}

// All checks of decode(), on some chunks at a time.
Status visit_chunks(const FileView& view, SplatFile& file, const ReadOptions& options) {
  auto validation = Validation::begin(view);
  if (!validation) return tl::unexpected(validation.error());
  const std::uint64_t n_chunks = view.header().n_chunks, at_once = validation->chunks_at_a_time();
  std::vector<Splat> rows;
  for (std::uint64_t chunk = 0; chunk < n_chunks; chunk += at_once) {
    const auto data = read_chunks(view, chunk, std::min(at_once, n_chunks - chunk), {.validate = false});
    if (!data) return tl::unexpected(data.error());
    if (Status s = validation->check(*data); !s) return s;
    rows.resize(data->size());
    if (Status s = data->read(data->first(), rows); !s) return s;
    if (Status s = detail::hand_over(rows, view.header().sh_degree, file, options); !s) return s;
  }
  return validation->finish();
}

constexpr std::size_t kPagesAtOnce = 64;

Result<SplatFile> decode_plain(Bytes bytes, const ReadOptions& options) {
  const DecodeLimits& limits = options.limits;
  const auto view = FileView::open(bytes, limits);
  if (!view) return tl::unexpected(view.error());
  if (options.visit) {
    SplatFile file;
    declare_as(view->declarations(), view->provenance(), file);
    if (const Status s = visit_chunks(*view, file, options); !s) return tl::unexpected(s.error());
    return file;
  }
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

Result<SplatFile> decode_levels(Bytes bytes, const ReadOptions& options) {
  const auto paged = PagedFile::open(bytes, options.limits);
  if (!paged) return tl::unexpected(paged.error());
  std::vector<std::uint32_t> pages;
  bool is_part = false;
  if (paged->n_present() == 0) {
    return make_error(Errc::pages_missing, bytes.size(), "the end of the file is missing, and with it all pages",
                      paged->n_pages(), 0);
  }
  if (options.level_of_detail) {
    if (const Status s = detail::check_level(paged->n_levels(), options); !s) return tl::unexpected(s.error());
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
  const bool leaves =
      !is_part && std::ranges::all_of(pages, [&](std::uint32_t i) { return paged->pages()[i].level == 0; });
  if (leaves) {
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
    pages = lod::pages_of_level(paged->pages(), 0);
  }
  if (leaves && !options.visit && paged->n_pages_with_origins() == 0) {
    // The leaves get all checks of a file without levels.
    const auto plain = leaves_as_file(*paged, {.validate = false});
    if (!plain) return tl::unexpected(plain.error());
    ReadOptions as_plain = options;
    as_plain.limits.max_file_bytes = plain->size();  // the file's own size was checked above
    auto file = decode_plain(*plain, as_plain);
    if (file) file->n_levels = paged->n_levels();
    return file;
  }
  SplatFile file;
  declare_as(paged->head().declarations(), paged->head().provenance(), file);
  file.n_levels = paged->n_levels();
  file.finest = leaves;
  if (leaves && !options.visit) {
    if (const Status s = validate(*paged); !s) return tl::unexpected(s.error());
  }
  const std::size_t at_once = options.visit ? kPagesAtOnce : pages.size();
  for (std::span<const std::uint32_t> rest(pages); !rest.empty();) {
    const auto some = rest.first(std::min(at_once, rest.size()));
    rest = rest.subspan(some.size());
    auto cloud = read_pages(*paged, some);
    if (!cloud) return tl::unexpected(cloud.error());
    file.cloud = std::move(*cloud);
    if (!options.visit) file.position_rounding = largest_rest(file.cloud.mean_rest);
    if (const Status s = detail::hand_over(file, options); !s) return tl::unexpected(s.error());
  }
  if (leaves && !options.visit && paged->has_source_index() && file.declarations->n_source >> 32 == 0) {
    for (std::uint64_t i = 0; i < file.cloud.size(); ++i)
      file.source_index.push_back(static_cast<std::uint32_t>(paged->source_index(i)));
  }
  return file;
}

Result<SplatFile> decode_rgs(Bytes bytes, const ReadOptions& options) {
  return has_levels(bytes) ? decode_levels(bytes, options) : decode_plain(bytes, options);
}

Result<SplatFile> finish(Result<SplatFile> file, SplatFormat format, std::uint64_t bytes, const ReadOptions& options) {
  if (!file) return file;
  file->format = format;
  file->bytes = std::max(file->bytes, bytes);
  if (const Status s = detail::hand_over(*file, options); !s) return tl::unexpected(s.error());
  if (!options.keep_axes && !options.visit && std::ranges::find(file->axes, Axis::undeclared) == file->axes.end()) {
    convert_axes(file->cloud, file->axes, kAxes3dgs);
    convert_axes(file->origin, file->axes, kAxes3dgs);
    convert_axes(file->crs, file->axes, kAxes3dgs);
    file->axes = kAxes3dgs;
    if (file->declarations) {
      if (file->declarations->axes != kAxes3dgs) file->declarations->first_view = {};
      file->declarations->axes = kAxes3dgs, file->declarations->origin = file->origin;
      file->declarations->crs = file->crs;
    }
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

Result<std::vector<std::byte>> encode_ply(const SplatView& splats, const WriteOptions& options) {
  const Origin& origin = options.origin;
  const std::string header = ply_header(splats.n, splats.sh_degree, detail::stated_scene(options).declarations());
  const std::uint64_t row = ply_row_bytes(splats.sh_degree, origin);
  std::vector<std::byte> file(header.size() + splats.n * row);
  std::memcpy(file.data(), header.data(), header.size());
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    const Splat s = splats.splat(i);
    encode_ply_rows({&s, 1}, splats.sh_degree, std::span(file).subspan(header.size() + i * row, row), origin);
  }
  return file;
}

// ---- the formats ----------------------------------------------------------------------------------------------------

struct Format {
  FormatInfo info;
  bool (*recognises)(Bytes) = nullptr;
  Result<SplatFile> (*read)(Bytes, const ReadOptions&) = nullptr;
  /// Absent also for .rgs, which encode() writes.
  Result<std::vector<std::byte>> (*write)(const SplatView&, const WriteOptions&) = nullptr;
};

template <Result<SplatFile> (*decode)(Bytes, const DecodeLimits&)>
Result<SplatFile> read_within(Bytes bytes, const ReadOptions& options) {
  return decode(bytes, options.limits);
}

// In the order in which they are recognised, by content and by name: the more special first, those without a signature
// last.
// clang-format off
constexpr Format kFormats[] = {
    {{SplatFormat::rgs, "rgs", "", "RoofGS, with or without levels of detail",
      "direct, packed: mean FP32, harmonics INT8, all else FP16; archive: within the bounds it states",
      kAxes3dgs, 3, true, {.levels = true, .origin = true, .aa_mode = true, .declarations = true}, true},
     is_rgs, decode_rgs},
    {{SplatFormat::compressed_ply, "compressed.ply", "", "PlayCanvas, SuperSplat, gsplat",
      "mean, scale 11, 10, 11 bits by chunk; rotation 32; opacity, harmonics 8",
      kAxes3dgs, 3, true, {.aa_mode = true, .declarations = true}, true},
     detail::is_compressed_ply, detail::decode_compressed_ply, detail::encode_compressed_ply},
    {{SplatFormat::ply, "ply", "", "3DGS; any order and type of properties, further columns",
      "FP32; damaged Gaussians too",
      kAxes3dgs, 3, true, {.origin = true, .aa_mode = true, .declarations = true}, true},
     is_ply, decode_ply, encode_ply},
    {{SplatFormat::tileset, "tileset.json", "tileset.json", "3D Tiles 1.0 and 1.1 above glTF with splats; written with .spz.glb",
      "as .spz.glb; read as .glb",
      kAxes3dTiles, 3, true, {.levels = true, .origin = true, .aa_mode = true, .declarations = true}, true, true},
     detail::is_tileset, detail::decode_lone_tileset},
    {{SplatFormat::spz_glb, "spz.glb", "", "the next with an SPZ inside (KHR_gaussian_splatting_compression_spz_2)",
      "as .spz, version 3",
      kAxesGltf, 3, true, {.origin = true, .aa_mode = true, .declarations = true}},
     detail::is_spz_glb, detail::decode_gltf, detail::encode_spz_glb},
    {{SplatFormat::glb, "glb", "", "glTF 2.0 with KHR_gaussian_splatting, also .gltf; written as .glb",
      "FP32; read from integers of 8 and 16 bits too",
      kAxesGltf, 3, true, {.origin = true, .aa_mode = true, .declarations = true}, false, true},
     detail::is_gltf, detail::decode_gltf, detail::encode_glb},
    {{SplatFormat::usda, "usda", "", "OpenUSD 26.03, text with ParticleField3DGaussianSplat",
      "FP32; read from FP16 or 32",
      kAxesOpenGl, 3, true, {.origin = true, .aa_mode = true, .declarations = true}},
     detail::is_usda, read_within<detail::decode_usda>, detail::encode_usda},
    {{SplatFormat::usdz, "usdz", "", "the same, a package whose first file is a .usda",
      "as .usda",
      kAxesOpenGl, 3, true, {.origin = true, .aa_mode = true, .declarations = true}},
     detail::is_usdz, read_within<detail::decode_usdz>, detail::encode_usdz},
    {{SplatFormat::spz, "spz", "", "Niantic, versions 2 and 3 (gzip) and 4 (zstd)",
      "mean 24 bits; rotation 32 (version 2: 24); scale, opacity, colour 8; harmonics 5 and 4",
      kAxes3dgs, 3, true, {.origin = true, .aa_mode = true}},
     detail::is_spz, detail::decode_placed_spz, detail::encode_spz},
    {{SplatFormat::npz, "npz", "", "NumPy archive of gsplat's arrays means, scales, quats, opacities, sh0, shN",
      "FP32; read from FP16, 32 or 64",
      kAxes3dgs, 3, true, {.origin = true}},
     detail::is_npz, read_within<detail::decode_npz>, detail::encode_npz},
    {{SplatFormat::pt, "pt", "", "checkpoint of gsplat by PyTorch: the same arrays as tensors",
      "FP16, 32 or 64",
      kAxes3dgs, 3, false, {.origin = true}},
     detail::is_torch_checkpoint, read_within<detail::decode_torch_checkpoint>},
    {{SplatFormat::ssog, "ssog", "lod-meta.json", "PlayCanvas, streamed SOG, a folder or zipped; written of an .rgs with levels",
      "as .sog",
      kAxes3dgs, 3, true, {.levels = true, .aa_mode = true}, true, true},
     detail::is_streamed_sog, detail::decode_streamed_sog},
    {{SplatFormat::sog, "sog", "meta.json", "PlayCanvas, versions 1 and 2, zipped or beside its WebP images; written zipped",
      "mean 16 bits; rotation 26; scale, opacity, colour 8; harmonics a palette",
      kAxes3dgs, 3, true, {.aa_mode = true}, true, true},
     detail::is_sog, detail::decode_sog, detail::encode_sog},
    {{SplatFormat::rad, "rad", "", "Spark 2 (three.js), also with .radc beside it; its tree of an .rgs with levels",
      "mean FP32; rotation 24 bits; scale, opacity, colour, harmonics 8; read from FP16 or 32 too",
      kAxes3dgs, 3, true, {.levels = true}, false, true},
     detail::is_rad, detail::decode_rad, detail::encode_rad},
    {{SplatFormat::lcc, "lcc", "", "XGRIDS, beside its index.bin, data.bin and shcoef.bin",
      "mean FP32; scale 16 bits; rotation 32; opacity, colour 8; harmonics 11, 10, 11",
      kAxesLcc, 3, false, {.levels = true}, true, true},
     detail::is_lcc, read_within<detail::decode_lone_lcc>},
    {{SplatFormat::lcc2, "lcc2", "", "XGRIDS, beside its .sog or .spz",
      "that of .sog or .spz",
      kAxesLcc, 3, false, {.levels = true, .aa_mode = true}, true, true},
     detail::is_lcc2, read_within<detail::decode_lone_lcc>},
    {{SplatFormat::ksplat, "ksplat", "", "GaussianSplats3D, levels 0 to 2; written with level 1",
      "level 0 FP32, 1 and 2 FP16; opacity, colour 8 bits",
      kAxes3dgs, detail::kKsplatShDegree, true, {}, true},
     detail::looks_like_ksplat, detail::decode_ksplat, detail::encode_ksplat},
    {{SplatFormat::splat, "splat", "", "antimatter15",
      "mean, scale FP32; rotation, opacity, colour 8 bits",
      kAxes3dgs, 0, true, {}, true},
     detail::looks_like_splat_records, detail::decode_splat_records, detail::encode_splat_records},
};
// clang-format on

const Format& entry(SplatFormat format) {
  static constexpr Format kUnknown;
  const auto* found = std::ranges::find(kFormats, format, [](const Format& f) { return f.info.format; });
  return found == std::end(kFormats) ? kUnknown : *found;
}

// Formats that are known and not read, by the text with which they begin, that is a key of their JSON, or that is in a
// name of their zip archive.
struct Foreign {
  bool (*recognises)(Bytes, std::string_view);
  std::string_view sign;
  const char* advice;
};
constexpr Foreign kForeign[] = {
    {detail::begins_with, detail::kRadChunkMagic,
     "a .radc of Spark, one chunk of a scene, is not read: name the .rad beside it"},
    {detail::begins_with, "PXR-USDC", detail::kUsdCrate},
    {detail::is_zip_with, "@3dtilesIndex1@",
     "a .3tz, 3D Tiles in one file, is not read: unzip it and name its tileset.json"},
    {detail::begins_with, "\x93NUMPY",
     "one array, a .npy, is not read: put gsplat's arrays into one .npz (numpy.savez)"},
};

// What to do with a file of such a format; null: it is none.
const char* advice_for(Bytes bytes) {
  const auto* found = std::ranges::find_if(kForeign, [&](const Foreign& f) { return f.recognises(bytes, f.sign); });
  return found == std::end(kForeign) ? nullptr : found->advice;
}

tl::unexpected<Error> no_levels() {
  return make_error(Errc::bad_argument, Error::kNone, "no levels of detail are read from this file");
}

// Files in the folder of an .lcc, or the chunks of an .lcc2, which may be thousands, one at a time.
class LccFiles {
 public:
  LccFiles(std::string folder, bool one_at_a_time) : folder_(std::move(folder)), one_at_a_time_(one_at_a_time) {}
  Result<Bytes> fetch(const std::string& name) {
    if (one_at_a_time_ && !files_.empty()) {
      if (unchanged_) unchanged_ = files_.back().check_unchanged();
      files_.pop_back();
    }
    auto file = MappedFile::open(folder_ + "/" + name);
    if (!file) return tl::unexpected(file.error());
    bytes_ += file->bytes().size();
    files_.push_back(std::move(*file));
    return files_.back().bytes();
  }
  // Of all that was fetched so far.
  std::uint64_t bytes() const { return bytes_; }
  Status check_unchanged() {
    for (const MappedFile& file : files_) {
      if (unchanged_) unchanged_ = file.check_unchanged();
    }
    return unchanged_;
  }

 private:
  std::string folder_;
  bool one_at_a_time_ = false;
  std::vector<MappedFile> files_;
  std::uint64_t bytes_ = 0;
  Status unchanged_;
};

Result<SplatFile> read_lcc(Bytes bytes, const std::string& folder, const ReadOptions& options) {
  const bool is_lcc = detail::is_lcc(bytes);
  LccFiles files(folder, !is_lcc);
  auto splats = (is_lcc ? detail::decode_lcc : detail::decode_lcc2)(
      bytes, [&](const std::string& name) { return files.fetch(name); }, options);
  if (const Status s = files.check_unchanged(); !s) return tl::unexpected(s.error());
  return finish(std::move(splats), is_lcc ? SplatFormat::lcc : SplatFormat::lcc2, bytes.size() + files.bytes(),
                options);
}

Result<SplatFile> decode_format(Bytes bytes, const Format& format, const ReadOptions& options) {
  const auto& keeps = format.info.keeps;
  const bool may_have_levels = format.info.format == SplatFormat::rgs ? has_levels(bytes) : keeps.levels;
  if (options.level_of_detail && !may_have_levels) return no_levels();
  if (format.read != nullptr) return format.read(bytes, options);
  if (const char* advice = advice_for(bytes)) return make_error(Errc::unsupported_feature, 0, advice);
  static const std::string none = "is not a " + format_list() + " file";
  return make_error(Errc::bad_magic, 0, none.c_str());
}

}  // namespace

const char* format_name(SplatFormat format) {
  return format_info(format).name;
}

const FormatInfo& format_info(SplatFormat format) {
  return entry(format).info;
}

std::vector<FormatInfo> all_formats() {
  std::vector<FormatInfo> infos;
  for (const Format& format : kFormats) infos.push_back(format.info);
  return infos;
}

std::string format_list(bool writable) {
  std::vector<FormatInfo> infos = all_formats();
  if (writable) std::erase_if(infos, [](const FormatInfo& info) { return !info.writable; });
  std::string list;
  for (const FormatInfo& info : infos)
    list += (&info == &infos.front() ? "." : &info == &infos.back() ? " or ." : ", .") + std::string(info.name);
  return list;
}

SplatFormat detect_format(std::span<const std::byte> bytes) {
  if (advice_for(bytes) != nullptr) return SplatFormat::unknown;
  const auto* found = std::ranges::find_if(kFormats, [&](const Format& format) { return format.recognises(bytes); });
  return found == std::end(kFormats) ? SplatFormat::unknown : found->info.format;
}

SplatFormat format_of_name(const std::string& path) {
  std::string name = detail::path_of(path).filename().string();
  std::ranges::transform(name, name.begin(), [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  const auto* found = std::ranges::find_if(kFormats, [&](const Format& format) {
    return name.ends_with(std::string(".") + format.info.name) || (!name.empty() && name == format.info.other_name);
  });
  return found == std::end(kFormats) ? SplatFormat::unknown : found->info.format;
}

EncodeOptions keep_declarations(EncodeOptions options, const SplatFile& file) {
  if (file.declarations) options = keep_declarations(std::move(options), *file.declarations);
  if (file.declarations) options.provenance = file.provenance;
  if (file.declarations && file.declarations->axes != file.axes) options.first_view = {};  // of means in other axes
  options.axes = file.axes;
  options.colour_space = file.colour_space;
  options.aa_mode = file.aa_mode;
  options.low_pass_px2 = file.low_pass_px2;
  options.metres_per_unit = file.metres_per_unit;
  options.origin = file.origin;
  options.crs = file.crs;
  return options;
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
    if (format == SplatFormat::ssog && detail::is_streamed_sog_meta(bytes)) {
      return make_error(Errc::unsupported_feature, 0,
                        "a streamed SOG's lod-meta.json without its SOGs: name the file, or zip the folder");
    }
    return finish(decode_format(bytes, entry(format), options), format, bytes.size(), options);
  });
}

Result<SplatFile> read_splats(const std::string& path, const ReadOptions& options) {
  return detail::guard_memory([&]() -> Result<SplatFile> {
    const auto file = MappedFile::open(path);
    if (!file) return tl::unexpected(file.error());
    const std::string parent = detail::path_of(path).parent_path().string(), folder = parent.empty() ? "." : parent;
    const bool maybe_gltf = options.format == SplatFormat::unknown || options.format == SplatFormat::glb;
    const bool is_gltf = maybe_gltf && detail::is_gltf_text(file->bytes());
    const bool is_streamed = detail::is_streamed_sog_meta(file->bytes());
    const bool is_lcc = detail::is_lcc(file->bytes()) || detail::is_lcc2(file->bytes());
    const auto read = [&]() -> Result<SplatFile> {
      if (is_lcc) return read_lcc(file->bytes(), folder, options);
      if (detail::is_rad(file->bytes()))
        return finish(detail::decode_rad_folder(file->bytes(), folder, options), SplatFormat::rad, 0, options);
      if (detail::is_tileset(file->bytes()))
        return finish(detail::decode_tileset_folder(file->bytes(), folder, options), SplatFormat::tileset, 0, options);
      if (is_streamed)
        return finish(detail::decode_streamed_sog_folder(file->bytes(), folder, options), SplatFormat::ssog, 0,
                      options);
      if (is_gltf)
        return finish(detail::decode_gltf_folder(file->bytes(), folder, options), SplatFormat::glb, 0, options);
      if (detail::is_sog_meta(file->bytes()))
        return finish(detail::decode_sog_folder(file->bytes(), folder, options), SplatFormat::sog, 0, options);
      return read_splats(file->bytes(), options);
    };
    auto splats = read();
    // A change of the file explains any other error.
    if (const Status s = file->check_unchanged(); !s) return tl::unexpected(s.error());
    return splats;
  });
}

std::vector<std::string> files_of_tileset(const std::string& path) {
  const std::filesystem::path parent = detail::path_of(path).parent_path();
  std::vector<std::string> files;
  (void)detail::guard_memory([&]() -> Result<bool> {
    std::error_code ignored;
    if (!std::filesystem::is_regular_file(detail::path_of(path), ignored)) return false;
    const auto file = MappedFile::open(path);
    if (!file || !detail::is_tileset(file->bytes())) return false;
    for (const std::string& name : detail::opened_by_tileset(file->bytes(), parent.empty() ? "." : parent.string())) {
      std::string found = (parent / detail::path_of(name)).string();
      if (found != path && std::filesystem::is_regular_file(detail::path_of(found), ignored))
        files.push_back(std::move(found));
    }
    return true;
  });
  return files;
}

FormatInfo::Keeps keeps_of(SplatFormat format, const WriteOptions& options) {
  FormatInfo::Keeps keeps = format_info(format).keeps;
  keeps.axes = keeps.crs = keeps.declarations;
  if (format == SplatFormat::spz) {
    keeps.origin = detail::keeps_origin(options);
    keeps.crs = detail::keeps_crs(options);
    keeps.axes = options.axes[0] != Axis::undeclared && !detail::georeference_records(options).empty();
  }
  return keeps;
}

Result<LevelTree> open_levels(std::span<const std::byte> bytes, const std::string& folder, const ReadOptions& options) {
  return detail::guard_memory([&]() -> Result<LevelTree> {
    const bool is_lcc = detail::is_lcc(bytes);
    if (!is_lcc && !detail::is_lcc2(bytes)) {
      if (detail::is_tileset(bytes)) return detail::open_tileset_levels(bytes, folder, options);
      if (detail::is_rad(bytes)) return detail::open_rad_levels(bytes, folder, options);
      if (!detail::is_streamed_sog(bytes)) return no_levels();
      return detail::open_streamed_sog_levels(bytes, folder, options);
    }
    const auto files = std::make_shared<LccFiles>(folder, !is_lcc);
    auto tree = (is_lcc ? detail::open_lcc_levels : detail::open_lcc2_levels)(
        bytes, [files](const std::string& name) { return files->fetch(name); }, options.limits);
    if (!tree) return tree;
    tree->file.bytes = bytes.size() + files->bytes();
    tree->read = [files, read = std::move(tree->read)](const LevelTree::Visit& visit) -> Status {
      const Status status = read(visit);
      if (const Status s = files->check_unchanged(); !s) return s;
      return status;
    };
    return tree;
  });
}

Result<double> position_rounding(const SplatView& splats, SplatFormat format, const WriteOptions& options) {
  return detail::guard_memory([&]() -> Result<double> {
    const Origin origin = keeps_of(format, options).origin ? kNoOrigin : options.origin;
    const bool is_spz = detail::holds_spz(format);
    if (origin == kNoOrigin && !is_spz) return 0.0;
    const std::vector<float> positions = positions_of(splats, origin);
    int bits = 0;
    if (is_spz) {
      SplatView placed = splats;
      placed.mean = positions;
      const auto chosen = detail::choose_fractional_bits(placed);
      if (!chosen) return tl::unexpected(chosen.error());
      bits = *chosen;
    }
    double largest = 0;
    for (std::size_t i = 0; i < positions.size(); ++i) {
      double held = static_cast<double>(positions[i]);
      if (is_spz) held = std::ldexp(std::floor(std::ldexp(held, bits) + 0.5), -bits);
      const double error = std::fabs(held - (origin[i % 3] + static_cast<double>(splats.mean[i])));
      if (std::isfinite(error)) largest = std::max(largest, error);
    }
    return largest;
  });
}

Result<std::vector<std::byte>> encode_splats(const SplatView& splats, SplatFormat format, const WriteOptions& options,
                                             WriteReport* report) {
  return detail::guard_memory([&]() -> Result<std::vector<std::byte>> {
    const Format& f = entry(format);
    if (f.write == nullptr) return make_error(Errc::bad_argument, Error::kNone, "this format cannot be written");
    if (!splats.consistent()) return make_error(Errc::bad_argument, Error::kNone, "the view's array sizes disagree");
    if (splats.n > std::numeric_limits<std::uint32_t>::max()) {
      return make_error(Errc::limit_exceeded, Error::kNone, "more than 2^32 - 1 Gaussians; split the scene",
                        std::numeric_limits<std::uint32_t>::max(), splats.n);
    }
    if (report != nullptr) *report = {};
    if (format == SplatFormat::ply) return f.write(splats, options);
    if (const Status s = check_sound(splats); !s) return tl::unexpected(s.error());
    std::vector<float> positions;  // FP32, where the format holds no origin
    SplatView placed = splats;
    if (options.origin != kNoOrigin && !keeps_of(format, options).origin) {
      if (options.strict) {
        return make_error(Errc::bad_value, Error::kNone,
                          "the format holds no origin: positions would be rounded to FP32; write "
                          ".rgs, .ply, .glb, .usda, .npz or .spz of version 4, or drop --strict");
      }
      positions = positions_of(splats, options.origin);
      placed.mean = positions;
    }
    if (report != nullptr || options.strict) {
      const WriteReport clamping = detail::measure_clamping(placed, format);
      if (report != nullptr) *report = clamping;
      if (const Status s = detail::refuse_clamping(clamping); options.strict && !s) return tl::unexpected(s.error());
    }
    return f.write(placed, options);
  });
}

}  // namespace rgs
