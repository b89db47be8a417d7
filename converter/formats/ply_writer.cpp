// ply_writer.cpp - 3DGS PLY files as the original training code writes them.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cassert>
#include <cstring>
#include <limits>
#include <type_traits>
#include <utility>
#include <vector>

#include "rgs/guard_memory.hpp"
#include "rgs/ply.hpp"
#include "stated_scene.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t row_floats(int sh_degree) {
  return static_cast<std::uint64_t>(14 + 3 * sh_coefficients(sh_degree));
}

bool has_origin(const Origin& origin) {
  return origin != kNoOrigin;
}

template <int kCoefficients>
void encode_rows(std::span<const Splat> splats, std::byte* out, const Origin& origin) {
  constexpr std::size_t kPerChannel = kCoefficients - 1;
  constexpr std::size_t kFloats = 14 + 3 * kCoefficients;
  for (const Splat& splat : splats) {
    float row[kFloats];
    float* at = std::copy_n(splat.mean, 3, row);
    at = std::fill_n(at, 3, 0.0F);  // normals: viewers expect the properties but ignore the values
    at = std::copy_n(splat.sh, 3, at);
    for (std::size_t c = 0; c < 3; ++c) {
      for (std::size_t k = 1; k <= kPerChannel; ++k) *at++ = splat.sh[3 * k + c];
    }
    *at++ = splat.opacity_logit;
    at = std::copy_n(splat.log_scale, 3, at);
    std::copy_n(splat.rotation, 4, at);
    const float* from = row;
    if (has_origin(origin)) {
      double mean[3];
      for (std::size_t k = 0; k < 3; ++k)
        mean[k] = origin[k] + static_cast<double>(splat.mean[k]) + static_cast<double>(splat.mean_rest[k]);
      std::memcpy(out, mean, sizeof(mean));
      out += sizeof(mean);
      from += 3;
    }
    const auto bytes = static_cast<std::size_t>(row + kFloats - from) * sizeof(float);
    std::memcpy(out, from, bytes);
    out += bytes;
  }
}

}  // namespace

std::string ply_header(std::uint64_t n, int sh_degree, const Declarations& stated) {
  assert(sh_degree >= 0 && sh_degree <= kMaxShDegree);
  std::string header = "ply\nformat binary_little_endian 1.0\n" + detail::comment_lines(detail::stated_scene(stated)) +
                       "element vertex " + std::to_string(n) + "\n";
  const auto add = [&header](const std::string& name) { header += "property float " + name + "\n"; };
  const auto add_numbered = [&add](const std::string& name, int count) {
    for (int i = 0; i < count; ++i) add(name + std::to_string(i));
  };
  const std::string type = has_origin(stated.origin) ? "double " : "float ";
  for (const char* name : {"x", "y", "z"}) header += "property " + type + name + "\n";
  for (const char* name : {"nx", "ny", "nz"}) add(name);
  add_numbered("f_dc_", 3);
  add_numbered("f_rest_", 3 * (sh_coefficients(sh_degree) - 1));
  add("opacity");
  add_numbered("scale_", 3);
  add_numbered("rot_", 4);
  return header + "end_header\n";
}

std::uint64_t ply_row_bytes(int sh_degree, const Origin& origin) {
  return sizeof(float) * row_floats(sh_degree) + (has_origin(origin) ? 3 * (sizeof(double) - sizeof(float)) : 0);
}

void encode_ply_rows(std::span<const Splat> splats, int sh_degree, std::span<std::byte> out, const Origin& origin) {
  assert(out.size() == splats.size() * ply_row_bytes(sh_degree, origin));
  switch (sh_degree) {
    case 0: return encode_rows<1>(splats, out.data(), origin);
    case 1: return encode_rows<4>(splats, out.data(), origin);
    case 2: return encode_rows<9>(splats, out.data(), origin);
    case 3: return encode_rows<16>(splats, out.data(), origin);
    default: assert(false);
  }
}

Result<PlyWriter> PlyWriter::create(const std::string& path, std::uint64_t n, int sh_degree,
                                    const AtomicFile::Options& options, const Declarations& stated) {
  return detail::guard_memory([&]() -> Result<PlyWriter> {
    if (sh_degree < 0 || sh_degree > kMaxShDegree) {
      return make_error(Errc::bad_argument, Error::kNone, "the SH degree is not 0 to 3");
    }
    const std::string header = ply_header(n, sh_degree, stated);
    const std::uint64_t row_bytes = ply_row_bytes(sh_degree, stated.origin);
    constexpr auto kMaxFile = static_cast<std::uint64_t>(std::numeric_limits<std::int64_t>::max());
    if (n > (kMaxFile - header.size()) / row_bytes) {
      return make_error(Errc::bad_argument, Error::kNone, "too many Gaussians for one file", Error::kNone, n);
    }
    auto file = AtomicFile::create(path, options);
    if (!file) return tl::unexpected(file.error());
    PlyWriter writer;
    writer.file_ = std::move(*file);
    writer.n_ = n;
    writer.header_bytes_ = header.size();
    writer.sh_degree_ = sh_degree;
    writer.origin_ = stated.origin;
    if (auto ok = writer.file_.reserve(header.size() + n * row_bytes); !ok) {
      return tl::unexpected(ok.error());
    }
    if (auto ok = writer.file_.write_at(0, std::as_bytes(std::span(header))); !ok) return tl::unexpected(ok.error());
    return writer;
  });
}

Status PlyWriter::write(std::uint64_t first, std::span<const Splat> splats) {
  return detail::guard_memory([&]() -> Status {
    assert(first <= n_ && splats.size() <= n_ - first);
    constexpr std::size_t kBatch = 1024;  // 248 KiB at degree 3: encoded and copied to the kernel within L2
    const std::uint64_t row = ply_row_bytes(sh_degree_, origin_);
    std::vector<std::byte> buffer(std::min(splats.size(), kBatch) * row);
    while (!splats.empty()) {
      const auto part = splats.first(std::min(splats.size(), kBatch));
      const auto bytes = std::span(buffer).first(part.size() * row);
      encode_ply_rows(part, sh_degree_, bytes, origin_);
      if (auto ok = file_.write_at(header_bytes_ + first * row, bytes); !ok) return ok;
      splats = splats.subspan(part.size());
      first += part.size();
    }
    return {};
  });
}

Result<double> PlyWriter::commit() {
  return file_.commit();
}

}  // namespace rgs
