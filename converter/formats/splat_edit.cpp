// splat_edit.cpp - transforms, merges, filters and strips Gaussians in memory.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/splat_edit.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <glm/gtc/type_ptr.hpp>
#include <glm/matrix.hpp>
#include <numbers>
#include <numeric>
#include <utility>
#include <vector>

#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"
#include "sh_rotation.hpp"

namespace rgs {

namespace {

// Quaternion of a rotation matrix; the branch with the largest square keeps the division well-conditioned (Shepperd
// 1978). Written out, like the products below, because GLM adds in another order and files must keep their bytes.
glm::dquat quaternion_of(const glm::dmat3& m) {
  const double xx = m[0][0], yy = m[1][1], zz = m[2][2];
  const double squares[4] = {1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz};
  const auto largest = std::max_element(squares, squares + 4) - squares;
  const double x = m[1][2] - m[2][1], y = m[2][0] - m[0][2], z = m[0][1] - m[1][0];
  const double xy = m[1][0] + m[0][1], xz = m[2][0] + m[0][2], yz = m[2][1] + m[1][2];
  const glm::dquat rows[4] = {
      {squares[0], x, y, z}, {x, squares[1], xy, xz}, {y, xy, squares[2], yz}, {z, xz, yz, squares[3]}};
  return rows[largest] * (0.5 / std::sqrt(squares[largest]));
}

// q <- turn * q; q: w, x, y, z.
void turn_quaternion(const glm::dquat& turn, float* q) {
  const double a = turn.w, b = turn.x, c = turn.y, d = turn.z;
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  q[0] = static_cast<float>(a * w - b * x - c * y - d * z);
  q[1] = static_cast<float>(a * x + b * w + c * z - d * y);
  q[2] = static_cast<float>(a * y - b * z + c * w + d * x);
  q[3] = static_cast<float>(a * z + b * y - c * x + d * w);
}

void turn_harmonics(SplatCloud& cloud, const glm::dmat3& rotation) {
  if (cloud.sh_degree == 0) return;
  const detail::ShRotation turn(rotation);
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(cloud.sh_degree));
  for (std::uint64_t i = 0; i < cloud.size(); ++i) turn.apply(&cloud.sh[floats * i], cloud.sh_degree);
}

// Unit vector of a direction, in the basis right, up, forward.
glm::dvec3 direction(Axis axis) {
  switch (axis) {
    case Axis::undeclared: break;
    case Axis::right: return {1, 0, 0};
    case Axis::left: return {-1, 0, 0};
    case Axis::up: return {0, 1, 0};
    case Axis::down: return {0, -1, 0};
    case Axis::forward: return {0, 0, 1};
    case Axis::backward: return {0, 0, -1};
  }
  return {0, 0, 0};
}

// Columns are the directions of the axes.
glm::dmat3 frame(const Axes& axes) {
  return {direction(axes[0]), direction(axes[1]), direction(axes[2])};
}

bool is_declared(const Axes& axes) {
  return std::ranges::find(axes, Axis::undeclared) == axes.end();
}

// Corners are decimals. Where coordinates are FP32 they are rounded too: a mean at 0.1 lies on the border 0.1.
WorldBox comparable(WorldBox box, const Origin& origin) {
  for (auto* corner : {&box.min, &box.max}) {
    for (double& x : *corner) x = origin == kNoOrigin ? static_cast<double>(static_cast<float>(x)) : x;
  }
  return box;
}

bool inside(const WorldBox& box, const float* mean, const Origin& origin) {
  for (std::size_t k = 0; k < 3; ++k) {
    const double x = origin[k] + static_cast<double>(mean[k]);
    if (!(x >= box.min[k] && x <= box.max[k])) return false;
  }
  return true;
}

double farthest(const glm::dvec3& translation) {
  const glm::dvec3 size = glm::abs(translation);
  return std::max({size.x, size.y, size.z});
}

// Logarithm of opacity times the two largest scales: roughly a Gaussian's visible area.
double weight(const SplatCloud& cloud, std::uint64_t i) {
  const float* s = &cloud.log_scale[3 * i];
  const float largest = std::max({s[0], s[1], s[2]});
  const float second =
      std::max(std::min(s[0], s[1]), std::min(std::max(s[0], s[1]), s[2]));  // the smallest may be -inf
  const double value = static_cast<double>(largest) + static_cast<double>(second) +
                       std::log(static_cast<double>(opacity_from_logit(cloud.opacity_logit[i])));
  return std::isnan(value) ? -HUGE_VAL : value;
}

}  // namespace

