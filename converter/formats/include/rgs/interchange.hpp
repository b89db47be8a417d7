// interchange.hpp - reads and writes splat files of any known format; detects the format from the content.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/file.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

class PagedFile;

/// docs/user/INTERCHANGE.md says what each format keeps and loses.
enum class SplatFormat : std::uint8_t {
  unknown,
  rgs,
  ply,             ///< 3DGS PLY, see ply.hpp
  compressed_ply,  ///< PLY with packed_position (PlayCanvas, SuperSplat, gsplat)
  spz,             ///< Niantic SPZ; versions 2 to 4
  splat,           ///< 32 bytes a Gaussian, no harmonics
  ksplat,          ///< GaussianSplats3D, levels 0 to 2; written with level 1
  sog,             ///< PlayCanvas SOG, zipped or meta.json beside its images; written zipped
  ssog,            ///< PlayCanvas streamed SOG, zipped or lod-meta.json above its SOGs; written by write_streamed_sog()
  glb,             ///< glTF with KHR_gaussian_splatting, also .gltf; written as .glb
  spz_glb,         ///< the same with an SPZ inside
  tileset,         ///< 3D Tiles: tileset.json above its .glb; written by write_tileset()
  usda,            ///< OpenUSD text with ParticleField3DGaussianSplat
  usdz,            ///< OpenUSD package of a .usda
  npz,             ///< NumPy archive of gsplat's parameters
  rad,             ///< Spark 2, also with .radc beside it
  pt,              ///< gsplat's checkpoint of PyTorch; read only
  lcc,             ///< XGRIDS, the finest level; read only
  lcc2,            ///< the same
};

/// "ply", "compressed.ply", "spz", ...: FormatInfo::name.
const char* format_name(SplatFormat format);
/// Detects a file's format from its first bytes; .ksplat and .splat, which have no signature, from plausible sizes and
/// records. unknown also for formats that read_splats() names in its error, such as a .gltf.
SplatFormat detect_format(std::span<const std::byte> bytes);
/// The format that a file name's ending (or meta.json) implies.
SplatFormat format_of_name(const std::string& path);

/// The world directions of a scene's +x, +y and +z.
using Axes = std::array<Axis, 3>;
inline constexpr Axes kAxes3dgs{Axis::right, Axis::down, Axis::forward};
inline constexpr Axes kAxesOpenGl{Axis::right, Axis::up, Axis::backward};
inline constexpr Axes kAxesGltf{Axis::left, Axis::up, Axis::forward};
inline constexpr Axes kAxesLcc{Axis::right, Axis::forward, Axis::up};
inline constexpr Axes kAxes3dTiles{Axis::left, Axis::backward, Axis::up};  ///< those of glTF, turned
/// What a format is and keeps. `rgs-convert --formats` prints it for all.
struct FormatInfo {
  SplatFormat format = SplatFormat::unknown;
  const char* name = "unknown";  ///< the ending of its files, and what rgs-convert's --from and --to take
  const char* other_name = "";   ///< another name that its files have: "meta.json", "lod-meta.json", "tileset.json"
  const char* title = "";        ///< whose it is, and which versions are read
  const char* precision = "";    ///< of its Gaussians; docs/user/INTERCHANGE.md has the ranges
  /// The frame that it prescribes. The description of SPZ says OpenGL's, but its tools leave coordinates as a PLY has
  /// them: ReadOptions::spz_axes.
  Axes axes = kAxes3dgs;
  int sh_degree = 3;      ///< the highest that is written; of ksplat 3 is read
  bool writable = false;  ///< by encode_splats(), .rgs by encode(), .ssog and tilesets by the functions below
  struct Keeps {
    bool levels = false;  ///< of detail, as those of an .rgs: open_levels()
    bool origin = false;  ///< formats without hold FP32 positions; of spz only version 4: keeps_of()
    bool aa_mode = false;
    bool declarations = false;       ///< low-pass, colour space and metres per unit; axes, where none are prescribed
    bool axes = false, crs = false;  ///< keeps_of() sets these
  };
  Keeps keeps = {};
  bool in_parts = false;   ///< read in less memory than its Gaussians take: ReadOptions::visit
  bool in_folder = false;  ///< its Gaussians are, or may be, in files beside it
};
const FormatInfo& format_info(SplatFormat format);
/// All but unknown.
std::vector<FormatInfo> all_formats();
/// ".rgs, .ply or .glb": those that are read, or only those that are written.
std::string format_list(bool writable = false);

