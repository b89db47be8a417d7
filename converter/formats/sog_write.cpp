// sog_write.cpp - writes SOG of version 2, which sog.cpp describes.
// SPDX-License-Identifier: Apache-2.0
#include <webp/encode.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <memory>
#include <new>
#include <nlohmann/json.hpp>
#include <numeric>
#include <string>
#include <utility>

#include "morton_order.hpp"
#include "palette.hpp"
#include "parallel_jobs.hpp"
#include "quantised.hpp"
#include "rgs/quantize.hpp"
#include "sog.hpp"
#include "zip_archive.hpp"

namespace rgs::detail {
namespace {

using Bytes = std::vector<std::byte>;

constexpr std::size_t kEntriesPerRow = 64, kMaxPalette = 65536;
constexpr std::uint8_t kRotationTag = 252;  // w is the largest component

// ---- images ---------------------------------------------------------------------------------------------------------

struct Image {
  std::string name;
  std::size_t width, height;
  std::vector<std::uint8_t> rgba;

  Image(std::string name_, std::size_t width_, std::size_t height_)
      : name(std::move(name_)), width(width_), height(height_), rgba(4 * width * height) {
    for (std::size_t i = 3; i < rgba.size(); i += 4) rgba[i] = 255;
  }
  std::uint8_t* pixel(std::size_t i) { return &rgba[4 * i]; }
};

Bytes encode_webp(const Image& image) {
  WebPConfig config;
  WebPPicture picture;
  WebPMemoryWriter writer;
  if (WebPConfigInit(&config) == 0 || WebPPictureInit(&picture) == 0) throw std::bad_alloc();
  WebPMemoryWriterInit(&writer);
  const std::unique_ptr<WebPPicture, decltype(&WebPPictureFree)> picture_guard(&picture, WebPPictureFree);
  const std::unique_ptr<WebPMemoryWriter, decltype(&WebPMemoryWriterClear)> guard(&writer, WebPMemoryWriterClear);
  config.lossless = config.exact = picture.use_argb = 1;
  picture.width = static_cast<int>(image.width);
  picture.height = static_cast<int>(image.height);
  picture.writer = WebPMemoryWrite;
  picture.custom_ptr = &writer;
  // Sizes are within WebP's: only memory can be missing.
  if (WebPPictureImportRGBA(&picture, image.rgba.data(), 4 * picture.width) == 0 || WebPEncode(&config, &picture) == 0)
    throw std::bad_alloc();
  const auto* bytes = reinterpret_cast<const std::byte*>(writer.mem);
  return {bytes, bytes + writer.size};
}

// ---- Gaussians ------------------------------------------------------------------------------------------------------

double fold_mean(float mean) {
  return std::copysign(std::log1p(std::abs(static_cast<double>(mean))), static_cast<double>(mean));
}

// As a float that readers unfold to a finite one.
float fold_bound(float mean) {
  const double folded = fold_mean(mean);
  const auto bound = static_cast<float>(folded);
  return std::abs(static_cast<double>(bound)) > std::abs(folded) ? std::nextafter(bound, 0.F) : bound;
}

class Writer {
 public:
  Writer(const SplatView& splats, const WriteOptions& options)
      : splats_(splats), threads_(options.threads), order_(splats.n) {
    if (options.keep_order) {
      std::iota(order_.begin(), order_.end(), 0U);
    } else {
      order_ = morton_order(splats);
    }
    width_ = 4 * static_cast<std::size_t>(std::ceil(std::sqrt(static_cast<double>(splats.n)) / 4));
    height_ = (splats.n + width_ - 1) / width_;
    meta_["version"] = 2;
    meta_["asset"] = {{"generator", "RoofGS"}};
    meta_["count"] = splats.n;
    // The format's own name, and that of splat-transform.
    meta_["antialias"] = options.aa_mode == AaMode::mip_splatting;
    if (options.aa_mode == AaMode::mip_splatting) meta_["model"] = "antialiased";
  }

