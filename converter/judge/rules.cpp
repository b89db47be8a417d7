// rules.cpp - projects, orders and blends Gaussians by a set of rules, plainly.
// SPDX-License-Identifier: Apache-2.0
#include "rules.hpp"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "rgs/math/blend.hpp"
#include "rgs/math/projection.hpp"
#include "rgs/math/sh.hpp"
#include "rgs/quantize.hpp"

namespace rgs::judge {
namespace {

using Vec3 = math::Vec3<float>;
using Cov2 = math::Cov2<float>;

constexpr float kSh0 = 0.28209479177387814F;
constexpr float kEdge = 2.8284271247461903F;  // sigmas at which falls_to_0 ends, and radii count without a cut-off

struct Seen {
  math::PixelPoint<float> mean{};
  math::Conic<float> conic{};
  float opacity = 0, reach = 0;  // the quadratic form's largest value that is drawn
  Vec3 colour{};
  float axis_x = 1, axis_y = 0, major = 0, minor = 0;  // of the ellipse; variances
  float side_x = 0, side_y = 0;        // across the edge between its two triangles, if only the first is drawn
  int x0 = 0, x1 = 0, y0 = 0, y1 = 0;  // pixels, ends excluded
  float key = 0;
};

float stepped(float value, int steps, bool rounds_down) {
  const float scaled = static_cast<float>(steps) * std::clamp(value, 0.0F, 1.0F);
  return (rounds_down ? std::floor(scaled) : std::floor(scaled + 0.5F)) / static_cast<float>(steps);
}

float halved(float value) {
  return float_from_half(half_from_float(value));
}

float decoded(float c) {
  c = std::max(c, 0.0F);
  return c <= 0.04045F ? c / 12.92F : std::pow((c + 0.055F) / 1.055F, 2.4F);
}
float encoded(float c) {
  c = std::max(c, 0.0F);
  return c <= 0.0031308F ? c * 12.92F : 1.055F * std::pow(c, 1 / 2.4F) - 0.055F;
}

math::View<float> view_of(const SceneView& scene, const Camera& camera, const Rules& rules) {
  const std::array<double, 16> rows = row_major(camera.world_to_camera);
  double matrix[16];
  std::copy(rows.begin(), rows.end(), matrix);
  const double cx = rules.centres_picture ? camera.width / 2. : camera.cx;
  const double cy = rules.centres_picture ? camera.height / 2. : camera.cy;
  const double fx = rules.focal == Rules::Focal::y ? camera.fy : camera.fx;
  const double fy = rules.focal == Rules::Focal::x ? camera.fx : camera.fy;
  math::View<float> view = math::make_view<float>(matrix, camera.width, camera.height, fx, fy, cx, cy, rules.near_plane,
                                                  0, {scene.origin[0], scene.origin[1], scene.origin[2]});
  if (!rules.clamps_slope) {
    constexpr float kAny = std::numeric_limits<float>::max();
    view.slope_low_x = view.slope_low_y = -kAny, view.slope_high_x = view.slope_high_y = kAny;
  }
  return view;
}

// Relative to the camera, in its axes, as the rules keep positions.
Vec3 seen_from(const SceneView& scene, const math::View<float>& view, const Camera& camera, const float* m,
               const Rules& rules) {
  using Positions = Rules::Positions;
  const Vec3 mean{m[0], m[1], m[2]};
  if (rules.positions == Positions::exact) return math::to_camera(view, mean);
  const float* r = view.rotation;
  Vec3 d = math::from_camera(view, mean);
  if (rules.positions == Positions::camera) {
    d = {halved(d.x), halved(d.y), halved(d.z)};
    return {r[0] * d.x + r[1] * d.y + r[2] * d.z, r[3] * d.x + r[4] * d.y + r[5] * d.z,
            r[6] * d.x + r[7] * d.y + r[8] * d.z};
  }
  const auto in_world = [&](std::size_t axis) { return static_cast<double>(m[axis]) + scene.origin[axis]; };
  if (rules.positions == Positions::half) {
    const auto moved = [&](std::size_t axis) {
      const double at = in_world(axis);
      return m[axis] + static_cast<float>(static_cast<double>(halved(static_cast<float>(at))) - at);
    };
    return math::to_camera(view, {moved(0), moved(1), moved(2)});
  }
  const auto x = static_cast<float>(in_world(0)), y = static_cast<float>(in_world(1)),
             z = static_cast<float>(in_world(2));
  const glm::dvec3 t = camera.world_to_camera[3];
  return {r[0] * x + r[1] * y + r[2] * z + static_cast<float>(t.x),
          r[3] * x + r[4] * y + r[5] * z + static_cast<float>(t.y),
          r[6] * x + r[7] * y + r[8] * z + static_cast<float>(t.z)};
}

// By way of the covariance in the world, as programs keep it.
Cov2 by_covariance(const math::View<float>& view, const Vec3& p, const math::Quaternion<float>& rotation, const Vec3& s,
                   bool is_half) {
  float r[9];
  math::rotation_matrix(rotation, r);
  float sigma[3][3];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const float sum = r[3 * i] * r[3 * j] * s.x * s.x + r[3 * i + 1] * r[3 * j + 1] * s.y * s.y +
                        r[3 * i + 2] * r[3 * j + 2] * s.z * s.z;
      sigma[i][j] = is_half ? halved(4 * sum) / 4 : sum;
    }
  const float slope_x = math::clamp(p.x / p.z, view.slope_low_x, view.slope_high_x);
  const float slope_y = math::clamp(p.y / p.z, view.slope_low_y, view.slope_high_y);
  float du[3], dv[3];
  for (int k = 0; k < 3; ++k) {
    du[k] = view.fx / p.z * (view.rotation[k] - slope_x * view.rotation[6 + k]);
    dv[k] = view.fy / p.z * (view.rotation[3 + k] - slope_y * view.rotation[6 + k]);
  }
  Cov2 cov{};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      cov.xx += du[i] * sigma[i][j] * du[j];
      cov.xy += du[i] * sigma[i][j] * dv[j];
      cov.yy += dv[i] * sigma[i][j] * dv[j];
    }
  return cov;
}

