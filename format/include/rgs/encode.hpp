// encode.hpp - from Gaussians to an .rgs file: in memory with one call, or streamed in two passes.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// What to do with Gaussians that cannot be drawn (see Defect).
enum class BadPolicy : std::uint8_t {
  refuse,  ///< any damaged Gaussian is an error
  drop,    ///< leave damaged Gaussians out
  repair   ///< mend what has an obvious meaning, leave out the rest
};

/// Kinds of damage, each counted once per Gaussian that has it.
enum class Defect : std::uint8_t {
  mean,   ///< a coordinate is not finite                                   repair: dropped
  scale,  ///< log-scale is not finite or beyond +-60                       repair: -inf becomes -60; others dropped
  rotation_nan,      ///< a rotation component is not finite                           repair: identity
  rotation_zero,     ///< the quaternion is zero (norm below 2^-60)                    repair: identity
  opacity_nan,       ///< the logit is NaN                                             repair: dropped
  opacity_infinite,  ///< the logit is infinite                                        repair: +-20
  sh,                ///< an SH coefficient is not finite or above kShLimit            repair: 0
};
inline constexpr int kDefectKinds = 7;
/// "mean", "scale", "rotation_nan", ...
const char* defect_name(Defect defect);

/// Bit i is set if the Gaussian has Defect i; coefficients above `sh_degree` are not looked at.
std::uint32_t find_defects(const Splat& splat, int sh_degree);
/// Mends `splat` as listed at Defect; false if it has to be dropped.
bool repair(Splat& splat, std::uint32_t defects);

struct DepthRange {
  float z_near = 0;
  float z_far = 0;
  DepthSource source = DepthSource::by_hand;
};

/// How sections are stored. direct and packed decode to the same bytes.
enum class Profile : std::uint8_t {
  direct,  ///< as the GPU reads them
  packed,  ///< Codec::planes: about two thirds of the size
  archive  ///< Codec::archive: lossy within stated bounds, a sixth of the size and less; same layout once decoded
};

/// What Profile::archive may lose. Steps are those of a Gaussian of median importance (opacity^2 times area, over squared
/// distance where that is large); a Gaussian of x times its importance gets steps x^(-slope / 2) times as large, x limited
/// to 2^-8 .. 2^8. Defaults are archive_high().
struct ArchiveOptions {
  int mean_cells = 15;    ///< 4 to 20: 2^mean_cells cells between centre and half width of the robust box, on each axis
  float sh_step = 0.11f;  ///< of SH above degree 0, after decorrelation; 2^-20 to 2^20
  float dc_step = 0.14f;  ///< of SH degree 0, after decorrelation; 2^-10 to 2^6
  float rotation_step = 1.f / 64;  ///< of quaternion components; 2^-10 to 0.5
  float scale_step = 0.15f;        ///< of ln(scale); 2^-10 to 2
  int opacity_levels = 96;         ///< 1 to 4096 steps between 0 and 1
  float slope = 0.6f;              ///< 0 to 1
  unsigned threads = 0;            ///< 0: as many as the machine runs at once; the file does not depend on it

  bool operator==(const ArchiveOptions&) const = default;
};
/// Presets; what they cost is in docs/PROFILES.md.
ArchiveOptions archive_high();
ArchiveOptions archive_small();
inline constexpr int kMaxLevel = 19;

struct EncodeOptions {
  Profile profile = Profile::direct;
  ArchiveOptions archive;
  int level = 1;                   ///< packed: effort, 1 to kMaxLevel; see docs/PROFILES.md
  std::uint32_t chunk_size = 256;  ///< Gaussians per chunk, a multiple of 32 in [32, 2^16]
  bool chunk_step_sets = true;     ///< SH steps per chunk; false: one set for the file (the paper's scheme)
  Order order = Order::morton;
  bool keep_permutation = false;  ///< store each Gaussian's position in the source
  int sh_degree = kMaxShDegree;   ///< higher degrees are stripped
  BadPolicy on_bad = BadPolicy::drop;
  double max_bad_fraction = 0.01;   ///< more damaged Gaussians than this share is too_many_bad; not under repair/refuse
  std::optional<DepthRange> depth;  ///< absent: from the extent of the scene
  DepthMapping depth_mapping = DepthMapping::logarithmic;  ///< about 4.5 bits better than linear, the paper's
  std::array<Axis, 3> axes{Axis::right, Axis::down, Axis::forward};
  ColourSpace colour_space = ColourSpace::srgb_display;
  AaMode aa_mode = AaMode::classic;
  float metres_per_unit = 0;
  std::optional<Provenance> provenance;
};

