// diff.cpp - matches the Gaussians of two files and compares them; sums per block, added in order.
// SPDX-License-Identifier: Apache-2.0
#include "diff.hpp"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <optional>
#include <span>
#include <utility>

#include "audit_declarations.hpp"
#include "rgs/checksum.hpp"
#include "rgs/file.hpp"
#include "rgs/ply.hpp"

namespace rgs::audit {
namespace {

constexpr std::uint64_t kBlock = 4096;
constexpr std::size_t kAtOnce = 64;
constexpr double kY0 = 0.28209479177387814;  // the harmonic of degree 0
constexpr double kSameComponent = 1e-6;      // of a unit quaternion: what FP32 rounds when it is normalised
constexpr Axes kAsStored{Axis::undeclared, Axis::undeclared, Axis::undeclared};

enum Attribute : std::size_t { kMean, kScale, kRotation, kColour, kOpacity, kAttributes };

double difference(double a, double b) {
  if (a == b || (std::isnan(a) && std::isnan(b))) return 0;
  const double d = std::abs(a - b);
  return std::isfinite(d) ? d : std::numeric_limits<double>::infinity();
}

using Quaternion = std::array<double, 4>;

// A rotation of the cube: local axis i of a Gaussian becomes axis from[i] of the same Gaussian.
struct Relabelling {
  Quaternion turn;
  std::array<std::size_t, 3> from;
};

// All 24.
std::vector<Relabelling> make_relabellings() {
  std::vector<Relabelling> out;
  for (int code = 80; code >= 0; --code) {
    const std::array<int, 4> q{code / 27 - 1, code / 9 % 3 - 1, code / 3 % 3 - 1, code % 3 - 1};
    int length = 0, first = 0;
    for (const int x : q) {
      length += x * x;
      if (first == 0) first = x;
    }
    if (length == 0 || length == 3 || first < 0) continue;
    Relabelling r{};
    for (std::size_t i = 0; i < 4; ++i) r.turn[i] = q[i] / std::sqrt(length);
    const int w = q[0], x = q[1], y = q[2], z = q[3];
    const int matrix[3][3] = {{w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)},
                              {2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)},
                              {2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z}};
    for (std::size_t column = 0; column < 3; ++column)
      for (std::size_t row = 0; row < 3; ++row)
        if (matrix[row][column] != 0) r.from[column] = row;
    out.push_back(r);
  }
  return out;
}

std::optional<Quaternion> normalised(const float* q) {
  double length = 0;
  for (int i = 0; i < 4; ++i) length += static_cast<double>(q[i]) * static_cast<double>(q[i]);
  if (!(length > 0) || !std::isfinite(length)) return {};
  Quaternion out;
  for (std::size_t i = 0; i < 4; ++i) out[i] = static_cast<double>(q[i]) / std::sqrt(length);
  return out;
}

Quaternion product(const Quaternion& a, const Quaternion& b) {
  return {a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3], a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
          a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1], a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]};
}

// Radians; q and -q are one rotation.
double angle_between(const Quaternion& a, const Quaternion& b) {
  double dot = 0, apart = 0, together = 0, component = 0;
  for (std::size_t i = 0; i < 4; ++i) dot += a[i] * b[i];
  for (std::size_t i = 0; i < 4; ++i) {
    const double x = dot < 0 ? -a[i] : a[i];
    apart += (x - b[i]) * (x - b[i]);
    together += (x + b[i]) * (x + b[i]);
    component = std::max(component, std::abs(x - b[i]));
  }
  return component <= kSameComponent ? 0 : 4 * std::atan(std::sqrt(apart / together));
}

struct Reshaped {
  double log_scale = 0, radians = 0;
};

double scale_change(const Splat& a, const Splat& b, const std::array<std::size_t, 3>& from) {
  double out = 0;
  for (std::size_t i = 0; i < 3; ++i)
    out = std::max(out, difference(static_cast<double>(a.log_scale[i]), static_cast<double>(b.log_scale[from[i]])));
  return out;
}

