// first_view.cpp - chooses the view from which a scene is seen first, by quick pictures of a sample.
//
// A picture is a coarse grid of cells with bins of depth. Each Gaussian of the sample adds its optical depth to the
// cells that it covers; then light is followed from the front. Sums have a fixed order, and of functions only square
// roots are used, so that every compiler and C library chooses alike.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/first_view.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <numbers>

#include "rgs/quantize.hpp"
#include "rgs/subject_box.hpp"

namespace rgs {
namespace {

using Vec = std::array<float, 3>;

Vec operator+(const Vec& a, const Vec& b) {
  return {a[0] + b[0], a[1] + b[1], a[2] + b[2]};
}
Vec operator-(const Vec& a, const Vec& b) {
  return {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
}
Vec operator*(float s, const Vec& a) {
  return {s * a[0], s * a[1], s * a[2]};
}
float dot(const Vec& a, const Vec& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
Vec cross(const Vec& a, const Vec& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
float norm(const Vec& a) {
  return std::sqrt(dot(a, a));
}
Vec normalized(const Vec& a, const Vec& otherwise) {
  const float l = norm(a);
  return l > 1e-6F && std::isfinite(l) ? (1 / l) * a : otherwise;
}

constexpr int kWidth = 48, kHeight = 27, kBins = 64;  // 8 bins an octave of depth
constexpr float kTanX = 0.57735027F, kTanY = kTanX * kHeight / kWidth;
constexpr float kHorizontalFov = 60;
constexpr double kDegrees = 180 / std::numbers::pi;  // a radian
constexpr float kNear = 0.2F;                        // nothing nearer is drawn
constexpr float kSharp = 0.015F;  // a Gaussian with this standard deviation, as a share of the width, is half blurred
constexpr float kUnit = 1024;     // of sums
constexpr std::size_t kQuick = 8192;  // Gaussians of quick pictures
constexpr float kFewestBlocked = 0.02F, kMuchBlocked = 0.1F;

// In the frame of the picture taker: x to the side, y up, z to the front; the subject's half diagonal is 1.
struct Item {
  Vec mean;
  std::array<float, 6> spread;  // sum of (s_j s_k)^2 a_i a_i^T: xx yy zz xy xz yz
  float opacity, weight;        // weight: of what the scene is about
};

struct Pose {
  Vec eye, right, down, forward;
  float tan_x = kTanX, tan_y = kTanY;
};

Pose looking(const Vec& eye, const Vec& forward, const Vec& up = {0, 1, 0}) {
  const Vec ahead = normalized(forward, {0, 0, -1});
  const Vec right = normalized(cross(ahead, up), {1, 0, 0});
  return {eye, right, cross(ahead, right), ahead};
}

// exp(-x) to a few percent.
float transmitted(float x) {
  return 1 / (1 + x * (1 + x * (0.5F + x * (1.F / 6))));
}

class Picture {
 public:
  Picture()
      : depth_(kCells * kBins),
        sharp_(kCells * kBins),
        solid_(kCells * kBins),
        weight_(kCells * kBins),
        light_(kCells * kBins) {}

  struct Seen {
    float subject = 0;  // share of the picture that shows sharply what the scene is about
    float blocked = 0;  // share that shows what is before it
    float weight = 0;   // share of the scene that is seen
    float framed = 0;   // share that is seen or hidden in the picture
    float median = 0;   // depth
    float rim = 0;      // share of the upper, left and right edge that shows it
    float bulge = 0;    // -1 to 1: whether the middle of what is seen is nearer than its rim
  };

  // `share` of the scene's Gaussians are items. `distance` to the subject; 0: the median depth counts.
  Seen take(std::span<const Item> items, const Pose& pose, float near, float share, float distance) {
    std::ranges::fill(depth_, 0U);
    std::ranges::fill(sharp_, 0U);
    std::ranges::fill(solid_, 0U);
    std::ranges::fill(weight_, 0U);
    double all = 0;
    for (const Item& item : items) {
      all += static_cast<double>(item.weight);
      const Vec d = item.mean - pose.eye;
      const float z = dot(pose.forward, d);
      if (!(z > near)) continue;
      const float to_cells = kWidth / (2 * pose.tan_x * z);
      const float x = dot(pose.right, d) * to_cells + 0.5F * kWidth;
      const float y = dot(pose.down, d) * (kHeight / (2 * pose.tan_y * z)) + 0.5F * kHeight;
      const auto& m = item.spread;
      const float squares = (m[0] * d[0] * d[0] + m[1] * d[1] * d[1] + m[2] * d[2] * d[2] +
                             2 * (m[3] * d[0] * d[1] + m[4] * d[0] * d[2] + m[5] * d[1] * d[2])) /
                            dot(d, d);
      const float sigma = std::sqrt(std::sqrt(std::max(squares, 0.F))) * to_cells;
      // The sample's Gaussians stand for the others, too, and cover as much.
      const float half = 1.25F * sigma / std::sqrt(share);
      if (!(x + half >= 0 && x - half < kWidth && y + half >= 0 && y - half < kHeight)) continue;
      const int bin = bin_of(z);
      const float blur = sigma / (kSharp * kWidth);
      const float is_subject = item.weight > 0 ? 1.F : 0.F;
      const float sharp = is_subject / (1 + blur * blur), solid = is_subject / (1 + blur * blur / 16);
      const float deep = item.opacity * (1 + item.opacity);
      if (x >= 0 && x < kWidth && y >= 0 && y < kHeight)
        weight_[at(static_cast<int>(x), static_cast<int>(y), bin)] += static_cast<std::uint32_t>(item.weight * kUnit);
      const int x0 = clamped(x - half, kWidth), x1 = clamped(x + half, kWidth);
      const int y0 = clamped(y - half, kHeight), y1 = clamped(y + half, kHeight);
      // What is smaller than a cell covers a part of it.
      const float part = std::min(4 * half * half, 1.F) * deep;
      const auto added = static_cast<std::uint32_t>(part * kUnit);
      const auto added_sharp = static_cast<std::uint32_t>(part * sharp * kUnit);
      const auto added_solid = static_cast<std::uint32_t>(part * solid * kUnit);
      for (int j = y0; j <= y1; ++j) {
        for (int i = x0; i <= x1; ++i) {
          depth_[at(i, j, bin)] += added;
          sharp_[at(i, j, bin)] += added_sharp;
          solid_[at(i, j, bin)] += added_solid;
        }
      }
    }
    return follow(distance, all);
  }

  // Whether an item is seen in the picture taken last.
  bool sees(const Item& item, const Pose& pose, float near) const {
    const Vec d = item.mean - pose.eye;
    const float z = dot(pose.forward, d);
    if (!(z > near)) return false;
    const float x = (dot(pose.right, d) / (pose.tan_x * z) + 1) * (0.5F * kWidth);
    const float y = (dot(pose.down, d) / (pose.tan_y * z) + 1) * (0.5F * kHeight);
    return x >= 0 && x < kWidth && y >= 0 && y < kHeight &&
           light_[at(static_cast<int>(x), static_cast<int>(y), bin_of(z))] > 0.3F;
  }

 private:
  static constexpr int kCells = kWidth * kHeight;
  static std::size_t at(int x, int y, int bin) { return static_cast<std::size_t>((y * kWidth + x) * kBins + bin); }
  static int clamped(float x, int side) { return static_cast<int>(std::clamp(x, 0.F, static_cast<float>(side - 1))); }
  static constexpr std::uint32_t kFirstBin = std::bit_cast<std::uint32_t>(1.F / 32) >> 20;
  static int bin_of(float z) {
    const std::uint32_t bin = std::bit_cast<std::uint32_t>(z) >> 20;
    return bin < kFirstBin ? 0 : static_cast<int>(std::min<std::uint32_t>(bin - kFirstBin, kBins - 1));
  }
  static float depth_of(int bin) {
    return std::bit_cast<float>((kFirstBin + static_cast<std::uint32_t>(bin)) << 20 | 1U << 19);
  }

  Seen follow(float distance, double all) {
    Seen out;
    std::array<double, kBins> by_depth{}, sharp_by_depth{}, solid_by_depth{};
    double seen = 0, framed = 0, n = 0, sum_r = 0, sum_z = 0, sum_rr = 0, sum_zz = 0, sum_rz = 0, mid_x = 0, mid_y = 0,
           mid = 0;
    std::array<float, kCells> cell_cover{}, cell_depth{};
    for (int y = 0; y < kHeight; ++y) {
      for (int x = 0; x < kWidth; ++x) {
        float light = 1, depth = 0, subject = 0;
        for (int bin = 0; bin < kBins; ++bin) {
          const std::size_t i = at(x, y, bin);
          light_[i] = light;
          if (weight_[i] != 0) {
            framed += static_cast<double>(weight_[i]);
            seen += static_cast<double>(static_cast<float>(weight_[i]) * light);
          }
          if (depth_[i] == 0) continue;
          const float after = light * transmitted(static_cast<float>(depth_[i]) / kUnit), taken = light - after;
          const float share = static_cast<float>(sharp_[i]) / static_cast<float>(depth_[i]);
          const auto b = static_cast<std::size_t>(bin);
          by_depth[b] += static_cast<double>(taken);
          sharp_by_depth[b] += static_cast<double>(taken * share);
          solid_by_depth[b] +=
              static_cast<double>(taken * (static_cast<float>(solid_[i]) / static_cast<float>(depth_[i])));
          depth += taken * share * depth_of(bin);
          subject += taken * share;
          light = after;
        }
        const auto cell = static_cast<std::size_t>(y * kWidth + x);
        cell_cover[cell] = subject;
        cell_depth[cell] = subject > 0 ? depth / subject : 0;
        if (x == 0 || x == kWidth - 1 || y == 0) out.rim += subject / (kWidth + 2 * kHeight - 2);
        if (subject > 0.5F) ++mid, mid_x += x, mid_y += y;
      }
    }
    double total = 0, below = 0;
    for (const double taken : by_depth) total += taken;
    int middle = 0;
    for (; middle < kBins - 1; ++middle) {
      below += by_depth[static_cast<std::size_t>(middle)];
      if (2 * below > total) break;
    }
    out.median = depth_of(middle);
    // What is before the subject's middle is often the subject.
    const float to = distance > 0 ? std::clamp(out.median, 0.5F * distance, distance) : out.median;
    for (int bin = 0; bin < kBins; ++bin) {
      const auto b = static_cast<std::size_t>(bin);
      out.subject += static_cast<float>(sharp_by_depth[b]) / kCells;
      if (depth_of(bin) < 0.75F * to)
        out.blocked += static_cast<float>(by_depth[b] - (depth_of(bin) < 0.3F * to ? 0 : solid_by_depth[b])) / kCells;
    }
    if (all > 0) {
      out.weight = static_cast<float>(seen / (all * static_cast<double>(kUnit)));
      out.framed = static_cast<float>(framed / (all * static_cast<double>(kUnit)));
    }
    if (mid > 0) mid_x /= mid, mid_y /= mid;
    for (int y = 0; y < kHeight; ++y) {
      for (int x = 0; x < kWidth; ++x) {
        const auto cell = static_cast<std::size_t>(y * kWidth + x);
        if (!(cell_cover[cell] > 0.5F)) continue;
        const double r = (x - mid_x) * (x - mid_x) + (y - mid_y) * (y - mid_y);
        const auto z = static_cast<double>(cell_depth[cell]);
        ++n, sum_r += r, sum_z += z, sum_rr += r * r, sum_zz += z * z, sum_rz += r * z;
      }
    }
    const double rr = n * sum_rr - sum_r * sum_r, zz = n * sum_zz - sum_z * sum_z;
    if (rr > 1e-9 && zz > 1e-9) out.bulge = static_cast<float>((n * sum_rz - sum_r * sum_z) / std::sqrt(rr * zz));
    return out;
  }

  std::vector<std::uint32_t> depth_, sharp_, solid_, weight_;  // [kHeight, kWidth, kBins]
  std::vector<float> light_;                                   // before the bin
};

// Axis i of a unit quaternion's rotation.
std::array<Vec, 3> axes_of(const std::array<float, 4>& q) {
  const float length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const float s = length > 0 ? 1 / length : 0;
  const float w = length > 0 ? q[0] * s : 1, x = q[1] * s, y = q[2] * s, z = q[3] * s;
  return {{{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
           {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
           {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}}};
}

std::uint64_t key_of(const float* mean) {
  std::uint64_t key = 0;
  for (int k = 0; k < 3; ++k) {
    key = (key ^ std::bit_cast<std::uint32_t>(mean[k] + 0.F)) * 0x9E3779B97F4A7C15U;  // -0 is 0
    key ^= key >> 29;
  }
  key *= 0xBF58476D1CE4E5B9U;
  return key ^ key >> 32;
}

// Up by what is flat and opaque: the direction near the guess that most of it faces, if there clearly is one.
Vec up_by_floors(std::span<const FirstViewSample::Row> rows, const Box& box, const Vec& guess) {
  struct Facing {
    Vec normal;
    float area;
  };
  std::vector<Facing> flat;
  float all = 0;
  for (const auto& row : rows) {
    bool inside = true;
    for (std::size_t k = 0; k < 3; ++k) inside &= row.mean[k] >= box.min[k] && row.mean[k] <= box.max[k];
    std::array<std::size_t, 3> order{0, 1, 2};
    std::ranges::sort(order, [&](std::size_t a, std::size_t b) { return row.scale[a] < row.scale[b]; });
    if (!inside || row.opacity < 0.3F || !(row.scale[order[0]] < 0.3F * row.scale[order[1]])) continue;
    // By number, not area: few large Gaussians are no evidence.
    const Vec normal = axes_of(row.rotation)[order[0]];
    all += row.opacity;
    if (std::abs(dot(normal, guess)) > 0.8F)
      flat.push_back({dot(normal, guess) < 0 ? -1 * normal : normal, row.opacity});
  }
  const auto facing = [&](const Vec& axis, float cosine) {
    float sum = 0;
    for (const Facing& f : flat) sum += dot(f.normal, axis) > cosine ? f.area : 0;
    return sum;
  };
  // Where to look: the guess, and rings of 6 around it, tilted by 9, 18 and 27 degrees.
  const Vec side = normalized(cross(guess, std::abs(guess[0]) < 0.9F ? Vec{1, 0, 0} : Vec{0, 1, 0}), {1, 0, 0});
  const Vec other = cross(guess, side);
  constexpr float kHalfRoot3 = 0.8660254F;
  constexpr std::array<std::array<float, 2>, 6> kRing{
      {{1, 0}, {0.5F, kHalfRoot3}, {-0.5F, kHalfRoot3}, {-1, 0}, {-0.5F, -kHalfRoot3}, {0.5F, -kHalfRoot3}}};
  constexpr float kWithin = 0.98480775F, kClosely = 0.99619470F;  // cosines of 10 and 5 degrees
  Vec best = guess;
  float most = 1.25F * facing(guess, kWithin);
  for (const float tilt : {0.158F, 0.325F, 0.51F}) {
    for (const auto& [a, b] : kRing) {
      const Vec axis = normalized(guess + (tilt * a) * side + (tilt * b) * other, guess);
      if (const float sum = facing(axis, kWithin); sum > most) best = axis, most = sum;
    }
  }
  for (int turn = 0; turn < 8; ++turn) {
    Vec sum{0, 0, 0};
    const float cosine = turn < 4 ? kWithin : kClosely;
    for (const Facing& f : flat)
      if (dot(f.normal, best) > cosine) sum = sum + f.area * f.normal;
    best = normalized(sum, best);
  }
  // Of directions at random 0.8 % lie within 5 degrees of either end of an axis.
  const float close = facing(best, kClosely);
  if (!(close > 0.12F * all) || flat.size() < 64 || !(close > 3 * facing(guess, kClosely)) || dot(best, guess) < 0.866F)
    return guess;
  return best;
}

struct Candidate {
  Pose pose;
  float distance = 0;  // of the subject; 0 inside
  float prior = 1;
  int place = 0;        // azimuth, or position inside
  bool is_far = false;  // shows the whole subject
  float score = -1;
  Picture::Seen seen;
};

class Choice {
 public:
  Choice(const FirstViewSample& sample, const std::array<double, 3>& up_wish, bool finds_up) {
    for (const auto& row : sample.rows()) {
      if (row.opacity > 1.F / 255) rows_.push_back(row);
    }
    if (rows_.empty()) return;
    std::vector<float> means, opacities;
    for (const auto& row : rows_) {
      means.insert(means.end(), row.mean.begin(), row.mean.end());
      opacities.push_back(row.opacity);
    }
    const Vec guess = normalized(
        {static_cast<float>(up_wish[0]), static_cast<float>(up_wish[1]), static_cast<float>(up_wish[2])}, {0, -1, 0});
    up_ = finds_up ? up_by_floors(rows_, subject_box(means, opacities), guess) : guess;
    Vec front = Vec{0, 0, -1} + up_[2] * up_;
    front_ = normalized(norm(front) > 1e-3F ? front : Vec{-1, 0, 0} + up_[0] * up_, {0, 0, -1});
    side_ = cross(up_, front_);
    for (std::size_t i = 0; i < rows_.size(); ++i) std::ranges::copy(turned(rows_[i].mean), &means[3 * i]);
    const Box box = subject_box(means, opacities);
    for (std::size_t k = 0; k < 3; ++k) {
      middle_[k] = 0.5F * box.min[k] + 0.5F * box.max[k];
      half_[k] = 0.5F * box.max[k] - 0.5F * box.min[k];
    }
    scale_ = std::max(norm(half_), 1e-20F);
    if (!std::isfinite(scale_)) return;
    half_ = (1 / scale_) * half_;
    near_ = kNear / scale_;
    const float n = static_cast<float>(std::max<std::uint64_t>(sample.n(), 1));
    share_ = std::min(1.F, static_cast<float>(FirstViewSample::kMost) / n);
    for (const auto& row : rows_) items_.push_back(item_of(row));
  }

  bool has_items() const { return !items_.empty(); }

  FirstView best_of_many() {
    std::vector<Candidate> outside = around(), inside = within();
    const bool is_inside = is_room(outside, inside);
    return view_of(best_of(is_inside ? inside : outside, is_inside), is_inside);
  }

  FirstView best_of_given(std::span<const CandidateView> given) {
    std::vector<Candidate> outside = around(), inside = within(), candidates;
    for (const CandidateView& view : given) {
      const auto vec = [](const std::array<double, 3>& v) {
        return Vec{static_cast<float>(v[0]), static_cast<float>(v[1]), static_cast<float>(v[2])};
      };
      Candidate& c = candidates.emplace_back();
      const Vec eye = (1 / scale_) * (turned(vec(view.position)) - middle_);
      c.pose = looking(eye, turned(vec(view.forward)), turned(vec(view.up)));
      c.pose.tan_x = static_cast<float>(view.tan_x);
      c.pose.tan_y = static_cast<float>(view.tan_y);
    }
    rate(candidates, true);
    const Candidate best = best_of(std::move(candidates), true);
    FirstView view = view_of(best, is_room(outside, inside));
    view.up = turned_back(-1 * best.pose.down);
    view.horizontal_fov = static_cast<float>(2 * std::atan(static_cast<double>(best.pose.tan_x)) * kDegrees);
    return view;
  }

 private:
  static constexpr float kRoomShare = 2;
  static constexpr float kRoomLeast = 0.1F;
  static constexpr float kMargin = 0.12F;
  static constexpr std::size_t kFinal = 12;

  Vec turned(const Vec& v) const { return {dot(side_, v), dot(up_, v), dot(front_, v)}; }
  Vec turned_back(const Vec& v) const { return v[0] * side_ + v[1] * up_ + v[2] * front_; }

  Item item_of(const FirstViewSample::Row& row) const {
    Item item{};
    item.mean = (1 / scale_) * (turned(row.mean) - middle_);
    item.opacity = std::min(row.opacity, 1.F);
    bool inside = true;
    for (std::size_t k = 0; k < 3; ++k) inside &= std::abs(item.mean[k]) <= 1.1F * half_[k] + 0.02F;
    item.weight = inside ? item.opacity : 0;
    const std::array<Vec, 3> axes = axes_of(row.rotation);
    for (std::size_t i = 0; i < 3; ++i) {
      const float a = std::min(row.scale[(i + 1) % 3] / scale_, 100.F),
                  b = std::min(row.scale[(i + 2) % 3] / scale_, 100.F);
      const float s = a * b * a * b;
      const Vec axis = turned(axes[i]);
      item.spread[0] += s * axis[0] * axis[0], item.spread[1] += s * axis[1] * axis[1];
      item.spread[2] += s * axis[2] * axis[2], item.spread[3] += s * axis[0] * axis[1];
      item.spread[4] += s * axis[0] * axis[2], item.spread[5] += s * axis[1] * axis[2];
    }
    return item;
  }

  // How far the middle must be for the picture to hold the ellipsoid in the box: see orbit() in rgs/camera.hpp.
  float fitting(const Pose& pose) const {
    const Vec away = -1 * pose.forward;
    const auto far = [&](const Vec& edge) {
      const Vec sum = away + edge;
      return norm({half_[0] * sum[0], half_[1] * sum[1], half_[2] * sum[2]});
    };
    float distance = far({0, 0, 0}) + 2 * near_;
    for (const float sign : {1.F, -1.F})
      distance = std::max({distance, far((sign / kTanX) * pose.right), far((sign / kTanY) * pose.down)});
    return distance;
  }

  std::vector<Candidate> around() const {
    constexpr float kHalfRoot3 = 0.8660254F;
    constexpr std::array<std::array<float, 2>, 12> kAzimuths{{{0, 1},
                                                              {0.5F, kHalfRoot3},
                                                              {kHalfRoot3, 0.5F},
                                                              {1, 0},
                                                              {kHalfRoot3, -0.5F},
                                                              {0.5F, -kHalfRoot3},
                                                              {0, -1},
                                                              {-0.5F, -kHalfRoot3},
                                                              {-kHalfRoot3, -0.5F},
                                                              {-1, 0},
                                                              {-kHalfRoot3, 0.5F},
                                                              {-0.5F, kHalfRoot3}}};
    struct Elevation {
      float sine, cosine, prior;
    };
    // 6, 15, 25 and 40 degrees.
    constexpr std::array<Elevation, 4> kElevations{{{0.10452846F, 0.99452190F, 0.95F},
                                                    {0.25881905F, 0.96592583F, 1},
                                                    {0.42261826F, 0.90630779F, 1},
                                                    {0.64278761F, 0.76604444F, 0.75F}}};
    std::vector<Candidate> out;
    for (std::size_t azimuth = 0; azimuth < kAzimuths.size(); ++azimuth) {
      const auto [sine, cosine] = kAzimuths[azimuth];
      for (const Elevation& e : kElevations) {
        const Vec away{e.cosine * sine, e.sine, e.cosine * cosine};
        Pose pose = looking({0, 0, 0}, -1 * away);
        const float fit = fitting(pose);
        for (const float part : {0.5F, 0.62F, 0.78F, 1.F}) {
          Candidate c;
          c.distance = std::max(part * fit, 2 * near_);
          c.pose = pose;
          c.pose.eye = c.distance * away;
          // Of a box it would see the inside.
          const Vec& eye = c.pose.eye;
          if (part < 1 && std::abs(eye[0]) < half_[0] + kMargin && std::abs(eye[1]) < half_[1] + kMargin &&
              std::abs(eye[2]) < half_[2] + kMargin)
            continue;
          c.is_far = part == 1;
          c.prior = e.prior * (1 + 0.06F * cosine);
          c.place = static_cast<int>(azimuth);
          out.push_back(c);
        }
      }
    }
    return out;
  }

  std::vector<Candidate> within() const {
    std::vector<Candidate> out;
    constexpr float kHalfRoot2 = 0.70710678F;
    constexpr std::array<std::array<float, 2>, 8> kDirections{{{0, -1},
                                                               {kHalfRoot2, -kHalfRoot2},
                                                               {1, 0},
                                                               {kHalfRoot2, kHalfRoot2},
                                                               {0, 1},
                                                               {-kHalfRoot2, kHalfRoot2},
                                                               {-1, 0},
                                                               {-kHalfRoot2, -kHalfRoot2}}};
    int place = 0;
    for (const float y : {0.F, 0.25F}) {
      for (const float x : {0.F, -0.55F, 0.55F}) {
        for (const float z : {0.F, -0.55F, 0.55F}) {
          for (const auto& [dx, dz] : kDirections) {
            Candidate c;
            c.pose = looking({x * half_[0], y * half_[1], z * half_[2]}, {dx, -0.15F, dz});
            c.place = place;
            out.push_back(c);
          }
          ++place;
        }
      }
    }
    return out;
  }

  float score(const Candidate& c, const Picture::Seen& s, bool is_inside) const {
    const float blocked = std::max(s.blocked - kFewestBlocked, 0.F) / kMuchBlocked;
    const float clear = 1 / (1 + blocked * blocked);
    if (is_inside) {
      const float far = std::min(s.median / 0.6F, 1.F);
      return c.prior * clear * s.subject * s.subject * (0.2F + s.weight) * far;
    }
    const float size = s.subject / (s.subject + 0.25F);
    return c.prior * clear * size * s.weight * std::sqrt(s.framed) * (1 - 0.5F * s.rim) * (1 + 0.35F * s.bulge);
  }

  void rate(std::vector<Candidate>& candidates, bool is_inside, bool quickly = true) {
    const std::size_t n = quickly ? std::min(kQuick, items_.size()) : items_.size();
    const float share = share_ * static_cast<float>(n) / static_cast<float>(items_.size());
    for (Candidate& c : candidates) {
      c.seen = picture_.take(std::span(items_).first(n), c.pose, near_, share, c.distance);
      c.score = score(c, c.seen, is_inside);
    }
  }

  // Ties by place in the list.
  Candidate best_of(std::vector<Candidate> candidates, bool is_inside) {
    std::ranges::stable_sort(candidates, [](const auto& a, const auto& b) { return a.score > b.score; });
    candidates.resize(std::min(candidates.size(), kFinal));
    rate(candidates, is_inside, false);
    return *std::ranges::max_element(candidates, [](const auto& a, const auto& b) { return a.score < b.score; });
  }

  // Shares of the scene that are seen by turning at the best place inside, or by going around.
  float seen_share(std::span<const Pose> poses) {
    const auto quick = std::span(items_).first(std::min(kQuick, items_.size()));
    const float share = share_ * static_cast<float>(quick.size()) / static_cast<float>(items_.size());
    std::vector<bool> seen(quick.size());
    for (const Pose& pose : poses) {
      picture_.take(quick, pose, near_, share, 0);
      for (std::size_t i = 0; i < quick.size(); ++i) seen[i] = seen[i] || picture_.sees(quick[i], pose, near_);
    }
    double sum = 0, all = 0;
    for (std::size_t i = 0; i < quick.size(); ++i) {
      bool is_hull = false;
      for (std::size_t k = 0; k < 3; ++k) is_hull |= std::abs(quick[i].mean[k]) > 0.85F * half_[k];
      if (is_hull) continue;
      const auto weight = static_cast<double>(quick[i].weight);
      all += weight;
      sum += seen[i] ? weight : 0;
    }
    return all > 0 ? static_cast<float>(sum / all) : 0;
  }
  float seen_from_inside(const std::vector<Candidate>& inside) {
    const auto& best =
        *std::ranges::max_element(inside, [](const auto& a, const auto& b) { return a.score < b.score; });
    std::vector<Pose> poses;
    for (const Vec& forward : {Vec{0, 0, -1}, Vec{1, 0, 0}, Vec{0, 0, 1}, Vec{-1, 0, 0}}) {
      poses.push_back(looking(best.pose.eye, forward));
    }
    for (const Vec& forward : {Vec{0, 1, 0}, Vec{0, -1, 0}})
      poses.push_back(looking(best.pose.eye, forward, {0, 0, 1}));
    for (Pose& pose : poses) pose.tan_x = pose.tan_y = 1;
    return seen_share(poses);
  }
  bool is_room(std::vector<Candidate>& outside, std::vector<Candidate>& inside) {
    rate(outside, false);
    rate(inside, true);
    const float seen = seen_from_inside(inside);
    return seen > kRoomLeast && seen > kRoomShare * seen_from_outside(outside);
  }
  float seen_from_outside(const std::vector<Candidate>& outside) {
    std::vector<Pose> poses;
    for (std::size_t place = 0; place < 12; ++place) {
      const Candidate* best = nullptr;
      for (const Candidate& c : outside)
        if (c.is_far && c.place == static_cast<int>(place) && (best == nullptr || c.score > best->score)) best = &c;
      poses.push_back(best->pose);
    }
    return seen_share(poses);
  }

  FirstView view_of(const Candidate& c, bool is_inside) const {
    FirstView view;
    const float distance = c.distance > 0 ? c.distance : std::max(c.seen.median, 2 * near_);
    view.position = turned_back(middle_ + scale_ * c.pose.eye);
    view.pivot = turned_back(middle_ + scale_ * (c.pose.eye + distance * c.pose.forward));
    view.up = up_;
    view.horizontal_fov = kHorizontalFov;
    view.kind = is_inside ? ViewKind::inside : ViewKind::outside;
    return view;
  }

  std::vector<FirstViewSample::Row> rows_;
  std::vector<Item> items_;
  Vec up_{}, front_{}, side_{}, middle_{}, half_{};
  float scale_ = 1, near_ = 0, share_ = 1;
  Picture picture_;
};

}  // namespace

void FirstViewSample::add(const float* mean, const float* scale, const float* rotation, float opacity) {
  ++n_;
  Row row{key_of(mean), {}, {}, {}, opacity};
  if (row.key > most_) return;
  std::copy_n(mean, 3, row.mean.begin());
  std::copy_n(scale, 3, row.scale.begin());
  std::copy_n(rotation, 4, row.rotation.begin());
  const auto finite = [](float x) { return std::isfinite(x); };
  if (!std::ranges::all_of(row.mean, finite) || !std::ranges::all_of(row.scale, finite) ||
      !std::ranges::all_of(row.rotation, finite) || !finite(opacity))
    return;
  take(row);
}

void FirstViewSample::add(const Splat& splat) {
  if (key_of(splat.mean) > most_) return count(1);
  std::array<float, 3> scale;
  std::ranges::transform(splat.log_scale, scale.begin(), scale_from_log);
  add(splat.mean, scale.data(), splat.rotation, opacity_from_logit(splat.opacity_logit));
}

void FirstViewSample::merge(const FirstViewSample& other) {
  n_ += other.n_;
  for (const Row& row : other.rows_) {
    if (row.key <= most_) take(row);
  }
}

void FirstViewSample::take(const Row& row) {
  rows_.push_back(row);
  if (rows_.size() >= 2 * kMost) keep_least();
}

void FirstViewSample::keep_least() {
  if (rows_.size() <= kMost) return;
  std::nth_element(rows_.begin(), rows_.begin() + (kMost - 1), rows_.end());
  rows_.resize(kMost);
  most_ = rows_.back().key;
}

std::vector<FirstViewSample::Row> FirstViewSample::rows() const {
  FirstViewSample least = *this;
  least.keep_least();
  std::ranges::sort(least.rows_);
  return std::move(least.rows_);
}

FirstView choose_first_view(const FirstViewSample& sample, const std::array<double, 3>& up, bool finds_up,
                            std::span<const CandidateView> candidates) {
  Choice choice(sample, up, finds_up);
  if (!choice.has_items()) return {};
  const FirstView view = candidates.empty() ? choice.best_of_many() : choice.best_of_given(candidates);
  const auto within = [](float x) { return std::abs(static_cast<double>(x)) <= kMaxOrigin; };
  const bool sound = view.horizontal_fov >= 1 && view.horizontal_fov <= 179 &&
                     std::ranges::all_of(view.position, within) && std::ranges::all_of(view.pivot, within) &&
                     view.position != view.pivot;
  return sound ? view : FirstView();
}

}  // namespace rgs