/// "right,down,forward", or "undeclared".
std::string axes_text(const Axes& axes);
/// The inverse; none unless three directions span space.
std::optional<Axes> axes_of_text(std::string_view text);

struct SplatFile {
  SplatFormat format = SplatFormat::unknown;
  std::uint64_t bytes = 0;    ///< size of the file; of all files that belong to it, if they are in a folder
  Axes axes = kAxes3dgs;      ///< of `cloud`
  bool axes_assumed = false;  ///< an SPZ without a coordinate record: ReadOptions::spz_axes
  ColourSpace colour_space = ColourSpace::srgb_display;
  AaMode aa_mode = AaMode::classic;
  std::optional<float> low_pass_px2 = std::nullopt;  ///< absent: default_low_pass_px2(aa_mode)
  float metres_per_unit = 0;                         ///< 0: unknown
  /// From an .rgs: all its declarations (axes are again those of `cloud`), its provenance, and, if it keeps them, the
  /// Gaussians' positions in its source, [n].
  std::optional<Declarations> declarations = std::nullopt;
  std::optional<Provenance> provenance = std::nullopt;
  std::vector<std::uint32_t> source_index = {};
  /// From a file with levels of detail, if one may be chosen: the number of levels, and whether `cloud` is level 0.
  std::uint32_t n_levels = 0;
  bool finest = true;
  /// What the file also holds and SplatCloud has no field for, one phrase each: extensions of SPZ that do not change
  /// its Gaussians, what of an OpenUSD stage is not shown or not followed, coarser levels, the environment, meshes and
  /// the georeference of an LCC.
  std::vector<std::string> unused = {};
  SplatCloud cloud;              ///< the Gaussians
  Origin origin = kNoOrigin;     ///< of `cloud`, in `axes`; from an .rgs, doubles of a PLY, npz or pt, or a far node or
                                 ///< prim of a glb or usda
  Crs crs = {};                  ///< of origin + mean
  double position_rounding = 0;  ///< largest rounding of a coordinate by reading, world units: of doubles, or of far
                                 ///< nodes or prims
};

/// `options` with the file's declarations: all, and the provenance, of an .rgs; axes, colours, anti-aliasing, low-pass,
/// units, origin and CRS of others. For encode() of Gaussians that were read from it, and perhaps filtered.
EncodeOptions keep_declarations(EncodeOptions options, const SplatFile& file);

struct ReadOptions {
  DecodeLimits limits;
  SplatFormat format = SplatFormat::unknown;  ///< read as this format; unknown: detect it
  bool keep_axes = false;  ///< leave Gaussians in the file's frame; otherwise declared axes are converted to kAxes3dgs
  /// SPZ: skip extensions of unknown type, which otherwise are unsupported_feature. They may change what the Gaussians
  /// mean; SplatFile::unused names them.
  bool skip_unknown_extensions = false;
  Axes spz_axes = kAxes3dgs;  ///< of an SPZ that declares none by a coordinate record
  /// For an .rgs, .ssog, .rad, .lcc, .lcc2 or tileset: read this level (0: finest; of a .rad the Gaussians that have at
  /// most so many generations below them, and whose parents have more), or of an .rgs the finest cut of at most max_count
  /// Gaussians (lod::finest_cut()). Neither: level 0. A level of a file without levels is bad_argument; files without
  /// levels are read whole whatever max_count is.
  std::optional<std::uint32_t> level_of_detail = std::nullopt;
  std::optional<std::uint64_t> max_count = std::nullopt;
  /// [pages] how many Gaussians of each page count towards max_count, for callers that keep only some; empty: all.
  /// Pages that count 0 are not read, except from a file with positions in its source that fits whole.
  std::vector<std::uint32_t> page_counts = {};
  /// Receives the Gaussians in their order, piece by piece, as `cloud` of what is known of the file; it may change them.
  /// Pieces of formats that are FormatInfo::in_parts are small, so the scene need not fit into memory; others come
  /// whole. Means are relative to the piece's origin, which in a tileset is that of one content; `position_rounding` is
  /// what is lost, without what Splat::mean_rest holds. Implies keep_axes; the returned file has no `cloud` and no
  /// `source_index`. An error of it ends the reading.
  std::function<Status(SplatFile& piece)> visit = nullptr;
};