  Result<Bytes> write() {
    weights_ = weigh();
    write_means();
    write_scales();
    write_rotations();
    write_colours();
    if (splats_.sh_degree > 0) write_harmonics();
    std::vector<std::pair<std::string, Bytes>> files(images_.size() + 1);
    const std::string text = meta_.dump();
    const auto bytes = std::as_bytes(std::span(text));
    files[0] = {"meta.json", Bytes(bytes.begin(), bytes.end())};
    run_in_parallel(images_.size(), threads_, [&](std::size_t i) {
      Image& image = images_[images_.size() - 1 - i];  // the palette, which takes longest, first
      files[images_.size() - i] = {image.name, encode_webp(image)};
      image.rgba = std::vector<std::uint8_t>();
    });
    std::uint64_t stored = 0;
    for (std::size_t i = 1; i < files.size(); ++i) stored += files[i].second.size();
    // As readers check; tens of thousands of equal Gaussians.
    if (!check_expansion(4 * images_.size() * splats_.n, stored, 0, {})) {
      return make_error(
          Errc::limit_exceeded, Error::kNone,
          "Gaussians are so alike that readers would refuse the SOG as too compressed; write .rgs or .ply");
    }
    return zip_stored(files);
  }

 private:
  Image& add_image(const char* name) { return images_.emplace_back(name, width_, height_); }

  void write_means() {
    Image lower("means_l.webp", width_, height_), upper("means_u.webp", width_, height_);
    float low[3], high[3];
    for (std::size_t k = 0; k < 3; ++k) {
      low[k] = high[k] = splats_.mean[k];
      for (std::size_t i = 0; i < splats_.n; ++i) {
        low[k] = std::min(low[k], splats_.mean[3 * i + k]);
        high[k] = std::max(high[k], splats_.mean[3 * i + k]);
      }
      low[k] = fold_bound(low[k]);
      high[k] = fold_bound(high[k]);
      const double width = static_cast<double>(high[k]) - static_cast<double>(low[k]);
      for (std::size_t i = 0; i < splats_.n; ++i) {
        const double along = fold_mean(splats_.mean[3 * std::size_t{order_[i]} + k]) - static_cast<double>(low[k]);
        const std::uint32_t code = width > 0 ? unit_code(along / width, 65535) : 0;
        lower.pixel(i)[k] = static_cast<std::uint8_t>(code & 255);
        upper.pixel(i)[k] = static_cast<std::uint8_t>(code >> 8);
      }
    }
    meta_["means"] = {{"mins", low}, {"maxs", high}, {"files", {lower.name, upper.name}}};
    images_.push_back(std::move(lower));
    images_.push_back(std::move(upper));
  }

  float harmonic(std::size_t i) const { return std::clamp(splats_.sh[i], -kMaxSogHarmonic, kMaxSogHarmonic); }
  // JSON has no infinities.
  float log_scale(std::size_t i) const { return std::clamp(splats_.log_scale[i], -kMaxLogScale, kMaxLogScale); }

  void write_scales() {
    std::vector<Weighed> numbers(3 * splats_.n);
    for (std::size_t i = 0; i < numbers.size(); ++i) {
      numbers[i] = {log_scale(3 * std::size_t{order_[i / 3]} + i % 3), weights_[i / 3]};
    }
    const Codebook codebook = fit_codebook(std::move(numbers));
    Image& image = add_image("scales.webp");
    for (std::size_t i = 0; i < splats_.n; ++i) {
      for (std::size_t k = 0; k < 3; ++k) {
        image.pixel(i)[k] = nearest_code(codebook, log_scale(3 * std::size_t{order_[i]} + k));
      }
    }
    meta_["scales"] = {{"codebook", codebook}, {"files", {image.name}}};
  }

  // Half turns about its own axes leave a Gaussian as it is and make any component the largest. If that is always w,
  // alpha takes no bytes: a quarter of a byte a Gaussian.
  void write_rotations() {
    Image& image = add_image("quats.webp");
    for (std::size_t i = 0; i < splats_.n; ++i) {
      const float* q = &splats_.rotation[4 * std::size_t{order_[i]}];
      const float turned[4][4] = {
          {q[0], q[1], q[2], q[3]}, {q[1], -q[0], -q[3], q[2]}, {q[2], q[3], -q[0], -q[1]}, {q[3], -q[2], q[1], -q[0]}};
      const SmallestThree s = smallest_three(turned[smallest_three(turned[0]).largest]);
      for (std::size_t k = 0; k < 3; ++k) {
        image.pixel(i)[k] = static_cast<std::uint8_t>(unit_code((s.rest[k] / kRootHalf + 1) / 2, 255));
      }
      image.pixel(i)[3] = kRotationTag;
    }
    meta_["quats"] = {{"files", {image.name}}};
  }

