// palette.hpp - few numbers, or few rows, that stand for many.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "palette_simd.hpp"

namespace rgs::detail {

/// 256 numbers, ascending.
using Codebook = std::array<float, 256>;

/// A number and what its squared error weighs, more than 0.
struct Weighed {
  float value, weight;
};
/// Of a small sum of errors of `numbers` by the nearest of the codebook (Lloyd 1982); exact if at most 256 differ.
Codebook fit_codebook(std::vector<Weighed> numbers);
std::uint8_t nearest_code(const Codebook& codebook, float value);

struct Palette {
  Rows entries;                       ///< those of close numbers are close
  std::vector<std::uint32_t> labels;  ///< [rows] the entry of each
};

/// At most n_entries entries, close to `rows` by the sum of weighted squared differences. The same for any number of
/// threads. Memory: 16 bytes a row and three times the entries.
Palette fit_palette(const Rows& rows, std::span<const float> weights, std::size_t n_entries, unsigned threads);

/// Labels rows once more, for entries that have changed a little.
void label_nearest(const Rows& rows, Palette& palette, unsigned threads);

}  // namespace rgs::detail
