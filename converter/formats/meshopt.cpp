// meshopt.cpp - decodes attribute streams after KHR_meshopt_compression (KhronosGroup/glTF, 17 July 2026), Appendix A,
// mode 0, and Appendix B.
//
//   version | blocks of at most 256 elements | zeros | first element's base | channel modes (version 1)
// A block has the deltas of each byte of its elements, one after the other, in groups of 16 deltas: of a fixed number of
// bits each, of which all ones says that the delta is a byte behind the group.
// SPDX-License-Identifier: Apache-2.0
#include "meshopt.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>
#include <type_traits>

#include "quantised.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kGroup = 16, kMaxBlock = 256, kMaxStride = 256;

std::uint64_t block_elements(std::uint64_t stride) {
  return std::min((8192 / stride) & ~(kGroup - 1), kMaxBlock);
}

std::uint32_t unzigzag(std::uint32_t code) {
  return (code & 1) != 0 ? ~(code >> 1) : code >> 1;
}

class AttributeDecoder {
 public:
  AttributeDecoder(std::span<const std::byte> stream, std::uint64_t stride, std::uint64_t begin)
      : stream_(stream), stride_(stride), begin_(begin) {}

  Result<std::vector<std::byte>> decode(std::uint64_t n) {
    if (stream_.empty() || (load_u8(stream_, 0) & 0xFE) != 0xA0)
      return make_error(Errc::unsupported_feature, begin_, "a meshopt stream is not of attributes, version 0 or 1");
    version_ = load_u8(stream_, 0) & 1;
    const std::uint64_t n_modes = version_ == 1 ? stride_ / 4 : 0, tail = stride_ + n_modes;
    const std::uint64_t padded = std::max<std::uint64_t>(tail, version_ == 1 ? 24 : 32);
    if (stream_.size() < 1 + padded) return truncated();
    end_ = stream_.size() - padded;
    const std::uint64_t block = block_elements(stride_), n_blocks = (n + block - 1) / block;
    // A block has two bits for each group of a byte, in version 1 for each byte.
    const std::uint64_t least = version_ == 1 ? n_blocks * stride_ / 4 : n / kGroup * stride_ / 4;
    if (least > end_ - 1) return truncated();
    std::copy_n(stream_.end() - static_cast<std::ptrdiff_t>(tail), stride_, last_.begin());
    for (std::uint64_t c = 0; c < n_modes; ++c) {
      modes_[c] = load_u8(stream_, stream_.size() - n_modes + c);
      if ((modes_[c] & 15) > 2 || ((modes_[c] & 15) < 2 && modes_[c] > 15)) {
        return make_error(Errc::bad_value, begin_ + stream_.size() - n_modes + c, "a meshopt channel has no such mode",
                          2, modes_[c]);
      }
    }
    std::vector<std::byte> out(n * stride_);
    for (std::uint64_t first = 0; first < n; first += block) {
      if (const Status s = decode_block(std::span(out).subspan(first * stride_), std::min(block, n - first)); !s)
        return tl::unexpected(s.error());
    }
    if (at_ != end_)
      return make_error(Errc::trailing_bytes, begin_ + at_, "a meshopt stream holds more than its elements");
    return out;
  }

 private:
  using Deltas = std::array<std::uint8_t, kMaxBlock>;

  tl::unexpected<Error> truncated() const {
    return make_error(Errc::truncated, begin_ + stream_.size(), "a meshopt stream ends early");
  }
  bool has(std::uint64_t bytes) const { return bytes <= end_ - at_; }

  Status decode_block(std::span<std::byte> out, std::uint64_t n) {
    std::array<std::uint8_t, kMaxStride / 4> controls{};
    if (version_ == 1) {
      if (!has(stride_ / 4)) return truncated();
      std::memcpy(controls.data(), &stream_[at_], stride_ / 4);
      at_ += stride_ / 4;
    }
    for (std::uint64_t c = 0; c < stride_ / 4; ++c) {
      std::array<Deltas, 4> deltas;
      for (std::uint64_t k = 0; k < 4; ++k) {
        if (const Status s = decode_deltas(controls[c] >> 2 * k & 3, n, deltas[k]); !s) return s;
      }
      add_deltas(c, deltas, n, out);
    }
    return {};
  }