  void write_colours() {
    const auto floats = static_cast<std::size_t>(3 * sh_coefficients(splats_.sh_degree));
    std::vector<Weighed> numbers;
    for (std::size_t i = 0; i < 3 * splats_.n; ++i) numbers.push_back({harmonic(i / 3 * floats + i % 3), 1});
    const Codebook codebook = fit_codebook(std::move(numbers));
    Image& image = add_image("sh0.webp");
    for (std::size_t i = 0; i < splats_.n; ++i) {
      const std::size_t from = order_[i];
      for (std::size_t k = 0; k < 3; ++k) image.pixel(i)[k] = nearest_code(codebook, harmonic(floats * from + k));
      image.pixel(i)[3] = static_cast<std::uint8_t>(unit_code(opacity_from_logit(splats_.opacity_logit[from]), 255));
    }
    meta_["sh0"] = {{"codebook", codebook}, {"files", {image.name}}};
  }

  // What errors of a Gaussian weigh: its opacity times the root of its largest section. An outdoor scene's views gain
  // 1.8 dB from such harmonics and 1.2 dB from such scales; the squares gain as much. Outliers would get entries of
  // their own.
  std::vector<float> weigh() const {
    std::vector<float> logs(splats_.n);
    for (std::size_t i = 0; i < splats_.n; ++i) {
      const std::size_t from = order_[i];
      float axes[3] = {log_scale(3 * from), log_scale(3 * from + 1), log_scale(3 * from + 2)};
      std::ranges::sort(axes);
      logs[i] = std::log(opacity_from_logit(splats_.opacity_logit[from]) + 1e-6F) + (axes[1] + axes[2]) / 2;
    }
    std::vector<float> sorted = logs;
    const auto median = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
    std::ranges::nth_element(sorted, median);
    constexpr float kMost = 4.6F;  // factor of 100
    for (float& x : logs) x = std::exp(std::clamp(x - *median, -kMost, kMost));
    return logs;
  }

  void write_harmonics() {
    const auto coefficients = static_cast<std::size_t>(sh_coefficients(splats_.sh_degree) - 1);
    const std::size_t n_values = 3 * coefficients;
    Rows rows(splats_.n, (n_values + 7) / 8 * 8);
    for (std::size_t i = 0; i < splats_.n; ++i) {
      for (std::size_t k = 0; k < n_values; ++k) rows[i][k] = harmonic((n_values + 3) * order_[i] + 3 + k);
    }
    // As many as splat-transform has.
    const std::size_t n_entries = std::min(std::bit_floor(std::size_t{splats_.n}), kMaxPalette);
    Palette palette = fit_palette(rows, weights_, n_entries, threads_);
    const std::size_t n = palette.entries.size();
    Image centroids("shN_centroids.webp", kEntriesPerRow * coefficients, (n + kEntriesPerRow - 1) / kEntriesPerRow);
    std::vector<Weighed> numbers;
    for (std::size_t i = 0; i < n * n_values; ++i) numbers.push_back({palette.entries[i / n_values][i % n_values], 1});
    const Codebook codebook = fit_codebook(std::move(numbers));
    for (std::size_t i = 0; i < n * n_values; ++i) {
      float& value = palette.entries[i / n_values][i % n_values];
      const std::uint8_t code = nearest_code(codebook, value);
      centroids.pixel(i / 3)[i % 3] = code;
      value = codebook[code];
    }
    label_nearest(rows, palette, threads_);
    Image& labels = add_image("shN_labels.webp");
    for (std::size_t i = 0; i < splats_.n; ++i) {
      labels.pixel(i)[0] = static_cast<std::uint8_t>(palette.labels[i] & 255);
      labels.pixel(i)[1] = static_cast<std::uint8_t>(palette.labels[i] >> 8);
    }
    meta_["shN"] = {
        {"count", n}, {"bands", splats_.sh_degree}, {"codebook", codebook}, {"files", {centroids.name, labels.name}}};
    images_.push_back(std::move(centroids));
  }

  const SplatView& splats_;
  unsigned threads_;
  std::vector<std::uint32_t> order_;
  std::vector<float> weights_;  // [pixel]
  std::size_t width_ = 0, height_ = 0;
  nlohmann::ordered_json meta_;
  std::vector<Image> images_;
};

}  // namespace

Result<std::vector<std::byte>> encode_sog(const SplatView& splats, const WriteOptions& options) {
  if (splats.n == 0) return make_error(Errc::bad_value, Error::kNone, "a SOG holds at least one Gaussian");
  constexpr std::uint64_t kSide = WEBP_MAX_DIMENSION / 4 * 4;
  if (splats.n > kSide * kSide) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than an image of a SOG has pixels",
                      kSide * kSide, splats.n);
  }
  return Writer(splats, options).write();
}

}  // namespace rgs::detail
