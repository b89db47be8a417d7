// palette.cpp - codebooks, and palettes: a tree of cells, each halved by 2-means, the worst first (Gersho and Gray
// 1992, "Vector Quantization and Signal Compression", chapter 12), then k-means whose rows search near their entries.
// SPDX-License-Identifier: Apache-2.0
#include "palette.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <numeric>
#include <utility>

#include "parallel_jobs.hpp"

namespace rgs::detail {
namespace {

// ---- numbers --------------------------------------------------------------------------------------------------------

constexpr std::size_t kCodes = std::tuple_size_v<Codebook>;

// Weighted sums over the numbers before one.
struct Sums {
  double weight = 0, value = 0, square = 0;

  Sums operator-(const Sums& s) const { return {weight - s.weight, value - s.value, square - s.square}; }
  float mean() const { return static_cast<float>(value / weight); }
  double distortion() const { return square - value * value / weight; }
};

// Where the numbers of each code begin, and the end: the worst stretch is cut at its mean, again and again.
using Stretches = std::array<std::size_t, kCodes + 1>;
Stretches first_stretches(const std::vector<Weighed>& sorted, const std::vector<Sums>& sums) {
  std::vector<std::size_t> begins{0, sorted.size()};
  std::vector<double> bad{1};
  while (bad.size() < kCodes) {
    const auto worst = static_cast<std::size_t>(std::ranges::max_element(bad) - bad.begin());
    const std::size_t begin = begins[worst], end = begins[worst + 1];
    const auto stretch = std::span(sorted).subspan(begin, end - begin);
    const auto above = std::ranges::upper_bound(stretch, (sums[end] - sums[begin]).mean(), {}, &Weighed::value);
    const std::size_t cut =
        begin + std::clamp<std::size_t>(static_cast<std::size_t>(above - stretch.begin()), 1, end - begin - 1);
    begins.insert(begins.begin() + static_cast<std::ptrdiff_t>(worst) + 1, cut);
    const auto distortion = [&](std::size_t a, std::size_t b) {
      constexpr double kUncuttable = -std::numeric_limits<double>::infinity();  // others may round to less than 0
      return b - a < 2 ? kUncuttable : (sums[b] - sums[a]).distortion();
    };
    bad[worst] = distortion(begin, cut);
    bad.insert(bad.begin() + static_cast<std::ptrdiff_t>(worst) + 1, distortion(cut, end));
  }
  Stretches stretches;
  std::ranges::copy(begins, stretches.begin());
  return stretches;
}

// Those not above are nearer to the lower one.
float middle(float low, float high) {
  return static_cast<float>((static_cast<double>(low) + static_cast<double>(high)) / 2);
}

}  // namespace

Codebook fit_codebook(std::vector<Weighed> numbers) {
  std::ranges::sort(numbers, [](const Weighed& a, const Weighed& b) {
    return a.value != b.value ? a.value < b.value : a.weight < b.weight;
  });
  std::vector<Weighed> distinct;
  std::ranges::unique_copy(numbers, std::back_inserter(distinct), {}, &Weighed::value);
  Codebook codebook{};
  if (distinct.size() <= kCodes) {
    std::ranges::fill(codebook, distinct.empty() ? 0.F : distinct.back().value);
    std::ranges::transform(distinct, codebook.begin(), &Weighed::value);
    return codebook;
  }
  std::vector<Sums> sums(numbers.size() + 1);
  for (std::size_t i = 0; i < numbers.size(); ++i) {
    const auto value = static_cast<double>(numbers[i].value), weight = static_cast<double>(numbers[i].weight);
    const Sums& s = sums[i];
    sums[i + 1] = {s.weight + weight, s.value + weight * value, s.square + weight * value * value};
  }
  Stretches begins = first_stretches(numbers, sums), before{};
  constexpr int kRounds = 300;
  for (int round = 0; round < kRounds && begins != before; ++round) {
    before = begins;
    for (std::size_t c = 0; c < kCodes; ++c) {
      if (begins[c] < begins[c + 1]) codebook[c] = (sums[begins[c + 1]] - sums[begins[c]]).mean();
    }
    std::ranges::sort(codebook);  // rounding may swap neighbours
    for (std::size_t c = 1; c < kCodes; ++c) {
      const auto above = std::ranges::upper_bound(numbers, middle(codebook[c - 1], codebook[c]), {}, &Weighed::value);
      begins[c] = static_cast<std::size_t>(above - numbers.begin());
    }
  }
  return codebook;
}

std::uint8_t nearest_code(const Codebook& codebook, float value) {
  const auto above = static_cast<std::size_t>(std::ranges::lower_bound(codebook, value) - codebook.begin());
  if (above == 0) return 0;
  const bool lower = above == kCodes || value <= middle(codebook[above - 1], codebook[above]);
  return static_cast<std::uint8_t>(lower ? above - 1 : above);
}

namespace {

// ---- cells ----------------------------------------------------------------------------------------------------------

using Members = std::span<const std::uint32_t>;

class Cells {
 public:
  struct Cell {
    std::size_t begin, end;  // of the members
    double distortion;
  };

