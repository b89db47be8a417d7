// audit.hpp - the result of rgs-audit for one source and one asset: values only; audit_*.cpp fill and print them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "console.hpp"
#include "rgs/camera.hpp"
#include "rgs/image.hpp"
#include "rgs/interchange.hpp"
#include "rgs/layout.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"

namespace rgs::audit {

/// An error, and the file or names that it is about.
struct Failure {
  std::string subject;
  Error error;
};
template <class T>
using Outcome = tl::expected<T, Failure>;

inline tl::unexpected<Failure> make_error(std::string subject, const Error& error) {
  return tl::unexpected(Failure{std::move(subject), error});
}

/// A further measure of the views, taken over black and over white; the worse value counts.
struct Measure {
  const char* name;  ///< in --measures and as a condition
  const char* key;   ///< in JSON
  const char* title;
  bool at_least;  ///< more is better
  const char* scale;
  const char* method;
  const char* shows;  ///< of its maps
};
inline constexpr std::size_t kFlip = 0, kMsSsim = 1, kGmsd = 2;
inline constexpr std::array<Measure, 3> kMeasures{{
    {"flip", "flip", "FLIP", false, "0 is equal, 1 the most",
     "LDR-FLIP (Andersson et al. 2020) of sRGB values clamped to 0..1, at 67.02 pixels per degree",
     "What an observer sees who flips between both pictures"},
    {"ms-ssim", "ms_ssim", "MS-SSIM", true, "1 is equal",
     "multi-scale SSIM (Wang et al. 2003), whole 11 x 11 windows of SSIM at five scales, at fewer in small pictures",
     "What differs in contrast and structure, fine or coarse"},
    {"gmsd", "gmsd", "GMSD", false, "0 is equal",
     "gradient magnitude similarity deviation (Xue et al. 2014) of luma at half the size",
     "Where edges differ, at half the size"},
}};
using Chosen = std::array<bool, kMeasures.size()>;
using Values = std::array<std::optional<double>, kMeasures.size()>;

struct Options {
  std::string source, asset;
  std::vector<std::string> also;  ///< other files of the same scene, measured like the asset
  std::string cameras;            ///< camera file or COLMAP folder; empty: views on a circle around the scene
  std::string split;              ///< train, test, all; empty: test if there are more than 32 cameras, else all
  std::string photos;             ///< folder of photographs named like the cameras; may be empty
  tool::ImageSize size;           ///< of all views; 0: the cameras' own, 1280x720 without cameras
  int views = 8;                  ///< number of views without cameras
  int worst = 4;                  ///< without cameras, further views: the worst ones of a search
  bool render = true;             ///< false: sizes and attributes only
  bool attribution = true;
  bool compare_scales = false;  ///< also compare one SH scale set for the file with one per chunk
  bool depth = false;           ///< also compare depths
  Chosen measures{};            ///< what else is measured
  bool video = false;           ///< the cameras are frames in their order
  int fps = 30;                 ///< of the video
  bool distances = true;        ///< of a file with levels of detail: quality from afar
  Backend backend = Backend::automatic;
  int threads = 0;
  std::uint64_t picture_bytes = std::uint64_t{512} << 20;  ///< of the source in memory at a time; at least one view's
  ReadOptions read;                                        ///< limits, and the axes of SPZ
};

// ---- size

struct SectionSize {
  std::string type, content;
  std::uint64_t stored_bytes = 0, decoded_bytes = 0;
};

struct StoredLevels {
  std::uint32_t n_levels = 0, n_pages = 0;
  std::uint64_t n_gaussians = 0;  ///< of all pages
};

struct SizeReport {
  std::uint64_t source_bytes = 0, asset_bytes = 0;
  std::uint64_t n_source = 0, n_asset = 0;  ///< of level 0
  int source_sh_degree = 0, asset_sh_degree = 0;
  /// What a renderer keeps resident: sections, or all pages, decoded; 0 if not an .rgs file.
  std::uint64_t gpu_bytes = 0;
  std::uint64_t gpu_bytes_fp32 = 0;  ///< the same scene as FP32 attributes
  std::vector<SectionSize> sections;
  std::optional<StoredLevels> levels{};

