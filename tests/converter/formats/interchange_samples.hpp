// interchange_samples.hpp - clouds that every format can hold, comparison by attribute, files of other tools, and
// hostile variants of a file.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "data_folder.hpp"
#include "edit_file.hpp"
#include "golden_scenes.hpp"
#include "rgs/file.hpp"
#include "rgs/interchange.hpp"
#include "rgs/quantize.hpp"
#include "rgs/splat_edit.hpp"
#include "skip.hpp"

namespace rgs::test {

inline Bytes bytes_of(const std::string& text) {
  const auto bytes = std::as_bytes(std::span(text));
  return {bytes.begin(), bytes.end()};
}
inline std::string text_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}
inline void write_bytes(const std::string& path, std::span<const std::byte> bytes) {
  std::ofstream(path, std::ios::binary) << text_of(bytes);
}

/// n Gaussians within the range of all formats: means within 8 units, log-scales -9..1, unit rotations, logits +-5,
/// constant harmonics +-1.7, others +-0.95.
inline SplatCloud ordinary_cloud(std::uint64_t n, int sh_degree, std::uint64_t seed) {
  SplitMix random(seed);
  SplatCloud cloud;
  cloud.resize(n, sh_degree);
  for (std::uint64_t i = 0; i < n; ++i) {
    Splat s;
    for (float& x : s.mean) x = random.dyadic(-8, 8);
    for (float& x : s.log_scale) x = random.dyadic(-9, 1);
    float squared = 0;
    for (float& x : s.rotation) {
      x = random.dyadic(-1, 1) + 0x1p-13F;
      squared += x * x;
    }
    for (float& x : s.rotation) x /= std::sqrt(squared);
    s.opacity_logit = random.dyadic(-5, 5);
    for (int k = 0; k < 3 * sh_coefficients(sh_degree); ++k) s.sh[k] = random.dyadic(-1, 1) * (k < 3 ? 1.7F : 0.95F);
    cloud.set(i, s);
  }
  return cloud;
}

/// Checks that pieces of a file, by its path or bytes, are its scene. Returns the largest piece's number of Gaussians.
template <class Source>
std::uint64_t check_pieces(const Source& source) {
  ReadOptions options;
  options.keep_axes = true;
  const auto whole = read_splats(source, options);
  REQUIRE(whole);
  SplatCloud pieces;
  std::uint64_t largest = 0;
  options.visit = [&](SplatFile& piece) {
    CHECK(piece.axes == whole->axes);
    CHECK(piece.origin == whole->origin);
    largest = std::max(largest, piece.cloud.size());
    append_splats(pieces, piece.cloud);
    return Status();
  };
  const auto visited = read_splats(source, options);
  REQUIRE(visited);
  CHECK(visited->cloud.size() == 0);
  CHECK(visited->bytes == whole->bytes);
  CHECK(visited->aa_mode == whole->aa_mode);
  CHECK(visited->unused == whole->unused);
  CHECK(visited->n_levels == whole->n_levels);
  CHECK(visited->finest == whole->finest);
  CHECK(pieces.sh_degree == whole->cloud.sh_degree);
  CHECK(pieces.mean == whole->cloud.mean);
  CHECK(pieces.log_scale == whole->cloud.log_scale);
  CHECK(pieces.rotation == whole->cloud.rotation);
  CHECK(pieces.opacity_logit == whole->cloud.opacity_logit);
  CHECK(pieces.sh == whole->cloud.sh);
  return largest;
}

/// Largest differences between two Gaussians.
struct SplatError {
  double mean[3] = {0, 0, 0}, log_scale[3] = {0, 0, 0};  ///< by axis
  double opacity = 0;                                    ///< activated
  double rotation = 0;                                   ///< largest of a component, with the same sign
  double sh[4] = {0, 0, 0, 0};                           ///< by degree