glm::dmat3 rotation_from_euler(const glm::dvec3& degrees) {
  glm::dmat3 product(1.0);
  for (int axis = 0; axis < 3; ++axis) {
    const double angle = degrees[axis] * std::numbers::pi / 180;
    const int u = (axis + 1) % 3, v = (axis + 2) % 3;
    glm::dmat3 turn(1.0);
    turn[u][u] = turn[v][v] = std::cos(angle);
    turn[u][v] = std::sin(angle);
    turn[v][u] = -std::sin(angle);
    product = turn * product;
  }
  return product;
}

glm::dmat3 rotation_from_quaternion(const glm::dquat& q) {
  const double w = q.w, x = q.x, y = q.y, z = q.z, s = 2 / (w * w + x * x + y * y + z * z);
  return {1 - s * (y * y + z * z), s * (x * y + w * z),     s * (x * z - w * y),  //
          s * (x * y - w * z),     1 - s * (x * x + z * z), s * (y * z + w * x),  //
          s * (x * z + w * y),     s * (y * z - w * x),     1 - s * (x * x + y * y)};
}

Similarity compose(const Similarity& outer, const Similarity& inner) {
  // + 0.0 turns -0 into 0, which would reach the means.
  return {outer.rotation * inner.rotation + 0.0, outer.scale * inner.scale,
          outer.rotation * inner.translation * outer.scale + outer.translation};
}

void transform_splats(SplatCloud& cloud, const Similarity& similarity) {
  const bool turns = similarity.rotation != glm::dmat3(1.0);
  // Keep the bits: sums would lose the sign of -0, and a damaged mean's sound coordinates.
  if (!turns && similarity.scale == 1 && similarity.translation == glm::dvec3(0)) return;
  const glm::dquat turn = quaternion_of(similarity.rotation);
  const auto log_factor = static_cast<float>(std::log(similarity.scale));
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    float* mean = &cloud.mean[3 * i];
    float* rest = cloud.mean_rest.empty() ? nullptr : &cloud.mean_rest[3 * i];
    glm::dvec3 centre(glm::make_vec3(mean));
    if (rest != nullptr) centre += glm::dvec3(glm::make_vec3(rest));
    const glm::dvec3 moved = similarity.rotation * centre * similarity.scale + similarity.translation;
    for (int k = 0; k < 3; ++k) mean[k] = static_cast<float>(moved[k]);
    for (int k = 0; k < 3 && rest != nullptr; ++k)
      rest[k] = std::isfinite(mean[k]) ? static_cast<float>(moved[k] - static_cast<double>(mean[k])) : 0;
    for (int k = 0; k < 3; ++k) cloud.log_scale[3 * i + static_cast<std::size_t>(k)] += log_factor;
    if (turns) turn_quaternion(turn, &cloud.rotation[4 * i]);
  }
  if (turns) turn_harmonics(cloud, similarity.rotation);
}

void transform_splats(SplatCloud& cloud, Origin& origin, const Similarity& similarity) {
  if (origin == kNoOrigin) {
    FarMove move(similarity);
    move.add(cloud.mean);
    if (!move.is_far()) return transform_splats(cloud, similarity);
  }
  const glm::dvec3 moved =
      similarity.rotation * glm::make_vec3(origin.data()) * similarity.scale + similarity.translation;
  transform_splats(cloud, {similarity.rotation, similarity.scale, {0, 0, 0}});
  origin = {moved.x + 0.0, moved.y + 0.0, moved.z + 0.0};
}

void FarMove::add(std::span<const float> means) {
  const double limit = farthest(similarity_.translation);
  for (const float x : means) {
    if (!std::isfinite(x)) continue;
    ++n_;
    if (limit > 64 * similarity_.scale * static_cast<double>(std::fabs(x))) ++n_small_;
  }
}

// Whether FP32 means would lose more than 6 bits to the translation: its magnitude decides against the median.
bool FarMove::is_far() const {
  const double limit = farthest(similarity_.translation);
  return limit > 0 && limit <= kMaxOrigin && n_small_ > n_ / 2;
}

double rebase_means(std::span<float> means, const Origin& from, const Origin& to) {
  double largest = 0;
  if (from == to) return largest;
  for (std::size_t i = 0; i < means.size(); ++i) {
    const double x = static_cast<double>(means[i]) + (from[i % 3] - to[i % 3]);
    means[i] = static_cast<float>(x);
    if (std::isfinite(means[i])) largest = std::max(largest, std::fabs(static_cast<double>(means[i]) - x));
  }
  return largest;
}

