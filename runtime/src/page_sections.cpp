// page_sections.cpp - the sections of one page, with padding of its last chunk.
// SPDX-License-Identifier: Apache-2.0
#include "page_sections.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <span>

namespace rgs::detail {
namespace {

// Byte offsets in an entry of CHNK.
constexpr std::size_t kStepSetAt = 32, kScaleUnitAt = 44;

}  // namespace

void write_page_sections(const PageRows& page, std::uint32_t chunk_size, std::uint64_t first_set,
                         const std::array<std::byte*, 5>& to) {
  const std::array<std::span<const std::byte>, 5> from{page.means, page.geometry, page.sh, page.steps, page.chunks};
  for (std::size_t k = 0; k < from.size(); ++k) std::ranges::copy(from[k], to[k]);
  const std::uint64_t n = page.n, n_sets = page.steps.size() / kStepSetBytes, sh_row = page.sh.size() / n;
  const std::array<std::uint64_t, 5> rows = section_rows(page.n, n_sets, chunk_size);
  // A NaN mean is in no view.
  constexpr float kNowhere = std::numeric_limits<float>::quiet_NaN();
  constexpr float kMean[3] = {kNowhere, kNowhere, kNowhere};
  constexpr std::uint16_t kNoSize[8] = {0x3C00, 0, 0, 0, 0, 0, 0, 0};
  for (std::uint64_t i = n; i < rows[0]; ++i) {
    std::memcpy(to[0] + i * kMeanBytes, kMean, kMeanBytes);
    std::memcpy(to[1] + i * kGeometryBytes, kNoSize, kGeometryBytes);
  }
  std::memset(to[2] + n * sh_row, 0, (rows[2] - n) * sh_row);
  const float scale_unit = std::ldexp(1.0F, -page.scale_exponent);
  for (std::uint64_t i = 0; i < rows[4]; ++i) {
    std::byte* const entry = to[4] + i * kChunkEntryBytes;
    const std::uint64_t set = first_set + (n_sets == 1 ? 0 : i);
    std::memcpy(entry + kStepSetAt, &set, sizeof set);
    std::memcpy(entry + kScaleUnitAt, &scale_unit, sizeof scale_unit);
  }
}

}  // namespace rgs::detail