  Cells(const Rows& rows, std::span<const float> weights) : rows_(rows), weights_(weights), members_(weights.size()) {
    std::iota(members_.begin(), members_.end(), 0U);
  }

  // At most n cells, in the order of the tree.
  std::vector<Cell> split(std::size_t n, unsigned threads) {
    std::vector<Cell> cells{{0, members_.size(), 1}};
    while (cells.size() < n) {
      // All that are at least half as bad as the worst, so that few rounds are enough.
      std::ranges::sort(cells, [](const Cell& a, const Cell& b) {
        return a.distortion != b.distortion ? a.distortion > b.distortion : a.begin < b.begin;
      });
      const double worst = cells.front().distortion;
      if (!(worst > 0)) break;
      const auto mild = std::ranges::find_if(cells, [&](const Cell& c) { return c.distortion < worst / 2; });
      std::vector<Cell> halves(std::min(static_cast<std::size_t>(mild - cells.begin()), n - cells.size()));
      run_in_parallel(halves.size(), threads, [&](std::size_t i) { halves[i] = halve(cells[i]); });
      std::ranges::copy_if(halves, std::back_inserter(cells), [](const Cell& c) { return c.begin < c.end; });
    }
    std::ranges::sort(cells, {}, &Cell::begin);
    return cells;
  }

  Members members(const Cell& cell) const { return std::span(members_).subspan(cell.begin, cell.end - cell.begin); }

  std::vector<float> mean(Members members) const {
    double weight = 0;
    for (const std::uint32_t i : members) weight += static_cast<double>(weights_[i]);
    std::vector<float> mean;
    for (const double sum : summed(members, [&](Members part, float*sum) { add_rows(rows_, weights_, part, sum); }))
      mean.push_back(static_cast<float>(sum / weight));
    return mean;
  }

 private:
  // Sums by coordinate; of a few rows at a time, since sums of millions in FP32 stand still.
  template <class Add>
  std::vector<double> summed(Members members, const Add& add) const {
    constexpr std::size_t kAtOnce = 4096;
    std::vector<double> total(rows_.width);
    for (std::size_t first = 0; first < members.size(); first += kAtOnce) {
      std::vector<float> sum(rows_.width);
      add(members.subspan(first, std::min(kAtOnce, members.size() - first)), sum.data());
      for (std::size_t k = 0; k < sum.size(); ++k) total[k] += static_cast<double>(sum[k]);
    }
    return total;
  }
  std::vector<double> squares(Members members, const std::vector<float>& mean) const {
    return summed(members, [&](Members part, float* sum) { add_squares(rows_, weights_, part, mean.data(), sum); });
  }
  double distortion(Members members) const {
    const std::vector<double> sum = squares(members, mean(members));
    return members.size() < 2 ? 0 : std::accumulate(sum.begin(), sum.end(), 0.0);
  }

  // Keeps a half in `cell` and returns the other: empty if all rows are alike.
  Cell halve(Cell& cell) {
    const auto mine = std::span(members_).subspan(cell.begin, cell.end - cell.begin);
    const std::vector<float> centre = mean(mine);
    const std::vector<double> spread = squares(mine, centre);
    const auto widest = static_cast<std::size_t>(std::ranges::max_element(spread) - spread.begin());
    std::vector<float> direction(rows_.width), projected(mine.size());
    direction[widest] = 1;
    double threshold = static_cast<double>(centre[widest]);
    std::vector<std::uint32_t> sides[2];
    constexpr int kRounds = 5;
    for (int round = 0; round < kRounds; ++round) {
      project_rows(rows_, mine, direction.data(), projected.data());
      for (auto& side : sides) side.clear();
      for (std::size_t i = 0; i < mine.size(); ++i) {
        sides[static_cast<double>(projected[i]) > threshold ? 1 : 0].push_back(mine[i]);
      }
      if (sides[0].empty() || sides[1].empty()) {
        cell.distortion = 0;
        return {};
      }
      const std::vector<float> low = mean(sides[0]), high = mean(sides[1]);
      threshold = 0;
      for (std::size_t k = 0; k < rows_.width; ++k) {
        direction[k] = high[k] - low[k];
        threshold += static_cast<double>(direction[k]) * static_cast<double>(middle(low[k], high[k]));
      }
    }
    std::ranges::copy(sides[1], std::ranges::copy(sides[0], mine.begin()).out);
    const std::size_t end = std::exchange(cell.end, cell.begin + sides[0].size());
    cell.distortion = distortion(sides[0]);
    return {cell.end, end, distortion(sides[1])};
  }