void rebase_exactly(std::span<float> means, std::span<float> rests, const Origin& from, const Origin& to) {
  assert(rests.size() == means.size());
  for (std::size_t i = 0; i < means.size() && from != to; ++i) {
    const double x = static_cast<double>(means[i]) + (from[i % 3] - to[i % 3]) + static_cast<double>(rests[i]);
    means[i] = static_cast<float>(x);
    rests[i] = std::isfinite(means[i]) ? static_cast<float>(x - static_cast<double>(means[i])) : 0;
  }
}

double largest_rest(std::span<const float> rests) {
  float largest = 0;
  for (const float rest : rests) largest = std::max(largest, std::fabs(rest));
  return static_cast<double>(largest);
}

Origin merged_origin(std::span<const Origin> origins) {
  Origin middle = kNoOrigin;
  for (std::size_t k = 0; k < 3 && !origins.empty(); ++k) {
    const auto [low, high] = std::ranges::minmax(origins, {}, [k](const Origin& origin) { return origin[k]; });
    middle[k] = 0.5 * (low[k] + high[k]) + 0.0;
  }
  return middle;
}

void convert_axes(Origin& origin, const Axes& from, const Axes& to) {
  if (!is_declared(from) || !is_declared(to)) return;
  const glm::dvec3 turned = glm::transpose(frame(to)) * frame(from) * glm::make_vec3(origin.data());
  origin = {turned.x + 0.0, turned.y + 0.0, turned.z + 0.0};
}

void convert_axes(Crs& crs, const Axes& from, const Axes& to) {
  if (crs.text.empty() || from == to || !is_declared(from) || !is_declared(to)) return;
  if (!is_declared(crs.axes)) crs.axes = from;
  if (crs.axes == to) crs.axes = Axes{};
}

void convert_axes(SplatCloud& cloud, const Axes& from, const Axes& to) {
  if (from == to || !is_declared(from) || !is_declared(to)) return;
  const glm::dmat3 change = glm::transpose(frame(to)) * frame(from);  // a signed permutation
  std::array<std::size_t, 3> source{};                                // of each new axis
  std::array<float, 3> sign{};
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      const double entry = change[static_cast<int>(j)][static_cast<int>(i)];
      if (entry == 0) continue;
      source[i] = j;
      sign[i] = static_cast<float>(entry);
    }
  }
  const auto hand = static_cast<float>(glm::determinant(change));
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    const Splat old = cloud.view().splat(i);
    // C R C^T turns the rotation; the local axes are permuted alike, and their scales with them. The quaternion's
    // vector is axial: a mirror reverses it.
    for (std::size_t k = 0; k < 3; ++k) {
      cloud.mean[3 * i + k] = sign[k] * old.mean[source[k]];
      if (!cloud.mean_rest.empty()) cloud.mean_rest[3 * i + k] = sign[k] * old.mean_rest[source[k]];
      cloud.log_scale[3 * i + k] = old.log_scale[source[k]];
      cloud.rotation[4 * i + 1 + k] = hand * sign[k] * old.rotation[1 + source[k]];
    }
  }
  turn_harmonics(cloud, change);
}

void strip_sh(SplatCloud& cloud, int degree) {
  assert(degree >= 0);
  if (degree >= cloud.sh_degree) return;
  const auto from = static_cast<std::uint64_t>(3 * sh_coefficients(cloud.sh_degree)),
             to = static_cast<std::uint64_t>(3 * sh_coefficients(degree));
  for (std::uint64_t i = 1; i < cloud.size(); ++i) std::copy_n(&cloud.sh[from * i], to, &cloud.sh[to * i]);
  cloud.sh.resize(to * cloud.size());
  cloud.sh_degree = degree;
}

void append_splats(SplatCloud& cloud, const SplatCloud& other) {
  const std::uint64_t n = cloud.size();
  const auto narrow = static_cast<std::uint64_t>(3 * sh_coefficients(other.sh_degree));
  if (other.sh_degree > cloud.sh_degree) {
    const auto old = static_cast<std::uint64_t>(3 * sh_coefficients(cloud.sh_degree));
    std::vector<float> sh(narrow * n);
    for (std::uint64_t i = 0; i < n; ++i) std::copy_n(&cloud.sh[old * i], old, &sh[narrow * i]);
    cloud.sh = std::move(sh);
    cloud.sh_degree = other.sh_degree;
  }
  const auto wide = static_cast<std::uint64_t>(3 * sh_coefficients(cloud.sh_degree));
  const std::uint64_t n_other = other.size();  // may be the same cloud
  // Resized in place: appending many pieces stays linear.
  cloud.sh.resize(wide * (n + n_other));
  for (std::uint64_t i = 0; i < n_other; ++i) std::copy_n(&other.sh[narrow * i], narrow, &cloud.sh[wide * (n + i)]);
  const auto add = [n_other](std::vector<float>& to, const std::vector<float>& from, std::uint64_t each) {
    to.resize(to.size() + each * n_other);
    std::copy_n(from.begin(), each * n_other, to.end() - static_cast<std::ptrdiff_t>(each * n_other));
  };
  if (!cloud.mean_rest.empty() || !other.mean_rest.empty()) {
    cloud.mean_rest.resize(3 * (n + n_other));
    if (!other.mean_rest.empty()) std::copy_n(other.mean_rest.begin(), 3 * n_other, &cloud.mean_rest[3 * n]);
  }
  add(cloud.mean, other.mean, 3);
  add(cloud.log_scale, other.log_scale, 3);
  add(cloud.rotation, other.rotation, 4);
  add(cloud.opacity_logit, other.opacity_logit, 1);
}