  // The deltas of one byte of a block's elements.
  Status decode_deltas(int control, std::uint64_t n, Deltas& deltas) {
    static constexpr int kBits[3][4] = {{0, 1, 2, 4}, {1, 2, 4, 8}, {0, 2, 4, 8}};  // the last of version 0
    deltas.fill(0);
    if (version_ == 1 && control == 2) return {};
    if (version_ == 1 && control == 3) {
      if (!has(n)) return truncated();
      std::memcpy(deltas.data(), &stream_[at_], n);
      at_ += n;
      return {};
    }
    const auto& bits = kBits[version_ == 1 ? control : 2];
    const std::uint64_t n_groups = (n + kGroup - 1) / kGroup, head = at_, head_bytes = (n_groups + 3) / 4;
    if (!has(head_bytes)) return truncated();
    at_ += head_bytes;
    for (std::uint64_t g = 0; g < n_groups; ++g) {
      const int mode = load_u8(stream_, head + g / 4) >> 2 * (g % 4) & 3;
      if (const Status s = decode_group(bits[mode], &deltas[g * kGroup]); !s) return s;
    }
    return {};
  }

  Status decode_group(int bits, std::uint8_t* deltas) {
    if (bits == 0) return {};
    const std::uint64_t packed = at_;
    if (!has(2 * static_cast<std::uint64_t>(bits))) return truncated();
    at_ += 2 * static_cast<std::uint64_t>(bits);
    const int per_byte = 8 / bits, sentinel = (1 << bits) - 1;
    for (int i = 0; i < static_cast<int>(kGroup); ++i) {
      const int within = i % per_byte, shift = bits == 1 ? within : 8 - bits * (within + 1);  // single bits ascend
      int delta = load_u8(stream_, packed + static_cast<std::uint64_t>(i / per_byte)) >> shift & sentinel;
      if (delta == sentinel && bits < 8) {
        if (!has(1)) return truncated();
        delta = load_u8(stream_, at_++);
      }
      deltas[i] = static_cast<std::uint8_t>(delta);
    }
    return {};
  }

  // Adds the deltas of channel `c`, four bytes of an element, to the element before.
  void add_deltas(std::uint64_t c, const std::array<Deltas, 4>& deltas, std::uint64_t n, std::span<std::byte> out) {
    const std::uint8_t mode = modes_[c] & 15, rotation = modes_[c] >> 4;
    auto last = load<std::uint32_t>(last_, 4 * c);
    for (std::uint64_t i = 0; i < n; ++i) {
      std::uint32_t code = 0;
      for (std::uint64_t k = 0; k < 4; ++k) code |= static_cast<std::uint32_t>(deltas[k][i]) << 8 * k;
      if (mode == 2) {
        last ^= std::rotr(code, rotation);  // the extension's text shows the encoder's rotation, to the left
      } else {
        const std::uint32_t width = mode == 1 ? 16 : 8, mask = mode == 1 ? 0xFFFF : 0xFF;
        std::uint32_t sum = 0;
        for (std::uint32_t at = 0; at < 32; at += width)
          sum |= (((last >> at) + unzigzag(code >> at & mask)) & mask) << at;
        last = sum;
      }
      store(out, i * stride_ + 4 * c, last);
    }
    store(std::span(last_), 4 * c, last);
  }

  std::span<const std::byte> stream_;
  std::uint64_t stride_, begin_, at_ = 1, end_ = 0;
  int version_ = 0;
  std::array<std::uint8_t, kMaxStride / 4> modes_{};
  std::array<std::byte, kMaxStride> last_{};
};

// ---- filters --------------------------------------------------------------------------------------------------------

// round(value) within T; 0 for NaN, which damaged codes give.
template <class T>
T rounded(float value) {
  constexpr auto kLow = static_cast<float>(std::numeric_limits<T>::min()),
                 kHigh = static_cast<float>(std::numeric_limits<T>::max());
  return std::isnan(value) ? T{0} : static_cast<T>(std::clamp(std::round(value), kLow, kHigh));
}

template <class T>
void undo_octahedral(std::span<std::byte> element) {
  T v[4];
  std::memcpy(v, element.data(), sizeof v);
  constexpr auto kMax = static_cast<float>(std::numeric_limits<T>::max());
  const auto one = static_cast<float>(v[2]);
  float x = static_cast<float>(v[0]) / one, y = static_cast<float>(v[1]) / one;
  const float z = 1 - std::abs(x) - std::abs(y), fold = std::min(z, 0.F);
  x -= std::copysign(fold, x);
  y -= std::copysign(fold, y);
  const float factor = kMax / std::sqrt(x * x + y * y + z * z);
  v[0] = rounded<T>(x * factor);
  v[1] = rounded<T>(y * factor);
  v[2] = rounded<T>(z * factor);
  std::memcpy(element.data(), v, sizeof v);
}

