// bench_quality.cpp - distances from the baseline and from photographs.
// SPDX-License-Identifier: Apache-2.0
#include "bench_quality.hpp"

#include <algorithm>
#include <filesystem>
#include <limits>

#include "rgs/image_metrics.hpp"

namespace rgs::bench {
namespace {

// A display shows nothing beyond 0..1; a photograph holds nothing beyond.
Image displayed(const Image& image) {
  Image out = image;
  for (float& value : out.pixels) value = std::clamp(value, 0.0F, 1.0F);
  return out;
}

}  // namespace

Result<Quality> compare(std::span<const Image> baseline, std::span<const Image> pictures,
                        std::span<const Image> photos) {
  Quality q;
  q.worst_psnr = std::numeric_limits<double>::infinity();
  double photo_psnr = 0, baseline_psnr = 0;
  for (std::size_t i = 0; i < pictures.size(); ++i) {
    const auto d = difference(baseline[i], pictures[i]);
    if (!d) return tl::unexpected(d.error());
    const auto similarity = ssim(baseline[i], pictures[i]);
    if (!similarity) return tl::unexpected(similarity.error());
    q.psnr += d->psnr;
    q.worst_psnr = std::min(q.worst_psnr, d->psnr);
    q.ssim += *similarity;
    q.largest = std::max(q.largest, d->largest);
    if (photos.empty()) continue;
    const auto ours = difference(photos[i], displayed(pictures[i]));
    if (!ours) return tl::unexpected(ours.error());
    const auto theirs = difference(photos[i], displayed(baseline[i]));
    if (!theirs) return tl::unexpected(theirs.error());
    photo_psnr += ours->psnr;
    baseline_psnr += theirs->psnr;
  }
  const auto n = static_cast<double>(pictures.size());
  q.psnr /= n;
  q.ssim /= n;
  if (!photos.empty()) {
    q.photo_psnr = photo_psnr / n;
    q.photo_loss = (baseline_psnr - photo_psnr) / n;
  }
  return q;
}

std::string photo_path(const std::string& folder, const Camera& camera) {
  return (std::filesystem::path(folder) / (std::filesystem::path(camera.name).stem().string() + ".ppm")).string();
}

}  // namespace rgs::bench