// Some formats turn and exchange the local axes, which leaves the Gaussian as it is: the least change of all 24 ways.
Reshaped shape_change(const Splat& a, const Splat& b) {
  static const std::vector<Relabelling> kRelabellings = make_relabellings();
  const double scale = scale_change(a, b, {0, 1, 2});
  const bool same_rotation = std::equal(std::begin(a.rotation), std::end(a.rotation), std::begin(b.rotation));
  if (same_rotation && scale == 0) return {};
  const auto of_a = normalised(a.rotation), of_b = normalised(b.rotation);
  if (!of_a || !of_b) return {scale, same_rotation ? 0 : std::numeric_limits<double>::infinity()};
  Reshaped least{scale, angle_between(*of_a, *of_b)};
  for (const Relabelling& r : kRelabellings) {
    const Reshaped other{scale_change(a, b, r.from), angle_between(*of_a, product(*of_b, r.turn))};
    if (other.log_scale + other.radians < least.log_scale + least.radians) least = other;
  }
  return least;
}

std::array<double, kAttributes> changes_of(const Splat& a, const Splat& b, const std::array<double, 3>& between) {
  std::array<double, kAttributes> out{};
  double moved = 0, colour = 0;
  for (std::size_t i = 0; i < 3; ++i) {
    const double rest = static_cast<double>(b.mean_rest[i]) - static_cast<double>(a.mean_rest[i]);
    const double d = difference(static_cast<double>(b.mean[i]) + (between[i] + rest), static_cast<double>(a.mean[i]));
    moved += d * d;
  }
  for (std::size_t i = 0; i < std::size(a.sh); ++i) {
    const double d = difference(static_cast<double>(a.sh[i]), static_cast<double>(b.sh[i]));
    colour += d * d;
  }
  out[kMean] = std::sqrt(moved);
  const Reshaped shape = shape_change(a, b);
  out[kScale] = 100 * std::expm1(shape.log_scale);
  out[kRotation] = shape.radians * 180 / std::numbers::pi;
  // The harmonics are orthonormal (Parseval): RMS over directions and channels.
  out[kColour] = 255 * kY0 * std::sqrt(colour / 3);
  if (difference(static_cast<double>(a.opacity_logit), static_cast<double>(b.opacity_logit)) != 0) {
    const auto opacity = [](float logit) { return 1 / (1 + std::exp(-static_cast<double>(logit))); };
    // Logits that differ where opacities no longer do are a change too.
    out[kOpacity] = std::max(100 * difference(opacity(a.opacity_logit), opacity(b.opacity_logit)),
                             std::numeric_limits<double>::min());
  }
  return out;
}

struct Block {
  std::uint64_t n_equal = 0, n_reshaped = 0;
  std::array<Change, kAttributes> changes{};  // rms: the sum of squares
};