void undo_quaternion(std::span<std::byte> element) {
  std::int16_t v[4], out[4];
  std::memcpy(v, element.data(), sizeof v);
  const auto unit = static_cast<float>(kRootHalf) / static_cast<float>(v[3] | 3);
  const auto largest = static_cast<unsigned>(v[3] & 3);
  float rest = 1;
  for (unsigned k = 0; k < 3; ++k) {
    const float value = static_cast<float>(v[k]) * unit;
    rest -= value * value;
    out[(largest + 1 + k) % 4] = rounded<std::int16_t>(value * 32767);
  }
  out[largest] = rounded<std::int16_t>(std::sqrt(std::max(rest, 0.F)) * 32767);
  std::memcpy(element.data(), out, sizeof out);
}

void undo_exponential(std::span<std::byte> element) {
  for (std::uint64_t at = 0; at < element.size(); at += 4) {
    const auto code = load<std::int32_t>(element, at);
    const auto mantissa = static_cast<std::int32_t>(static_cast<std::uint32_t>(code) << 8) >> 8;
    store(element, at, std::ldexp(static_cast<float>(mantissa), code >> 24));
  }
}

template <class T>
void undo_colour(std::span<std::byte> element) {
  T v[4];
  std::memcpy(v, element.data(), sizeof v);
  using Signed = std::make_signed_t<T>;
  const int largest = (1 << std::bit_width(v[3])) - 1;
  const auto with_sign = [](auto bits) { return static_cast<int>(static_cast<Signed>(bits)); };
  const int y = v[0], co = with_sign(v[1]), cg = with_sign(v[2]), alpha = v[3] & largest >> 1;
  const float factor = static_cast<float>(std::numeric_limits<T>::max()) / static_cast<float>(largest);
  const int rgba[4] = {y + co - cg, y + cg, y - co - cg, alpha << 1 | (alpha & 1)};
  for (unsigned k = 0; k < 4; ++k) v[k] = rounded<T>(static_cast<float>(rgba[k]) * factor);
  std::memcpy(element.data(), v, sizeof v);
}

void undo(MeshoptFilter filter, std::span<std::byte> element) {
  const bool bytes = element.size() == 4;
  switch (filter) {
    case MeshoptFilter::none: break;
    case MeshoptFilter::octahedral:
      bytes ? undo_octahedral<std::int8_t>(element) : undo_octahedral<std::int16_t>(element);
      break;
    case MeshoptFilter::quaternion: undo_quaternion(element); break;
    case MeshoptFilter::exponential: undo_exponential(element); break;
    case MeshoptFilter::colour: bytes ? undo_colour<std::uint8_t>(element) : undo_colour<std::uint16_t>(element); break;
  }
}

bool allows(MeshoptFilter filter, std::uint64_t stride) {
  if (stride == 0 || stride % 4 != 0 || stride > kMaxStride) return false;
  switch (filter) {
    case MeshoptFilter::octahedral:
    case MeshoptFilter::colour: return stride == 4 || stride == 8;
    case MeshoptFilter::quaternion: return stride == 8;
    default: return true;
  }
}

}  // namespace

std::optional<MeshoptFilter> meshopt_filter_of_text(std::string_view text) {
  constexpr std::array<std::string_view, 5> kNames{"NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", "COLOR"};
  const auto* found = std::ranges::find(kNames, text);
  if (found == kNames.end()) return std::nullopt;
  return static_cast<MeshoptFilter>(found - kNames.begin());
}

Result<std::vector<std::byte>> decode_meshopt(std::span<const std::byte> stream, std::uint64_t n, std::uint64_t stride,
                                              MeshoptFilter filter, std::uint64_t begin) {
  if (!allows(filter, stride))
    return make_error(Errc::bad_header, begin, "a meshopt stream has a stride that its codec or filter has not");
  auto elements = AttributeDecoder(stream, stride, begin).decode(n);
  if (!elements) return elements;
  if (filter == MeshoptFilter::none) return elements;
  for (std::uint64_t i = 0; i < n; ++i) undo(filter, std::span(*elements).subspan(i * stride, stride));
  return elements;
}

}  // namespace rgs::detail
