// point_decode.cpp - decodes Draco's kd-tree (Devillers and Gandoin 2000) by docs/format/ARCHIVE.md "Tree".
//
// Not by Draco's library: this needs no exceptions and no memory, trusts nothing in the stream, and runs where the
// library does not.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <bit>
#include <cassert>
#include <cstring>

#include "archive/point_codec.hpp"
#include "file/byte_reader.hpp"

namespace rgs::detail {
namespace {

// What Draco 1.5 writes around the number of points.
constexpr unsigned char kHead[11] = {'D', 'R', 'A', 'C', 'O', 2, 3, 0, 1, 0, 0};
constexpr unsigned char kAttribute[8] = {1, 1, 0, 6, 3, 0, 0, 6};
constexpr std::size_t kHeadBytes = sizeof kHead + 4 + sizeof kAttribute + 8;

bool has(std::span<const std::byte> stream, std::size_t at, std::span<const unsigned char> bytes) {
  return std::memcmp(stream.data() + at, bytes.data(), bytes.size()) == 0;
}

// Seven bits a byte, lowest first, in at most five bytes; if there are more, a number beyond any stream's.
std::uint64_t varint(ByteReader& in) {
  std::uint64_t value = 0;
  for (unsigned shift = 0; shift < 35; shift += 7) {
    const std::uint64_t next = in.u8();
    value |= (next & 127u) << shift;
    if (next < 128) return value;
  }
  return ~std::uint64_t{0};
}

// Bits of one probability: a binary asymmetric numeral system, read from its end.
class CodedBits {
 public:
  bool begin(ByteReader& in) {
    one_ = (256u - in.u8()) & 255u;
    const auto bytes = in.bytes(varint(in));
    if (bytes.empty()) return false;
    const std::size_t size = (std::to_integer<std::size_t>(bytes.back()) >> 6) + 1;
    if (size > 3 || size > bytes.size()) return false;
    state_ = 0;
    for (std::size_t i = 0; i < size; ++i) {
      state_ |= std::to_integer<std::uint32_t>(bytes[bytes.size() - size + i]) << (8 * i);
    }
    state_ = (state_ & ((1u << (8 * size - 2)) - 1)) + kLow;
    left_ = bytes.first(bytes.size() - size);
    return state_ < kLow * 256;
  }
  std::uint32_t bit() {
    if (state_ < kLow && !left_.empty()) {
      state_ = state_ << 8 | std::to_integer<std::uint32_t>(left_.back());
      left_ = left_.first(left_.size() - 1);
    }
    const std::uint32_t slot = state_ & 255u, ones = (state_ >> 8) * one_;
    const bool one = slot < one_;
    state_ = one ? ones + slot : state_ - ones - one_;
    return one ? 1 : 0;
  }

 private:
  static constexpr std::uint32_t kLow = 4096;
  std::span<const std::byte> left_;
  std::uint32_t one_ = 0, state_ = 0;
};

// Bits in 32-bit words, highest first.
class PlainBits {
 public:
  bool begin(ByteReader& in) {
    words_ = in.bytes(in.u32());
    n_bits_ = std::uint64_t{8} * words_.size();
    return !words_.empty() && words_.size() % 4 == 0;
  }
  /// At most 32; past the end zeros and ok() false.
  std::uint32_t take(std::uint32_t count) {
    if (count > n_bits_ - at_) ok_ = false;
    if (count == 0 || !ok_) return 0;
    const std::size_t first = static_cast<std::size_t>(at_ / 32) * 4;
    const std::uint64_t second = first + 4 < words_.size() ? word(first + 4) : 0;
    const std::uint64_t bits = (std::uint64_t{word(first)} << 32 | second) << (at_ % 32);
    at_ += count;
    return static_cast<std::uint32_t>(bits >> (64 - count));
  }
  bool ok() const { return ok_; }