  double ratio() const;                   ///< source over asset, bytes
  double bytes_per_gaussian() const;      ///< of the asset's file
  double gpu_bytes_per_gaussian() const;  ///< resident
};

// ---- attributes

/// Distribution of absolute errors. Quantiles are upper edges of bins 1/64 of a power of two wide: at most 1.6 % high.
struct ErrorStatistics {
  std::uint64_t n = 0, n_zero = 0;
  double max = 0, mean = 0, rms = 0, p50 = 0, p99 = 0, p999 = 0;
  int first_octave = 0;                    ///< quarter octaves from 2^first_octave on
  std::vector<std::uint64_t> histogram{};  ///< errors in [2^(first_octave + i / 4), ...); excludes zeros
};

/// One attribute's error, in its own unit and in its meaning's.
struct AttributeError {
  std::string key, name;           ///< "sh2.green", "SH degree 2, green"
  std::string unit, meaning_unit;  ///< "", "8-bit levels"
  ErrorStatistics value, meaning;
};

struct WorstGaussian {
  double error = 0;  ///< in the meaning's unit
  std::uint64_t asset_index = 0, source_index = 0;
  std::array<double, 3> mean{};  ///< position in the source, world coordinates
};
struct WorstList {
  std::string key, name, unit;
  std::vector<WorstGaussian> gaussians;  ///< worst first
};

/// How often each code -127..127 is used, by degree.
struct CodeUsage {
  std::array<std::uint64_t, 255> count{};
  std::uint64_t n() const;
  int used() const;  ///< different codes that occur
  double entropy_bits() const;
};

/// Values that the number formats could not hold.
struct RangeCounts {
  std::uint64_t sh_clipped = 0;  ///< source more than half a step beyond the codes' range
  std::uint64_t sh_limit = 0;    ///< codes of +-127: the largest of each step set, so always some
  std::uint64_t sh_flushed = 0;  ///< source not 0, stored 0
  std::uint64_t scale_subnormal = 0, scale_zero = 0;
  std::uint64_t opacity_zero = 0, opacity_one = 0;  ///< where the source is not 0 or 1
};

enum class PairedBy : std::uint8_t { permutation, order, means, nearest };

/// Which Gaussians source and asset share, whatever the asset's format.
struct PairReport {
  PairedBy by = PairedBy::means;
  std::uint64_t n_paired = 0, n_source_only = 0, n_asset_only = 0;
};

/// A declaration of the asset that differs from the source's, in words.
struct DeclaredDifference {
  std::string key, name, source, asset;
  bool changes_picture = false;  ///< and no picture of the audit shows it: a contradiction
};

struct AttributeReport {
  std::vector<AttributeError> errors;
  AttributeError colour;  ///< all degrees and channels of a Gaussian, over all directions
  std::vector<WorstList> worst;
  std::vector<CodeUsage> codes;  ///< [sh_degree + 1]
  RangeCounts ranges;
  double seconds = 0;  ///< of pairing and comparing
};

// ---- rendered

/// A view over a black and over a white background. Colours blend linearly: over no background within 0..1 does a channel
/// of two such pictures differ by more than over one of these.
struct Picture {
  Image black, white;
  Image depth = {};  ///< expected depth; empty unless asked for
  const Image& over(bool over_white) const { return over_white ? white : black; }
};

/// Depths are compared where the alphas of source and asset are both at least this: the expected depth of less is that of
/// the little that is drawn.
inline constexpr float kDepthAlpha = 0.5F;
/// Errors over the source's depth, of the pixels that are compared.
struct DepthScore {
  double error = 0, largest = 0;  ///< the mean and the largest
  double compared = 0;            ///< share of all pixels
};

/// Differences are those over the background that shows more, chosen for each channel of each pixel; SSIM is the lower
/// one of both backgrounds.
struct Score {
  double mse = 0, psnr = 0, ssim = 1;
  float largest = 0;
  int x = 0, y = 0;         ///< of the largest difference
  bool over_white = false;  ///< white alone shows more than black alone
  std::optional<DepthScore> depth{};
  Values measures{};
  std::optional<double> flicker{};  ///< of a video: see VideoReport
};

struct PhotoScore {
  double source_psnr = 0, asset_psnr = 0, source_ssim = 0, asset_ssim = 0;
  double loss() const { return source_psnr == asset_psnr ? 0 : source_psnr - asset_psnr; }  // both may be infinite
};

/// A view is rated if the source or the asset draws on at least this share of its pixels. With one pixel in a hundred
/// drawn, the equal background adds 20 dB: 28 dB on the drawn pixels would pass for 48 dB, "no visible loss".
inline constexpr double kRatedShare = 0.01;
/// A view below this share is rated but flagged: the background adds 10 dB to its PSNR. If less than this share of the
/// source's or of the asset's Gaussians lies in rated views, most of the scene is not compared.
inline constexpr double kHardlySeenShare = 0.1;

struct ViewResult {
  std::string name;
  int width = 0, height = 0;
  double drawn = 1;  ///< share of pixels on which the source or, if larger, the asset draws
  Score score;       ///< of rated views; with levels of detail each measure is the worse one of `leaves` and `levels`
  std::optional<PhotoScore> photo;          ///< likewise the one that loses more
  std::optional<Score> leaves{}, levels{};  ///< of a file with levels of detail: see LevelPsnr

