// scene.cpp - activation of training parameters.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/scene.hpp"

#include <algorithm>
#include <array>
#include <atomic>
#include <cassert>
#include <cmath>
#include <utility>

#include "parallel.hpp"
#include "rgs/file.hpp"
#include "rgs/quantize.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kMaxGaussians = std::uint64_t{1} << 31;
constexpr std::uint64_t kGrain = 8192;

bool all_finite(const float* values, std::uint64_t n) {
  return std::all_of(values, values + n, [](float v) { return std::isfinite(v); });
}

Status check(const SplatView& s) {
  if (!s.consistent())
    return make_error(Errc::bad_argument, Error::kNone, "the sizes of the attributes contradict each other");
  if (s.n >= kMaxGaussians) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than the renderer numbers", kMaxGaussians - 1,
                      s.n);
  }
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(s.sh_degree));
  std::atomic<std::uint64_t> first_bad{s.n};
  detail::parallel_ranges(s.n, kGrain, [&](std::uint64_t begin, std::uint64_t end) {
    for (std::uint64_t i = begin; i < end; ++i) {
      const bool good = all_finite(&s.mean[3 * i], 3) && all_finite(&s.log_scale[3 * i], 3) &&
                        all_finite(&s.rotation[4 * i], 4) && std::isfinite(s.opacity_logit[i]) &&
                        all_finite(&s.sh[floats * i], floats);
      if (good) continue;
      std::uint64_t seen = first_bad.load();
      while (i < seen && !first_bad.compare_exchange_weak(seen, i)) {
      }
      return;
    }
  });
  if (first_bad < s.n) {
    return make_error(Errc::bad_value, first_bad,
                      "a Gaussian has a non-finite attribute; convert with a repair policy first");
  }
  return {};
}

void normalize(float* q) {
  const float length = std::hypot(std::hypot(q[0], q[1]), std::hypot(q[2], q[3]));
  if (length > 0 && std::isfinite(length)) {
    for (int k = 0; k < 4; ++k) q[k] /= length;
  } else {
    q[0] = 1, q[1] = q[2] = q[3] = 0;
  }
}

std::uint64_t next_identity() {
  static std::atomic<std::uint64_t> last{0};
  return ++last;
}

// Training parameters to rendered ones, in place.
void activate(SplatCloud& s) {
  detail::parallel_ranges(s.size(), kGrain, [&](std::uint64_t begin, std::uint64_t end) {
    for (std::uint64_t i = begin; i < end; ++i) {
      for (std::uint64_t k = 3 * i; k < 3 * i + 3; ++k) s.log_scale[k] = scale_from_log(s.log_scale[k]);
      normalize(&s.rotation[4 * i]);
      s.opacity_logit[i] = opacity_from_logit(s.opacity_logit[i]);
    }
  });
}

}  // namespace

Result<Scene> Scene::load(const SplatView& splats) {
  if (const auto ok = check(splats); !ok) return tl::unexpected(ok.error());
  const auto copy = [](std::span<const float> s) { return std::vector<float>(s.begin(), s.end()); };
  return adopt({splats.sh_degree, copy(splats.mean), copy(splats.log_scale), copy(splats.rotation),
                copy(splats.opacity_logit), copy(splats.sh)});
}

Result<Scene> Scene::load(SplatCloud&& splats) {
  if (const auto ok = check(splats.view()); !ok) return tl::unexpected(ok.error());
  return adopt(std::move(splats));
}

Scene Scene::adopt(SplatCloud splats) {
  activate(splats);
  Scene scene;
  scene.identity_ = next_identity();
  scene.sh_degree_ = splats.sh_degree;
  scene.mean_ = std::move(splats.mean);
  scene.rotation_ = std::move(splats.rotation);
  scene.scale_ = std::move(splats.log_scale);
  scene.opacity_ = std::move(splats.opacity_logit);
  scene.sh_ = std::move(splats.sh);
  return scene;
}

Result<Scene> Scene::load(const FileView& file) {
  const std::uint64_t n = file.header().n_gaussians;
  if (n >= kMaxGaussians) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than the renderer numbers", kMaxGaussians - 1,
                      n);
  }
  const auto data = load_direct(file);
  if (!data) return tl::unexpected(data.error());
  Scene scene;
  scene.identity_ = next_identity();
  scene.sh_degree_ = file.header().sh_degree;
  scene.declarations_ = file.declarations();
  scene.mean_.resize(3 * n);
  scene.rotation_.resize(4 * n);
  scene.scale_.resize(3 * n);
  scene.opacity_.resize(n);
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(scene.sh_degree_));
  scene.sh_.resize(floats * n);
  detail::parallel_ranges(n, kGrain, [&](std::uint64_t begin, std::uint64_t end) {
    std::array<ActivatedSplat, 64> buffer;
    for (std::uint64_t first = begin; first < end; first += buffer.size()) {
      const auto part = std::span(buffer).first(std::min<std::uint64_t>(buffer.size(), end - first));
      [[maybe_unused]] const Status read = data->read(first, part);
      assert(read.has_value());  // the file is valid
      for (std::uint64_t k = 0; k < part.size(); ++k) {
        const ActivatedSplat& s = part[k];
        const std::uint64_t i = first + k;
        std::copy_n(s.mean, 3, &scene.mean_[3 * i]);
        std::copy_n(s.rotation, 4, &scene.rotation_[4 * i]);
        std::copy_n(s.scale, 3, &scene.scale_[3 * i]);
        scene.opacity_[i] = s.opacity;
        std::copy_n(s.sh, floats, &scene.sh_[floats * i]);
      }
    }
  });
  return scene;
}

Result<Scene> Scene::load(std::span<const std::byte> bytes) {
  const auto file = FileView::open(bytes);
  if (!file) return tl::unexpected(file.error());
  return load(*file);
}

Result<Scene> Scene::load(const std::string& path) {
  auto file = MappedFile::open(path);
  if (!file) return tl::unexpected(file.error());
  return load(*std::move(file));
}

Result<Scene> Scene::load(MappedFile&& file) {
  auto scene = load(file.bytes());
  if (scene) scene->file_ = std::make_shared<const MappedFile>(std::move(file));
  return scene;
}

std::span<const std::byte> Scene::file_bytes() const {
  return file_ ? file_->bytes() : std::span<const std::byte>();
}

std::uint64_t Scene::bytes() const {
  return sizeof(float) * (mean_.size() + rotation_.size() + scale_.size() + opacity_.size() + sh_.size());
}

}  // namespace rgs
