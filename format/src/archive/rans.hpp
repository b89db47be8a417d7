// rans.hpp - entropy coder of Codec::archive: eight interleaved rANS states over one stream; docs/format/ARCHIVE.md "Streams".
//
// Range asymmetric numeral systems (Duda 2013) with 12-bit frequencies, 32-bit states and 16-bit words, interleaved as
// in Giesen 2014: consecutive numbers use different states, so that the processor works on several at once.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <span>
#include <type_traits>
#include <vector>

#include "rgs/archive_rules.hpp"

namespace rgs::detail {

/// A number as a token and raw bits.
struct RansToken {
  std::uint32_t token, n_bits, bits;
};
/// A token each below 32, then four an octave. z < 2^16.
constexpr RansToken rans_token(std::uint32_t z) {
  if (z < 32) return {z, 0, 0};
  const auto n_bits = static_cast<std::uint32_t>(std::bit_width(z)) - 3;
  return {32 + (n_bits - 3) * 4 + (z >> n_bits) - 4, n_bits, z & ((1u << n_bits) - 1)};
}

/// Signed codes to numbers: the inverse of unfold_code().
constexpr std::uint32_t fold_code(std::int16_t code) {
  return static_cast<std::uint16_t>(static_cast<std::uint16_t>(code << 1) ^ static_cast<std::uint16_t>(code >> 15));
}

/// Distributions prepared for decoding: 4.3 KiB each, so that those of a plane stay in the first-level cache.
class RansTables {
 public:
  /// frequencies [n, kRansTokens]; false if a row does not sum to kRansTotal.
  bool assign(std::span<const std::uint16_t> frequencies);
  std::uint64_t memory_bytes() const { return distributions_.capacity() * sizeof(Distribution); }
  struct Distribution {
    std::array<std::uint8_t, kRansTotal> token;          ///< of each slot
    std::array<std::uint32_t, kRansTokens> frequency{};  ///< of each token, and from bit 16 on the sum before it
  };
  const Distribution& of(std::uint8_t distribution) const { return distributions_[distribution]; }
  std::span<const Distribution> all() const { return distributions_; }

 private:
  std::vector<Distribution> distributions_;
};

/// Decodes planes of one stream. Counts every word: reading past the end gives zeros and ok() false.
class RansReader {
 public:
  RansReader(const RansTables& tables, std::span<const std::uint8_t> map) : distributions_(&tables.of(0)), map_(map) {}
  /// False if the stream is shorter than its states or has half a word.
  bool begin(std::span<const std::byte> stream);

  /// Reads values[i] for i < n. Contexts of bytes may use those before, others may not: many are found at once. Unsigned
  /// numbers above `limit` become 0 and ok() false.
  template <class T, class Context>
  void plane(std::size_t n, T* values, std::uint32_t limit, Context context) {
    constexpr std::size_t kAtOnce = sizeof(T) == 1 ? 1 : 512;
    std::array<std::uint16_t, kAtOnce> contexts;
    for (std::size_t first = 0; first < n; first += kAtOnce) {
      const std::size_t count = std::min(kAtOnce, n - first);
      for (std::size_t i = 0; i < count; ++i) contexts[i] = static_cast<std::uint16_t>(context(first + i));
      read(first, count, contexts.data(), values + first, limit);
    }
  }

  /// Reads values[i] of widths[i] bits each, at most 12.
  void bits(std::size_t n, std::uint16_t* values, const std::uint8_t* widths);
  static constexpr bool kReads = true;

  bool ok() const { return !bad_; }
  /// All words were read and the states are the encoder's initial ones.
  bool finished() const;

 private:
  // Numbers first to first + n - 1 of a plane replace their contexts; several only from multiples of kRansStates on.
  void numbers(std::size_t first, std::size_t n, std::uint16_t* contexts);
  template <class T>
  void read(std::size_t first, std::size_t n, std::uint16_t* contexts, T* values, std::uint32_t limit);
  template <bool kAmple>
  std::uint32_t next(std::uint32_t& x, std::size_t context);
  template <bool kAmple>
  void refill(std::uint32_t& x);

  const RansTables::Distribution* distributions_;
  std::span<const std::uint8_t> map_;
  std::array<std::uint32_t, kRansStates> states_{};
  const std::byte *at_ = nullptr, *end_ = nullptr;
  bool bad_ = false;
};

/// A plane's number type for the coder.
template <class T>
std::uint32_t rans_number(T value) {
  if constexpr (std::is_signed_v<T>) {
    return fold_code(value);
  } else {
    return value;
  }
}

/// Counts tokens by context: [n_contexts, kRansTokens].
class RansCounter {
 public:
  explicit RansCounter(std::size_t n_contexts) : counts_(n_contexts * kRansTokens) {}
  template <class T, class Context>
  void plane(std::size_t n, T* values, std::uint32_t, Context context) {
    for (std::size_t i = 0; i < n; ++i) ++counts_[context(i) * kRansTokens + rans_token(rans_number(values[i])).token];
  }
  void bits(std::size_t, const std::uint16_t*, const std::uint8_t*) {}
  static constexpr bool kReads = false;
  std::vector<std::uint32_t>& counts() { return counts_; }

 private:
  std::vector<std::uint32_t> counts_;
};

/// Encodes planes, given in decoding order. frequencies [n, kRansTokens].
class RansWriter {
 public:
  RansWriter(std::span<const std::uint16_t> frequencies, std::span<const std::uint8_t> map);
  template <class T, class Context>
  void plane(std::size_t n, T* values, std::uint32_t, Context context) {
    for (std::size_t i = 0; i < n; ++i) {
      numbers_.push_back({static_cast<std::uint16_t>(rans_number(values[i])), map_[context(i)],
                          static_cast<std::uint8_t>(i % kRansStates), 0});
    }
  }
  void bits(std::size_t n, const std::uint16_t* values, const std::uint8_t* widths) {
    for (std::size_t i = 0; i < n; ++i) {
      if (widths[i] != 0) numbers_.push_back({values[i], 0, static_cast<std::uint8_t>(i % kRansStates), widths[i]});
    }
  }
  static constexpr bool kReads = false;
  /// Returns the stream and empties the writer.
  std::vector<std::byte> finish();

 private:
  struct Number {
    std::uint16_t z;
    std::uint8_t distribution, state, width;  // width: of raw bits, which have no distribution
  };
  std::span<const std::uint16_t> frequencies_;
  std::span<const std::uint8_t> map_;
  std::vector<std::uint16_t> starts_;  // [n, kRansTokens]: sum of earlier frequencies
  std::vector<Number> numbers_;
};

}  // namespace rgs::detail
