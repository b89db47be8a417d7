// parts_scan.hpp - data between the steps of parts.hpp: scans, and the basis of a plan.
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

/// Input K when it was scanned; the rest of scan.K is its scan and then the sample.
struct ScannedInput {
  std::uint64_t xxh3 = 0;           ///< of the input
  std::string modified;             ///< its stamp, which avoids hashing it each time
  std::uint64_t first_damaged = 0;  ///< byte of the first dropped or repaired Gaussian; Error::kNone: none
  MeanRounding rounding;
  std::uint64_t scan_bytes = 0, content_xxh3 = 0;
};
/// None if it is missing, or from another job or version.
Outcome<std::optional<ScannedInput>> find_scan(const PartsRun& run, const PartsJob& job, std::size_t input);
/// The basis of a plan: the scans of all inputs.
std::uint64_t basis_of_plan(const PartsJob& job, std::span<const ScannedInput> scans);
/// The same for the present scans; none if one is missing.
Outcome<std::optional<std::uint64_t>> find_basis_of_plan(const PartsRun& run, const PartsJob& job);
Status write_plan(const PartsRun& run, const PartsPlan& plan, std::uint64_t basis);

}  // namespace rgs
