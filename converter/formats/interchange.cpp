// interchange.cpp - tells the formats apart and calls their readers and writers.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/interchange.hpp"

#include <algorithm>
#include <array>
#include <cctype>
#include <cstring>
#include <filesystem>
#include <limits>
#include <string_view>

#include "compressed_ply.hpp"
#include "gltf_splats.hpp"
#include "ksplat.hpp"
#include "rgs/encode.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/ply.hpp"
#include "rgs/splat_edit.hpp"
#include "sog.hpp"
#include "splat_records.hpp"
#include "spz.hpp"

namespace rgs {
namespace {

constexpr std::array<const char*, 9> kNames{"unknown", "rgs", "ply", "compressed.ply", "spz", "splat",
                                            "ksplat",  "sog", "glb"};

bool begins_with(std::span<const std::byte> bytes, std::span<const unsigned char> magic) {
  return bytes.size() >= magic.size() && std::memcmp(bytes.data(), magic.data(), magic.size()) == 0;
}

SplatCloud read_rows(const PlyFile& ply) {
  SplatCloud cloud;
  cloud.resize(ply.size(), ply.sh_degree());
  std::array<Splat, 256> rows;
  for (std::uint64_t first = 0; first < ply.size(); first += rows.size()) {
    const auto part = std::span(rows).first(std::min<std::uint64_t>(rows.size(), ply.size() - first));
    ply.read(first, part);
    for (std::size_t i = 0; i < part.size(); ++i) cloud.set(first + i, part[i]);
  }
  return cloud;
}

Result<SplatFile> decode_ply(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto ply = PlyFile::open(bytes);
  if (!ply) return tl::unexpected(ply.error());
  if (ply->size() > limits.max_gaussians) {
    return make_error(Errc::limit_exceeded, 0, "more Gaussians than the caller allows", limits.max_gaussians,
                      ply->size());
  }
  SplatFile file;
  file.cloud = read_rows(*ply);
  return file;
}

Result<SplatFile> decode_rgs(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto view = FileView::open(bytes, limits);
  if (!view) return tl::unexpected(view.error());
  auto cloud = decode(bytes, limits);
  if (!cloud) return tl::unexpected(cloud.error());
  SplatFile file;
  file.axes = view->declarations().axes;
  file.colour_space = view->declarations().colour_space;
  file.aa_mode = view->declarations().aa_mode;
  file.low_pass_px2 = view->declarations().low_pass_px2;
  file.cloud = std::move(*cloud);
  return file;
}

Result<SplatFile> decode_format(std::span<const std::byte> bytes, SplatFormat format, const DecodeLimits& limits) {
  switch (format) {
    case SplatFormat::rgs: return decode_rgs(bytes, limits);
    case SplatFormat::ply: return decode_ply(bytes, limits);
    case SplatFormat::compressed_ply: return detail::decode_compressed_ply(bytes, limits);
    case SplatFormat::spz: return detail::decode_spz(bytes, limits);
    case SplatFormat::splat: return detail::decode_splat_records(bytes, limits);
    case SplatFormat::ksplat: return detail::decode_ksplat(bytes, limits);
    case SplatFormat::sog: return detail::decode_sog(bytes, limits);
    case SplatFormat::glb: return detail::decode_glb(bytes, limits);
    case SplatFormat::unknown: break;
  }
  return make_error(Errc::bad_magic, 0, "is none of .rgs, .ply, .spz, .splat, .ksplat, .sog and .glb");
}

Result<SplatFile> finish(Result<SplatFile> file, SplatFormat format, std::uint64_t bytes, const ReadOptions& options) {
  if (!file) return file;
  file->format = format;
  file->bytes = std::max(file->bytes, bytes);
  if (!options.keep_axes && std::ranges::find(file->axes, Axis::undeclared) == file->axes.end()) {
    convert_axes(file->cloud, file->axes, kAxes3dgs);
    file->axes = kAxes3dgs;
  }
  return file;
}

// Codes of fixed width cannot say "not a number".
Status check_sound(const SplatView& splats) {
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    if (find_defects(splats.splat(i), splats.sh_degree) != 0) {
      return make_error(Errc::bad_value, i, "a damaged Gaussian; drop or repair such before writing this format");
    }
  }
  return {};
}

std::vector<std::byte> encode_ply(const SplatView& splats) {
  const std::string header = ply_header(splats.n, splats.sh_degree);
  const std::uint64_t row = ply_row_bytes(splats.sh_degree);
  std::vector<std::byte> file(header.size() + splats.n * row);
  std::memcpy(file.data(), header.data(), header.size());
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    const Splat s = splats.splat(i);
    encode_ply_rows({&s, 1}, splats.sh_degree, std::span(file).subspan(header.size() + i * row, row));
  }
  return file;
}

}  // namespace

