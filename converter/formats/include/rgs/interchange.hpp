// interchange.hpp - splat files of any known format as one value in memory, told apart by their content.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/file.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// docs/INTERCHANGE.md says what each format keeps and what it loses.
enum class SplatFormat : std::uint8_t {
  unknown,
  rgs,
  ply,             ///< 3DGS PLY, see ply.hpp
  compressed_ply,  ///< PLY with packed_position (PlayCanvas, SuperSplat, gsplat)
  spz,             ///< Niantic SPZ; versions 2 to 4 are read, 4 is written
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
  float low_pass_px2 = 0.3F;  ///< what an .rgs declares
  SplatCloud cloud;
};

struct ReadOptions {
  DecodeLimits limits;
  SplatFormat format = SplatFormat::unknown;  ///< read as this; unknown: as the content says
  bool keep_axes = false;  ///< leave Gaussians in the file's frame; otherwise declared axes are turned into kAxes3dgs
};

/// Reads a whole file of any format. Memory: a constant times the size of the file (decompressed sizes are checked
/// against it before they are allocated, see docs/INTERCHANGE.md). Values are passed on as they are stored, NaN too.
/// Errors: read_failed (also if the file is written to meanwhile); those of PlyFile::open and FileView::open(); for the other formats bad_magic, unsupported_version,
/// unsupported_feature, reserved_bits, bad_header, bad_syntax, bad_value, truncated, size_mismatch, trailing_bytes,
/// checksum_mismatch, missing_section, limit_exceeded, each with the byte offset in the file (inside SOG: in the image
/// or in meta.json).
Result<SplatFile> read_splats(const std::string& path, const ReadOptions& options = {});
/// The same from memory; a SOG must be zipped.
Result<SplatFile> read_splats(std::span<const std::byte> bytes, const ReadOptions& options = {});

struct WriteOptions {
  ColourSpace colour_space = ColourSpace::srgb_display;  ///< declared where the format can (glb)
  AaMode aa_mode = AaMode::classic;                      ///< declared where the format can (spz)
  bool keep_order = false;  ///< compressed.ply: do not gather near Gaussians in its chunks of 256
};

/// True for what encode_splats() writes: ply, compressed_ply, spz, splat and glb.
bool is_writable(SplatFormat format);

/// A file of that format. `splats` must be in format_axes(format), or of undeclared axes; values that the format
/// cannot hold are clamped to its range. Deterministic.
/// Errors: bad_argument (not writable, inconsistent view), limit_exceeded (more Gaussians than the format counts),
/// bad_value (damaged, see find_defects(), in formats other than ply; or a mean beyond SPZ's range), whose offset is
/// the Gaussian's index.
Result<std::vector<std::byte>> encode_splats(const SplatView& splats, SplatFormat format,
                                             const WriteOptions& options = {});

}  // namespace rgs