/// The file for `splats`. Deterministic (packed and archive: for one version of Zstandard and Draco; archive: and of the C
/// library's exp() and log() on one kind of processor). Single-threaded but for Profile::archive.
/// Errors: bad_argument (options out of range, sizes of the view disagree), bad_value (BadPolicy::refuse; offset is the
/// Gaussian's index), too_many_bad, limit_exceeded (more than 2^32 - 1 Gaussians to sort); those of encode_archive().
Result<std::vector<std::byte>> encode(const SplatView& splats, const EncodeOptions& options = {});

// ---- streamed encoding ---------------------------------------------------------------------------------------------
// For scenes that do not fit into memory, and for several threads:
//   1. SceneScan::add every Gaussian in any split; merge() the parts.       (first pass over the source)
//   2. spatial_order() of the means that find_defects() and the policy let through.
//   3. make_plan(): every size and offset of the file is known from here on.
//   4. encode_chunk() for each chunk, in any order, on any thread.          (second pass)
//   5. finish(): head, tables and small sections, given the hashes of the large ones.
// Results do not depend on the split. For Profile::packed the chunks of a frame go through PackedEncoder, frames are
// put anywhere, and finish_packed() says where each belongs.

/// Largest |SH| of each coefficient over the Gaussians added.
class ShMagnitudes {
 public:
  void add(const float* sh, int sh_degree);  ///< sh: [16, 3] as in Splat
  void merge(const ShMagnitudes& other);
  /// Largest |SH| per degree and channel.
  ShStepSet max_abs() const;

 private:
  std::array<std::int32_t, 48> bits_{};  // magnitudes as integers, which order alike and vectorise on any x86-64
};

/// What the first pass learns. Every field is independent of the order in which Gaussians are added.
class SceneScan {
 public:
  /// `sh_degree` of the source; coefficients above options.sh_degree do not count.
  SceneScan(int sh_degree, const EncodeOptions& options);

  /// Examines one Gaussian, mends it under BadPolicy::repair, and says whether it is kept.
  bool add(Splat& splat);
  void merge(const SceneScan& other);

  int sh_degree() const { return sh_degree_; }
  std::uint64_t n_source() const { return n_source_; }
  std::uint64_t n_kept() const { return n_kept_; }
  std::uint64_t n_repaired() const { return n_repaired_; }
  std::uint64_t defects(Defect defect) const { return defects_[static_cast<std::size_t>(defect)]; }
  /// Of the kept Gaussians; boxes and ranges are zero if there are none.
  Box full() const { return n_kept_ == 0 ? Box() : full_; }
  /// Bounds that at least 99 of 100 means lie within on each axis; see FORMAT.md "Robust box".
  Box robust() const;
  float min_log_scale() const { return n_kept_ == 0 ? 0 : min_log_scale_; }
  float max_log_scale() const { return n_kept_ == 0 ? 0 : max_log_scale_; }
  float min_opacity_logit() const { return n_kept_ == 0 ? 0 : min_opacity_logit_; }
  float max_opacity_logit() const { return n_kept_ == 0 ? 0 : max_opacity_logit_; }
  const ShMagnitudes& sh_magnitudes() const { return sh_magnitudes_; }

 private:
  int sh_degree_;
  BadPolicy on_bad_;
  std::uint64_t n_source_ = 0, n_kept_ = 0, n_repaired_ = 0;
  std::array<std::uint64_t, kDefectKinds> defects_{};
  Box full_;
  float min_log_scale_, max_log_scale_, min_opacity_logit_, max_opacity_logit_;
  ShMagnitudes sh_magnitudes_;
  std::vector<std::uint64_t> histogram_;  // [3, 65536] of the top 16 bits of each coordinate, order-preserving
};

/// Where the bytes go. Section offsets are in file order; those of Profile::packed leave room for the worst case, those of
/// Profile::archive mean nothing.
struct EncodePlan {
  Profile profile = Profile::direct;
  ArchiveOptions archive;
  int level = 1;
  Header header;
  Declarations declarations;
  std::optional<Provenance> provenance;
  ShStepSet file_scales;  ///< used if n_step_sets is 1 for the file
  bool chunk_step_sets = true;
  bool keep_permutation = false;
  std::uint64_t permutation_entry_bytes = 0;  ///< 4 or 8, 0 without permutation
  std::vector<SectionEntry> sections;         ///< hashes still 0

  const SectionEntry* find(SectionType type) const;
  /// Gaussians a frame of Profile::packed or archive: whole chunks, at least one.
  std::uint32_t frame_rows() const;
};

/// Errors: as encode().
Result<EncodePlan> make_plan(const SceneScan& scan, const EncodeOptions& options);

