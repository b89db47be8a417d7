// ply_samples.hpp - seeded Gaussians and hand-built PLY files for the PLY tests.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>
#include <cstring>
#include <memory>
#include <random>
#include <span>
#include <string>
#include <vector>

#include "rgs/ply.hpp"

namespace rgs::test {

/// Finite values of any magnitude, drawn as bits; sh above the degree is 0.
inline std::vector<Splat> random_splats(std::size_t n, int sh_degree, std::uint32_t seed) {
  std::mt19937 random(seed);
  const auto fill = [&random](float* values, int count) {
    for (int i = 0; i < count; ++i)
      values[i] = std::bit_cast<float>(static_cast<std::uint32_t>(random()) & 0xbfffffffU);
  };
  std::vector<Splat> splats(n);
  for (Splat& s : splats) {
    fill(s.mean, 3);
    fill(s.log_scale, 3);
    fill(s.rotation, 4);
    fill(&s.opacity_logit, 1);
    fill(s.sh, 3 * sh_coefficients(sh_degree));
  }
  return splats;
}

/// The file that PlyWriter makes of the splats.
inline std::string binary_ply(std::span<const Splat> splats, int sh_degree) {
  std::string file = ply_header(splats.size(), sh_degree);
  std::vector<std::byte> rows(splats.size() * ply_row_bytes(sh_degree));
  encode_ply_rows(splats, sh_degree, rows);
  return file.append(reinterpret_cast<const char*>(rows.data()), rows.size());
}

inline bool same_bits(std::span<const Splat> a, std::span<const Splat> b) {
  return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size_bytes()) == 0);
}

inline std::vector<Splat> read_all(const PlyFile& ply) {
  std::vector<Splat> splats(ply.size());
  ply.read(0, splats);
  return splats;
}

/// A heap copy of the exact size, so that AddressSanitizer detects any overread.
class ExactCopy {
 public:
  explicit ExactCopy(std::string_view text) : bytes_(new std::byte[text.size()]), size_(text.size()) {
    if (size_ != 0) std::memcpy(bytes_.get(), text.data(), size_);
  }
  std::span<const std::byte> bytes() const { return {bytes_.get(), size_}; }

 private:
  std::unique_ptr<std::byte[]> bytes_;
  std::size_t size_;
};

inline Result<PlyFile> open_text(const std::string& text) {
  return PlyFile::open(std::as_bytes(std::span(text)));
}

/// Names of the 14 + f_rest properties in the order of the original code, without normals.
inline std::vector<std::string> splat_properties(int f_rest) {
  std::vector<std::string> names{"x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"};
  for (int i = 0; i < f_rest; ++i) names.push_back("f_rest_" + std::to_string(i));
  for (const char* name : {"opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"}) {
    names.emplace_back(name);
  }
  return names;
}

/// A header of one vertex element with the given properties, all of one type.
inline std::string header_of(const std::vector<std::string>& names, const std::string& count = "1",
                             const std::string& encoding = "binary_little_endian", const std::string& type = "float") {
  std::string header = "ply\nformat " + encoding + " 1.0\nelement vertex " + count + "\n";
  for (const std::string& name : names) header += "property " + type + " " + name + "\n";
  return header + "end_header\n";
}

/// Appends a value's bytes in either byte order.
template <class T>
void append_value(std::string& out, T value, bool big_endian) {
  char raw[sizeof(T)];
  std::memcpy(raw, &value, sizeof(T));
  if (big_endian) std::reverse(raw, raw + sizeof(T));
  out.append(raw, sizeof(T));
}

}  // namespace rgs::test
