// convert.hpp - whole-file conversions, streamed and parallel, as rgs-convert runs them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "archive_target.hpp"
#include "build_levels.hpp"
#include "rgs/camera.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/file.hpp"
#include "rgs/interchange.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/ply.hpp"
#include "rgs/result.hpp"
#include "splat_source.hpp"
#include "stream_levels.hpp"

namespace rgs {

/// Receives a stage's progress; texts are static. Called first with the total, then with 0 and the units done, from
/// several threads.
struct StageObserver {
  std::function<void(const char* stage, std::uint64_t total, const char* unit)> begin = [](auto...) {};
  std::function<void(std::uint64_t units)> advance = [](auto...) {};
  std::function<void()> finish = [] {};
};

struct ConvertOptions {
  EncodeOptions encode;  ///< except its origin, which is that of the Gaussians
  /// Depth range as these see the scene, and the first view is the best of them. Empty: encode.depth, or the scene's
  /// extent; encode.first_view, or what choose_first_view() chooses.
  std::vector<Camera> cameras;
  std::optional<float> z_near, z_far;  ///< override either end of the range
  int spz_version = WriteOptions{}.spz_version;
  /// Levels of detail beside the Gaussians of an .rgs (docs/develop/LEVELS.md).
  std::optional<lod::Quality> levels;
  lod::BuildOptions build;                           ///< of levels, except quality and chunks
  std::uint64_t memory_bytes = lod::kDefaultMemory;  ///< for levels, see lod::StreamOptions
  std::string scratch;                               ///< for levels: folder of temporary files
  bool strict =
      false;  ///< fail with bad_value, writing nothing, if values would be clamped or flushed to the output's range
  bool allow_rounding = false;  ///< write means that their origin holds to no millimetre
  AtomicFile::Options output;
  /// Whether a path leads to a file that is read, which no file of a folder that is written may replace.
  std::function<bool(const std::string& path)> is_input = [](const std::string&) { return false; };
};

struct ConvertSummary {
  std::string source_name, source_format, output_format;
  std::uint64_t source_bytes = 0, output_bytes = 0;
  std::uint64_t n_source = 0, n_filtered = 0, n_written = 0, n_repaired = 0;
  int source_sh_degree = 0, sh_degree = 0;
  int spz_version = 0;              ///< of an SPZ
  std::vector<std::string> unused;  ///< other contents of the source, see SplatFile::unused
  std::array<std::uint64_t, kDefectKinds> defects{};
  Declarations declarations;       ///< of an .rgs; for other outputs the scene's
  std::vector<std::string> lost;   ///< declarations of the source that the output cannot state
  std::vector<std::string> notes;  ///< disagreements of inputs, and the like
  Header header;
  std::uint32_t n_levels = 0,
                n_pages = 0;    ///< of an .rgs with levels of detail; n_levels also of what convert_levels() writes
  std::uint32_t n_regions = 0;  ///< of a streamed SOG; tiles of a tileset
  std::uint64_t n_stored = 0;   ///< Gaussians of all levels of these and of a .rad
  std::vector<SectionEntry> sections;
  float min_scale = 0, max_scale = 0, min_opacity = 0, max_opacity = 0;
  std::vector<std::pair<const char*, double>> seconds;  ///< by stage, in order
  double sync_seconds = 0;
  Origin origin = kNoOrigin;     ///< of the output
  double position_rounding = 0;  ///< largest rounding of a coordinate, world units, by reading, merging and writing:
                                 ///< see rgs::position_rounding()
  std::optional<ArchiveSearch> search;  ///< of an archive with a target; `seconds` are of the kept pass
  WriteReport clamped;                  ///< for formats other than .rgs; its counts are in `declarations`
};

/// Whether a file can hold so many Gaussians. Errors: limit_exceeded.
Status check_count(std::uint64_t n);
/// The rounding of a coordinate that is not refused, world units: a millimetre, where a unit of unknown size counts as a
/// metre; without end if `allowed`.
double max_rounding(const EncodeOptions& encode, bool allowed);
/// Errors: unsupported_feature, found in micrometres.
Status check_rounding(double position_rounding, double max_rounding);
/// Adds to `notes` that positions are rounded by more than max_rounding().
void note_rounding(ConvertSummary& summary);

/// Converts to .rgs in two passes over the source; for a mapped PLY anonymous memory is at most 64 MB + 48 bytes a
/// Gaussian on two threads. The bytes do not depend on the number of threads (limited by the caller through oneTBB's
/// global_control).
/// Errors: those of PlyFile, SceneWriter, depth_range_from_cameras, AtomicFile; limit_exceeded for more than 2^32 - 1
/// Gaussians.
Result<ConvertSummary> convert_to_rgs(const SplatSource& source, const std::string& output_path,
                                      const ConvertOptions& options, const StageObserver& observer = {});

/// Largest rounding of a coordinate to FP32, world units.
struct MeanRounding {
  double lost = 0;  ///< by reading
  double rest = 0;  ///< of what Splat::mean_rest holds
  void add(const MeanRounding& other) {
    lost = std::max(lost, other.lost);
    rest = std::max(rest, other.rest);
  }
};

/// Gives pages origins of their own, but not in Profile::archive, if rests are more than a quarter of a millimetre, and
/// leaves that quarter of them. Returns the largest rounding then. Errors: check_rounding()'s.
Result<double> choose_page_origins(EncodeOptions& encode, MeanRounding rounding, bool allow_rounding);

struct StreamFacts {
  std::uint64_t bytes = 0;
  Origin origin = kNoOrigin;            ///< of the means
  std::function<std::uint64_t()> hash;  ///< XXH3-64 of the bytes
  /// Once the stream was read.
  std::function<MeanRounding()> rounding = [] { return MeanRounding(); };
  /// Byte at which Gaussian i starts; Error::kNone if unknown.
  std::function<std::uint64_t(std::uint64_t i)> row_offset = [](std::uint64_t) { return Error::kNone; };
  /// Absent: order_leaves() and build_upper().
  std::function<Status(const SceneScan& scan, const EncodeOptions& encode, const lod::StreamOptions& options,
                       lod::StreamedLevels& out)>
      arrange = {};
};
/// Converts a stream to .rgs with levels, in about options.memory_bytes whatever its size, plus 200 bytes a page and 4
/// bytes a Gaussian with keep_permutation; Profile::archive takes at least 80 bytes a Gaussian. The leaves are those of
/// convert_to_rgs(). The bytes depend on neither threads nor memory.
/// Errors: the stream's, convert_to_rgs()'s, those of stream_levels.hpp.
Result<ConvertSummary> convert_to_levels(const lod::SplatStream& stream, const StreamFacts& facts,
                                         const std::string& output_path, const ConvertOptions& options,
                                         const StageObserver& observer = {});

/// Converts .rgs to PLY; validates the file first. With a permutation section rows are in source order. `stated` goes
/// into the PLY's comments; absent: the file's declarations.
/// Errors: those of validate() and PlyWriter.
Result<ConvertSummary> convert_rgs_to_ply(const FileView& source, const std::string& output_path,
                                          const AtomicFile::Options& output, const StageObserver& observer = {},
                                          const std::optional<Declarations>& stated = std::nullopt);

/// Writes an .rgs with levels as a streamed SOG, tileset or .rad: write_streamed_sog(), write_tileset(), write_rad().
/// options.encode.axes are those of the file. Errors: theirs, SceneOutput's.
Result<ConvertSummary> convert_levels(const PagedFile& source, SplatFormat format, const std::string& output_path,
                                      const ConvertOptions& options, const StageObserver& observer = {});
/// Those of encode_splats() that are in `options`; without the origin.
WriteOptions write_options(const ConvertOptions& options);

struct LoadedScene {
  SplatCloud cloud;
  std::string format;          ///< of the file; "merged" for several
  std::uint64_t bytes = 0;     ///< of all files
  std::uint64_t xxh3 = 0;      ///< of their concatenated bytes
  std::uint64_t n_source = 0;  ///< Gaussians in them; those not in `cloud` were filtered out
  int source_sh_degree = 0;
  Origin origin = kNoOrigin;     ///< of the means
  double position_rounding = 0;  ///< largest rounding of a coordinate by reading and merging, world units
  /// EncodeOptions::keep_permutation stores this, see keep_source(); empty: 0, 1, 2, ...
  std::vector<std::uint32_t> source_index = {};
  std::vector<std::string> unused;  ///< see SplatFile::unused
};

/// Describes the source of `file` in `scene`, which holds the rest of its Gaussians, and in `encode`: the count of
/// Gaussians and, for an .rgs, the source that it names. `kept`: positions in the file of the scene's Gaussians.
/// encode.provenance is that of the file itself; encode.keep_permutation must be set already. Returns false if
/// positions are requested but the .rgs has lost them; it is then its own source.
bool keep_source(EncodeOptions& encode, LoadedScene& scene, const SplatFile& file, std::span<const std::uint64_t> kept,
                 bool edited = false);
/// Those declarations that a file of that format, which keeps these, cannot state: "anti-aliasing (mip-splatting)", ...
std::vector<std::string> lost_declarations(SplatFormat format, const EncodeOptions& declared,
                                           const FormatInfo::Keeps& keeps);

/// Writes a scene in memory as .rgs or any writable format. Its Gaussians must be in FormatInfo::axes, for .rgs in
/// options.encode.axes. options.encode.on_bad applies to damaged ones, except that PLY keeps them.
/// Errors: those of convert_to_rgs(), clean_splats(), encode_splats() and AtomicFile.
Result<ConvertSummary> convert_scene(LoadedScene&& scene, SplatFormat format, const std::string& output_path,
                                     const ConvertOptions& options, const StageObserver& observer = {});

}  // namespace rgs