struct Axes {
  float x = 1, y = 0, major = 0, minor = 0;  // the longer one's direction; variances
};

Axes axes_of(const Cov2& cov) {
  const float middle = (cov.xx + cov.yy) / 2, apart = std::hypot((cov.xx - cov.yy) / 2, cov.xy);
  const float angle = std::atan2(2 * cov.xy, cov.xx - cov.yy) / 2, sign = angle < 0 ? -1.0F : 1.0F;
  return {sign * std::cos(angle), sign * std::sin(angle), middle + apart, middle - apart};
}
Cov2 covariance_of(const Axes& a) {
  return {a.x * a.x * a.major + a.y * a.y * a.minor, a.x * a.y * (a.major - a.minor),
          a.y * a.y * a.major + a.x * a.x * a.minor};
}

// What the rules change in an ellipse. False: it is not drawn.
bool reshape(Cov2& cov, Axes& axes, const Camera& camera, const Rules& rules) {
  const float sigmas = rules.cutoff > 0 ? rules.cutoff : kEdge;
  const float limit =
      rules.most_radius >= 0 ? rules.most_radius : static_cast<float>(std::min({1024, camera.width, camera.height}));
  const float least = rules.least_radius / sigmas, most = limit / sigmas;
  const float middle = (cov.xx + cov.yy) / 2, apart = (axes.major - axes.minor) / 2;
  bool is_changed = false;
  if (rules.drops_round && rules.least_difference <= 0) {
    // As programs compute it in FP32, where rounding decides: the longer axis's direction is (0, 0).
    const float half = (cov.xx - cov.yy) / 2;
    if (cov.xy == 0 && middle + std::sqrt(half * half) - cov.xx == 0) return false;
  }
  if (rules.least_difference > 0) {
    // As GaussianSplats3D computes it in FP32: where the axes are those of the pixels, rounding decides the direction.
    const float squares =
        std::max(rules.least_difference * rules.least_difference, middle * middle - math::determinant(cov));
    const float across = middle + std::sqrt(squares) - cov.xx, length = std::hypot(cov.xy, across);
    if (rules.drops_round && length == 0) return false;
    axes = {cov.xy / length, across / length, middle + std::sqrt(squares), middle - std::sqrt(squares)};
    if (axes.minor <= 0) return false;
    is_changed = apart < rules.least_difference;
  }
  if (rules.axis_epsilon > 0) {
    const float across = axes.major + rules.axis_epsilon - cov.xx, length = std::hypot(cov.xy, across);
    axes.x = cov.xy / length, axes.y = across / length, is_changed = true;
  }
  if (axes.major < least * least) return false;
  if (most > 0 && axes.major > most * most) {
    axes.major = most * most, axes.minor = std::min(axes.minor, most * most), is_changed = true;
  }
  if (is_changed) cov = covariance_of(axes);
  return true;
}

