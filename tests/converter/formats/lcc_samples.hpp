// lcc_samples.hpp - a folder in the published layout of LCC.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>
#include <map>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "interchange_samples.hpp"

namespace rgs::test {

using Files = std::map<std::string, Bytes>;

inline constexpr double kSmallest = 1e-5, kLargest[3] = {3, 4, 5};             // scales
inline constexpr double kLow[3] = {-1, -1.5, -2}, kHigh[3] = {1.25, 1.75, 2};  // harmonics
inline constexpr std::uint64_t kLevels = 3, kCell = 4 + 16 * kLevels;

inline std::uint32_t code_of(double value, double low, double high, std::uint32_t max_code) {
  return static_cast<std::uint32_t>(std::lround((value - low) / (high - low) * max_code));
}

template <class T>
void add(Bytes& bytes, T value) {
  const auto raw = std::as_bytes(std::span(&value, 1));
  bytes.insert(bytes.end(), raw.begin(), raw.end());
}

inline void add_record(const Splat& s, Bytes& data, Bytes& harmonics) {
  for (const float x : s.mean) add(data, x);
  for (int k = 0; k < 3; ++k) {
    add(data, static_cast<std::uint8_t>(code_of(0.5 + 0.28209479 * static_cast<double>(s.sh[k]), 0, 1, 255)));
  }
  add(data, static_cast<std::uint8_t>(code_of(static_cast<double>(opacity_from_logit(s.opacity_logit)), 0, 1, 255)));
  for (int k = 0; k < 3; ++k) {
    const double scale = std::exp(static_cast<double>(s.log_scale[k]));
    add(data, static_cast<std::uint16_t>(code_of(scale, kSmallest, kLargest[k], 65535)));
  }
  const float xyzw[4] = {s.rotation[1], s.rotation[2], s.rotation[3], s.rotation[0]};
  std::uint32_t largest = 0, rotation = 0;
  for (std::uint32_t k = 1; k < 4; ++k) largest = std::abs(xyzw[k]) > std::abs(xyzw[largest]) ? k : largest;
  for (std::uint32_t k = 0, at = 0; k < 4; ++k) {
    if (k == largest) continue;
    const double part = static_cast<double>(xyzw[largest] < 0 ? -xyzw[k] : xyzw[k]);
    rotation |= code_of(part, -std::sqrt(0.5), std::sqrt(0.5), 1023) << at;
    at += 10;
  }
  add(data, rotation | largest << 30);
  for (int k = 0; k < 3; ++k) add(data, std::uint16_t{7});  // normal
  for (int i = 1; i < 16; ++i) {
    const auto code = [&](int c, std::uint32_t most) {
      return code_of(static_cast<double>(s.sh[3 * i + c]), kLow[c], kHigh[c], most);
    };
    add(harmonics, code(0, 2047) | code(1, 1023) << 11 | code(2, 2047) << 21);
  }
  add(harmonics, 0xFFFFFFFFU);  // unused
}

inline nlohmann::json attribute(const char* name, const double (&low)[3], const double (&high)[3]) {
  return {{"name", name}, {"min", low}, {"max", high}};
}

// `cells`: Gaussians of each cell's finest level; two coarser levels lie between them.
inline Files lcc(const std::vector<SplatCloud>& cells) {
  Files files;
  Bytes &index = files["index.bin"], &data = files["data.bin"], &harmonics = files["shcoef.bin"];
  std::uint64_t n = 0;
  for (const SplatCloud& cell : cells) {
    add(index, static_cast<std::uint16_t>(7 * n));
    add(index, std::uint16_t{3});
    for (std::uint64_t level = 0; level < kLevels; ++level) {
      const std::uint64_t n_here = level == 0 ? cell.size() : cell.size() / 4, offset = data.size();
      for (std::uint64_t i = 0; i < n_here; ++i) {
        Splat splat = cell.view().splat(i);
        if (level > 0) splat.mean[0] += 100;
        add_record(splat, data, harmonics);
      }
      add(index, static_cast<std::uint32_t>(n_here));
      add(index, offset);
      add(index, static_cast<std::uint32_t>(data.size() - offset));
    }
    n += cell.size();
  }
  const double smallest[3] = {kSmallest, kSmallest, kSmallest};
  const nlohmann::json meta = {
      {"version", "5.0"},
      {"totalLevel", kLevels},
      {"cellLengthX", 30},
      {"splats", {n, 3, 3}},
      {"encoding", "COMPRESS"},
      {"fileType", "Quality"},
      {"attributes", {attribute("shcoef", kLow, kHigh), attribute("scale", smallest, kLargest)}}};
  files["a.lcc"] = bytes_of(meta.dump());
  return files;
}

}  // namespace rgs::test
