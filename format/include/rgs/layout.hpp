// layout.hpp - the contents of an .rgs file: sizes and numbers of its layout (magic, versions, record sizes, section
// types, codecs, limits), and a struct for each parsed record (header, section and frame tables, declarations, chunks,
// SH steps, archive parameters, provenance). The structs are not the bytes: file/layout_io.cpp reads and writes those
// field by field. Gaussians are in splat_cloud.hpp, their quantisation in quantize.hpp. docs/format/FORMAT.md is the
// specification and wins over the code.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

inline constexpr std::array<unsigned char, 8> kMagic = {0x89, 'R', 'G', 'S', 0x0D, 0x0A, 0x1A, 0x0A};
inline constexpr std::uint16_t kVersionMajor = 1;
/// The newest known. A file states the lowest that describes it: 5 with Codec::archive, a CRS, origins of pages or a
/// first view, 4 with levels of detail, 3 with an origin, 2 with Codec::archive_draco, 1 with Codec::planes, else 0.
inline constexpr std::uint16_t kVersionMinor = 5;

inline constexpr std::uint64_t kHeaderBytes = 128;
inline constexpr std::uint64_t kSectionEntryBytes = 64;
inline constexpr std::uint64_t kHeadChecksumBytes = 8;
inline constexpr std::uint64_t kSectionAlignment = 256;
inline constexpr std::uint32_t kMaxSections = 1024;

inline constexpr std::uint64_t kMeanBytes = 12;      ///< FP32 x, y, z
inline constexpr std::uint64_t kGeometryBytes = 16;  ///< FP16 w, x, y, z, sx, sy, sz, opacity: one 128-bit load
inline constexpr std::uint64_t kStepSetBytes = 48;   ///< FP32 [4, 3]: degree, channel
inline constexpr std::uint64_t kChunkEntryBytes = 48;
inline constexpr std::uint64_t kDeclarationBytes = 256;
inline constexpr std::uint64_t kCrsHeadBytes = 4;  ///< of CREF, before its text

inline constexpr std::uint64_t kLevelsHeadBytes = 64;     ///< of LODS, before its records
inline constexpr std::uint64_t kPageRecordBytes = 112;    ///< of LODS, one a page
inline constexpr std::uint64_t kPageAlignment = 256;      ///< of pages stored as is
inline constexpr std::uint64_t kPageOriginBytes = 16;     ///< of an origin of a page, before its arrays
inline constexpr std::uint64_t kPageArrayAlignment = 16;  ///< of each array within a page, as decoded

inline constexpr std::uint32_t kMinChunkSize = 32;
inline constexpr std::uint32_t kMaxChunkSize = 1u << 16;

/// Bytes of SH a Gaussian: 3 * (degree + 1)^2 INT8, padded to a multiple of 4: 4, 12, 28, 48.
constexpr std::uint64_t sh_bytes(int degree) {
  return (3 * static_cast<std::uint64_t>(sh_coefficients(degree)) + 3) / 4 * 4;
}
static_assert(sh_bytes(0) == 4 && sh_bytes(1) == 12 && sh_bytes(2) == 28 && sh_bytes(3) == 48);

/// Four ASCII characters in file order.
constexpr std::uint32_t four_cc(const char (&name)[5]) {
  std::uint32_t code = 0;
  for (int i = 3; i >= 0; --i) code = code << 8 | static_cast<unsigned char>(name[i]);
  return code;
}

enum class SectionType : std::uint32_t {
  declarations = four_cc("DECL"),  ///< 256 bytes, see Declarations
  sh_steps = four_cc("SHSC"),      ///< FP32 [n_step_sets, 4, 3]
  chunks = four_cc("CHNK"),        ///< ChunkEntry [n_chunks]
  means = four_cc("MEAN"),         ///< FP32 [n, 3]
  geometry = four_cc("GEOM"),      ///< FP16 [n, 8]
  sh = four_cc("SHI8"),            ///< INT8 [n, sh_bytes]
  archive = four_cc("ARCH"),       ///< with Codec::archive: its parameters, docs/format/ARCHIVE.md
  permutation = four_cc("PERM"),   ///< optional: position in the source, u32 [n], u64 [n] above 2^32 source Gaussians
  provenance = four_cc("PROV"),    ///< optional: Provenance
  crs = four_cc("CREF"),           ///< optional: Crs
  levels = four_cc("LODS"),        ///< of a file with levels of detail: its tree of pages, see paged_file.hpp
  pages = four_cc("PAGE"),         ///< of such a file: its Gaussians, instead of SHSC, CHNK, MEAN, GEOM and SHI8
};

