// rans.cpp - the entropy coder's tables, stream ends and backward pass.
// SPDX-License-Identifier: Apache-2.0
#include "archive/rans.hpp"

#include <algorithm>
#include <cassert>
#include <cstring>
#include <numeric>

namespace rgs::detail {

bool RansTables::assign(std::span<const std::uint16_t> frequencies) {
  const std::size_t n = frequencies.size() / kRansTokens;
  distributions_.assign(n, {});
  for (std::size_t d = 0; d < n; ++d) {
    const auto row = frequencies.subspan(d * kRansTokens, kRansTokens);
    if (std::accumulate(row.begin(), row.end(), 0u) != kRansTotal) return false;
    Distribution& to = distributions_[d];
    std::uint8_t* slot = to.token.data();
    std::uint32_t before = 0;
    for (std::uint32_t token = 0; token < kRansTokens; ++token) {
      to.frequency[token] = row[token] | before << 16;
      slot = std::fill_n(slot, row[token], static_cast<std::uint8_t>(token));
      before += row[token];
    }
  }
  return true;
}

bool RansReader::begin(std::span<const std::byte> stream) {
  if (stream.size() < sizeof states_ || stream.size() % 2 != 0) return false;
  std::memcpy(states_.data(), stream.data(), sizeof states_);
  at_ = stream.data() + sizeof states_;
  end_ = stream.data() + stream.size();
  return true;
}

template <bool kAmple>
void RansReader::refill(std::uint32_t& x) {
  if constexpr (kAmple) {  // no branch: which state needs a word is unpredictable
    std::uint16_t word;
    std::memcpy(&word, at_, sizeof word);
    const bool low = x < kRansLow;
    x = low ? x << 16 | word : x;
    at_ += low ? 2 : 0;
  } else if (x < kRansLow) {
    std::uint16_t word = 0;
    if (at_ != end_) {
      std::memcpy(&word, at_, sizeof word);
      at_ += 2;
    } else {
      bad_ = true;
    }
    x = x << 16 | word;
  }
}

template <bool kAmple>
std::uint32_t RansReader::next(std::uint32_t& x, std::size_t context) {
  const RansTables::Distribution& d = distributions_[map_[context]];
  const std::uint32_t slot = x & (kRansTotal - 1), token = d.token[slot], frequency = d.frequency[token];
  x = (frequency & 0xFFFF) * (x >> 12) + slot - (frequency >> 16);
  refill<kAmple>(x);
  if (token < 32) [[likely]]
    return token;
  const std::uint32_t n_bits = (token - 32) / 4 + 3;
  const std::uint32_t z = (4 + token % 4) << n_bits | (x & ((1u << n_bits) - 1));
  x >>= n_bits;
  refill<kAmple>(x);
  return z;
}

void RansReader::numbers(std::size_t first, std::size_t n, std::uint16_t* contexts) {
  std::array<std::uint32_t, kRansStates> x = states_;
  std::size_t i = 0;
  for (; i + kRansStates <= n && end_ - at_ >= std::ptrdiff_t{4 * kRansStates}; i += kRansStates) {
    for (std::size_t lane = 0; lane < kRansStates; ++lane) {
      contexts[i + lane] = static_cast<std::uint16_t>(next<true>(x[lane], contexts[i + lane]));
    }
  }
  states_ = x;
  for (; i < n; ++i)
    contexts[i] = static_cast<std::uint16_t>(next<false>(states_[(first + i) % kRansStates], contexts[i]));
}

template <class T>
void RansReader::read(std::size_t first, std::size_t n, std::uint16_t* contexts, T* values, std::uint32_t limit) {
  numbers(first, n, contexts);
  for (std::size_t i = 0; i < n; ++i) {
    const std::uint16_t z = contexts[i];
    if constexpr (std::is_signed_v<T>) {
      values[i] = unfold_code(z);
    } else {
      bad_ |= z > limit;
      values[i] = z > limit ? T{0} : static_cast<T>(z);
    }
  }
}

template void RansReader::read(std::size_t, std::size_t, std::uint16_t*, std::int16_t*, std::uint32_t);
template void RansReader::read(std::size_t, std::size_t, std::uint16_t*, std::uint16_t*, std::uint32_t);
template void RansReader::read(std::size_t, std::size_t, std::uint16_t*, std::uint8_t*, std::uint32_t);

void RansReader::bits(std::size_t n, std::uint16_t* values, const std::uint8_t* widths) {
  for (std::size_t i = 0; i < n; ++i) {
    std::uint32_t& x = states_[i % kRansStates];
    values[i] = static_cast<std::uint16_t>(x & ((1u << widths[i]) - 1));
    x >>= widths[i];
    refill<false>(x);
  }
}

bool RansReader::finished() const {
  return at_ == end_ && std::ranges::all_of(states_, [](std::uint32_t x) { return x == kRansLow; });
}

RansWriter::RansWriter(std::span<const std::uint16_t> frequencies, std::span<const std::uint8_t> map)
    : frequencies_(frequencies), map_(map), starts_(frequencies.size()) {
  for (std::size_t row = 0; row < frequencies.size(); row += kRansTokens) {
    std::exclusive_scan(&frequencies[row], &frequencies[row] + kRansTokens, &starts_[row], std::uint16_t{0});
  }
}

// A state is a stack: numbers go in backwards, raw bits before their token.
std::vector<std::byte> RansWriter::finish() {
  std::array<std::uint32_t, kRansStates> x;
  x.fill(kRansLow);
  std::vector<std::uint16_t> words;
  const auto make_room = [&words](std::uint32_t& state, std::uint64_t limit) {
    if (state < limit) return;
    words.push_back(static_cast<std::uint16_t>(state));
    state >>= 16;
  };
  for (auto number = numbers_.rbegin(); number != numbers_.rend(); ++number) {
    std::uint32_t& state = x[number->state];
    const RansToken t = number->width != 0 ? RansToken{0, number->width, number->z} : rans_token(number->z);
    if (t.n_bits != 0) {
      make_room(state, std::uint64_t{1} << (32 - t.n_bits));
      state = state << t.n_bits | t.bits;
    }
    if (number->width != 0) continue;
    const std::size_t entry = number->distribution * std::size_t{kRansTokens} + t.token;
    const std::uint32_t frequency = frequencies_[entry];
    assert(frequency != 0);
    make_room(state, std::uint64_t{frequency} << 20);
    state = (state / frequency << 12) + state % frequency + starts_[entry];
  }
  numbers_.clear();
  std::ranges::reverse(words);
  std::vector<std::byte> out(sizeof x + 2 * words.size());
  std::memcpy(out.data(), x.data(), sizeof x);
  if (!words.empty()) std::memcpy(out.data() + sizeof x, words.data(), 2 * words.size());
  return out;
}

}  // namespace rgs::detail