/// Reads a whole file of any format. Memory: a constant times the file's size (decompressed sizes are checked against
/// it before allocation, see docs/user/INTERCHANGE.md). Values are passed on as stored, NaN too.
/// Errors: read_failed (also if the file changes meanwhile); bad_argument (no such level, no cut of so few Gaussians,
/// or page_counts of another file); pages_missing (an .rgs with levels is cut off, and requested pages with it); those
/// of PlyFile::open, FileView::open() and PagedFile::open(); for other formats bad_magic, unsupported_version,
/// unsupported_feature, reserved_bits, bad_header, bad_syntax, bad_value, truncated, size_mismatch, trailing_bytes,
/// checksum_mismatch, missing_section, limit_exceeded, each with the byte offset in the file (inside SOG: in the image
/// or in meta.json; inside .npz: in the array; inside .pt: in data.pkl; inside .usdz: in its first file; of .lcc and
/// .lcc2 in the file that the text names; of tilesets in the tileset or in the content of a tile).
Result<SplatFile> read_splats(const std::string& path, const ReadOptions& options = {});
/// The same from memory; a SOG must be zipped, an .lcc, .lcc2 or tileset is refused.
Result<SplatFile> read_splats(std::span<const std::byte> bytes, const ReadOptions& options = {});

struct WriteOptions {
  ColourSpace colour_space = ColourSpace::srgb_display;  ///< stated in ply, compressed_ply, glb and usda
  AaMode aa_mode = AaMode::classic;                      ///< stated in these four, spz and sog
  std::optional<float> low_pass_px2 = std::nullopt;      ///< stated in these four if it differs from the mode's default
  float metres_per_unit = 0;                             ///< stated in these four if it is not 0
  Axes axes = kAxes3dgs;                                 ///< of the Gaussians; stated in ply and compressed_ply
  /// Of the Gaussians; ply, glb, usda, npz and spz of version 4 keep it, others hold FP32 positions:
  /// position_rounding().
  Origin origin = kNoOrigin;
  Crs crs = {};  ///< of origin + mean; stated in ply, compressed_ply, glb and, if it can be, spz of version 4
  bool keep_order = false;  ///< compressed.ply, sog: do not sort Gaussians, so that close ones are neighbours
  unsigned threads = 0;     ///< sog, tileset; 0: as many as the machine runs at once. No file depends on it
  int spz_version = 3;      ///< 2, 3 or 4; docs/user/INTERCHANGE.md says which viewer reads which
  /// Refuse to clamp: bad_value if WriteReport::any(), or if the format has no field for an origin.
  bool strict = false;
};

/// How many Gaussians have a value beyond the format's range, and by how much at most.
struct Clamped {
  std::uint64_t n = 0;  ///< Gaussians
  double largest = 0;   ///< excess, in the attribute's unit
};

/// What a format's ranges changed in a scene, by attribute. Rounding to the nearest code is not clamping:
/// docs/user/INTERCHANGE.md gives it.
struct WriteReport {
  Clamped mean;           ///< spz: means with coarser steps than usual, because some are far out; world units
  Clamped log_scale;      ///< spz, compressed.ply, ksplat
  Clamped opacity_logit;  ///< glb, usda: the opacity is 0 or 1 as a 32-bit float
  Clamped sh_dc;          ///< spz, splat, ksplat, sog; of f_dc
  Clamped sh;             ///< spz, compressed.ply, sog; splat and ksplat: also those not 0 above their degree