void compare_matched(const Sides& sides, const Pairing& pairing, Diff& diff) {
  const std::uint64_t n = diff.b.n, n_blocks = (n + kBlock - 1) / kBlock;
  std::array<double, 3> between;
  for (std::size_t i = 0; i < 3; ++i) between[i] = sides.b.origin()[i] - sides.a.origin()[i];
  diff.fates.assign(n, Fate::added);
  std::vector<Block> blocks(n_blocks);
  tbb::parallel_for(std::uint64_t{0}, n_blocks, [&](std::uint64_t at) {
    Block& block = blocks[at];
    std::array<Splat, kAtOnce> of_a, of_b;
    std::array<std::uint32_t, kAtOnce> rows{};
    const std::uint64_t end = std::min(n, (at + 1) * kBlock);
    for (std::uint64_t first = at * kBlock; first < end; first += kAtOnce) {
      const auto count = static_cast<std::size_t>(std::min<std::uint64_t>(kAtOnce, end - first));
      for (std::size_t i = 0; i < count; ++i) {
        const std::uint32_t row = pairing.source_of[first + i];
        rows[i] = row == kUnpaired ? 0 : row;
      }
      if (diff.a.n != 0) sides.a.gather(std::span(rows).first(count), std::span(of_a).first(count));
      sides.b.read(first, std::span(of_b).first(count));
      for (std::size_t i = 0; i < count; ++i) {
        if (pairing.source_of[first + i] == kUnpaired) continue;
        std::array<double, kAttributes> found = changes_of(of_a[i], of_b[i], between);
        if (found[kMean] <= diff.tolerance) found[kMean] = 0;
        for (std::size_t k = 0; k < kAttributes; ++k) {
          Change& c = block.changes[k];
          c.rms += found[k] * found[k];
          if (found[k] == 0) continue;
          ++c.n;
          if (found[k] <= c.largest) continue;
          c.largest = found[k];
          c.a = rows[i];
          c.b = first + i;
        }
        const bool reshaped = found[kScale] != 0 || found[kRotation] != 0;
        block.n_reshaped += reshaped;
        const Fate fate = found[kMean] != 0      ? Fate::moved
                          : reshaped             ? Fate::reshaped
                          : found[kColour] != 0  ? Fate::recoloured
                          : found[kOpacity] != 0 ? Fate::opacity
                                                 : Fate::unchanged;
        block.n_equal += fate == Fate::unchanged;
        diff.fates[first + i] = fate;
      }
    }
  });
  for (const Block& block : blocks) {
    diff.n_equal += block.n_equal;
    diff.n_reshaped += block.n_reshaped;
    for (std::size_t k = 0; k < kAttributes; ++k) {
      Change& c = diff.changes[k];
      const Change& part = block.changes[k];
      c.n += part.n;
      c.rms += part.rms;
      if (part.largest <= c.largest) continue;
      c.largest = part.largest;
      c.a = part.a;
      c.b = part.b;
    }
  }
  for (Change& c : diff.changes)
    if (pairing.n_paired != 0) c.rms = std::sqrt(c.rms / static_cast<double>(pairing.n_paired));
}

// Whether the permutation of `made` is one of the file at `path`: edited files have other rows.
bool made_from(const Source& made, const std::string& path) {
  const auto provenance = made.provenance();
  if (!provenance) return true;
  const auto file = MappedFile::open(path);
  return file && provenance->source_bytes == file->bytes().size() && provenance->source_xxh3 == xxh3(file->bytes());
}

Result<Pairing> match(const Sides& sides, const std::string& a, const std::string& b) {
  if (made_from(sides.b, a))
    if (auto pairing = pair_by_permutation(sides.a, sides.b)) return *std::move(pairing);
  if (made_from(sides.a, b)) {
    if (const auto inverse = pair_by_permutation(sides.b, sides.a)) {
      Pairing pairing{PairedBy::permutation, std::vector<std::uint32_t>(sides.b.size(), kUnpaired), inverse->n_paired};
      for (std::size_t i = 0; i < inverse->source_of.size(); ++i)
        pairing.source_of[inverse->source_of[i]] = static_cast<std::uint32_t>(i);
      return pairing;
    }
  }
  auto pairing = pair_gaussians(sides.a, sides.b);
  if (!pairing || pairing->by != PairedBy::means || sides.a.size() != sides.b.size()) return pairing;
  for (std::size_t i = 0; i < pairing->source_of.size(); ++i)
    if (pairing->source_of[i] != i) return pairing;
  pairing->by = PairedBy::order;
  return pairing;
}

Diff::Side side_of(const std::string& path, const Source& source) {
  return {path, format_name(source.format()), source.bytes(), source.size(), source.sh_degree()};
}

std::array<float, 3> colour_of(Fate fate) {
  switch (fate) {
    case Fate::unchanged: return {0.5F, 0.5F, 0.5F};
    case Fate::moved: return {0, 0, 1};
    case Fate::reshaped: return {1, 1, 0};
    case Fate::recoloured: return {0, 1, 0};
    case Fate::opacity: return {1, 0, 1};
    case Fate::added: return {0, 1, 1};
  }
  return {};
}
constexpr std::array<float, 3> kRemovedColour{1, 0, 0};

