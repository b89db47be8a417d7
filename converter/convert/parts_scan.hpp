// parts_scan.hpp - what the steps of parts.hpp hand each other: scans, and what a plan is made of.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "parts.hpp"
#include "scene_input.hpp"

namespace rgs {

/// What input K was when it was scanned; the rest of scan.K are its scan and the sample, one after the other.
struct ScannedInput {
  std::uint64_t xxh3 = 0;           ///< of the input
  std::string modified;             ///< when it last was, so that its hash need not be asked for each time
  std::uint64_t first_damaged = 0;  ///< byte of the first Gaussian that is not kept as it is; Error::kNone: none
  double position_rounding = 0;
  std::uint64_t scan_bytes = 0, content_xxh3 = 0;
};
/// None if it is missing, or of another job or version.
Outcome<std::optional<ScannedInput>> find_scan(const PartsRun& run, const PartsJob& job, std::size_t input);
/// What a plan is made of: the scans of all inputs.
std::uint64_t basis_of_plan(const PartsJob& job, std::span<const ScannedInput> scans);
/// The same of the scans that are there; none if one is missing.
Outcome<std::optional<std::uint64_t>> find_basis_of_plan(const PartsRun& run, const PartsJob& job);
Status write_plan(const PartsRun& run, const PartsPlan& plan, std::uint64_t basis);

}  // namespace rgs