  bool any() const { return mean.n + log_scale.n + opacity_logit.n + sh_dc.n + sh.n != 0; }
};

/// Encodes a file of that format. `splats` must be in FormatInfo::axes or of undeclared axes, for ply and
/// compressed_ply in options.axes, for spz in options.axes, which should be those that its readers assume. Values beyond
/// the format's range are clamped and counted in `report`. Deterministic.
/// Errors: bad_argument (rgs or not writable, inconsistent view, no such version of SPZ); limit_exceeded (more
/// Gaussians than the format counts); bad_value with a Gaussian's index as offset (damaged, see find_defects(), in
/// formats other than ply; or a mean beyond SPZ's range); bad_value without an offset (no Gaussians, of which a sog has
/// at least one, or WriteOptions::strict refuses what `report` counts).
Result<std::vector<std::byte>> encode_splats(const SplatView& splats, SplatFormat format,
                                             const WriteOptions& options = {}, WriteReport* report = nullptr);

/// Receives a file of a scene that is a folder, by its path in it.
using PutFile = std::function<Status(const std::string& name, std::span<const std::byte> bytes)>;
struct LevelsReport {
  std::uint32_t n_levels = 0;
  std::uint32_t n_regions = 0;  ///< of a tileset: tiles; of a .rad 0
  std::uint64_t n_stored = 0;   ///< Gaussians of all levels
  double position_rounding = 0;
  WriteReport clamped;
};
/// Writes an .rgs with levels as streamed SOG: SOG after SOG, of at most 512 Ki Gaussians, lod-meta.json last. Regions
/// are pages of the coarsest level at which they hold so many with all their levels, or of a finer one if most are
/// wider than 16 units; coarser levels are left out. options.axes and options.origin are those of the file.
/// Deterministic. Memory: that of one SOG. Errors: pages_missing, those of read_pages(), encode_splats() and `put`.
Result<LevelsReport> write_streamed_sog(const PagedFile& file, const WriteOptions& options, int sh_degree,
                                        const PutFile& put);

/// Writes an .rgs with levels as an explicit tileset of 3D Tiles 1.1: tile after tile, each an SPZ inside a .glb, then
/// tileset.json. A tile holds the pages some levels below one page: as many levels as keep it at most at 32 Ki Gaussians.
/// Coarser levels are left out. `folder`, a name: of the tiles. Otherwise as write_streamed_sog(). Memory: that of one
/// tile a thread.
Result<LevelsReport> write_tileset(const PagedFile& file, const WriteOptions& options, int sh_degree,
                                   const std::string& folder, const PutFile& put);
/// The same of a scene without levels, as one tile. `splats` are in kAxes3dTiles or of undeclared axes.
Result<LevelsReport> write_tileset(const SplatView& splats, const WriteOptions& options, const std::string& folder,
                                   const PutFile& put);

/// Writes an .rgs with levels as a .rad with a tree, one file without a name: each level, and one Gaussian above the
/// coarsest. Each Gaussian is below one of its page's parent; coarser ones without any below are left out. Otherwise as
/// write_streamed_sog(). Memory: all levels, decoded, twice. Errors: limit_exceeded too (more than 65,535 Gaussians
/// below one).
Result<LevelsReport> write_rad(const PagedFile& file, const WriteOptions& options, int sh_degree, const PutFile& put);

/// What a file of that format with these options keeps of the scene.
FormatInfo::Keeps keeps_of(SplatFormat format, const WriteOptions& options);

/// Largest distance of a written coordinate from origin + mean, world units: from FP32 positions where the format holds
/// no origin, and from SPZ's fixed point, also inside .glb. 0 where positions are kept. Excludes the steps of compressed.ply, ksplat and
/// sog, which are proportional to the size of chunks, buckets or the scene. Errors: those of encode_splats() for SPZ.
Result<double> position_rounding(const SplatView& splats, SplatFormat format, const WriteOptions& options = {});

}  // namespace rgs