enum class Codec : std::uint32_t {
  none = 0,           ///< stored bytes are the decoded bytes
  planes = 1,         ///< a frame table and frames: byte planes of transformed rows, Zstandard; for coded_type()
  archive_draco = 2,  ///< a frame table and frames: lossy codes, docs/format/ARCHIVE.md; MEAN, GEOM and SHI8 together
  archive = 3         ///< the same in fewer bytes, from version 1.5 on
};
constexpr bool is_archive(Codec codec) {
  return codec == Codec::archive_draco || codec == Codec::archive;
}

/// Section types that may have Codec::planes.
constexpr bool coded_type(SectionType type) {
  return type == SectionType::sh_steps || type == SectionType::chunks || type == SectionType::means ||
         type == SectionType::geometry || type == SectionType::sh;
}

/// Section types that have one of the archive codecs, all or none. Pages may have it, or Codec::planes.
constexpr bool archive_type(SectionType type) {
  return type == SectionType::means || type == SectionType::geometry || type == SectionType::sh;
}

/// An independently decodable piece of a coded section.
struct CodedFrame {
  std::uint64_t offset = 0;  ///< in the file
  std::uint32_t stored_bytes = 0;
  std::uint64_t xxh3 = 0;  ///< of the stored bytes
};

/// Frame i of a section has rows i * rows .. min(n, (i + 1) * rows) - 1; a row is a Gaussian, a chunk or an SH step
/// set.
struct FrameTable {
  std::uint32_t rows = 0;
  std::vector<CodedFrame> frames;  ///< empty in a section stored as is
};
inline constexpr std::uint32_t kMaxFrameRows = 1u << 16, kMaxArchiveRows = 1u << 15;  ///< the latter: Codec::archive
inline constexpr std::uint64_t kFrameTableBytes = 8;                                  ///< without its entries and hash
inline constexpr std::uint64_t kFrameEntryBytes = 16;

inline constexpr std::uint32_t kSectionMustUnderstand = 1;  ///< bit of SectionEntry::flags; the others are reserved

struct SectionEntry {
  std::uint32_t type = 0;
  std::uint32_t flags = 0;
  std::uint32_t codec = 0;
  std::uint64_t offset = 0;
  std::uint64_t stored_bytes = 0;
  std::uint64_t decoded_bytes = 0;
  std::uint64_t xxh3 = 0;  ///< XXH3-64, seed 0, of the stored bytes
};

struct Header {
  std::uint16_t version_major = kVersionMajor;
  std::uint16_t version_minor = 0;
  std::uint64_t file_bytes = 0;
  std::uint64_t n_gaussians = 0;
  std::uint64_t n_chunks = 0;
  std::uint64_t n_step_sets = 0;
  std::uint32_t chunk_size = 0;
  std::uint32_t n_sections = 0;
  std::uint8_t sh_degree = 0;
  std::int16_t scale_exponent = 0;  ///< stored scale = scale * 2^scale_exponent
};

/// Direction of a scene's axis; `undeclared`: not known.
enum class Axis : std::uint8_t { undeclared = 0, right = 1, left = 2, up = 3, down = 4, forward = 5, backward = 6 };
enum class ColourSpace : std::uint8_t { undeclared = 0, srgb_display = 1, linear_display = 2 };
enum class ShBasis : std::uint8_t { real_3dgs = 1 };    ///< constants and signs of Kerbl et al. 2023, +0.5
enum class Kernel : std::uint8_t { gaussian_ewa = 1 };  ///< EWA-projected Gaussian
enum class AaMode : std::uint8_t { undeclared = 0, classic = 1, mip_splatting = 2 };
enum class SortMetric : std::uint8_t { z_depth = 1 };
enum class DepthMapping : std::uint8_t { linear = 1, logarithmic = 2 };
enum class DepthSource : std::uint8_t { cameras = 1, scene_extent = 2, by_hand = 3 };
enum class Order : std::uint8_t { input = 1, morton = 2 };

