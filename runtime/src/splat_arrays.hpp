// splat_arrays.hpp - FP32 arrays of activated Gaussians in one block of memory.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <memory>

#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::detail {

/// The arrays of n Gaussians, one after the other.
struct SplatArrays {
  std::uint64_t sh_floats;
  float *mean, *rotation, *scale, *opacity, *sh;

  SplatArrays(float* memory, std::uint64_t n, int sh_degree)
      : sh_floats(static_cast<std::uint64_t>(3 * sh_coefficients(sh_degree))),
        mean(memory),
        rotation(mean + 3 * n),
        scale(rotation + 4 * n),
        opacity(scale + 3 * n),
        sh(opacity + n) {}
  /// Floats a Gaussian.
  static constexpr std::uint64_t floats(int sh_degree) {
    return static_cast<std::uint64_t>(11 + 3 * sh_coefficients(sh_degree));
  }
  /// Not cleared, so that the threads that fill it touch its memory first.
  static std::unique_ptr<float[]> memory(std::uint64_t n, int sh_degree) {
    return std::make_unique_for_overwrite<float[]>(n * floats(sh_degree));
  }
  void set(std::uint64_t i, const ActivatedSplat& s) const {
    std::copy_n(s.mean, 3, &mean[3 * i]);
    std::copy_n(s.rotation, 4, &rotation[4 * i]);
    std::copy_n(s.scale, 3, &scale[3 * i]);
    opacity[i] = s.opacity;
    std::copy_n(s.sh, sh_floats, &sh[sh_floats * i]);
  }
  /// Stores a decoded page from Gaussian `first` on, once its values are checked. Errors: those of check_page_values().
  Status set_page(const PagedFile& file, std::uint32_t page, const PageRows& rows, std::uint64_t first) const {
    if (Status ok = check_page_values(file, page, rows); !ok) return ok;
    std::array<ActivatedSplat, 64> buffer;
    for (std::uint32_t row = 0; row < rows.n; row += static_cast<std::uint32_t>(buffer.size())) {
      const auto part = std::span(buffer).first(std::min<std::size_t>(buffer.size(), rows.n - row));
      if (Status ok = read_page(file, page, rows, row, part); !ok) return ok;
      for (std::uint64_t k = 0; k < part.size(); ++k) set(first + row + k, part[k]);
    }
    return {};
  }
};

/// Memory for decoded pages, aligned as PageRows requires.
class PageMemory {
 public:
  explicit PageMemory(std::uint64_t bytes) : memory_(std::make_unique_for_overwrite<std::byte[]>(bytes + kAlignment)) {
    void* aligned = memory_.get();
    std::size_t room = bytes + kAlignment;
    aligned_ = {static_cast<std::byte*>(std::align(kAlignment, bytes, aligned, room)), bytes};
  }
  std::span<std::byte> first(std::uint64_t bytes) const { return aligned_.first(bytes); }

 private:
  static constexpr std::size_t kAlignment = 16;
  std::unique_ptr<std::byte[]> memory_;
  std::span<std::byte> aligned_;
};

}  // namespace rgs::detail