struct Kept {
  math::Quaternion<float> rotation;
  Vec3 scale;
  float opacity;
};

// The Gaussian that Rules::loses_last is about, by means in half units; scene.n without it.
std::uint64_t lost_gaussian(const SceneView& scene, const Rules& rules) {
  std::uint64_t lost = scene.n;
  double most = -1;
  for (std::uint64_t i = 0; rules.loses_last && i < scene.n; ++i) {
    double squares = 0;
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const double at = std::floor((static_cast<double>(scene.mean[3 * i + axis]) + scene.origin[axis]) * 2) / 2;
      squares += at * at;
    }
    if (squares > most) most = squares, lost = i;
  }
  return lost;
}

Kept kept_shape(const SceneView& scene, std::uint64_t i, std::uint64_t lost, const Rules& rules) {
  const float* q = &scene.rotation[4 * i];
  const float* s = &scene.scale[3 * i];
  Kept kept{{q[0], q[1], q[2], q[3]}, {s[0], s[1], s[2]}, scene.opacity[i]};
  if (rules.rotation_bits > 0) {
    const auto top = static_cast<float>((1 << (rules.rotation_bits - 1)) - 1);
    float v[4], squares = 0;
    for (int k = 0; k < 4; ++k) v[k] = std::round(q[k] * top), squares += v[k] * v[k];
    const float length = std::sqrt(squares);
    kept.rotation = {v[0] / length, v[1] / length, v[2] / length, v[3] / length};
  }
  const auto scaled = [&rules](float scale) {
    if (rules.half_scales) scale = halved(scale);
    if (rules.scale_steps <= 0 || scale <= 0) return scale;
    const float step = 21 / static_cast<float>(rules.scale_steps);
    return std::exp(std::round((std::log(scale) + 12) / step) * step - 12);
  };
  kept.scale = {scaled(s[0]), scaled(s[1]), scaled(s[2])};
  if (i == lost) {
    float r[9];
    math::rotation_matrix(kept.rotation, r);
    const Vec3 along_x{r[0] * kept.scale.x, r[1] * kept.scale.y, r[2] * kept.scale.z};
    kept.rotation = {1, 0, 0, 0}, kept.scale = {std::sqrt(math::dot(along_x, along_x)), 0, 0};
  }
  if (rules.opacity_steps > 0) kept.opacity = stepped(kept.opacity, rules.opacity_steps, rules.rounds_down);
  // The default rounding is to even.
  if (rules.even_opacity) kept.opacity = 2 * std::nearbyint(std::round(kept.opacity * 255) / 2) / 255;
  return kept;
}

Vec3 colour_of(const SceneView& scene, std::uint64_t i, const math::View<float>& view, const Vec3& mean,
               const Rules& rules) {
  const float* sh = &scene.sh[static_cast<std::uint64_t>(3 * sh_coefficients(scene.sh_degree)) * i];
  const int degree = std::min(scene.sh_degree, rules.sh_degree);
  const auto coefficient = [&](int k) {
    const auto one = [&](float c) {
      if (k > 0 && rules.sh_limit > 0) c = std::clamp(c, -rules.sh_limit, rules.sh_limit);
      if (k == 0 && rules.colour_steps > 0)
        c = (stepped(0.5F + kSh0 * c, rules.colour_steps, rules.rounds_down) - 0.5F) / kSh0;
      return c;
    };
    return Vec3{one(sh[3 * k]), one(sh[3 * k + 1]), one(sh[3 * k + 2])};
  };
  const Vec3 c = math::sh_color<float>(degree, math::sh_basis(degree, math::view_direction(view, mean)), coefficient);
  const auto shown = [&rules](float v) {
    if (rules.clamps_colour) v = std::min(v, 1.0F);
    if (rules.seen_colour_steps > 0) v = stepped(v, rules.seen_colour_steps, false);
    return rules.blend == Rules::Blend::linear ? decoded(v) : v;
  };
  return {shown(c.x), shown(c.y), shown(c.z)};
}