void paint(Splat& s, const std::array<float, 3>& colour) {
  std::fill(std::begin(s.sh), std::end(s.sh), 0.0F);
  for (std::size_t k = 0; k < 3; ++k) s.sh[k] = static_cast<float>((static_cast<double>(colour[k]) - 0.5) / kY0);
}

}  // namespace

bool Diff::same() const {
  return n_equal == a.n && n_equal == b.n && declared.empty();
}

Outcome<Diff> compare_files(const std::string& a, const std::string& b, const ReadOptions& options, double tolerance,
                            Sides& sides) {
  auto of_a = Source::open(a, options, std::nullopt);
  if (!of_a) return make_error(a, of_a.error());
  sides.a = *std::move(of_a);
  auto of_b = Source::open(b, options, sides.a.declarations().axes);
  if (!of_b) return make_error(b, of_b.error());
  sides.b = *std::move(of_b);
  auto pairing = match(sides, a, b);
  if (!pairing) return make_error(b, pairing.error());
  if (2 * pairing->n_paired < std::min(sides.a.size(), sides.b.size())) {
    // A file may have been given other axes than it states.
    auto stored = Source::open(b, options, kAsStored);
    if (!stored) return make_error(b, stored.error());
    const Sides other{sides.a, *std::move(stored)};
    auto again = match(other, a, b);
    if (!again) return make_error(b, again.error());
    if (again->n_paired > pairing->n_paired) {
      pairing = std::move(again);
      sides = other;
    }
  }
  Diff diff;
  diff.a = side_of(a, sides.a);
  diff.b = side_of(b, sides.b);
  diff.pairs = pairing->report(diff.a.n);
  diff.tolerance = tolerance;
  diff.declared = compare_declarations(sides.a, sides.b.declarations(), sides.b.format() == SplatFormat::rgs);
  compare_matched(sides, *pairing, diff);
  std::vector<std::uint8_t> is_matched(diff.a.n);
  for (const std::uint32_t row : pairing->source_of)
    if (row != kUnpaired) is_matched[row] = 1;
  for (std::uint64_t row = 0; row < diff.a.n; ++row)
    if (is_matched[row] == 0) diff.removed.push_back(static_cast<std::uint32_t>(row));
  return diff;
}

Status write_fates(const std::string& path, const Diff& diff, const Sides& sides, bool overwrite) {
  Declarations stated;
  stated.axes = sides.b.declarations().axes;
  stated.origin = sides.b.origin();
  auto writer = PlyWriter::create(path, diff.b.n + diff.removed.size(), 0, {.overwrite = overwrite}, stated);
  if (!writer) return tl::unexpected(writer.error());
  std::array<Splat, kAtOnce> splats;
  for (std::uint64_t first = 0; first < diff.b.n; first += kAtOnce) {
    const auto part = std::span(splats).first(std::min<std::uint64_t>(kAtOnce, diff.b.n - first));
    sides.b.read(first, part);
    for (std::size_t i = 0; i < part.size(); ++i) paint(part[i], colour_of(diff.fates[first + i]));
    if (auto ok = writer->write(first, part); !ok) return ok;
  }
  for (std::size_t first = 0; first < diff.removed.size(); first += kAtOnce) {
    const std::size_t count = std::min(kAtOnce, diff.removed.size() - first);
    const auto part = std::span(splats).first(count);
    sides.a.gather(std::span(diff.removed).subspan(first, count), part);
    for (Splat& s : part) {
      paint(s, kRemovedColour);
      for (std::size_t k = 0; k < 3; ++k)
        s.mean[k] = static_cast<float>(sides.a.origin()[k] - sides.b.origin()[k] + static_cast<double>(s.mean[k]));
    }
    if (auto ok = writer->write(diff.b.n + first, part); !ok) return ok;
  }
  if (const auto done = writer->commit(); !done) return tl::unexpected(done.error());
  return {};
}

}  // namespace rgs::audit