/// Low-pass of a scene that does not declare one, square pixels: 0.1 for Mip-Splatting, else 0.3 as in 3DGS.
constexpr float default_low_pass_px2(AaMode mode) {
  return mode == AaMode::mip_splatting ? 0.1f : 0.3f;
}

/// Of means, relative to the origin.
struct Box {
  std::array<float, 3> min{0, 0, 0};
  std::array<float, 3> max{0, 0, 0};
};

/// The coordinate reference system of positions, origin + mean.
struct Crs {
  std::string text;  ///< an authority's code, such as EPSG:4978, or WKT; empty: none. Untrusted: show it as plain text
  /// Where the first, second, third coordinate of the system point, if the positions were turned since; undeclared: they
  /// are x, y, z of the positions.
  std::array<Axis, 3> axes{};

  bool operator==(const Crs&) const = default;
};
inline constexpr std::uint32_t kMaxCrsText = 1u << 14;
/// Whether a text can be that of a Crs: UTF-8 of at most kMaxCrsText bytes without control characters, not empty.
bool is_crs_text(std::string_view text);

/// Where a first view stands.
enum class ViewKind : std::uint8_t {
  none = 0,
  outside = 1,  ///< of what it looks at, which can be seen from around
  inside = 2,   ///< of a scene that is all around
};

/// The view from which a scene is seen first.
struct FirstView {
  ViewKind kind = ViewKind::none;  ///< none: all else is 0
  /// Relative to the origin, at most kMaxOrigin; different. It looks at the pivot.
  std::array<float, 3> position{0, 0, 0}, pivot{0, 0, 0};
  std::array<float, 3> up{0, 0, 0};  ///< unit direction
  float horizontal_fov = 0;          ///< 1 to 179 degrees
  bool operator==(const FirstView&) const = default;
};

/// Facts of a scene that a reader must not guess. Defaults are the original 3DGS code's.
struct Declarations {
  std::array<Axis, 3> axes{Axis::right, Axis::down, Axis::forward};  ///< where +x, +y, +z point
  ColourSpace colour_space = ColourSpace::srgb_display;
  ShBasis sh_basis = ShBasis::real_3dgs;
  Kernel kernel = Kernel::gaussian_ewa;
  AaMode aa_mode = AaMode::classic;
  SortMetric sort_metric = SortMetric::z_depth;
  DepthMapping depth_mapping = DepthMapping::linear;
  DepthSource depth_source = DepthSource::scene_extent;
  Order order = Order::morton;
  float z_near = 0.2f;  ///< depth range of the quantised sort key, world units, 0 < z_near < z_far
  float z_far = 100.f;
  float metres_per_unit = 0;  ///< 0: unknown
  float cutoff_sigma = 3.f;   ///< extent of the kernel in standard deviations
  float alpha_threshold = 1.f / 255.f;
  float alpha_max = 0.99f;
  float low_pass_px2 = 0.3f;  ///< added to the diagonal of the screen-space covariance, square pixels
  float transmittance_min = 1e-4f;
  Box full;                       ///< of all means
  Box robust;                     ///< of the means without outliers on each axis
  float robust_fraction = 0.99f;  ///< share of the means inside `robust` on each axis, at least
  std::uint64_t n_source = 0;     ///< Gaussians in the source
  std::uint64_t n_dropped = 0;    ///< left out: damaged or filtered
  std::uint64_t n_repaired = 0;
  std::uint64_t n_scale_subnormal = 0;  ///< stored scales below the normal range of FP16, not zero
  std::uint64_t n_scale_zero = 0;       ///< stored scales that are zero
  std::uint64_t n_opacity_zero = 0;     ///< stored opacities that are 0
  std::uint64_t n_opacity_one = 0;      ///< stored opacities that are 1
  Origin origin = kNoOrigin;            ///< of all means and boxes of the file; |x| <= kMaxOrigin
  FirstView first_view;
  Crs crs;  ///< in a section of its own, CREF
};