  const Rows& rows_;
  std::span<const float> weights_;
  std::vector<std::uint32_t> members_;
};

// ---- k-means --------------------------------------------------------------------------------------------------------

// Set i has order[starts[i]] to order[starts[i + 1]], ascending.
struct Sets {
  std::vector<std::size_t> starts;
  std::vector<std::uint32_t> order;

  // `labels` divided by `size` are the sets.
  Sets(std::size_t n, std::span<const std::uint32_t> labels, std::size_t size) : starts(n + 1), order(labels.size()) {
    for (const std::uint32_t label : labels) ++starts[label / size + 1];
    std::partial_sum(starts.begin(), starts.end(), starts.begin());
    std::vector<std::size_t> at(starts.begin(), starts.end() - 1);
    for (std::uint32_t i = 0; i < labels.size(); ++i) order[at[labels[i] / size]++] = i;
  }
  Members members(std::size_t i) const { return std::span(order).subspan(starts[i], starts[i + 1] - starts[i]); }
};

// Four times as many gain an outdoor scene 0.1 dB, and take four times as long.
constexpr std::size_t kNear = 32;

// By their means.
void find_near(const Rows& means, EntryGroups& entries, unsigned threads) {
  const std::size_t n_groups = means.size();
  entries.n_near = std::min(kNear, n_groups);
  entries.near.resize(n_groups * entries.n_near);
  run_in_parallel(n_groups, threads, [&](std::size_t group) {
    std::vector<std::pair<float, std::uint32_t>> found(n_groups);
    for (std::uint32_t g = 0; g < n_groups; ++g) {
      float squared = 0;
      for (std::size_t k = 0; k < means.width; ++k) {
        const float d = means[g][k] - means[group][k];
        squared += d * d;
      }
      found[g] = {g == group ? -1 : squared, g};
    }
    const auto end = found.begin() + static_cast<std::ptrdiff_t>(entries.n_near);
    std::ranges::partial_sort(found, end);
    std::transform(found.begin(), end, entries.near.begin() + static_cast<std::ptrdiff_t>(group * entries.n_near),
                   [](const auto& pair) { return pair.second; });
  });
}

EntryGroups group_entries(const Rows& values, unsigned threads) {
  const std::size_t width = values.width, n = values.size(), n_groups = (n + kGroup - 1) / kGroup;
  EntryGroups entries{values, std::vector<float>(n_groups * kGroup * width), {}, 0, {}};
  entries.half_squares.assign(n_groups * kGroup, std::numeric_limits<float>::max());
  Rows means(n_groups, width);
  for (std::size_t i = 0; i < n; ++i) {
    const auto in_group = static_cast<float>(std::min(kGroup, n - i / kGroup * kGroup));
    float squares = 0;
    for (std::size_t k = 0; k < width; ++k) {
      const float value = values[i][k];
      entries.panels[i / kPanel * kPanel * width + k * kPanel + i % kPanel] = value;
      means[i / kGroup][k] += value / in_group;
      squares += value * value;
    }
    entries.half_squares[i] = squares / 2;
  }
  find_near(means, entries, threads);
  return entries;
}

}  // namespace

void label_nearest(const Rows& rows, Palette& palette, unsigned threads) {
  const EntryGroups entries = group_entries(palette.entries, threads);
  const std::size_t n_groups = entries.half_squares.size() / kGroup;
  const Sets sets(n_groups, palette.labels, kGroup);
  run_in_parallel(n_groups, threads,
                  [&](std::size_t group) { search_groups(rows, sets.members(group), entries, group, palette.labels); });
}

Palette fit_palette(const Rows& rows, std::span<const float> weights, std::size_t n_entries, unsigned threads) {
  Palette palette;
  palette.labels.resize(weights.size());
  Cells cells(rows, weights);
  const auto leaves = cells.split(n_entries, threads);
  palette.entries = Rows(leaves.size(), rows.width);
  for (std::uint32_t c = 0; c < leaves.size(); ++c) {
    for (const std::uint32_t i : cells.members(leaves[c])) palette.labels[i] = c;
  }
  // After four rounds, four more gain an outdoor scene 0.03 dB.
  constexpr int kRounds = 4;
  constexpr std::size_t kJob = 256;
  for (int round = 0;; ++round) {
    const Sets sets(leaves.size(), palette.labels, 1);
    run_in_parallel((leaves.size() + kJob - 1) / kJob, threads, [&](std::size_t job) {
      for (std::size_t c = kJob * job; c < std::min(kJob * (job + 1), leaves.size()); ++c) {
        if (!sets.members(c).empty()) std::ranges::copy(cells.mean(sets.members(c)), palette.entries[c]);
      }
    });
    if (round == kRounds) return palette;
    label_nearest(rows, palette, threads);
  }
}

}  // namespace rgs::detail
