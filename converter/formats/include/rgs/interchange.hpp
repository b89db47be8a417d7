// interchange.hpp - splat files of any known format as one value in memory, told apart by their content.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/file.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// docs/user/INTERCHANGE.md says what each format keeps and what it loses.
enum class SplatFormat : std::uint8_t {
  unknown,
  rgs,
  ply,             ///< 3DGS PLY, see ply.hpp
  compressed_ply,  ///< PLY with packed_position (PlayCanvas, SuperSplat, gsplat)
  spz,             ///< Niantic SPZ; versions 2 to 4
  splat,           ///< 32 bytes a Gaussian, no harmonics
  ksplat,          ///< GaussianSplats3D, levels 0 to 2; read only
  sog,             ///< PlayCanvas SOG, zipped or meta.json beside its images; read only
  glb,             ///< binary glTF with KHR_gaussian_splatting, 32-bit floats
};

/// "ply", "compressed.ply", "spz", ...; also what --from and --to of rgs-convert take.
const char* format_name(SplatFormat format);
/// What a file holds, by its first bytes and, for the two formats without a signature (.ksplat, .splat), by whether
/// its size and records make sense as such.
SplatFormat detect_format(std::span<const std::byte> bytes);
/// What a file of that name should hold, by its ending (and meta.json).
SplatFormat format_of_name(const std::string& path);

/// Where +x, +y and +z of a scene point.
using Axes = std::array<Axis, 3>;
inline constexpr Axes kAxes3dgs{Axis::right, Axis::down, Axis::forward};
inline constexpr Axes kAxesOpenGl{Axis::right, Axis::up, Axis::backward};
inline constexpr Axes kAxesGltf{Axis::left, Axis::up, Axis::forward};
/// The frame that a format prescribes: SPZ's is OpenGL's, glTF has its own; everything else is in that of 3DGS.
Axes format_axes(SplatFormat format);

struct SplatFile {
  SplatFormat format = SplatFormat::unknown;
  std::uint64_t bytes = 0;  ///< size of the file; of a SOG folder, of all its files
  Axes axes = kAxes3dgs;    ///< of `cloud`
  ColourSpace colour_space = ColourSpace::srgb_display;
  AaMode aa_mode = AaMode::classic;
  std::optional<float> low_pass_px2 = std::nullopt;  ///< absent: default_low_pass_px2(aa_mode)
  float metres_per_unit = 0;                         ///< 0: unknown
  /// Of an .rgs: all that it declares (the axes too are those of `cloud`), where it comes from, and the positions of its
  /// Gaussians in that source, [n], if it keeps them.
  std::optional<Declarations> declarations = std::nullopt;
  std::optional<Provenance> provenance = std::nullopt;
  std::vector<std::uint32_t> source_index = {};
  /// Of an .rgs with levels of detail: how many it has, and whether `cloud` is the finest, the scene's own Gaussians.
  std::uint32_t n_levels = 0;
  bool finest = true;
  /// What the file holds besides, one phrase each, and SplatCloud has no place for: extensions of SPZ that do not
  /// change its Gaussians.
  std::vector<std::string> unused = {};
  SplatCloud cloud;
  Origin origin = kNoOrigin;  ///< of `cloud`, in `axes`: of an .rgs, a PLY of doubles (ply.hpp), a far node of a glb
};

/// `options` with what a file states of its scene: of an .rgs all declarations and its provenance, of others axes,
/// colours, anti-aliasing, low-pass and units. For encode() of Gaussians that were read, and perhaps filtered, from it.
EncodeOptions keep_declarations(EncodeOptions options, const SplatFile& file);

struct ReadOptions {
  DecodeLimits limits;
  SplatFormat format = SplatFormat::unknown;  ///< read as this; unknown: as the content says
  bool keep_axes = false;  ///< leave Gaussians in the file's frame; otherwise declared axes are turned into kAxes3dgs
  /// SPZ: read past extensions of unknown type, which are unsupported_feature otherwise. They may change what the
  /// Gaussians mean; SplatFile::unused names them.
  bool skip_unknown_extensions = false;
  /// Of an .rgs with levels of detail: this level (0: the finest); or the finest cut through the levels of at most so many
  /// Gaussians, see lod::finest_cut(). Neither: the finest level. A level of a file without levels is bad_argument; files
  /// without levels are read as a whole whatever max_count is.
  std::optional<std::uint32_t> level_of_detail = std::nullopt;
  std::optional<std::uint64_t> max_count = std::nullopt;
  /// [pages] how many Gaussians of each page count towards max_count, for who keeps only some of them; empty: all. Pages of which
  /// none counts are not read, but of a file that has places in its source where it fits as a whole.
  std::vector<std::uint32_t> page_counts = {};
};