/// One entry of the chunk table: answers questions about a chunk without reading its Gaussians.
struct ChunkEntry {
  Box means;                   ///< exact bounds of the means
  float radius = 0;            ///< largest 3-sigma extent of a Gaussian of the chunk, world units
  float max_opacity = 0;       ///< largest stored opacity
  std::uint64_t step_set = 0;  ///< index into the SHSC section
  std::uint32_t count = 0;     ///< Gaussians in the chunk: chunk_size, fewer only in the last
};

/// Step sizes of the SH codes. value = step[degree][channel] * code.
struct ShStepSet {
  float step[4][3] = {};
  /// Step of value i of a Gaussian's SH: coefficient i div 3, channel i mod 3.
  constexpr float of_value(int i) const { return step[sh_degree_of(i / 3)][i % 3]; }
};

/// Steps of archives for the Gaussians of a class, and the error bounds that the writer verified.
struct ArchiveClass {
  std::uint32_t dc_step = 1;     ///< of SH degree 0, 1/65536
  float sh_step = 0;             ///< of the other degrees
  std::uint32_t sh_units = 1;    ///< Codec::archive: the same in units of the file
  float bound_dc = 0;            ///< of each coefficient of degree 0; half the chunk's SH step comes on top
  float bound_sh = 0;            ///< of the other coefficients, likewise
  float bound_mean = 0;          ///< Codec::archive: of the distance, in blurred standard deviations
  float bound_covariance = 0;    ///< Codec::archive: see docs/format/ARCHIVE.md
  float rotation_step = 0;       ///< Codec::archive_draco: of quaternion components
  std::uint32_t scale_step = 1;  ///< likewise: of log2(scale), 1/65536
  std::int32_t scale_base = 0;   ///< likewise: log2(scale) of code 0, 1/65536
  float bound_rotation = 0;      ///< likewise: angle, radians
  float bound_scale = 0;         ///< likewise: of ln(scale), if it is stored as a normal FP16 number
};
inline constexpr std::uint32_t kMaxArchiveClasses = 32;

/// Steps of Codec::archive; logarithms to base 2 in 1/65536.
struct ShapeParameters {
  double nearest = 1;            ///< distances from the grid's centre count as this much at least; squared
  std::int32_t blur = 0;         ///< of what a pixel blurs, in distances
  std::int32_t coarse_step = 1;  ///< of blurred scales
  std::int32_t fine_step = 0, turn_step = 0, mean_step = 0;  ///< logarithms of steps at the middle importance
  std::int32_t middle = 0;                                   ///< importance of the middle class
  std::int32_t slope = 0;  ///< steps are proportional to importance^(-slope / 2), 1/65536
};

/// Contents of section ARCH.
struct ArchiveParameters {
  Codec codec = Codec::archive;
  std::uint32_t mean_cells = 4;  ///< 2^mean_cells cells between centre and half width on each axis
  std::uint32_t mean_bits = 1;   ///< of a coordinate
  std::uint32_t opacity_levels = 1;
  std::array<double, 3> centre{0, 0, 0}, half_width{1, 1, 1};
  float step = 0;  ///< Codec::archive: ArchiveOptions::step
  ShapeParameters shape;
  float sh_step = 0, dc_step = 0, rotation_step = 0, scale_step = 0;  ///< archive_draco: of the middle class
  float slope = 0, class_octaves = 0;                                 ///< archive_draco
  float bound_mean = 0;     ///< archive_draco: of |error| / max(half_width, |mean - centre|) on each axis
  float bound_opacity = 0;  ///< Codec::archive: of the square root
  std::vector<ArchiveClass> classes;
};

struct Provenance {
  std::uint64_t source_bytes = 0;
  std::uint64_t source_xxh3 = 0;  ///< XXH3-64, seed 0, of the source file
  std::string source_name;        ///< UTF-8 file name without folders, at most 4096 bytes
  std::string tool;               ///< UTF-8 program and version, at most 4096 bytes
};
inline constexpr std::uint32_t kMaxProvenanceText = 4096;

}  // namespace rgs