  void widen(const SplatError& other) {
    const auto larger = [](double& a, double b) { a = std::max(a, b); };
    for (int k = 0; k < 3; ++k) larger(mean[k], other.mean[k]), larger(log_scale[k], other.log_scale[k]);
    larger(opacity, other.opacity);
    larger(rotation, other.rotation);
    for (int d = 0; d < 4; ++d) larger(sh[d], other.sh[d]);
  }
  /// Largest ratio of a difference to its step; steps of 0 do not count.
  double over(const SplatError& step) const {
    double worst = 0;
    const auto ratio = [&worst](double a, double b) { worst = b > 0 ? std::max(worst, a / b) : worst; };
    for (int k = 0; k < 3; ++k) ratio(mean[k], step.mean[k]), ratio(log_scale[k], step.log_scale[k]);
    ratio(opacity, step.opacity);
    ratio(rotation, step.rotation);
    for (int d = 0; d < 4; ++d) ratio(sh[d], step.sh[d]);
    return worst;
  }
  double sum() const {
    return mean[0] + mean[1] + mean[2] + log_scale[0] + log_scale[1] + log_scale[2] + opacity + rotation + sh[0] +
           sh[1] + sh[2] + sh[3];
  }
};

inline SplatError compare(const Splat& a, const Splat& b, int sh_degree) {
  const auto apart = [](float x, float y) { return std::abs(static_cast<double>(x) - static_cast<double>(y)); };
  SplatError e;
  for (int k = 0; k < 3; ++k) {
    e.mean[k] = apart(a.mean[k], b.mean[k]);
    e.log_scale[k] = apart(a.log_scale[k], b.log_scale[k]);
  }
  e.opacity = apart(opacity_from_logit(a.opacity_logit), opacity_from_logit(b.opacity_logit));
  double dot = 0, aa = 0, bb = 0;
  for (int k = 0; k < 4; ++k) {
    const double x = static_cast<double>(a.rotation[k]), y = static_cast<double>(b.rotation[k]);
    dot += x * y, aa += x * x, bb += y * y;
  }
  for (int k = 0; k < 4; ++k) {
    const double x = static_cast<double>(a.rotation[k]) / std::sqrt(aa),
                 y = static_cast<double>(b.rotation[k]) / std::sqrt(bb);
    e.rotation = std::max(e.rotation, std::abs(dot < 0 ? x + y : x - y));
  }
  for (int k = 0; k < 3 * sh_coefficients(sh_degree); ++k) {
    double& worst = e.sh[sh_degree_of(k / 3)];
    worst = std::max(worst, apart(a.sh[k], b.sh[k]));
  }
  return e;
}

/// `cloud`, each rotation by the half turn about the Gaussian's own axes, if any, that brings it nearest to that of
/// `like`: the same ellipsoids.
inline SplatCloud turned_like(const SplatCloud& like, SplatCloud cloud) {
  REQUIRE(like.size() == cloud.size());
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    const float* to = &like.rotation[4 * i];
    const auto [w, x, y, z] = cloud.view().splat(i).rotation;
    double nearest = -1;
    for (const auto& q : {std::array{w, x, y, z}, {-x, w, z, -y}, {-y, -z, w, x}, {-z, y, -x, w}}) {
      const double dot = std::abs(static_cast<double>(q[0] * to[0] + q[1] * to[1] + q[2] * to[2] + q[3] * to[3]));
      if (dot > nearest) std::ranges::copy(q, &cloud.rotation[4 * i]);
      nearest = std::max(nearest, dot);
    }
  }
  return cloud;
}

/// Largest differences between Gaussians of equal index.
inline SplatError compare(const SplatCloud& a, const SplatCloud& b) {
  REQUIRE(a.size() == b.size());
  REQUIRE(a.sh_degree == b.sh_degree);
  SplatError e;
  for (std::uint64_t i = 0; i < a.size(); ++i) e.widen(compare(a.view().splat(i), b.view().splat(i), a.sh_degree));
  return e;
}