 private:
  std::uint32_t word(std::size_t place) const {
    std::uint32_t value;
    std::memcpy(&value, words_.data() + place, sizeof value);
    return value;
  }
  std::span<const std::byte> words_;
  std::uint64_t at_ = 0, n_bits_ = 0;
  bool ok_ = true;
};

struct Cell {
  std::uint32_t n = 0;                   // points
  GridPoint corner{};                    // lowest
  std::array<std::uint32_t, 3> level{};  // halvings of each axis
};

class Tree {
 public:
  bool begin(std::span<const std::byte> stream) {
    ByteReader in(stream);
    for (CodedBits& bits : numbers_) {
      if (!bits.begin(in)) return false;
    }
    for (PlainBits* bits : {&remaining_, &axes_, &halves_}) {
      if (!bits->begin(in)) return false;
    }
    return in.remaining() == 0;
  }

  bool points(std::uint32_t bits, std::span<GridPoint> points) {
    constexpr std::uint32_t kMaxBits = 32;
    std::array<Cell, 3 * kMaxBits + 2> stack;  // each halving adds one cell, and at most 3 * bits of them nest
    std::size_t n_cells = 1;
    stack[0] = {static_cast<std::uint32_t>(points.size()), {}, {}};
    GridPoint* out = points.data();
    while (n_cells > 0) {
      Cell cell = stack[--n_cells];
      const std::size_t axis = next_axis(cell);
      if (axis > 2) return false;
      std::uint32_t& level = cell.level[axis];
      if (level == bits) {
        out = std::fill_n(out, cell.n, cell.corner);
      } else if (cell.n <= 2) {
        for (std::uint32_t i = 0; i < cell.n; ++i) *out++ = last_bits(cell, axis, bits);
      } else {
        const std::uint32_t less = number(static_cast<std::uint32_t>(std::bit_width(cell.n)) - 1);
        if (less > cell.n / 2) return false;
        std::uint32_t low = cell.n / 2 - less, high = cell.n - low;
        if (low != high && halves_.take(1) == 0) std::swap(low, high);
        ++level;
        if (low != 0) stack[n_cells++] = {low, cell.corner, cell.level};
        cell.corner[axis] += 1u << (bits - level);
        if (high != 0) stack[n_cells++] = {high, cell.corner, cell.level};
      }
      if (!remaining_.ok() || !axes_.ok() || !halves_.ok()) return false;
    }
    return true;
  }

 private:
  std::size_t next_axis(const Cell& cell) {
    if (cell.n >= 64) return axes_.take(4);
    return static_cast<std::size_t>(std::ranges::min_element(cell.level) - cell.level.begin());
  }
  GridPoint last_bits(const Cell& cell, std::size_t axis, std::uint32_t bits) {
    GridPoint point = cell.corner;
    for (std::size_t i = 0; i < 3; ++i, axis = (axis + 1) % 3) point[axis] += remaining_.take(bits - cell.level[axis]);
    return point;
  }
  std::uint32_t number(std::uint32_t digits) {
    std::uint32_t value = 0;
    for (std::uint32_t i = 0; i < digits; ++i) value = value << 1 | numbers_[i].bit();
    return value;
  }

  std::array<CodedBits, 33> numbers_;  // by digit, highest first
  PlainBits remaining_, axes_, halves_;
};

bool legal_head(std::span<const std::byte> stream, std::uint32_t n, std::uint32_t max_bits) {
  if (stream.size() < kHeadBytes || !has(stream, 0, kHead) || !has(stream, 15, kAttribute)) return false;
  ByteReader counts(stream.subspan(11)), tree(stream.subspan(23));
  return counts.u32() == n && tree.u32() <= max_bits && tree.u32() == n;
}

}  // namespace

Status decode_points(std::span<const std::byte> stream, std::uint64_t offset, std::uint32_t max_bits,
                     std::span<GridPoint> points) {
  assert(max_bits <= 32);
  if (!legal_head(stream, static_cast<std::uint32_t>(points.size()), max_bits)) {
    return make_error(Errc::corrupt_data, offset,
                      "a frame of means is not the Draco stream that the format prescribes");
  }
  Tree tree;
  const std::uint32_t bits = ByteReader(stream.subspan(23)).u32();
  if (!tree.begin(stream.subspan(kHeadBytes)) || !tree.points(bits, points)) {
    return make_error(Errc::corrupt_data, offset, "the tree of a frame of means does not decode");
  }
  return {};
}

}  // namespace rgs::detail
