// convert.hpp - whole-file conversions, streamed and parallel: what rgs-convert does.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "rgs/camera.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/file.hpp"
#include "rgs/ply.hpp"
#include "rgs/result.hpp"

namespace rgs {

/// Receives how far a stage is; the texts are static. Called with total first, then with 0 and the units done, from
/// several threads.
struct StageObserver {
  std::function<void(const char* stage, std::uint64_t total, const char* unit)> begin = [](auto...) {};
  std::function<void(std::uint64_t units)> advance = [](auto...) {};
  std::function<void()> finish = [] {};
};

struct ConvertOptions {
  EncodeOptions encode;
  std::vector<Camera> cameras;  ///< depth range as these see the scene; empty: encode.depth, or the scene's extent
  std::optional<float> z_near, z_far;  ///< override one end or both of whatever range was found
  AtomicFile::Options output;
};

/// What a conversion did, for people and programs.
struct ConvertSummary {
  std::string source_name, source_format, output_format;
  std::uint64_t source_bytes = 0, output_bytes = 0;
  std::uint64_t n_source = 0, n_written = 0, n_repaired = 0;
  int source_sh_degree = 0, sh_degree = 0;
  std::array<std::uint64_t, kDefectKinds> defects{};
  Declarations declarations;
  Header header;
  std::vector<SectionEntry> sections;
  float min_scale = 0, max_scale = 0, min_opacity = 0, max_opacity = 0;
  std::vector<std::pair<const char*, double>> seconds;  ///< by stage, in order
  double sync_seconds = 0;
};

/// PLY to .rgs, two passes over the mapped source; anonymous memory at most 64 MB + 48 bytes a Gaussian on two threads.
/// The bytes do not depend on the number of threads (which the caller limits through oneTBB's global_control).
/// Errors: those of PlyFile, make_plan, depth_range_from_cameras, AtomicFile; limit_exceeded for more than 2^32 - 1
/// Gaussians.
Result<ConvertSummary> convert_ply_to_rgs(const PlyFile& source, const std::string& output_path,
                                          const ConvertOptions& options, const StageObserver& observer = {});

/// .rgs to PLY. The file is validated first. With a permutation section rows come in the order of the source.
/// Errors: those of validate() and PlyWriter.
Result<ConvertSummary> convert_rgs_to_ply(const FileView& source, const std::string& output_path,
                                          AtomicFile::Options output, const StageObserver& observer = {});

}  // namespace rgs
