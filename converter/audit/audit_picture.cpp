// audit_picture.cpp - difference maps and crops.
// SPDX-License-Identifier: Apache-2.0
#include "audit_picture.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <utility>

#include "encoding.hpp"
#include "image_file.hpp"

namespace rgs::audit {
namespace {

struct Candidate {
  Region region;
  double squares = 0;
};

bool overlap(const Region& a, const Region& b) {
  return a.pictures == b.pictures && a.x < b.x + b.width && b.x < a.x + a.width && a.y < b.y + b.height &&
         b.y < a.y + a.height;
}

double sum_of_squares(const Image& levels, const Region& r) {
  double sum = 0;
  for (int y = r.y; y < r.y + r.height; ++y) {
    for (int x = r.x; x < r.x + r.width; ++x) {
      const auto v = static_cast<double>(levels.at(x, y, 0));
      sum += v * v;
    }
  }
  return sum;
}

// All regions on a grid of half their size.
std::vector<Candidate> candidates(std::span<const Image> levels, int width, int height) {
  std::vector<Candidate> out;
  for (std::size_t i = 0; i < levels.size(); ++i) {
    const int w = std::min(width, levels[i].width), h = std::min(height, levels[i].height);
    const int columns = 1 + (levels[i].width - w) * 2 / w, rows = 1 + (levels[i].height - h) * 2 / h;
    for (int row = 0; row < rows; ++row) {
      for (int column = 0; column < columns; ++column) {
        Region r{i, std::min(column * w / 2, levels[i].width - w), std::min(row * h / 2, levels[i].height - h), w, h,
                 0};
        const double squares = sum_of_squares(levels[i], r);
        r.rms = std::sqrt(squares / (static_cast<double>(w) * h));
        if (squares > 0) out.push_back({r, squares});
      }
    }
  }
  std::stable_sort(out.begin(), out.end(),
                   [](const Candidate& a, const Candidate& b) { return a.squares > b.squares; });
  return out;
}

// Pixels [first, last) of the large picture that fall into pixel i of n.
std::array<int, 2> covered(int i, int n, int size) {
  const auto at = [&](int k) { return static_cast<int>(static_cast<std::int64_t>(k) * size / n); };
  return {at(i), std::max(at(i) + 1, at(i + 1))};
}

template <class Combine>
Image combined(const Image& image, int width, const Combine& combine) {
  if (image.width <= width) return image;
  const int height = std::max(1, static_cast<int>(static_cast<std::int64_t>(image.height) * width / image.width));
  Image out = Image::make(width, height, image.channels);
  for (int y = 0; y < height; ++y) {
    const auto rows = covered(y, height, image.height);
    for (int x = 0; x < width; ++x) {
      const auto columns = covered(x, width, image.width);
      for (int c = 0; c < image.channels; ++c) out.at(x, y, c) = combine(rows, columns, c);
    }
  }
  return out;
}

}  // namespace

Colour heat(float share) {
  constexpr std::array<Colour, 6> kStops{{{0.00F, 0.00F, 0.02F},
                                          {0.30F, 0.07F, 0.48F},
                                          {0.69F, 0.16F, 0.38F},
                                          {0.93F, 0.41F, 0.14F},
                                          {0.98F, 0.75F, 0.14F},
                                          {0.99F, 1.00F, 0.64F}}};
  if (share > 1) return {1, 1, 1};
  const float at = std::clamp(share, 0.0F, 1.0F) * static_cast<float>(kStops.size() - 1);
  const auto i = std::min(static_cast<std::size_t>(at), kStops.size() - 2);
  const float t = at - static_cast<float>(i);
  const Colour &a = kStops[i], &b = kStops[i + 1];
  return {a.r + t * (b.r - a.r), a.g + t * (b.g - a.g), a.b + t * (b.b - a.b)};
}

Picture over_backgrounds(Image black, std::span<const float> alpha) {
  Picture out{std::move(black), {}};
  out.white = out.black;
  for (std::size_t i = 0; i < out.white.pixels.size(); ++i) out.white.pixels[i] += 1 - alpha[i / 3];
  return out;
}

Result<ImageDifference> difference(const Picture& a, const Picture& b) {
  Image worst_a = a.black, worst_b = b.black;
  for (std::size_t i = 0; i < worst_a.pixels.size() && i < worst_b.pixels.size(); ++i) {
    const float over_black = std::abs(worst_a.pixels[i] - worst_b.pixels[i]);
    const float over_white = std::abs(a.white.pixels[i] - b.white.pixels[i]);
    if (!(over_white <= over_black)) worst_a.pixels[i] = a.white.pixels[i], worst_b.pixels[i] = b.white.pixels[i];
  }
  return rgs::difference(worst_a, worst_b);
}

Result<double> ssim(const Picture& a, const Picture& b) {
  const auto black = rgs::ssim(a.black, b.black), white = rgs::ssim(a.white, b.white);
  return black && (!white || *white < *black) ? white : black;
}

Result<double> measure(std::size_t which, const Picture& a, const Picture& b, Image* map) {
  const auto of = [which](const Image& x, const Image& y, Image* where) {
    if (which == kFlip) return rgs::flip(x, y, kPixelsPerDegree, where);
    return which == kMsSsim ? ms_ssim(x, y, where) : gmsd(x, y, where);
  };
  Image over_white;
  const auto black = of(a.black, b.black, map);
  const auto white = of(a.white, b.white, map != nullptr ? &over_white : nullptr);
  if (!black || (white && (kMeasures[which].at_least ? *white >= *black : *white <= *black))) return black;
  if (map != nullptr) *map = std::move(over_white);
  return white;
}

std::optional<DepthScore> depth_difference(const Picture& source, const Picture& asset) {
  DepthScore score;
  std::uint64_t n = 0;
  const auto is_solid = [](const Picture& p, std::size_t pixel) {
    return 1 - (p.white.pixels[3 * pixel] - p.black.pixels[3 * pixel]) >= kDepthAlpha;
  };
  for (std::size_t i = 0; i < source.depth.pixels.size(); ++i) {
    if (!is_solid(source, i) || !is_solid(asset, i)) continue;
    const auto before = static_cast<double>(source.depth.pixels[i]), after = static_cast<double>(asset.depth.pixels[i]);
    const double error = std::abs(after - before) / before;
    score.error += error;
    score.largest = std::max(score.largest, error);
    ++n;
  }
  if (n == 0) return std::nullopt;
  score.error /= static_cast<double>(n);
  score.compared = static_cast<double>(n) / static_cast<double>(source.depth.pixels.size());
  return score;
}

bool shows_more_over_white(const Picture& a, const Picture& b) {
  const auto black = rgs::difference(a.black, b.black), white = rgs::difference(a.white, b.white);
  return black && white && white->mse > black->mse;
}

Image difference_levels(const Picture& a, const Picture& b) {
  Image out = Image::make(a.black.width, a.black.height, 1);
  const auto channels = static_cast<std::size_t>(a.black.channels);
  const auto levels = [](float v, float w) {
    return 255 * std::abs(std::clamp(v, 0.0F, 1.0F) - std::clamp(w, 0.0F, 1.0F));
  };
  for (std::size_t i = 0; i < out.pixels.size(); ++i)
    for (std::size_t c = i * channels; c < (i + 1) * channels; ++c)
      out.pixels[i] = std::max(
          {out.pixels[i], levels(a.black.pixels[c], b.black.pixels[c]), levels(a.white.pixels[c], b.white.pixels[c])});
  return out;
}

float scale_top(std::span<const Image> levels) {
  std::vector<float> sample;  // every seventh pixel: a prime, so that no column is favoured
  for (const Image& image : levels)
    for (std::size_t i = 0; i < image.pixels.size(); i += 7) sample.push_back(image.pixels[i]);
  if (sample.empty()) return 1;
  const auto at = sample.begin() + static_cast<std::ptrdiff_t>((sample.size() - 1) * 999 / 1000);
  std::nth_element(sample.begin(), at, sample.end());
  float top = 0.1F;
  for (const float step : {2.0F, 2.5F, 2.0F, 2.0F, 2.5F, 2.0F, 2.0F, 2.5F, 2.0F, 2.0F})
    if (top < *at) top *= step;
  return std::min(top, 255.0F);
}

Image heat_map(const Image& levels, float top) {
  Image out = Image::make(levels.width, levels.height, 3);
  for (std::size_t i = 0; i < levels.pixels.size(); ++i) {
    const Colour c = heat(levels.pixels[i] / top);
    out.pixels[3 * i] = c.r, out.pixels[3 * i + 1] = c.g, out.pixels[3 * i + 2] = c.b;
  }
  return out;
}

Image shrunk(const Image& image, int width) {
  return combined(image, width, [&](const auto& rows, const auto& columns, int c) {
    float sum = 0;
    for (int y = rows[0]; y < rows[1]; ++y)
      for (int x = columns[0]; x < columns[1]; ++x) sum += image.at(x, y, c);
    return sum / static_cast<float>((rows[1] - rows[0]) * (columns[1] - columns[0]));
  });
}

Image shrunk_to_largest(const Image& levels, int width) {
  return combined(levels, width, [&](const auto& rows, const auto& columns, int c) {
    float largest = 0;
    for (int y = rows[0]; y < rows[1]; ++y)
      for (int x = columns[0]; x < columns[1]; ++x) largest = std::max(largest, levels.at(x, y, c));
    return largest;
  });
}

Image cropped(const Image& image, int x, int y, int width, int height) {
  Image out = Image::make(width, height, image.channels);
  for (int j = 0; j < height; ++j)
    for (int i = 0; i < width; ++i)
      for (int c = 0; c < image.channels; ++c) out.at(i, j, c) = image.at(x + i, y + j, c);
  return out;
}

std::vector<Region> worst_regions(std::span<const Image> levels, int width, int height, std::size_t n,
                                  std::size_t per_view) {
  std::vector<Region> chosen;
  std::vector<std::size_t> taken(levels.size());
  for (const Candidate& c : candidates(levels, width, height)) {
    if (chosen.size() == n) break;
    const bool free = std::none_of(chosen.begin(), chosen.end(), [&](const Region& r) { return overlap(r, c.region); });
    if (!free || taken[c.region.pictures] == per_view) continue;
    ++taken[c.region.pictures];
    chosen.push_back(c.region);
  }
  return chosen;
}

std::string picture_uri(const Image& image, std::size_t max_bytes, bool* lossless) {
  if (lossless != nullptr) *lossless = true;
  if (const auto png = encode_image(image, ImageFormat::png); png && png->size() <= max_bytes)
    return "data:image/png;base64," + tool::base64(*png);
  if (lossless != nullptr) *lossless = false;
  ImageFileOptions options;
  for (int width = image.width; width >= 64; width = width * 2 / 3) {
    const Image small = shrunk(image, width);
    for (const int quality : {95, 88, 75}) {
      options.jpeg_quality = quality;
      if (const auto jpeg = encode_image(small, ImageFormat::jpeg, options); jpeg && jpeg->size() <= max_bytes)
        return "data:image/jpeg;base64," + tool::base64(*jpeg);
    }
  }
  return "data:,";
}

}  // namespace rgs::audit
