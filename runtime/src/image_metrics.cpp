// image_metrics.cpp - PSNR and SSIM in tasks of some rows; sums in row order.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/image_metrics.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <vector>

#include "parallel.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kRows = 8;  // a task; one row is too little work in small pictures
constexpr int kRadius = 5;
constexpr double kSigma = 1.5;
constexpr double kC1 = 0.01 * 0.01, kC2 = 0.03 * 0.03;

std::size_t row_length(const Image& image) {
  return static_cast<std::size_t>(image.width) * static_cast<std::size_t>(image.channels);
}

Status check(const Image& a, const Image& b) {
  if (a.width != b.width || a.height != b.height || a.channels != b.channels)
    return make_error(Errc::bad_argument, Error::kNone, "pictures of different sizes cannot be compared");
  if (a.width < 1 || a.height < 1 || a.channels < 1)
    return make_error(Errc::bad_argument, Error::kNone, "a picture without pixels cannot be compared");
  const std::size_t size = row_length(a) * static_cast<std::size_t>(a.height);
  if (a.pixels.size() != size || b.pixels.size() != size)
    return make_error(Errc::bad_argument, Error::kNone, "a picture's pixel array does not fit its size", size);
  return {};
}

tl::unexpected<Error> not_finite(const Image& a, const Image& b) {
  std::size_t i = 0;
  while (i + 1 < a.pixels.size() && std::isfinite(a.pixels[i]) && std::isfinite(b.pixels[i])) ++i;
  return make_error(Errc::bad_value, i, "a pixel of a picture is not finite");
}

// ---- SSIM

// Half of the normalised window profile, from its centre out; the window is separable.
std::array<double, kRadius + 1> window() {
  std::array<double, kRadius + 1> half{};
  double sum = 0;
  for (int i = 0; i <= kRadius; ++i) {
    half[static_cast<std::size_t>(i)] = std::exp(-i * i / (2 * kSigma * kSigma));
    sum += (i == 0 ? 1 : 2) * half[static_cast<std::size_t>(i)];
  }
  for (double& weight : half) weight /= sum;
  return half;
}

// The four local means of SSIM; the two variances enter only as their sum.
enum Moment : std::size_t { kA, kB, kSquares, kProduct, kMoments };

// Moments of one row, in FP64, because a variance is a small difference of two of them.
class RowMoments {
 public:
  explicit RowMoments(const Image& image)
      : length_(row_length(image)), margin_(static_cast<std::size_t>(kRadius * image.channels)) {
    for (auto& line : vertical_) line.assign(length_ + 2 * margin_, 0);  // the margins stay 0: the padding
    for (auto& line : means_) line.resize(length_);
  }

  void compute(const Image& a, const Image& b, std::uint64_t y, const std::array<double, kRadius + 1>& half) {
    for (auto& line : vertical_) std::fill_n(line.begin() + static_cast<std::ptrdiff_t>(margin_), length_, 0);
    const std::uint64_t first = y - std::min<std::uint64_t>(y, kRadius);
    const std::uint64_t last = std::min<std::uint64_t>(y + kRadius, static_cast<std::uint64_t>(a.height) - 1);
    for (std::uint64_t row = first; row <= last; ++row)
      add_row(&a.pixels[row * length_], &b.pixels[row * length_], half[row < y ? y - row : row - y]);
    const auto channels = margin_ / kRadius;
    for (std::size_t m = 0; m < kMoments; ++m) blur(&vertical_[m][margin_], channels, half, means_[m].data());
  }

  double sum_of_ssim() const {
    double sum = 0;
    for (std::size_t i = 0; i < length_; ++i) {
      const double ab = means_[kA][i] * means_[kB][i];
      const double squares = means_[kA][i] * means_[kA][i] + means_[kB][i] * means_[kB][i];
      // Rounding must not make a variance negative or a correlation exceed 1.
      const double variances = std::max(0.0, means_[kSquares][i] - squares);
      const double covariance = std::clamp(means_[kProduct][i] - ab, -variances / 2, variances / 2);
      sum += (2 * ab + kC1) * (2 * covariance + kC2) / ((squares + kC1) * (variances + kC2));
    }
    return sum;
  }

 private:
  void add_row(const float* a, const float* b, double weight) {
    double *const mean_a = &vertical_[kA][margin_], *const mean_b = &vertical_[kB][margin_];
    double *const squares = &vertical_[kSquares][margin_], *const product = &vertical_[kProduct][margin_];
    for (std::size_t i = 0; i < length_; ++i) {
      const double va = a[i], vb = b[i];
      mean_a[i] += weight * va;
      mean_b[i] += weight * vb;
      squares[i] += weight * (va * va + vb * vb);
      product[i] += weight * (va * vb);
    }
  }

  void blur(const double* in, std::size_t channels, const std::array<double, kRadius + 1>& half, double* out) const {
    for (std::size_t i = 0; i < length_; ++i) {
      double sum = half[0] * in[i];
      for (std::size_t k = 1; k < half.size(); ++k) sum += half[k] * (*(in + i - k * channels) + in[i + k * channels]);
      out[i] = sum;
    }
  }

  std::size_t length_, margin_;
  std::array<std::vector<double>, kMoments> vertical_, means_;
};

}  // namespace

Result<ImageDifference> difference(const Image& a, const Image& b) {
  return detail::guard_memory([&]() -> Result<ImageDifference> {
    if (const Status ok = check(a, b); !ok) return tl::unexpected(ok.error());
    const std::size_t length = row_length(a);
    std::vector<ImageDifference> rows(static_cast<std::size_t>(a.height));  // mse holds a row's sum
    detail::parallel_ranges(rows.size(), kRows, [&](std::uint64_t begin, std::uint64_t end) {
      for (std::size_t y = begin; y < end; ++y) {
        for (std::size_t i = y * length; i < (y + 1) * length; ++i) {
          const double d = static_cast<double>(a.pixels[i]) - static_cast<double>(b.pixels[i]);
          rows[y].mse += d * d;
          const float magnitude = std::abs(a.pixels[i] - b.pixels[i]);
          if (magnitude > rows[y].largest) rows[y].largest = magnitude, rows[y].largest_index = i;
        }
      }
    });
    ImageDifference out;
    double sum = 0;
    for (const ImageDifference& row : rows) {
      sum += row.mse;
      if (row.largest > out.largest) out.largest = row.largest, out.largest_index = row.largest_index;
    }
    if (!std::isfinite(sum)) return not_finite(a, b);
    out.mse = sum / static_cast<double>(a.pixels.size());
    out.psnr = out.mse > 0 ? -10 * std::log10(out.mse) : std::numeric_limits<double>::infinity();
    return out;
  });
}

Result<double> ssim(const Image& a, const Image& b) {
  return detail::guard_memory([&]() -> Result<double> {
    if (const Status ok = check(a, b); !ok) return tl::unexpected(ok.error());
    const auto half = window();
    std::vector<double> rows(static_cast<std::size_t>(a.height));
    detail::parallel_ranges(rows.size(), kRows, [&](std::uint64_t begin, std::uint64_t end) {
      RowMoments moments(a);
      for (std::uint64_t y = begin; y < end; ++y) {
        moments.compute(a, b, y, half);
        rows[y] = moments.sum_of_ssim();
      }
    });
    const double mean = std::accumulate(rows.begin(), rows.end(), 0.0) / static_cast<double>(a.pixels.size());
    if (!std::isfinite(mean)) return not_finite(a, b);
    return mean;
  });
}

}  // namespace rgs