float key_of(const Vec3& p, std::uint64_t i, const Rules& rules) {
  using Order = Rules::Order;
  return rules.order == Order::depth      ? p.z
         : rules.order == Order::distance ? std::sqrt(math::dot(p, p))
                                          : static_cast<float>(i);
}

// False: it is not drawn.
bool see(const SceneView& scene, std::uint64_t i, std::uint64_t lost, const math::View<float>& view,
         const Camera& camera, const Rules& rules, Seen& seen) {
  const float* const m = &scene.mean[3 * i];
  const Vec3 mean{m[0], m[1], m[2]}, p = seen_from(scene, view, camera, m, rules);
  if (!math::in_depth_range(view, p.z)) return false;
  if (rules.clip > 0 && (std::abs(p.x / p.z * view.fx) > rules.clip * static_cast<float>(view.width) / 2 ||
                         std::abs(p.y / p.z * view.fy) > rules.clip * static_cast<float>(view.height) / 2))
    return false;
  const Kept kept = kept_shape(scene, i, lost, rules);
  Cov2 cov = rules.half_covariance || rules.drops_round || rules.axis_epsilon > 0 || rules.least_difference > 0
                 ? by_covariance(view, p, kept.rotation, kept.scale, rules.half_covariance)
                 : math::project_covariance(view, p, kept.rotation, kept.scale);
  const auto anti_aliasing = rules.compensated ? math::AntiAliasing::mip_splatting : math::AntiAliasing::classic;
  math::Footprint<float> footprint = math::footprint(cov, kept.opacity, rules.low_pass, anti_aliasing);
  if (!footprint.valid) return false;
  Axes axes = axes_of(footprint.cov);
  cov = footprint.cov;
  if (!reshape(cov, axes, camera, rules)) return false;
  if (cov.xx != footprint.cov.xx || cov.xy != footprint.cov.xy || cov.yy != footprint.cov.yy)
    footprint = math::footprint(cov, footprint.opacity, 0.0F, math::AntiAliasing::classic);
  if (!footprint.valid || !(footprint.opacity > 0) || footprint.opacity < rules.alpha_min) return false;
  // A Gaussian that no threshold ends counts as far as an eighth of a step of 8 bits.
  const float least = rules.alpha_min > 0 ? rules.alpha_min : math::kAlphaMin / 8;
  const float by_alpha = 2 * std::log(std::max(footprint.opacity / least, 1.0F));
  const float by_cut = rules.cutoff > 0 ? rules.cutoff * rules.cutoff : by_alpha;
  const float wide = rules.cuts_square ? 2 * by_cut : rules.alpha_min > 0 ? std::min(by_alpha, by_cut) : by_cut;
  seen.mean = math::to_pixel(view, p);
  const auto pixels = [wide](float middle, float variance, int size, int& low, int& high) {
    const float half = std::sqrt(wide * variance) + 1, end = static_cast<float>(size);
    low = static_cast<int>(std::clamp(std::floor(middle - half), 0.0F, end));
    high = static_cast<int>(std::clamp(std::ceil(middle + half) + 1, 0.0F, end));
  };
  pixels(seen.mean.u, cov.xx, camera.width, seen.x0, seen.x1);
  pixels(seen.mean.v, cov.yy, camera.height, seen.y0, seen.y1);
  if (seen.x0 >= seen.x1 || seen.y0 >= seen.y1) return false;
  seen.reach = rules.cutoff > 0 ? by_cut : std::numeric_limits<float>::infinity();
  seen.conic = footprint.conic, seen.opacity = footprint.opacity;
  seen.axis_x = axes.x, seen.axis_y = axes.y, seen.major = axes.major, seen.minor = axes.minor;
  seen.side_x = seen.side_y = 0;
  if (rules.draws_n_indices && scene.n < 6) {
    if (scene.n < 3) return false;
    // Corners (-1, -1), (-1, 1), (1, 1) along the axes, of which the longer one points up and the other right of it.
    const float longer = std::sqrt(axes.major), shorter = std::sqrt(axes.minor);
    seen.side_x = -axes.y / shorter - axes.x / longer, seen.side_y = axes.x / shorter - axes.y / longer;
  }
  seen.colour = colour_of(scene, i, view, mean, rules);
  seen.key = key_of(p, i, rules);
  return true;
}

