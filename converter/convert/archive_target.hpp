// archive_target.hpp - the step of an archive that has a wanted quality or size, from the files made so far.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

namespace rgs {

/// What is asked for: at most one.
struct ArchiveTarget {
  std::optional<double> psnr;          ///< at least, dB
  std::optional<std::uint64_t> bytes;  ///< at most, of the file
  const char* option() const { return psnr ? "--target-psnr" : bytes ? "--target-size" : nullptr; }
};

/// One finished file.
struct ArchivePass {
  float step = 1;  ///< ArchiveOptions::step
  std::uint64_t bytes = 0;
  std::optional<double> psnr = {};  ///< measured for ArchiveTarget::psnr; infinite for identical pictures
};

inline constexpr std::size_t kMaxArchivePasses = 3;

struct ArchiveSearch {
  ArchiveTarget target;
  std::vector<ArchivePass> passes;  ///< in order
  std::size_t kept = 0;             ///< the one that was written
};

/// The smallest file that reaches the PSNR, or the finest that is not too large; null if there is none.
const ArchivePass* kept_pass(const ArchiveTarget& target, std::span<const ArchivePass> passes);
/// The step of the next pass; none if the kept one is near the target, no step is left to try, or
/// kMaxArchivePasses are done. `n_gaussians`: for the size of the first; 0: unknown.
std::optional<float> next_step(const ArchiveTarget& target, std::span<const ArchivePass> passes,
                               std::uint64_t n_gaussians);

}  // namespace rgs