/// Finds Gaussians in a reordered scene.
class Matcher {
 public:
  explicit Matcher(const SplatCloud& original) : original_(original) {
    for (std::uint64_t i = 0; i < original.size(); ++i) by_x_.emplace_back(original.mean[3 * i], i);
    std::ranges::sort(by_x_);
    used_.resize(original.size());
  }
  /// The Gaussian closest to `s` by its largest difference in steps, among those whose means are within two steps and
  /// 1e-6. Steps of 0 do not count.
  std::uint64_t nearest(const Splat& s, const SplatError& step) {
    std::optional<std::pair<double, std::uint64_t>> best;
    const auto reach = static_cast<float>(2 * step.mean[0] + 1e-6);
    for (auto it = std::ranges::lower_bound(by_x_, std::pair(s.mean[0] - reach, std::uint64_t{0}));
         it != by_x_.end() && it->first <= s.mean[0] + reach; ++it) {
      const SplatError e = compare(s, original_.view().splat(it->second), original_.sh_degree);
      if (e.mean[1] > 2 * step.mean[1] + 1e-6 || e.mean[2] > 2 * step.mean[2] + 1e-6) continue;
      const double apart = e.over(step);
      if (!best || apart < best->first) best = {apart, it->second};
    }
    REQUIRE(best);
    used_[best->second] = true;
    return best->second;
  }
  /// Number of different Gaussians found.
  std::uint64_t n_found() const { return static_cast<std::uint64_t>(std::ranges::count(used_, true)); }

 private:
  const SplatCloud& original_;
  std::vector<std::pair<float, std::uint64_t>> by_x_;
  std::vector<bool> used_;
};

/// A file written by another tool.
inline std::string peer_file(const std::string& name) {
  return (data_folder() / "formats" / name).string();
}
inline bool has_peer_files() {
  const bool found = std::filesystem::exists(peer_file("crop.ply"));
  if (!found)
    skip_without_data("the files of other tools are missing; set RGS_DATA_DIR to a folder with formats/crop.*");
  return found;
}

inline const ReadOptions kKeepAxes{{}, SplatFormat::unknown, true};

inline Result<SplatFile> read_exact(std::span<const std::byte> bytes) {
  // A heap block of the exact size, so that AddressSanitizer detects any overread.
  const auto block = std::make_unique<std::byte[]>(bytes.size());
  std::ranges::copy(bytes, block.get());
  return read_splats(std::span<const std::byte>(block.get(), bytes.size()));
}

/// A malformed-input error with a text; its offset, if any, lies inside the file.
inline void check_refusal(const Result<SplatFile>& file, std::uint64_t size) {
  REQUIRE_FALSE(file);
  CHECK(exit_code(file.error().code) == 4);
  CHECK(file.error().what[0] != '\0');
  CHECK((file.error().offset == Error::kNone || file.error().offset <= size));
}

/// Every prefix is refused. Files with flipped bytes are refused or read within the limits of the file's size.
inline void check_hostile(const Bytes& bytes, std::uint64_t seed, int flips = 400) {
  for (std::size_t size = 0; size < bytes.size(); ++size) {
    CAPTURE(size);
    check_refusal(read_exact(std::span(bytes).first(size)), size);
  }
  SplitMix random(seed);
  for (int i = 0; i < flips; ++i) {
    Bytes damaged = bytes;
    for (std::uint64_t n = random.below(3) + 1; n > 0; --n) {
      damaged[random.below(damaged.size())] = static_cast<std::byte>(random.below(256));
    }
    CAPTURE(i);
    const auto file = read_exact(damaged);
    if (!file) {
      check_refusal(file, damaged.size());
    } else {
      CHECK(file->cloud.view().consistent());
      CHECK(file->cloud.size() <= 64 * damaged.size() + 65536);
    }
  }
}

}  // namespace rgs::test
