// audit_pairing.cpp - pairs by permutation, by order, by a merge join of hashed means, or by the nearest mean.
// SPDX-License-Identifier: Apache-2.0
#include "audit_pairing.hpp"

#include <tbb/parallel_for.h>
#include <tbb/parallel_sort.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <optional>
#include <utility>

#include "audit_nearest.hpp"
#include "rgs/encode.hpp"
#include "rgs/quantize.hpp"

namespace rgs::audit {
namespace {

constexpr std::uint64_t kRows = 4096;
constexpr std::size_t kAtOnce = 64;

struct KeyedRow {
  std::uint64_t key;
  std::uint32_t row;
  // Rows with equal means stay in order: Morton order keeps it, so both files have them in source order.
  bool operator<(const KeyedRow& other) const { return key != other.key ? key < other.key : row < other.row; }
};

// Mixes a mean's bits; 64 bits tell 2^32 means apart. (Finaliser of SplitMix64, Steele et al. 2014.)
std::uint64_t key_of(const float* mean) {
  std::uint64_t key = 0;
  for (int i = 0; i < 3; ++i) {
    key += std::bit_cast<std::uint32_t>(mean[i]) + 0x9E3779B97F4A7C15u;
    key = (key ^ key >> 30) * 0xBF58476D1CE4E5B9u;
    key = (key ^ key >> 27) * 0x94D049BB133111EBu;
    key ^= key >> 31;
  }
  return key;
}

bool same_bits(const float* a, const float* b) {
  return std::equal(
      a, a + 3, b, [](float x, float y) { return std::bit_cast<std::uint32_t>(x) == std::bit_cast<std::uint32_t>(y); });
}

// In blocks on all threads.
template <class Row, class Read, class Use>
void for_each_row(std::uint64_t n, const Read& read, const Use& use) {
  tbb::parallel_for(std::uint64_t{0}, (n + kRows - 1) / kRows, [&](std::uint64_t block) {
    std::array<Row, kAtOnce> rows;
    const std::uint64_t end = std::min(n, (block + 1) * kRows);
    for (std::uint64_t first = block * kRows; first < end; first += kAtOnce) {
      const auto part = std::span(rows).first(std::min<std::uint64_t>(kAtOnce, end - first));
      read(first, part);
      for (std::size_t i = 0; i < part.size(); ++i) use(first + i, part[i]);
    }
  });
}

// Empty if the permutation does not fit this source. An asset made from another .rgs has that file's source's
// positions.
std::optional<Pairing> pair_by_permutation(const Source& source, const FileView& asset) {
  if (source.format() == SplatFormat::rgs) return {};
  if (asset.find(SectionType::permutation) == nullptr || asset.declarations().n_source != source.size()) return {};
  Pairing pairing{PairedBy::permutation, std::vector<std::uint32_t>(asset.header().n_gaussians), 0};
  for (std::uint64_t i = 0; i < pairing.source_of.size(); ++i)
    pairing.source_of[i] = static_cast<std::uint32_t>(asset.source_index(i));
  pairing.n_paired = pairing.source_of.size();
  return pairing;
}

// Both in the same order, with some rows of the source missing. Empty if a mean is not found.
std::optional<Pairing> pair_by_order(const Source& source, const FileView& asset) {
  if (asset.declarations().order != Order::input) return {};
  Pairing pairing{PairedBy::order, std::vector<std::uint32_t>(asset.header().n_gaussians), 0};
  std::array<Splat, kAtOnce> rows;
  std::array<ActivatedSplat, kAtOnce> stored;
  std::uint64_t i = 0, first_stored = 0, n_stored = 0;
  for (std::uint64_t first = 0; first < source.size() && i < pairing.source_of.size(); first += kAtOnce) {
    const auto part = std::span(rows).first(std::min<std::uint64_t>(kAtOnce, source.size() - first));
    source.read(first, part);
    for (std::size_t k = 0; k < part.size() && i < pairing.source_of.size(); ++k) {
      if (i == first_stored + n_stored) {
        first_stored = i;
        n_stored = std::min<std::uint64_t>(kAtOnce, pairing.source_of.size() - i);
        (void)asset.read(i, std::span(stored).first(n_stored));
      }
      if (!same_bits(part[k].mean, stored[i - first_stored].mean)) continue;
      pairing.source_of[i++] = static_cast<std::uint32_t>(first + k);
    }
  }
  if (i != pairing.source_of.size()) return {};
  pairing.n_paired = i;
  return pairing;
}

UseMean note_in(std::vector<KeyedRow>& rows) {
  return [&rows](std::uint64_t row, const float* mean) { rows[row] = {key_of(mean), static_cast<std::uint32_t>(row)}; };
}

Pairing join(std::vector<KeyedRow> of_source, std::vector<KeyedRow> of_asset) {
  tbb::parallel_sort(of_source);
  tbb::parallel_sort(of_asset);
  Pairing pairing{PairedBy::means, std::vector<std::uint32_t>(of_asset.size(), kUnpaired), 0};
  auto from = of_source.begin();
  for (const KeyedRow& row : of_asset) {
    while (from != of_source.end() && from->key < row.key) ++from;
    if (from == of_source.end() || from->key != row.key) continue;
    pairing.source_of[row.row] = from->row;
    ++pairing.n_paired;
    ++from;
  }
  return pairing;
}

Pairing pair_by_means(const Source& source, const FileView& asset) {
  std::vector<KeyedRow> of_source(source.size()), of_asset(asset.header().n_gaussians);
  const UseMean note = note_in(of_source);
  for_each_mean(source, note);
  for_each_mean(asset, note_in(of_asset));
  return join(std::move(of_source), std::move(of_asset));
}

float largest_scale(const Splat& s) {
  return scale_from_log(std::max({s.log_scale[0], s.log_scale[1], s.log_scale[2]}));
}

// Pairs what is left of the source, in order, each with the nearest within reach that is left of the asset, whose means
// `points` are. A format that rounds to a grid puts every mean on the point of the grid that is nearest to it, so each
// finds its own.
template <class Reach>
void pair_nearest(const Source& source, const std::vector<Point>& points, const Reach& reach, Pairing& pairing) {
  std::vector<std::uint8_t> is_paired(source.size());
  for (const std::uint32_t row : pairing.source_of)
    if (row != kUnpaired) is_paired[row] = 1;
  std::vector<std::uint32_t> rows;
  std::vector<Point> left;
  for (std::uint32_t row = 0; row < points.size(); ++row) {
    if (pairing.source_of[row] != kUnpaired ||
        !std::ranges::all_of(points[row], [](float x) { return std::isfinite(x); }))
      continue;
    rows.push_back(row);
    left.push_back(points[row]);
  }
  if (left.empty() || pairing.n_paired == source.size()) return;
  NearestPoints nearest(left);
  std::array<Splat, kAtOnce> splats;
  for (std::uint64_t first = 0; first < source.size(); first += kAtOnce) {
    const auto part = std::span(splats).first(std::min<std::uint64_t>(kAtOnce, source.size() - first));
    source.read(first, part);
    for (std::size_t i = 0; i < part.size(); ++i) {
      const Splat& s = part[i];
      if (is_paired[first + i] != 0) continue;
      const auto found = nearest.take({s.mean[0], s.mean[1], s.mean[2]}, reach(s));
      if (!found) continue;
      pairing.source_of[rows[*found]] = static_cast<std::uint32_t>(first + i);
      ++pairing.n_paired;
      pairing.by = PairedBy::nearest;
    }
  }
}

// How far the archive may have moved a Gaussian's mean; docs/format/ARCHIVE.md "Bounds".
float archive_reach(const ArchiveParameters& p, const Splat& s) {
  double squared = 0, widest = 0;
  for (std::size_t k = 0; k < 3; ++k) {
    const double d = static_cast<double>(s.mean[k]) - p.centre[k];
    squared += d * d;
    widest = std::max({widest, p.half_width[k], std::abs(d)});
  }
  const double size = static_cast<double>(largest_scale(s));
  if (p.codec == Codec::archive_draco) {
    return static_cast<float>(std::max<double>(kSameGaussian * size, 2 * static_cast<double>(p.bound_mean) * widest));
  }
  const double blur = std::exp2(p.shape.blur / 32768.0) * std::max(squared, p.shape.nearest);
  double most = kSameGaussian;
  for (const ArchiveClass& c : p.classes) most = std::max(most, static_cast<double>(c.bound_mean));
  return static_cast<float>(most * std::sqrt(size * size + blur));
}

Pairing pair_by_means(const Source& source, const FileView& asset, const ArchiveParameters* archive) {
  Pairing pairing = pair_by_means(source, asset);
  if (archive == nullptr) return pairing;
  std::vector<Point> points(asset.header().n_gaussians);
  for_each_mean(asset, [&points](std::uint64_t row, const float* mean) { std::copy_n(mean, 3, points[row].data()); });
  pair_nearest(
      source, points, [archive](const Splat& s) { return archive_reach(*archive, s); }, pairing);
  return pairing;
}

Status check_count(std::uint64_t n_source, std::uint64_t n_asset) {
  if (n_source < kUnpaired && n_asset < kUnpaired) return {};
  return rgs::make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than can be paired", kUnpaired - 1,
                         std::max(n_source, n_asset));
}

}  // namespace

