// image_metrics.cpp - PSNR, SSIM, MS-SSIM and GMSD in tasks of some rows; sums in row order.
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
constexpr std::array kScaleWeights{0.0448, 0.2856, 0.3001, 0.2363, 0.1333};  // of MS-SSIM, fine to coarse
constexpr double kGmsdC = 170;                                               // for luma of 0 to 255

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

  struct Similarity {
    double ssim = 0, structure = 0;  // structure: and contrast, SSIM without luminance
  };
  Similarity at(std::size_t i) const {
    const double ab = means_[kA][i] * means_[kB][i];
    const double squares = means_[kA][i] * means_[kA][i] + means_[kB][i] * means_[kB][i];
    // Rounding must not make a variance negative or a correlation exceed 1.
    const double variances = std::max(0.0, means_[kSquares][i] - squares);
    const double covariance = std::clamp(means_[kProduct][i] - ab, -variances / 2, variances / 2);
    const double top = 2 * covariance + kC2, bottom = variances + kC2;
    return {(2 * ab + kC1) * top / ((squares + kC1) * bottom), top / bottom};
  }

  double sum_of_ssim() const {
    double sum = 0;
    for (std::size_t i = 0; i < length_; ++i) sum += at(i).ssim;
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

// ---- MS-SSIM and GMSD

// Means of 2x2 pixels; an odd last row or column counts twice.
Image halved(const Image& image) {
  Image out = Image::make((image.width + 1) / 2, (image.height + 1) / 2, image.channels);
  detail::parallel_ranges(static_cast<std::uint64_t>(out.height), kRows, [&](std::uint64_t begin, std::uint64_t end) {
    for (int y = static_cast<int>(begin); y < static_cast<int>(end); ++y) {
      const int below = std::min(2 * y + 1, image.height - 1);
      for (int x = 0; x < out.width; ++x) {
        const int right = std::min(2 * x + 1, image.width - 1);
        for (int c = 0; c < out.channels; ++c)
          // Each by a quarter, lest the sum of large values overflow.
          out.at(x, y, c) = 0.25F * image.at(2 * x, 2 * y, c) + 0.25F * image.at(right, 2 * y, c) +
                            0.25F * image.at(2 * x, below, c) + 0.25F * image.at(right, below, c);
      }
    }
  });
  return out;
}

// Means by channel over the windows that lie in the picture. `map` takes the mean over channels at their middles.
std::vector<RowMoments::Similarity> mean_similarity(const Image& a, const Image& b, bool is_coarsest, Image* map) {
  const auto half = window();
  const auto n_channels = static_cast<std::size_t>(a.channels);
  const auto n_rows = static_cast<std::size_t>(a.height - 2 * kRadius);
  std::vector<RowMoments::Similarity> rows(n_rows * n_channels), means(n_channels);
  detail::parallel_ranges(n_rows, kRows, [&](std::uint64_t begin, std::uint64_t end) {
    RowMoments moments(a);
    for (std::uint64_t y = begin; y < end; ++y) {
      moments.compute(a, b, y + kRadius, half);
      for (std::size_t i = kRadius * n_channels; i < row_length(a) - kRadius * n_channels; ++i) {
        const auto found = moments.at(i);
        auto& sum = rows[y * n_channels + i % n_channels];
        sum.ssim += found.ssim, sum.structure += found.structure;
        if (map == nullptr) continue;
        float& pixel = map->pixels[(y + kRadius) * static_cast<std::size_t>(a.width) + i / n_channels];
        const double value = std::max(0.0, is_coarsest ? found.ssim : found.structure);
        pixel = (i % n_channels == 0 ? 0 : pixel) + static_cast<float>(value / static_cast<double>(n_channels));
      }
    }
  });
  for (std::size_t i = 0; i < rows.size(); ++i)
    means[i % n_channels].ssim += rows[i].ssim, means[i % n_channels].structure += rows[i].structure;
  const auto n = static_cast<double>(n_rows) * static_cast<double>(a.width - 2 * kRadius);
  for (auto& mean : means) mean.ssim /= n, mean.structure /= n;
  return means;
}

// Magnitudes of the gradient of 0..255 luma; pixels beyond the edge are 0, as in the authors' program.
std::vector<double> gradients(const Image& image) {
  const auto width = static_cast<std::size_t>(image.width), height = static_cast<std::size_t>(image.height);
  const std::size_t stride = width + 2;
  std::vector<double> luma(stride * (height + 2)), out(width * height);
  for (std::size_t i = 0; i < out.size(); ++i) {
    const float* const v = &image.pixels[i * static_cast<std::size_t>(image.channels)];
    luma[(i / width + 1) * stride + i % width + 1] =
        255 * (image.channels == 1 ? static_cast<double>(v[0]) : 0.299 * v[0] + 0.587 * v[1] + 0.114 * v[2]);
  }
  detail::parallel_ranges(height, kRows, [&](std::uint64_t begin, std::uint64_t end) {
    for (std::size_t i = begin * width; i < end * width; ++i) {
      const double *const above = &luma[i / width * stride + i % width], *const at = above + stride,
                          *const below = at + stride;
      out[i] = std::hypot((above[2] + at[2] + below[2] - above[0] - at[0] - below[0]) / 3,
                          (below[0] + below[1] + below[2] - above[0] - above[1] - above[2]) / 3);
    }
  });
  return out;
}

}  // namespace

