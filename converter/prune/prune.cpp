// prune.cpp - ranks Gaussians by contribution.
// SPDX-License-Identifier: Apache-2.0
#include "prune.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <charconv>
#include <cmath>
#include <cstring>
#include <limits>
#include <numeric>
#include <string>

#include "console.hpp"

namespace rgs::prune {

double score(const Contribution& contribution, Score score) {
  return score == Score::sum ? contribution.weight() : static_cast<double>(contribution.largest);
}

std::uint64_t Keep::of(std::uint64_t n) const {
  return std::min(n, count.value_or(static_cast<std::uint64_t>(std::llround(share * static_cast<double>(n)))));
}

Result<Keep> parse_keep(std::string_view text) {
  if (!text.ends_with('%')) {
    const auto count = tool::parse_count(text);
    if (!count) return tl::unexpected(count.error());
    return Keep{1, *count};
  }
  text.remove_suffix(1);
  double percent = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), percent);
  if (error != std::errc() || end != text.data() + text.size() || !(percent >= 0 && percent <= 100)) {
    return make_error(Errc::bad_argument, Error::kNone, "not a percentage from 0% to 100%");
  }
  return Keep{percent / 100, std::nullopt};
}

std::vector<std::uint64_t> highest(std::span<const Contribution> contributions, Score by, std::uint64_t n_kept) {
  std::vector<std::uint64_t> order(contributions.size());
  std::iota(order.begin(), order.end(), std::uint64_t{0});
  const auto before = [&](std::uint64_t a, std::uint64_t b) {
    const double score_a = score(contributions[a], by), score_b = score(contributions[b], by);
    return score_a != score_b ? score_a > score_b : a < b;
  };
  const auto end = order.begin() + static_cast<std::ptrdiff_t>(std::min<std::uint64_t>(n_kept, order.size()));
  std::nth_element(order.begin(), end, order.end(), before);
  order.erase(end, order.end());
  std::ranges::sort(order);
  return order;
}

std::vector<std::uint64_t> at_least(std::span<const Contribution> contributions, Score by, double least) {
  std::vector<std::uint64_t> kept;
  for (std::uint64_t i = 0; i < contributions.size(); ++i) {
    if (score(contributions[i], by) >= least) kept.push_back(i);
  }
  return kept;
}

Outcome outcome(std::span<const Contribution> contributions, Score by, std::span<const std::uint64_t> kept) {
  Outcome out;
  double all = 0, of_kept = 0, lowest = std::numeric_limits<double>::infinity();
  for (const Contribution& c : contributions) {
    all += c.weight();
    if (c.sum == 0) ++out.n_unseen;
  }
  for (const std::uint64_t i : kept) {
    of_kept += contributions[i].weight();
    lowest = std::min(lowest, score(contributions[i], by));
  }
  out.n_kept = kept.size();
  out.weight_share = all > 0 ? of_kept / all : 1;
  out.lowest_score = kept.empty() ? 0 : lowest;
  return out;
}

std::vector<std::byte> scores_npy(std::span<const Contribution> contributions) {
  static_assert(std::endian::native == std::endian::little);
  // Version 1.0: magic, version, length of the text (16 bits), text padded so that the header is a multiple of 64.
  std::string text =
      fmt::format("{{'descr': '<f8', 'fortran_order': False, 'shape': ({}, 2), }}", contributions.size());
  text.append(63 - (10 + text.size()) % 64, ' ');
  text += '\n';
  const std::string head = std::string("\x93NUMPY\x01\0", 8) + static_cast<char>(text.size() & 0xFF) +
                           static_cast<char>(text.size() >> 8) + text;
  std::vector<double> values;
  values.reserve(2 * contributions.size());
  for (const Contribution& c : contributions) values.insert(values.end(), {c.weight(), c.largest});
  std::vector<std::byte> out(head.size() + values.size() * sizeof(double));
  std::memcpy(out.data(), head.data(), head.size());
  if (!values.empty()) std::memcpy(out.data() + head.size(), values.data(), values.size() * sizeof(double));
  return out;
}

}  // namespace rgs::prune
