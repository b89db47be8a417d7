// encode.hpp - encodes Gaussians in memory as an .rgs file in one call. For scenes that do not fit:
// rgs/scene_writer.hpp.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/scene_scan.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

struct DepthRange {
  float z_near = 0;  ///< camera z, world units
  float z_far = 0;
  DepthSource source = DepthSource::by_hand;  ///< how it was found
};

/// The default range: from the near plane of 3DGS to ten diagonals of the robust box, or one if linear.
DepthRange depth_range_from_extent(const Box& robust, DepthMapping mapping);

/// How sections are stored. direct and packed decode to the same bytes.
enum class Profile : std::uint8_t {
  direct,  ///< as the GPU reads them
  packed,  ///< Codec::planes: about two thirds of the size
  archive  ///< Codec::archive: lossy within stated bounds, a seventh of the size or less; the same layout once decoded
};

/// Losses that Profile::archive may cause: docs/user/PROFILES.md. Defaults are archive_high().
struct ArchiveOptions {
  float step = 1;        ///< 1/16 to 64: all errors are about in proportion to it
  unsigned threads = 0;  ///< 0: as many as the machine runs at once; the file does not depend on it

  bool operator==(const ArchiveOptions&) const = default;
};
/// Presets; costs in docs/user/PROFILES.md.
ArchiveOptions archive_high();
ArchiveOptions archive_small();
ArchiveOptions archive_tiny();
inline constexpr int kMaxLevel = 19;

struct EncodeOptions {
  Profile profile = Profile::direct;
  ArchiveOptions archive;
  int level = 1;                       ///< packed: effort, 1 to kMaxLevel; docs/user/PROFILES.md
  std::uint32_t chunk_size = 256;      ///< Gaussians per chunk, a multiple of 32 in [32, 2^16], 2^15 with archive
  bool chunk_step_sets = true;         ///< SH steps per chunk; false: one set for the file (the paper's scheme)
  Order order = Order::morton;         ///< of the Gaussians in the file
  bool keep_permutation = false;       ///< store each Gaussian's position in the source
  int sh_degree = kMaxShDegree;        ///< higher degrees are stripped
  BadPolicy on_bad = BadPolicy::drop;  ///< what becomes of damaged Gaussians
  double max_bad_fraction = 0.01;  ///< a larger share of damaged Gaussians is too_many_bad; ignored under repair/refuse
  std::optional<DepthRange> depth;                                   ///< absent: from the extent of the scene
  DepthMapping depth_mapping = DepthMapping::logarithmic;            ///< about 4.5 bits better than linear, the paper's
  std::array<Axis, 3> axes{Axis::right, Axis::down, Axis::forward};  ///< where +x, +y and +z of the means point
  ColourSpace colour_space = ColourSpace::srgb_display;
  AaMode aa_mode = AaMode::classic;                  ///< how the scene was trained
  std::optional<float> low_pass_px2 = std::nullopt;  ///< absent: default_low_pass_px2(aa_mode)
  float metres_per_unit = 0;                         ///< 0: unknown
  /// of the means; |x| <= kMaxOrigin
  Origin origin = kNoOrigin;
  Crs crs;               ///< of origin + mean
  FirstView first_view;  ///< see choose_first_view()
  /// With levels, but not Profile::archive: pages get origins of their own where a Splat::mean_rest is not 0, so that
  /// means keep a quarter of a millimetre however far apart they are (a unit of unknown size counts as a metre).
  bool page_origins = false;
  float cutoff_sigma = 3.f;             ///< extent of the kernel, standard deviations
  float alpha_threshold = 1.f / 255.f;  ///< smaller alphas are not blended
  float alpha_max = 0.99f;              ///< larger alphas are clamped to it
  float transmittance_min = 1e-4f;      ///< blending ends below it
  std::optional<Provenance> provenance;
  /// For Gaussians that were loaded or filtered before, so that the file describes their original source:
  std::uint64_t n_source = 0;    ///< Gaussians in it; 0 or fewer than given: those given
  std::uint64_t n_repaired = 0;  ///< repaired before
  /// keep_permutation: each given Gaussian's position in the source, [n], all different and below n_source. Must
  /// outlive the call, or the SceneWriter. Empty: 0, 1, 2, ..., which needs n_source = 0.
  std::span<const std::uint32_t> source_index = {};
};

/// `options` with all that `declared` states of a scene: axes, colours, anti-aliasing, low-pass, units, origin, CRS,
/// first view, depth range and mapping, thresholds, n_source and n_repaired; so encode() keeps the declarations of a scene that was
/// loaded and filtered. Provenance and positions are no declarations: see FileView::provenance() and source_index().
EncodeOptions keep_declarations(EncodeOptions options, const Declarations& declared);

/// Whether a scene with this scan can be encoded with these options; an empty scan checks the options alone. Errors:
/// bad_argument (options out of range), bad_value (BadPolicy::refuse), too_many_bad.
Status check_encodable(const SceneScan& scan, const EncodeOptions& options);

/// The file for `splats`. Deterministic (packed and archive: for a version of Zstandard; archive: also for a C library's
/// exponentials and logarithms on a kind of processor). Single-threaded except Profile::archive. Errors: bad_argument
/// (options out of range, contradicting sizes of the view or source_index), bad_value (BadPolicy::refuse; offset is the
/// Gaussian's index), too_many_bad, limit_exceeded (more than 2^32 - 1 Gaussians to sort); those of
/// SceneWriter::finish().
Result<std::vector<std::byte>> encode(const SplatView& splats, const EncodeOptions& options = {});

}  // namespace rgs