/// Reads a whole file of any format. Memory: a constant times the size of the file (decompressed sizes are checked
/// against it before they are allocated, see docs/user/INTERCHANGE.md). Values are passed on as they are stored, NaN too.
/// Errors: read_failed (also if the file is written to meanwhile); bad_argument (no such level, none of so few Gaussians, or
/// page_counts of another file); pages_missing (the
/// end of an .rgs with levels is missing, and with it some of what is asked for); those of PlyFile::open, FileView::open() and PagedFile::open(); for the other formats bad_magic, unsupported_version,
/// unsupported_feature, reserved_bits, bad_header, bad_syntax, bad_value, truncated, size_mismatch, trailing_bytes,
/// checksum_mismatch, missing_section, limit_exceeded, each with the byte offset in the file (inside SOG: in the image
/// or in meta.json).
Result<SplatFile> read_splats(const std::string& path, const ReadOptions& options = {});
/// The same from memory; a SOG must be zipped.
Result<SplatFile> read_splats(std::span<const std::byte> bytes, const ReadOptions& options = {});

struct WriteOptions {
  ColourSpace colour_space = ColourSpace::srgb_display;  ///< stated by ply, compressed_ply and glb
  AaMode aa_mode = AaMode::classic;                      ///< stated by these and spz
  std::optional<float> low_pass_px2 = std::nullopt;  ///< stated by ply, compressed_ply and glb if it is not the mode's
  float metres_per_unit = 0;                         ///< stated by these if it is not 0
  Axes axes = kAxes3dgs;                             ///< of the Gaussians; stated by ply and compressed_ply
  /// Of the Gaussians; ply and glb keep it, others hold FP32 positions: position_rounding().
  Origin origin = kNoOrigin;
  bool keep_order = false;  ///< compressed.ply: do not gather near Gaussians in its chunks of 256
  int spz_version = 3;      ///< 2, 3 or 4; docs/user/INTERCHANGE.md says which viewer reads which
  /// Refuse to clamp: bad_value if WriteReport::any(), or if an origin has no place.
  bool strict = false;
};

/// Gaussians with a value that a format cannot hold, and how far the farthest is beyond the format's range.
struct Clamped {
  std::uint64_t n = 0;
  double largest = 0;
};

/// What a format's ranges did to a scene, by attribute. Rounding to the nearest code is not clamping: it is in
/// docs/user/INTERCHANGE.md and for all Gaussians alike.
struct WriteReport {
  Clamped mean;           ///< spz: moved farther than usual, since some means are far out; world units
  Clamped log_scale;      ///< spz, compressed.ply
  Clamped opacity_logit;  ///< glb: the opacity is 0 or 1 as a 32-bit float
  Clamped sh_dc;          ///< spz, splat; of f_dc
  Clamped sh;             ///< spz, compressed.ply; splat, which has none: those that are not 0

  bool any() const { return mean.n + log_scale.n + opacity_logit.n + sh_dc.n + sh.n != 0; }
};

/// True for what encode_splats() writes: ply, compressed_ply, spz, splat and glb.
bool is_writable(SplatFormat format);
/// Whether files of that format have a place for an origin: rgs, ply (as double coordinates) and glb. What is written as any
/// other has FP32 positions.
bool keeps_origin(SplatFormat format);

/// A file of that format. `splats` must be in format_axes(format) or of undeclared axes, for ply and compressed_ply in
/// options.axes; values that the format cannot hold are clamped to its range, which `report` counts. Deterministic.
/// Errors: bad_argument (not writable, inconsistent view, no such version of SPZ), limit_exceeded (more Gaussians than
/// the format counts),
/// bad_value (damaged, see find_defects(), in formats other than ply; or a mean beyond SPZ's range), whose offset is
/// the Gaussian's index; bad_value without an offset for what WriteOptions::strict refuses, which is in `report`.
Result<std::vector<std::byte>> encode_splats(const SplatView& splats, SplatFormat format,
                                             const WriteOptions& options = {}, WriteReport* report = nullptr);

/// How far a coordinate in such a file may be from origin + mean, world units: what FP32 takes from the positions where the
/// format has no place for an origin, and SPZ's fixed point. 0 where positions are kept. What the blocks of a
/// compressed.ply lose on top, in proportion to their size, is not in it. Errors: those of encode_splats() for SPZ.
Result<double> position_rounding(const SplatView& splats, SplatFormat format, const Origin& origin);

}  // namespace rgs