double psnr_of(double mse) {
  return mse > 0 ? -10 * std::log10(mse) : std::numeric_limits<double>::infinity();
}

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
    out.psnr = psnr_of(out.mse);
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

Result<double> ms_ssim(const Image& a, const Image& b, Image* map) {
  return detail::guard_memory([&]() -> Result<double> {
    if (const auto ok = difference(a, b); !ok) return tl::unexpected(ok.error());  // sizes, and finite values
    constexpr int kWindow = 2 * kRadius + 1;
    int side = std::min(a.width, a.height);
    if (side < kWindow)
      return make_error(Errc::bad_argument, Error::kNone, "MS-SSIM takes pictures of at least 11 pixels a side");
    std::size_t n_scales = 1;
    while (n_scales < kScaleWeights.size() && (side = (side + 1) / 2) >= kWindow) ++n_scales;
    const double weights = std::accumulate(&kScaleWeights[0], &kScaleWeights[0] + n_scales, 0.0);
    std::vector<double> products(static_cast<std::size_t>(a.channels), 1);
    Image small_a, small_b, level;
    if (map != nullptr) {
      *map = Image::make(a.width, a.height, 1);
      std::fill(map->pixels.begin(), map->pixels.end(), 1.0F);
    }
    for (std::size_t scale = 0; scale < n_scales; ++scale) {
      if (scale > 0) {
        small_a = halved(scale == 1 ? a : small_a);
        small_b = halved(scale == 1 ? b : small_b);
      }
      const Image &of_a = scale == 0 ? a : small_a, &of_b = scale == 0 ? b : small_b;
      const bool is_coarsest = scale + 1 == n_scales;
      if (map != nullptr) {
        level = Image::make(of_a.width, of_a.height, 1);
        std::fill(level.pixels.begin(), level.pixels.end(), 1.0F);
      }
      const auto means = mean_similarity(of_a, of_b, is_coarsest, map != nullptr ? &level : nullptr);
      for (int y = 0; map != nullptr && y < map->height; ++y)
        for (int x = 0; x < map->width; ++x)
          map->at(x, y, 0) *=
              static_cast<float>(std::pow(level.at(x >> scale, y >> scale, 0), kScaleWeights[scale] / weights));
      for (std::size_t c = 0; c < products.size(); ++c) {
        const double mean = is_coarsest ? means[c].ssim : means[c].structure;
        products[c] *= std::pow(std::max(0.0, mean), kScaleWeights[scale] / weights);
      }
    }
    if (map != nullptr)
      for (float& v : map->pixels) v = 1 - v;
    return std::accumulate(products.begin(), products.end(), 0.0) / static_cast<double>(products.size());
  });
}

Result<double> gmsd(const Image& a, const Image& b, Image* map) {
  return detail::guard_memory([&]() -> Result<double> {
    if (const auto ok = difference(a, b); !ok) return tl::unexpected(ok.error());  // sizes, and finite values
    if (a.channels != 1 && a.channels != 3)
      return make_error(Errc::bad_argument, Error::kNone, "GMSD compares pictures of 1 or 3 channels");
    std::vector<double> similarity = gradients(halved(a));
    const std::vector<double> of_b = gradients(halved(b));
    for (std::size_t i = 0; i < similarity.size(); ++i) {
      const double x = similarity[i], y = of_b[i];
      similarity[i] = (2 * x * y + kGmsdC) / (x * x + y * y + kGmsdC);
    }
    if (map != nullptr) {
      *map = Image::make((a.width + 1) / 2, (a.height + 1) / 2, 1);
      for (std::size_t i = 0; i < similarity.size(); ++i) map->pixels[i] = static_cast<float>(1 - similarity[i]);
    }
    const auto n = static_cast<double>(similarity.size());
    const double mean = std::accumulate(similarity.begin(), similarity.end(), 0.0) / n;
    double squares = 0;
    for (const double s : similarity) squares += (s - mean) * (s - mean);
    return std::sqrt(squares / n);
  });
}

}  // namespace rgs