void for_each_mean(const Source& source, const UseMean& use) {
  for_each_row<Splat>(
      source.size(), [&](std::uint64_t first, auto part) { source.read(first, part); },
      [&](std::uint64_t row, const Splat& splat) { use(row, splat.mean); });
}

void for_each_mean(const FileView& asset, const UseMean& use) {
  for_each_row<ActivatedSplat>(
      asset.header().n_gaussians, [&](std::uint64_t first, auto part) { (void)asset.read(first, part); },
      [&](std::uint64_t row, const ActivatedSplat& splat) { use(row, splat.mean); });
}

Result<Pairing> pair_gaussians(const Source& source, const FileView& asset, const ArchiveParameters* archive) {
  if (auto ok = check_count(source.size(), asset.header().n_gaussians); !ok) return tl::unexpected(ok.error());
  if (auto pairing = pair_by_permutation(source, asset)) return *std::move(pairing);
  const Origin& origin = asset.declarations().origin;
  if (source.origin() != origin) {
    // Means are equal only relative to the same origin.
    const auto again = source.relative_to(origin);
    if (!again) return tl::unexpected(again.error());
    if (auto pairing = pair_by_order(*again, asset)) return *std::move(pairing);
    return pair_by_means(*again, asset, archive);
  }
  if (auto pairing = pair_by_order(source, asset)) return *std::move(pairing);
  return pair_by_means(source, asset, archive);
}