/// Counts that only the second pass can know.
struct EncodeCounts {
  std::uint64_t scale_subnormal = 0, scale_zero = 0, opacity_zero = 0, opacity_one = 0;
  void add(const EncodeCounts& other);
};

/// Encodes one chunk. `splats`: its Gaussians, 1..chunk_size of them, already mended.
/// Outputs: means [count * 12], geometry [count * 16], sh [count * sh_bytes].
struct ChunkOutput {
  std::span<std::byte> means, geometry, sh;
  ChunkEntry entry;  // step_set is set by finish()
  ShStepSet scales;  // of this chunk; the file's set if the plan has one
  EncodeCounts counts;
};
void encode_chunk(const EncodePlan& plan, std::span<const Splat> splats, ChunkOutput& out);

/// Hashes of the sections that the caller has written himself.
struct SectionHashes {
  std::uint64_t means = 0, geometry = 0, sh = 0, permutation = 0;
};

/// Bytes that belong at a file offset.
struct FilePiece {
  std::uint64_t offset = 0;
  std::vector<std::byte> bytes;
};

/// Head and small sections. `chunks` and `scales` in chunk order ([n_chunks]; scales ignored for one set per file).
std::vector<FilePiece> finish(const EncodePlan& plan, std::span<const ChunkEntry> chunks,
                              std::span<const ShStepSet> scales, const EncodeCounts& counts,
                              const SectionHashes& hashes);

// ---- Profile::packed
// -------------------------------------------------------------------------------------------------

/// Stored bytes of one frame of each large section.
struct PackedFrames {
  std::vector<std::byte> means, geometry, sh;
};

/// Codes frames, one at a time; takes a few MB. One a thread.
class PackedEncoder {
 public:
  explicit PackedEncoder(const EncodePlan& plan);
  PackedEncoder(PackedEncoder&& other) noexcept;
  ~PackedEncoder();
  /// The chunks of one frame (frame_rows() Gaussians, fewer in the last), as encode_chunk() gave them; `scales` of each
  /// chunk.
  PackedFrames encode(std::span<const std::byte> means, std::span<const std::byte> geometry,
                      std::span<const std::byte> sh, std::span<const ShStepSet> scales);

 private:
  struct State;
  std::unique_ptr<State> state_;
};

/// Frames of the large sections in order. CodedFrame::offset is the caller's own: finish_packed() does not look at it.
struct PackedSections {
  std::vector<CodedFrame> means, geometry, sh;
  std::vector<std::byte> archive_tables;  ///< content of ARCH, for Profile::archive
};

/// Where everything of a packed file belongs.
struct PackedLayout {
  Header header;
  std::vector<SectionEntry> sections;  ///< hashes of MEAN, GEOM, SHI8 and PERM are for the caller to fill in
  std::vector<FilePiece> pieces;       ///< small sections, complete, and the frame tables of the large ones
  /// Section of the type; the plan has it.
  SectionEntry& find(SectionType type);
  /// Stored bytes of a large section before its first frame; part of what its hash covers.
  std::span<const std::byte> table(SectionType type);
  /// The head, once the hashes are there.
  FilePiece head() const;
};
PackedLayout finish_packed(const EncodePlan& plan, std::span<const ChunkEntry> chunks,
                           std::span<const ShStepSet> scales, const EncodeCounts& counts, const PackedSections& frames);

// ---- Profile::archive ----------------------------------------------------------------------------------------------

/// The file of Profile::archive for the plan's Gaussians: `splats` are those that the policy let through, mended and in
/// Morton order (frames are cut along it), `source_index` [n] their positions in the source, which a permutation and errors
/// name. Draco's order becomes the file's. Takes about 300 bytes a Gaussian beside them. What is written has been
/// decoded again and compared with `splats`: see verify_archive().
/// Errors: bad_value (a value too large for the steps asked for; `found` is the Gaussian's source_index), those of
/// verify_archive().
Result<std::vector<std::byte>> encode_archive(const EncodePlan& plan, const SplatView& splats,
                                              std::span<const std::uint32_t> source_index);

/// Opens and decodes `file`, a file of Profile::archive, and compares Gaussian i with Gaussian order[i] of `splats`
/// against the bounds that the file states. Errors: internal (a bound does not hold; the offset is the Gaussian's index
/// in the file), those of FileView::open() and load_direct().
Status verify_archive(std::span<const std::byte> file, const SplatView& splats, std::span<const std::uint32_t> order,
                      unsigned threads = 0);

/// The mean that a file with these parameters decodes to where its source has `mean`: finds Gaussians again that Draco has
/// put into its own order. Those in one cell of the grid cannot be told apart so.
std::array<float, 3> archive_mean(const ArchiveParameters& parameters, const float mean[3]);

}  // namespace rgs
