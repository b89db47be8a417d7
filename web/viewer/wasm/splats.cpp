// splats.cpp - PLY and SPZ as what rgs-render draws of them, for JavaScript; src/splats.ts calls it. An instance reads one file.
// SPDX-License-Identifier: Apache-2.0
//
// A function that fails returns -1; rgs_error() then gives the error. Further results are in rgs_numbers(), as FP64.

#include <algorithm>
#include <array>
#include <cstdint>
#include <new>
#include <optional>
#include <string>
#include <vector>

#include "rgs/activate.hpp"
#include "rgs/ply.hpp"
#include "rgs/splat_edit.hpp"
#include "spz_codes.hpp"

#define RGS_EXPORT(name) extern "C" [[clang::export_name(#name)]]
#define RGS_IMPORT(name) extern "C" [[clang::import_module("rgs"), clang::import_name(#name)]]

RGS_IMPORT(out_of_memory) [[noreturn]] void rgs_out_of_memory();

namespace {

using namespace rgs;

std::vector<std::byte> bytes;  // of a PLY, or the streams of an SPZ
std::optional<PlyFile> ply;
detail::SpzHeader spz;
Axes axes, wanted;
Error last_error;
std::string text;
std::vector<double> numbers;
std::vector<float> floats;

Axes axes_of(int x, int y, int z) {
  return {static_cast<Axis>(x), static_cast<Axis>(y), static_cast<Axis>(z)};
}

SplatCloud ply_rows(std::uint32_t first, std::uint32_t n) {
  std::vector<Splat> rows(n);
  ply->read(first, rows);
  SplatCloud cloud;
  cloud.resize(n, ply->sh_degree());
  for (std::uint32_t i = 0; i < n; ++i) cloud.set(i, rows[i]);
  return cloud;
}

SplatCloud spz_rows(std::uint32_t first, std::uint32_t n) {
  detail::SpzHeader before = spz, own = spz;
  before.n = first, own.n = n;
  detail::SpzStreams streams;
  std::uint64_t begin = 0;
  for (std::size_t i = 0; i < streams.size(); begin += spz.sizes()[i++])
    streams[i] = std::span(bytes).subspan(begin + before.sizes()[i], own.sizes()[i]);
  return decode_spz_streams(own, streams);
}

}  // namespace

RGS_EXPORT(rgs_start) void rgs_start() {
  std::set_new_handler([] { rgs_out_of_memory(); });
}

/// Where to write the next bytes of the file. `expected`: of all of it, or 0.
RGS_EXPORT(rgs_append) std::byte* rgs_append(std::uint32_t n, std::uint32_t expected) {
  bytes.reserve(expected);
  const std::size_t at = bytes.size();
  bytes.resize(at + n);
  return bytes.data() + at;
}

/// Code and text on a line each in rgs_text(); its offset in rgs_numbers(), -1: none.
RGS_EXPORT(rgs_error) void rgs_error() {
  text = std::string(errc_name(last_error.code)) + "\n" + last_error.what;
  numbers = {last_error.offset == Error::kNone ? -1 : static_cast<double>(last_error.offset)};
}
RGS_EXPORT(rgs_numbers) const double* rgs_numbers() {
  return numbers.data();
}
RGS_EXPORT(rgs_text) const char* rgs_text() {
  return text.data();
}
RGS_EXPORT(rgs_n_text) std::uint32_t rgs_n_text() {
  return text.size();
}

/// The bytes are a PLY, to be turned to these axes. Number of Gaussians, SH degree, origin, mode of anti-aliasing and low-pass.
RGS_EXPORT(rgs_open_ply) int rgs_open_ply(int x, int y, int z) {
  auto opened = PlyFile::open(std::span<const std::byte>(bytes));
  if (!opened) {
    last_error = opened.error();
    return -1;
  }
  ply = *std::move(opened);
  const Declarations& d = ply->declarations();
  axes = d.axes, wanted = axes_of(x, y, z);
  Origin origin = ply->origin();
  convert_axes(origin, axes, wanted);
  numbers = {static_cast<double>(ply->size()), static_cast<double>(ply->sh_degree()), origin[0], origin[1], origin[2],
             static_cast<double>(d.aa_mode),   static_cast<double>(d.low_pass_px2)};
  return 0;
}

/// The bytes are the streams of an SPZ in axes a, b, c, to be turned to x, y, z.
RGS_EXPORT(rgs_open_spz)
void rgs_open_spz(std::uint32_t version, std::uint32_t n, int sh_degree, int fractional_bits, int a, int b, int c,
                  int x, int y, int z) {
  spz = {version, n, static_cast<std::uint8_t>(sh_degree), static_cast<std::uint8_t>(fractional_bits), 0};
  axes = axes_of(a, b, c), wanted = axes_of(x, y, z);
}

/// Gaussians first .. first + n - 1, activated, without those that cannot be drawn; their number is in rgs_numbers(). Means,
/// rotations, scales, opacities, SH of degree 0, and those above, one after the other.
RGS_EXPORT(rgs_read) const float* rgs_read(std::uint32_t first, std::uint32_t n) {
  SplatCloud cloud = ply ? ply_rows(first, n) : spz_rows(first, n);
  convert_axes(cloud, axes, wanted);
  const auto sh_floats = static_cast<std::uint64_t>(3 * sh_coefficients(cloud.sh_degree));
  std::uint32_t kept = 0;
  for (std::uint32_t i = 0; i < n; ++i) {
    if (!detail::is_drawable(cloud.view(), i, sh_floats)) continue;
    if (i != kept) cloud.set(kept, cloud.view().splat(i));
    detail::activate(cloud, kept++);
  }
  cloud.resize(kept, cloud.sh_degree);
  floats.clear();
  floats.reserve(kept * (11 + sh_floats));
  for (const auto* values : {&cloud.mean, &cloud.rotation, &cloud.log_scale, &cloud.opacity_logit})
    floats.insert(floats.end(), values->begin(), values->end());
  for (auto sh = cloud.sh.begin(); sh != cloud.sh.end(); sh += static_cast<std::ptrdiff_t>(sh_floats))
    floats.insert(floats.end(), sh, sh + 3);
  for (auto sh = cloud.sh.begin(); sh != cloud.sh.end(); sh += static_cast<std::ptrdiff_t>(sh_floats))
    floats.insert(floats.end(), sh + 3, sh + static_cast<std::ptrdiff_t>(sh_floats));
  numbers = {static_cast<double>(kept)};
  return floats.data();
}