std::optional<Pairing> pair_by_permutation(const Source& source, const Source& asset) {
  const auto index = asset.source_index();
  if (source.format() == SplatFormat::rgs || index.empty() || index.size() != asset.size() ||
      asset.declarations().n_source != source.size())
    return {};
  std::vector<std::uint8_t> is_paired(source.size());
  for (const std::uint32_t row : index)
    if (row >= source.size() || is_paired[row]++ != 0) return {};
  return Pairing{PairedBy::permutation, std::vector<std::uint32_t>(index.begin(), index.end()), index.size()};
}

Result<Pairing> pair_gaussians(const Source& source, const Source& asset) {
  if (auto ok = check_count(source.size(), asset.size()); !ok) return tl::unexpected(ok.error());
  Pairing pairing{PairedBy::means, std::vector<std::uint32_t>(asset.size(), kUnpaired), 0};
  if (source.origin() == asset.origin()) {
    std::vector<KeyedRow> of_source(source.size()), of_asset(asset.size());
    for_each_mean(source, note_in(of_source));
    for_each_mean(asset, note_in(of_asset));
    pairing = join(std::move(of_source), std::move(of_asset));
  }
  std::vector<Point> points(asset.size());
  for_each_mean(asset, [&](std::uint64_t row, const float* mean) {
    for (std::size_t k = 0; k < 3; ++k)
      points[row][k] = static_cast<float>(asset.origin()[k] - source.origin()[k] + static_cast<double>(mean[k]));
  });
  pair_nearest(
      source, points, [](const Splat& s) { return kSameGaussian * largest_scale(s); }, pairing);
  return pairing;
}

}  // namespace rgs::audit