std::uint32_t spread(std::uint32_t v) {
  std::uint32_t out = 0;
  for (std::uint32_t bit = 0; bit < 10; ++bit) out |= (v >> bit & 1U) << 3 * bit;
  return out;
}

// Gaussians in Morton order.
std::vector<std::uint64_t> morton_order(const SceneView& scene) {
  std::array<float, 3> low{}, scale{};
  for (std::size_t axis = 0; axis < 3; ++axis) {
    float least = std::numeric_limits<float>::max(), most = -least;
    for (std::uint64_t i = 0; i < scene.n; ++i)
      least = std::min(least, scene.mean[3 * i + axis]), most = std::max(most, scene.mean[3 * i + axis]);
    low[axis] = least, scale[axis] = most > least ? 1024 / (most - least) : 0;
  }
  std::vector<std::pair<std::uint32_t, std::uint64_t>> keys(scene.n);
  for (std::uint64_t i = 0; i < scene.n; ++i) {
    std::uint32_t key = 0;
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const float at = std::min(1023.0F, (scene.mean[3 * i + axis] - low[axis]) * scale[axis]);
      key |= spread(static_cast<std::uint32_t>(at)) << axis;
    }
    keys[i] = {key, i};
  }
  std::sort(keys.begin(), keys.end());
  std::vector<std::uint64_t> order(scene.n);
  for (std::uint64_t k = 0; k < scene.n; ++k) order[k] = keys[k].second;
  return order;
}

void order(std::vector<Seen>& seen, const Rules& rules) {
  if (rules.sort_bits > 0 && !seen.empty()) {
    const auto less = [](const Seen& a, const Seen& b) { return a.key < b.key; };
    const auto ends = std::minmax_element(seen.begin(), seen.end(), less);
    const float low = ends.first->key, range = ends.second->key - low;
    const float bins = std::exp2(static_cast<float>(rules.sort_bits)) - 1;
    if (range > 0 && std::isfinite(range))
      for (Seen& s : seen) s.key = std::floor((s.key - low) / range * bins);
  }
  if (rules.reverses_ties) std::reverse(seen.begin(), seen.end());
  std::stable_sort(seen.begin(), seen.end(), [](const Seen& a, const Seen& b) { return a.key < b.key; });
}

// Of a pair, or 0 if it is skipped.
float alpha_at(const Seen& s, int x, int y, const Rules& rules) {
  const float dx = s.mean.u - static_cast<float>(x), dy = s.mean.v - static_cast<float>(y);
  const float power = math::power(s.conic, dx, dy);
  if (power > 0 || s.side_x * dx + s.side_y * dy < 0) return 0;
  if (rules.cuts_square) {
    const float along = s.axis_x * dx + s.axis_y * dy, across = s.axis_x * dy - s.axis_y * dx;
    if (along * along > s.reach * s.major || across * across > s.reach * s.minor) return 0;
  } else if (-2 * power > s.reach) {
    return 0;
  }
  float falloff = std::exp(power);
  if (rules.falls_to_0) {
    const float end = std::exp(-kEdge * kEdge / 2);
    falloff = (falloff - end) / (1 - end);
  }
  const float alpha = std::min(rules.alpha_max, s.opacity * falloff);
  return alpha < rules.alpha_min ? 0 : std::max(alpha, 0.0F);
}

float code(float value) {
  return static_cast<float>(to_8bit(value)) / 255;
}