const char* format_name(SplatFormat format) {
  return kNames[static_cast<std::size_t>(format)];
}

SplatFormat detect_format(std::span<const std::byte> bytes) {
  constexpr std::array<unsigned char, 3> kPly{'p', 'l', 'y'};
  constexpr std::array<unsigned char, 4> kGlb{'g', 'l', 'T', 'F'};
  if (begins_with(bytes, kMagic)) return SplatFormat::rgs;
  if (begins_with(bytes, kPly)) {
    return detail::is_compressed_ply(bytes) ? SplatFormat::compressed_ply : SplatFormat::ply;
  }
  if (begins_with(bytes, kGlb)) return SplatFormat::glb;
  if (detail::is_spz(bytes)) return SplatFormat::spz;
  if (detail::is_sog(bytes) || detail::is_sog_meta(bytes)) return SplatFormat::sog;
  if (detail::looks_like_ksplat(bytes)) return SplatFormat::ksplat;
  if (detail::looks_like_splat_records(bytes)) return SplatFormat::splat;
  return SplatFormat::unknown;
}

SplatFormat format_of_name(const std::string& path) {
  std::string name = std::filesystem::path(path).filename().string();
  std::ranges::transform(name, name.begin(), [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  if (name == "meta.json") return SplatFormat::sog;
  for (const SplatFormat format : {SplatFormat::compressed_ply, SplatFormat::ply, SplatFormat::rgs, SplatFormat::spz,
                                   SplatFormat::ksplat, SplatFormat::splat, SplatFormat::sog, SplatFormat::glb}) {
    if (name.ends_with(std::string(".") + format_name(format))) return format;
  }
  return SplatFormat::unknown;
}

Axes format_axes(SplatFormat format) {
  return format == SplatFormat::spz ? kAxesOpenGl : format == SplatFormat::glb ? kAxesGltf : kAxes3dgs;
}

bool is_writable(SplatFormat format) {
  return format == SplatFormat::ply || format == SplatFormat::compressed_ply || format == SplatFormat::spz ||
         format == SplatFormat::splat || format == SplatFormat::glb;
}

Result<SplatFile> read_splats(std::span<const std::byte> bytes, const ReadOptions& options) {
  return detail::guard_memory([&]() -> Result<SplatFile> {
    if (bytes.size() > options.limits.max_file_bytes) {
      return make_error(Errc::limit_exceeded, 0, "the file is larger than the caller allows",
                        options.limits.max_file_bytes, bytes.size());
    }
    const SplatFormat format = options.format != SplatFormat::unknown ? options.format : detect_format(bytes);
    if (format == SplatFormat::sog && detail::is_sog_meta(bytes)) {
      return make_error(Errc::unsupported_feature, 0,
                        "a SOG's meta.json without its images: name the file, or zip the folder");
    }
    return finish(decode_format(bytes, format, options.limits), format, bytes.size(), options);
  });
}

Result<SplatFile> read_splats(const std::string& path, const ReadOptions& options) {
  return detail::guard_memory([&]() -> Result<SplatFile> {
    const auto file = MappedFile::open(path);
    if (!file) return tl::unexpected(file.error());
    if (!detail::is_sog_meta(file->bytes())) {
      auto splats = read_splats(file->bytes(), options);
      // That the file changed explains whatever was found wrong in it.
      if (const Status s = file->check_unchanged(); !s) return tl::unexpected(s.error());
      return splats;
    }
    const std::string folder = std::filesystem::path(path).parent_path().string();
    return finish(detail::decode_sog_folder(file->bytes(), folder.empty() ? "." : folder, options.limits),
                  SplatFormat::sog, 0, options);
  });
}

Result<std::vector<std::byte>> encode_splats(const SplatView& splats, SplatFormat format, const WriteOptions& options) {
  return detail::guard_memory([&]() -> Result<std::vector<std::byte>> {
    if (!is_writable(format)) return make_error(Errc::bad_argument, Error::kNone, "this format is not written");
    if (!splats.consistent()) return make_error(Errc::bad_argument, Error::kNone, "the sizes of the view disagree");
    if (splats.n > std::numeric_limits<std::uint32_t>::max()) {
      return make_error(Errc::limit_exceeded, Error::kNone, "more than 2^32 - 1 Gaussians; split the scene",
                        std::numeric_limits<std::uint32_t>::max(), splats.n);
    }
    if (format == SplatFormat::ply) return encode_ply(splats);
    if (const Status s = check_sound(splats); !s) return tl::unexpected(s.error());
    switch (format) {
      case SplatFormat::compressed_ply: return detail::encode_compressed_ply(splats, options.keep_order);
      case SplatFormat::spz: return detail::encode_spz(splats, options.aa_mode);
      case SplatFormat::glb: return detail::encode_glb(splats, options.colour_space);
      default: return detail::encode_splat_records(splats);
    }
  });
}

}  // namespace rgs