  bool rated() const { return drawn >= kRatedShare; }
  bool hardly_sees() const { return drawn < kHardlySeenShare; }
};

/// The loss from one cause alone, or from all together.
struct AttributionRow {
  std::string key, name;
  double psnr = 0;   ///< mean over the views, dB
  double worst = 0;  ///< worst view, dB
  double mse = 0;    ///< mean over the views
  double share = 0;  ///< of the mse of all together; shares need not sum to 1, because errors add up or cancel
  std::optional<double> loss{};  ///< against the photographs, mean over the views, dB
};

struct ViewPictures {
  std::size_t view = 0;  ///< index into RenderReport::views
  Picture source, asset;
  Image photo = {};  ///< empty without photographs
};

/// A file with levels of detail is drawn twice in each view: its leaves like a file without levels, against the source;
/// and at the default detail as renderers draw it, against all of the source with the same compensated opacities.
struct LevelPsnr {
  double leaves = 0, levels = 0;  ///< means over the views, dB
};

/// One measure of a video, frame by frame.
struct Curve {
  std::string key, name;
  bool at_least = false;         ///< more is better
  std::vector<double> values{};  ///< [frames]; NaN where not rated
  std::size_t worst = 0;         ///< frame
  std::size_t second = 0;        ///< first frame of the worst second
  double second_mean = 0;        ///< of its rated frames; of PSNR that of their mean squared error
};

/// Flicker of a frame: how much the asset's change since the frame before differs from the source's, levels of 255, RMS
/// over the background that shows more. The first frame has none, nor has one after a frame that is not rated.
struct VideoReport {
  int fps = 0;
  std::vector<std::string> frames{};  ///< names, in the cameras' order
  std::vector<Curve> curves{};        ///< PSNR, SSIM, the measures, flicker
  std::optional<double> flicker{}, worst_flicker{};

  std::string name_of(std::size_t frame) const;
};

struct AlsoReport {
  std::string path, note;  ///< note: why there is no quality
  bool has_levels = false;
  std::uint64_t bytes = 0, n_gaussians = 0;
  std::optional<double> psnr, worst_psnr, ssim, loss;
};

/// "The views" of means, worst values and attribution are the rated ones.
struct RenderReport {
  std::string backend;
  bool automatic_views = false;
  std::size_t n_searched = 0;     ///< views among which the worst were chosen, whose names begin with "found"
  std::vector<ViewResult> views;  ///< rated ones first, worst PSNR first
  std::size_t n_rated = 0;
  double drawn = 0;  ///< ViewResult::drawn, mean over all views
  /// Gaussians whose mean lies in no rated view: what they draw was not compared.
  std::uint64_t source_unseen = 0, asset_unseen = 0;
  /// NaN without a rated view, which fails every condition.
  double psnr = kUnrated, worst_psnr = kUnrated, ssim = kUnrated, worst_ssim = kUnrated, mse = kUnrated;
  float largest = std::numeric_limits<float>::quiet_NaN();
  std::optional<double> loss;           ///< mean over the views, dB
  std::optional<PhotoScore> photo;      ///< means over the views
  std::optional<DepthScore> depth;      ///< of the view with the largest mean error
  Values measures{}, worst_measures{};  ///< means over the views, and those of the worst views
  std::optional<VideoReport> video{};
  std::optional<LevelPsnr> level_psnr;
  std::vector<AttributionRow> attribution;
  std::string attribution_note;          ///< why it is missing, or what it excludes
  std::uint64_t n_undrawable = 0;        ///< damaged Gaussians of the source, missing from the reference
  std::vector<ViewPictures> pictures{};  ///< of the worst views, worst first
  std::vector<Camera> cameras{};         ///< of the rated views, in their order
  double seconds = 0;

  static constexpr double kUnrated = std::numeric_limits<double>::quiet_NaN();
};

// ---- levels of detail at a distance

/// What is compared with the truth at each distance.
enum class FarScene : std::uint8_t {
  leaves,       ///< all Gaussians as the asset declares
  compensated,  ///< all Gaussians with Mip-Splatting's opacities and the levels' low-pass
  levels,       ///< the pages chosen at the default detail, as renderers draw them
};
inline constexpr std::size_t kFarScenes = 3;

/// Against the truth, values clamped to 0..1; over two backgrounds, like Score.
struct FarScore {
  double psnr = 0, worst_psnr = 0, ssim = 0, worst_ssim = 0;
};
/// PSNR above this is a waste: levels that reach it lose nothing.
inline constexpr double kEnoughDb = 44;
/// Levels that lose more than this in any view fail every gate without a limit of its own for them, and are not graded
/// better than "visible differences": four times the squared error that all Gaussians would leave.
inline constexpr double kLevelsLossDb = 6;

struct FarView {
  std::string name;
  int width = 0, height = 0;
  std::array<double, kFarScenes> psnr{}, ssim{};  ///< by FarScene
  double drawn = 0;  ///< Gaussians of the chosen pages, in view or not, over those of the asset

