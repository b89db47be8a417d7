// each_gaussian.hpp - all Gaussians of a file without levels of detail, a part of it being decoded at a time.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <span>

#include "rgs/decode.hpp"

namespace rgs {

/// Calls f(ActivatedSplat) in order. Errors: those of read_chunks() and of what it gives.
template <class F>
Status each_gaussian(const FileView& file, const F& f) {
  constexpr std::uint64_t kDecodedAtOnce = std::uint64_t{1} << 18;
  const std::uint64_t n_chunks = file.header().n_chunks;
  const std::uint64_t at_once = std::max<std::uint64_t>(1, kDecodedAtOnce / file.header().chunk_size);
  std::array<ActivatedSplat, 64> buffer;
  for (std::uint64_t chunk = 0; chunk < n_chunks; chunk += at_once) {
    const auto data = read_chunks(file, chunk, std::min(at_once, n_chunks - chunk), {.validate = false});
    if (!data) return tl::unexpected(data.error());
    for (std::uint64_t i = 0; i < data->size(); i += buffer.size()) {
      const auto part = std::span(buffer).first(std::min<std::uint64_t>(buffer.size(), data->size() - i));
      if (const Status s = data->read(data->first() + i, part); !s) return s;
      for (const ActivatedSplat& splat : part) f(splat);
    }
  }
  return {};
}

}  // namespace rgs