// One pixel, Gaussians front to back.
class Sum {
 public:
  explicit Sum(const Rules& rules) : rules_(rules) {
    if (is_over()) rgb_ = {rules.background[0], rules.background[1], rules.background[2]};
  }
  void add(float alpha, const Vec3& c) {
    using Blend = Rules::Blend;
    if (rules_.blend == Blend::exact || rules_.blend == Blend::linear) {
      const float next = transmittance_ * (1 - alpha);
      if (next < rules_.transmittance_min) {
        is_done_ = true;
        return;
      }
      const float weight = alpha * transmittance_;
      rgb_.x += weight * c.x, rgb_.y += weight * c.y, rgb_.z += weight * c.z;
      transmittance_ = next;
      return;
    }
    const auto out = [&](float v) {
      return rules_.blend == Blend::over_clamped ? std::clamp(v, 0.0F, 1.0F) * alpha
                                                 : std::clamp(v * alpha, 0.0F, 1.0F);
    };
    const Vec3 source{out(c.x), out(c.y), out(c.z)};
    if (is_over()) {
      const float rest = 1 - alpha;
      rgb_ = {code(source.x + rest * rgb_.x), code(source.y + rest * rgb_.y), code(source.z + rest * rgb_.z)};
      return;
    }
    rgb_ = {code(rgb_.x + transmittance_ * source.x), code(rgb_.y + transmittance_ * source.y),
            code(rgb_.z + transmittance_ * source.z)};
    transmittance_ = 1 - code(1 - transmittance_ + transmittance_ * alpha);
  }
  bool is_over() const { return rules_.blend == Rules::Blend::over || rules_.blend == Rules::Blend::over_clamped; }
  bool is_done() const { return is_done_; }
  Vec3 result() const {
    Vec3 rgb = rgb_;
    if (!is_over())
      rgb = {rgb.x + transmittance_ * rules_.background[0], rgb.y + transmittance_ * rules_.background[1],
             rgb.z + transmittance_ * rules_.background[2]};
    if (rules_.blend == Rules::Blend::linear || rules_.transfer == Rules::Transfer::encoded)
      rgb = {encoded(rgb.x), encoded(rgb.y), encoded(rgb.z)};
    if (rules_.transfer == Rules::Transfer::decoded) rgb = {decoded(rgb.x), decoded(rgb.y), decoded(rgb.z)};
    return rgb;
  }

 private:
  const Rules& rules_;
  Vec3 rgb_{0, 0, 0};
  float transmittance_ = 1;
  bool is_done_ = false;
};

}  // namespace

Image draw(const SceneView& scene, const Camera& camera, const Rules& rules, const Camera& before) {
  const math::View<float> view = view_of(scene, camera, rules), view_before = view_of(scene, before, rules);
  constexpr std::uint64_t kBlock = 4096;
  const std::uint64_t n_blocks = (scene.n + kBlock - 1) / kBlock;
  const std::vector<std::uint64_t> rows = rules.is_morton ? morton_order(scene) : std::vector<std::uint64_t>();
  const std::uint64_t lost = lost_gaussian(scene, rules);
  std::vector<std::vector<Seen>> blocks(n_blocks);
  tbb::parallel_for(std::uint64_t{0}, n_blocks, [&](std::uint64_t b) {
    Seen one;
    for (std::uint64_t k = b * kBlock; k < std::min(scene.n, (b + 1) * kBlock); ++k) {
      const std::uint64_t i = rows.empty() ? k : rows[k];
      if (!see(scene, i, lost, view, camera, rules, one)) continue;
      if (rules.is_stale) one.key = key_of(seen_from(scene, view_before, before, &scene.mean[3 * i], rules), i, rules);
      blocks[b].push_back(one);
    }
  });
  std::vector<Seen> seen;
  for (const auto& block : blocks) seen.insert(seen.end(), block.begin(), block.end());
  order(seen, rules);

  Image image = Image::make(camera.width, camera.height, 3);
  constexpr int kRows = 4;
  tbb::parallel_for(0, (camera.height + kRows - 1) / kRows, [&](int band) {
    const int top = band * kRows, bottom = std::min(camera.height, top + kRows);
    std::vector<Sum> sums(static_cast<std::size_t>((bottom - top) * camera.width), Sum(rules));
    const bool is_over = sums.front().is_over();
    for (std::size_t k = 0; k < seen.size(); ++k) {
      const Seen& s = seen[is_over ? seen.size() - 1 - k : k];
      for (int y = std::max(top, s.y0); y < std::min(bottom, s.y1); ++y)
        for (int x = s.x0; x < s.x1; ++x) {
          Sum& sum = sums[static_cast<std::size_t>((y - top) * camera.width + x)];
          if (sum.is_done()) continue;
          if (const float alpha = alpha_at(s, x, y, rules); alpha > 0) sum.add(alpha, s.colour);
        }
    }
    for (int y = top; y < bottom; ++y)
      for (int x = 0; x < camera.width; ++x) {
        const Vec3 rgb = sums[static_cast<std::size_t>((y - top) * camera.width + x)].result();
        image.at(x, y, 0) = rgb.x, image.at(x, y, 1) = rgb.y, image.at(x, y, 2) = rgb.z;
      }
  });
  return image;
}

}  // namespace rgs::judge