  /// What levels lose against all Gaussians compensated or, if less, against kEnoughDb.
  double loss() const;
};
/// The rated views from `far` times the distance, with 1 / `far` of their size.
struct FarRow {
  int far = 1;
  std::array<FarScore, kFarScenes> scores{};  ///< means and worst of the views
  double drawn = 0;                           ///< mean of the views
  std::vector<FarView> views{};

  const FarScore& score(FarScene what) const { return scores[static_cast<std::size_t>(what)]; }
};
struct FarPictures {
  std::size_t row = 0, view = 0;  ///< FarRow::views[view]: the one with the worst levels
  Picture truth, leaves, levels;
  bool over_white = false;  ///< of the levels, as in Score
};

/// The truth is the source as drawn elsewhere, at twice the size of the nearest view, clamped to 0..1 and averaged over
/// squares of pixels.
struct DistanceReport {
  float detail_px = 0;
  std::vector<FarRow> rows;             ///< near to far; without distances at which views are too small
  std::vector<FarPictures> pictures{};  ///< one a row
  std::string note{};                   ///< why rows are missing
  double seconds = 0;

  const FarRow* at(int far) const;  ///< null: not measured
  /// The view with the largest FarView::loss().
  struct Worst {
    double loss = std::numeric_limits<double>::quiet_NaN();  ///< NaN without rows
    double psnr = 0;                                         ///< of its levels
    int far = 0;
    std::string view{};
  };
  Worst worst() const;
};

// ---- all

struct Condition {
  std::string name;
  double limit = 0, found = 0;
  bool at_least = true, holds = false;
};

struct Report {
  std::string tool, source_name, source_format, asset_name, asset_format;
  std::uint64_t source_xxh3 = 0, asset_xxh3 = 0;
  /// Shell command that shows both sides in rgs-view, with paths as given; empty if a path cannot be typed.
  std::string view_command = {};
  std::string fingerprint;               ///< of tool, options and inputs: equal fingerprints give equal measurements
  std::optional<bool> made_from_source;  ///< whether the asset's provenance names this source; absent: it has none
  std::optional<Declarations> declarations;  ///< the asset's, whatever its format
  /// The source's, if its anti-aliasing or low-pass is not the default: it is drawn with them.
  std::optional<Declarations> source_stated;
  std::vector<DeclaredDifference> declared_differences = {};
  double source_rounding = 0;  ///< largest of a coordinate by reading the source in FP32, world units
  SizeReport size;
  PairReport pairs;
  std::optional<AttributeReport> attributes;  ///< of an .rgs asset
  std::optional<RenderReport> render;
  std::optional<DistanceReport> distances;  ///< of a file with levels of detail
  std::vector<AlsoReport> also;
  std::vector<Condition> gate;
  double seconds = 0;

  bool gate_holds() const;
  std::size_t n_contradictions() const;
  /// Share of the Gaussians in rated views, of the source or, if smaller, of the asset; 0 without pictures.
  double seen_share() const;
};

/// The result in words; the report's first line.
struct Verdict {
  enum class Grade : std::uint8_t { identical, lossless, close, visible, poor, unrated };
  Grade grade = Grade::unrated;
  bool depth_range_misfit = false;  ///< the quantised sort key alone is below 35 dB in some view
  bool hardly_seen = false;         ///< rated, but the pictures are mostly background or show a small part of the scene
  std::string finding;              ///< without conditions
  std::string headline, detail;     ///< headline: failed conditions, then the finding
};
Verdict verdict(const Report& report);

/// Sentences that limit the verdict: a source that FP32 cannot hold, views that are unrated or hardly see the scene.
std::vector<std::string> warnings(const Report& report);

/// Hash of this program's version, the contents of all inputs and every option that changes a measurement; an equal
/// hash means that an earlier result still holds. Excludes conditions: see earlier_audit(). Reads all inputs. Errors:
/// open_failed, read_failed.
Outcome<std::string> fingerprint(const Options& options);

/// Does all that `options` ask for, except the gate, see evaluate(). Errors: those of Source::open(), FileView::open(),
/// PagedFile::open(), validate(), the cameras and photographs; bad_value if no Gaussian of an .rgs asset is in the
/// source.
Outcome<Report> run(const Options& options, tool::Progress& progress);

}  // namespace rgs::audit