void merge_parts(SplatCloud& cloud, std::span<ScenePart> parts, Origin& origin) {
  std::vector<Origin> origins;
  for (const ScenePart& part : parts)
    if (part.n != 0) origins.push_back(part.origin);
  origin = merged_origin(origins);
  std::uint64_t first = 0;
  for (ScenePart& part : parts) {
    const auto means = std::span(cloud.mean).subspan(3 * first, 3 * part.n);
    if (cloud.mean_rest.empty()) {
      part.position_rounding += rebase_means(means, part.origin, origin);
    } else {
      rebase_exactly(means, std::span(cloud.mean_rest).subspan(3 * first, 3 * part.n), part.origin, origin);
    }
    first += part.n;
  }
}

void keep_splats(SplatCloud& cloud, std::span<const std::uint64_t> indices) {
  const auto pack = [&indices](std::vector<float>& values, std::uint64_t each) {
    for (std::uint64_t k = 0; k < indices.size(); ++k) {
      // k <= indices[k]: never overwrites a value still to be moved.
      if (indices[k] != k) std::copy_n(&values[each * indices[k]], each, &values[each * k]);
    }
    values.resize(each * indices.size());
  };
  if (indices.size() == cloud.size()) return;
  pack(cloud.mean, 3);
  if (!cloud.mean_rest.empty()) pack(cloud.mean_rest, 3);
  pack(cloud.log_scale, 3);
  pack(cloud.rotation, 4);
  pack(cloud.opacity_logit, 1);
  pack(cloud.sh, static_cast<std::uint64_t>(3 * sh_coefficients(cloud.sh_degree)));
}

std::vector<std::uint64_t> filter_splats(SplatCloud& cloud, const SplatFilter& filter, const Origin& origin) {
  const WorldBox crop = comparable(filter.crop.value_or(WorldBox()), origin);
  std::vector<std::uint64_t> kept;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    if (filter.crop && !inside(crop, &cloud.mean[3 * i], origin)) continue;
    if (filter.min_opacity > 0 && !(opacity_from_logit(cloud.opacity_logit[i]) >= filter.min_opacity)) continue;
    kept.push_back(i);
  }
  if (kept.size() > filter.max_n) {
    std::vector<std::pair<double, std::uint64_t>> ranked;
    ranked.reserve(kept.size());
    for (const std::uint64_t i : kept) ranked.emplace_back(-weight(cloud, i), i);
    const auto end = ranked.begin() + static_cast<std::ptrdiff_t>(filter.max_n);
    std::nth_element(ranked.begin(), end, ranked.end());
    kept.clear();
    std::for_each(ranked.begin(), end, [&kept](const auto& entry) { kept.push_back(entry.second); });
    std::ranges::sort(kept);
  }
  keep_splats(cloud, kept);
  return kept;
}

Result<SceneScan> clean_splats(SplatCloud& cloud, const EncodeOptions& options) {
  return detail::guard_memory([&]() -> Result<SceneScan> {
    SceneScan scan(std::min(cloud.sh_degree, options.sh_degree), options.on_bad);
    std::vector<std::uint64_t> kept;
    for (std::uint64_t i = 0; i < cloud.size(); ++i) {
      Splat s = cloud.view().splat(i);
      const std::uint64_t sound = scan.n_kept() - scan.n_repaired();
      const bool keeps = scan.add(s);
      if (options.on_bad == BadPolicy::refuse && !keeps)
        return make_error(Errc::bad_value, i, "the Gaussian of this index is damaged");
      if (!keeps) continue;
      if (scan.n_kept() - scan.n_repaired() == sound) cloud.set(i, s);  // repaired
      kept.push_back(i);
    }
    if (const Status s = check_encodable(scan, options); !s) return tl::unexpected(s.error());
    keep_splats(cloud, kept);
    return scan;
  });
}

}  // namespace rgs
