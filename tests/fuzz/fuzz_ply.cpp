// fuzz_ply.cpp - arbitrary bytes are an error or a scene; a scene reads the same by row and by index, and survives
// writing.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <span>
#include <string>
#include <vector>

#include "rgs/ply.hpp"

namespace {

void require(bool condition) {
  if (!condition) std::abort();
}

bool same_bits(std::span<const rgs::Splat> a, std::span<const rgs::Splat> b) {
  return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size_bytes()) == 0);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const auto ply = rgs::PlyFile::open(std::as_bytes(std::span(data, size)));
  if (!ply) {
    require(rgs::exit_code(ply.error().code) == 4 && ply.error().what[0] != '\0');
    require(ply.error().offset <= size);
    return 0;
  }
  const int degree = ply->sh_degree();
  require(degree >= 0 && degree <= rgs::kMaxShDegree && ply->bytes() == size);
  require(ply->size() <= size / 14);  // a Gaussian takes at least a byte per property

  const std::uint64_t n = std::min<std::uint64_t>(ply->size(), 256);
  const std::uint64_t first = ply->size() - n;  // ends at the last row
  std::vector<rgs::Splat> read(n), gathered(n), again(n);
  std::vector<std::uint32_t> indices(n);
  for (std::uint64_t i = 0; i < n; ++i) indices[i] = static_cast<std::uint32_t>(first + i);
  ply->read(first, read);
  ply->gather(indices, gathered);
  require(same_bits(read, gathered));

  rgs::Declarations one = ply->declarations();
  one.origin = rgs::kNoOrigin;  // rows are written as read
  const std::string header = rgs::ply_header(n, degree, one);
  std::vector<std::byte> file(header.size() + n * rgs::ply_row_bytes(degree));
  std::memcpy(file.data(), header.data(), header.size());
  rgs::encode_ply_rows(read, degree, std::span(file).subspan(header.size()));
  const auto reopened = rgs::PlyFile::open(file);
  require(reopened && reopened->size() == n && reopened->sh_degree() == degree);
  reopened->read(0, again);
  require(same_bits(read, again));
  const rgs::Declarations& two = reopened->declarations();
  require(one.axes == two.axes && one.colour_space == two.colour_space && one.aa_mode == two.aa_mode &&
          one.low_pass_px2 == two.low_pass_px2 && one.metres_per_unit == two.metres_per_unit);
  return 0;
}
