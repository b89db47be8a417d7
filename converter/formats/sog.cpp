// sog.cpp - PlayCanvas SOG (developer.playcanvas.com, "The SOG Format"): pixel i of each image is Gaussian i.
//
//   means_l, means_u  low and high bytes of 16-bit codes between bounds, in sign(x) ln(1 + |x|)
//   quats             red, green, blue: three components in +-sqrt(1/2); alpha: 252 + the largest of w, x, y, z
//   scales            logarithms;  sh0: constant harmonic, alpha is opacity;
//   shN               labels: 16 bits, the palette's entry; centroids: 64 entries a row, a pixel for each coefficient
// Version 2 looks values of scales, sh0 and shN up in codebooks of 256; version 1 has bounds, and opacity as logit.
// SPDX-License-Identifier: Apache-2.0
#include "sog.hpp"

#include <webp/decode.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <nlohmann/json.hpp>
#include <optional>
#include <string_view>

#include "json_member.hpp"
#include "pieces.hpp"
#include "quantised.hpp"
#include "rgs/quantize.hpp"
#include "signature.hpp"
#include "zip_archive.hpp"

namespace rgs::detail {
namespace {

using nlohmann::json;
using Bytes = std::vector<std::byte>;

constexpr std::uint64_t kMaxMetaBytes = std::uint64_t{1} << 24;  // the codebooks take 15 kB
constexpr std::uint64_t kEntriesPerRow = 64;
constexpr std::uint64_t kMaxPalette = 65536;
constexpr std::uint8_t kRotationTag = 252;  // plus the index of the largest component

// ---- meta.json ------------------------------------------------------------------------------------------------------

tl::unexpected<Error> bad_meta(const char* what) {
  return make_error(Errc::bad_syntax, 0, what);
}

std::vector<float> numbers(const json* array, std::size_t count) {
  std::vector<float> out;
  if (array == nullptr || !array->is_array() || array->size() != count) return out;
  for (const json& value : *array) {
    const double number = value.is_number() ? value.get<double>() : NAN;
    if (!(std::abs(number) <= 3e38)) return {};
    out.push_back(static_cast<float>(number));
  }
  return out;
}

std::optional<std::uint64_t> whole(const json* value) {
  return value != nullptr && value->is_number_unsigned() ? std::optional(value->get<std::uint64_t>()) : std::nullopt;
}

// Maps a byte of a channel to its value: by two bounds or a codebook.
class Lookup {
 public:
  static Lookup codebook(std::vector<float> values) { return Lookup(std::move(values)); }
  static Lookup range(float low, float high) {
    std::vector<float> values(256);
    for (std::size_t i = 0; i < 256; ++i) {
      const double t = static_cast<double>(i) / 255;
      values[i] =
          static_cast<float>(static_cast<double>(low) + t * (static_cast<double>(high) - static_cast<double>(low)));
    }
    return Lookup(std::move(values));
  }
  float operator[](std::uint8_t code) const { return values_[code]; }

 private:
  explicit Lookup(std::vector<float> values) : values_(std::move(values)) {}
  std::vector<float> values_;
};

struct Meta {
  std::uint64_t n = 0, palette = 0;
  int sh_degree = 0;
  bool opacity_is_logit = false;
  AaMode aa_mode = AaMode::classic;
  std::vector<float> mean_low, mean_high;  // [3], in sign(x) ln(1 + |x|)
  std::vector<Lookup> scale, sh0;          // per channel; version 1: the fourth of sh0 is opacity
  std::vector<Lookup> shn;                 // one for all
  std::vector<std::string> mean_files, quat_files, scale_files, sh0_files, shn_files;
};

// Names of `count` images; refuses one that leaves the scene's folder.
std::vector<std::string> file_names(const json* object, std::size_t count) {
  std::vector<std::string> names;
  const json* files = object != nullptr ? json_member(*object, "files") : nullptr;
  if (files == nullptr || !files->is_array() || files->size() != count) return names;
  for (const json& name : *files) {
    if (!name.is_string()) return {};
    names.push_back(name.get<std::string>());
    if (!is_beside(names.back())) return {};
  }
  return names;
}

// Lookups of the channels of `object`: its codebook for all, or a range for each.
std::vector<Lookup> lookups(const json* object, std::size_t channels, int version) {
  std::vector<Lookup> out;
  if (object == nullptr) return out;
  if (version == 2) {
    const std::vector<float> codebook = numbers(json_member(*object, "codebook"), 256);
    if (!codebook.empty()) out.assign(channels, Lookup::codebook(codebook));
    return out;
  }
  // One channel has its bounds as numbers, several as arrays.
  const auto bounds = [&](const char* name) {
    const json* stated = json_member(*object, name);
    const json one = stated != nullptr && stated->is_number() ? json::array({*stated}) : json();
    return numbers(one.is_array() ? &one : stated, channels);
  };
  const std::vector<float> low = bounds("mins"), high = bounds("maxs");
  for (std::size_t c = 0; c < channels && low.size() == channels && high.size() == channels; ++c) {
    out.push_back(Lookup::range(low[c], high[c]));
  }
  return out;
}

Status parse_shn(const json& shn, int version, Meta& meta) {
  meta.shn = lookups(&shn, 1, version);
  meta.shn_files = file_names(&shn, 2);
  if (meta.shn.empty() || meta.shn_files.empty()) {
    return bad_meta("meta.json: shN has no codebook or bounds, or not two files");
  }
  if (version == 2) {
    const auto bands = whole(json_member(shn, "bands")), count = whole(json_member(shn, "count"));
    if (!bands || *bands < 1 || *bands > 3) return bad_meta("meta.json: shN.bands is not 1 to 3");
    if (!count || *count < 1 || *count > kMaxPalette) return bad_meta("meta.json: shN.count is not 1 to 65536");
    meta.sh_degree = static_cast<int>(*bands);
    meta.palette = *count;
  }  // version 1: both follow from the palette's image
  return {};
}

Result<Meta> parse_meta(std::span<const std::byte> bytes) {
  if (bytes.size() > kMaxMetaBytes) return make_error(Errc::limit_exceeded, 0, "meta.json is longer than 16 MiB");
  const char* text = reinterpret_cast<const char*>(bytes.data());
  const json root = json::parse(text, text + bytes.size(), nullptr, false);
  if (!root.is_object()) return bad_meta("meta.json is not a JSON object");
  const json* means = json_member(root, "means");
  int version = 1;
  if (const json* stated = json_member(root, "version")) {
    if (whole(stated) != std::uint64_t{1} && whole(stated) != std::uint64_t{2}) {
      return make_error(Errc::unsupported_version, 0, "meta.json: the version is not 1 or 2");
    }
    version = static_cast<int>(stated->get<std::uint64_t>());
  }
  Meta meta;
  const json* shape = means != nullptr ? json_member(*means, "shape") : nullptr;
  const auto n = version == 2
                     ? whole(json_member(root, "count"))
                     : whole(shape != nullptr && shape->is_array() && !shape->empty() ? &(*shape)[0] : nullptr);
  if (!n) return bad_meta("meta.json: no number of Gaussians (count, in version 1 means.shape)");
  meta.n = *n;
  for (const char* name : {"scales", "quats", "sh0"}) {  // version 1 states the count with each
    const json* object = json_member(root, name);
    const json* stated = object != nullptr && version == 1 ? json_member(*object, "shape") : nullptr;
    const bool counts = stated != nullptr && stated->is_array() && !stated->empty();
    if (counts && whole(&(*stated)[0]) != meta.n) {
      return make_error(Errc::bad_header, 0, "meta.json: the shapes differ in their number of Gaussians", meta.n,
                        whole(&(*stated)[0]).value_or(Error::kNone));
    }
  }
  meta.mean_low = numbers(means != nullptr ? json_member(*means, "mins") : nullptr, 3);
  meta.mean_high = numbers(means != nullptr ? json_member(*means, "maxs") : nullptr, 3);
  meta.mean_files = file_names(means, 2);
  if (meta.mean_low.empty() || meta.mean_high.empty() || meta.mean_files.empty()) {
    return bad_meta("meta.json: means has not three mins, three maxs and two files");
  }
  const json *scales = json_member(root, "scales"), *sh0 = json_member(root, "sh0");
  meta.scale = lookups(scales, 3, version);
  meta.scale_files = file_names(scales, 1);
  meta.sh0 = lookups(sh0, version == 2 ? 3 : 4, version);
  meta.sh0_files = file_names(sh0, 1);
  meta.opacity_is_logit = version == 1;
  meta.quat_files = file_names(json_member(root, "quats"), 1);
  if (meta.scale.empty() || meta.scale_files.empty() || meta.sh0.empty() || meta.sh0_files.empty() ||
      meta.quat_files.empty()) {
    return bad_meta("meta.json: scales, sh0 or quats lacks its files, or its codebook or bounds");
  }
  if (const json* shn = json_member(root, "shN"); shn != nullptr && !shn->is_null()) {
    if (const Status s = parse_shn(*shn, version, meta); !s) return tl::unexpected(s.error());
  }
  // "model" is splat-transform's spelling, "antialias" that of other viewers.
  const json *model = json_member(root, "model"), *antialias = json_member(root, "antialias");
  const bool is_mip = model != nullptr ? *model == "antialiased" : antialias != nullptr && *antialias == true;
  if (is_mip) meta.aa_mode = AaMode::mip_splatting;
  return meta;
}

// ---- images ---------------------------------------------------------------------------------------------------------

struct Image {
  std::uint64_t width = 0, height = 0;
  std::vector<std::uint8_t> rgba;
  const std::uint8_t* pixel(std::uint64_t i) const { return &rgba[4 * i]; }
};

/// Decodes a lossless WebP of min_pixels to max_pixels; refuses others before allocating.
Result<Image> decode_image(const Bytes& file, std::uint64_t min_pixels, std::uint64_t max_pixels) {
  WebPBitstreamFeatures features;
  const auto* data = reinterpret_cast<const std::uint8_t*>(file.data());
  if (WebPGetFeatures(data, file.size(), &features) != VP8_STATUS_OK) {
    return make_error(Errc::bad_value, 0, "an image of the SOG is not a WebP");
  }
  constexpr int kLossless = 2;
  if (features.format != kLossless || features.has_animation != 0) {
    return make_error(Errc::unsupported_feature, 0,
                      "an image of the SOG is not a lossless still WebP: its values are lost");
  }
  Image image;
  image.width = static_cast<std::uint64_t>(features.width);
  image.height = static_cast<std::uint64_t>(features.height);
  const std::uint64_t pixels = image.width * image.height;  // WebP's sides have 14 bits
  if (pixels < min_pixels) {
    return make_error(Errc::size_mismatch, 0, "an image of the SOG has too few pixels", min_pixels, pixels);
  }
  if (pixels > max_pixels) {
    return make_error(Errc::limit_exceeded, 0, "an image of the SOG is much larger than its Gaussians", max_pixels,
                      pixels);
  }
  image.rgba.resize(4 * pixels);
  if (WebPDecodeRGBAInto(data, file.size(), image.rgba.data(), image.rgba.size(), 4 * features.width) == nullptr) {
    return make_error(Errc::bad_value, 0, "an image of the SOG is damaged");
  }
  return image;
}

struct Images {
  Image mean_low, mean_high, quats, scales, sh0, labels, centroids;
};

// Version 1 states neither the degree nor the palette's size.
Status measure_palette(const Image& centroids, Meta& meta) {
  const std::uint64_t coefficients = centroids.width / kEntriesPerRow;
  if (meta.sh_degree == 0) {
    meta.sh_degree = coefficients >= 15 ? 3 : coefficients >= 8 ? 2 : 1;
    meta.palette = std::min(kEntriesPerRow * centroids.height, kMaxPalette);
  }
  const auto wanted = static_cast<std::uint64_t>(sh_coefficients(meta.sh_degree) - 1);
  if (coefficients != wanted || centroids.width % kEntriesPerRow != 0 ||
      kEntriesPerRow * centroids.height < meta.palette) {
    return make_error(Errc::size_mismatch, 0, "the palette's image is not 64 entries wide, or has too few rows", wanted,
                      coefficients);
  }
  return {};
}

Status fetch_images(const FetchFile& fetch, Meta& meta, const DecodeLimits& limits, Images& images) {
  struct Wanted {
    const std::string& name;
    Image& image;
    std::uint64_t min_pixels, max_pixels;
  };
  const std::uint64_t most = 2 * meta.n + 65536;  // writers pad the last rows
  std::vector<Wanted> wanted{{meta.mean_files[0], images.mean_low, meta.n, most},
                             {meta.mean_files[1], images.mean_high, meta.n, most},
                             {meta.quat_files[0], images.quats, meta.n, most},
                             {meta.scale_files[0], images.scales, meta.n, most},
                             {meta.sh0_files[0], images.sh0, meta.n, most}};
  if (!meta.shn_files.empty()) {
    wanted.push_back({meta.shn_files[0], images.centroids, 1, 15 * (kMaxPalette + kEntriesPerRow)});
    wanted.push_back({meta.shn_files[1], images.labels, meta.n, most});
  }
  std::vector<Bytes> files;
  std::uint64_t stored = 0;
  for (const Wanted& w : wanted) {
    auto file = fetch(w.name);
    if (!file) return tl::unexpected(file.error());
    stored += file->size();
    files.push_back(std::move(*file));
  }
  if (const Status s = check_expansion(4 * wanted.size() * meta.n, stored, 0, limits); !s) return s;
  for (std::size_t i = 0; i < wanted.size(); ++i) {
    auto image = decode_image(files[i], wanted[i].min_pixels, wanted[i].max_pixels);
    if (!image) return tl::unexpected(image.error());
    wanted[i].image = std::move(*image);
    const Image &first = images.mean_low, &other = wanted[i].image;
    if (&other != &images.centroids && (other.width != first.width || other.height != first.height)) {
      return make_error(Errc::size_mismatch, 0, "the images of the SOG differ in size", first.width * first.height,
                        other.width * other.height);
    }
  }
  // The format ignores pixels after the last Gaussian, but a scene without Gaussians has no rotations either.
  for (std::size_t i = 3; meta.n == 0 && i < images.quats.rgba.size(); i += 4) {
    if (images.quats.rgba[i] >= kRotationTag) {
      return make_error(Errc::size_mismatch, 0, "meta.json counts no Gaussians, but the images hold some", 0,
                        images.quats.rgba.size() / 4);
    }
  }
  return meta.shn_files.empty() ? Status() : measure_palette(images.centroids, meta);
}

// ---- Gaussians ------------------------------------------------------------------------------------------------------

float unfold_mean(double folded) {
  return static_cast<float>(std::copysign(std::expm1(std::abs(folded)), folded));
}

Status decode_rotation(const std::uint8_t* pixel, std::uint64_t i, float (&rotation)[4]) {
  if (pixel[3] < kRotationTag) {
    return make_error(Errc::bad_value, 4 * i + 3, "quats: alpha is not 252 to 255", kRotationTag, pixel[3]);
  }
  SmallestThree s;
  s.largest = pixel[3] - kRotationTag;
  for (int k = 0; k < 3; ++k) s.rest[k] = (pixel[k] / 255.0 * 2 - 1) * kRootHalf;
  from_smallest_three(s, rotation);
  return {};
}

Status decode_harmonics(const Meta& meta, const Images& images, std::uint64_t i, Splat& s) {
  const std::uint8_t* code = images.labels.pixel(i);
  const std::uint64_t label = code[0] | static_cast<std::uint64_t>(code[1]) << 8;
  if (label >= meta.palette) {
    return make_error(Errc::bad_value, 4 * i, "a label of shN is beyond the palette", meta.palette, label);
  }
  const auto coefficients = static_cast<std::uint64_t>(sh_coefficients(meta.sh_degree) - 1);
  const std::uint64_t first = label / kEntriesPerRow * images.centroids.width + label % kEntriesPerRow * coefficients;
  for (std::uint64_t k = 0; k < coefficients; ++k) {
    const std::uint8_t* pixel = images.centroids.pixel(first + k);
    for (std::uint64_t c = 0; c < 3; ++c) s.sh[3 * (k + 1) + c] = meta.shn[0][pixel[c]];
  }
  return {};
}

Result<Splat> decode_splat(const Meta& meta, const Images& images, std::uint64_t i) {
  Splat s;
  for (std::size_t k = 0; k < 3; ++k) {
    const std::uint32_t code = images.mean_low.pixel(i)[k] | static_cast<std::uint32_t>(images.mean_high.pixel(i)[k])
                                                                 << 8;
    const double low = static_cast<double>(meta.mean_low[k]), high = static_cast<double>(meta.mean_high[k]);
    s.mean[k] = unfold_mean(low + code / 65535.0 * (high - low));
    s.log_scale[k] = meta.scale[k][images.scales.pixel(i)[k]];
    s.sh[k] = meta.sh0[k][images.sh0.pixel(i)[k]];
  }
  const std::uint8_t alpha = images.sh0.pixel(i)[3];
  s.opacity_logit = meta.opacity_is_logit ? meta.sh0[3][alpha] : logit_from_opacity(static_cast<float>(alpha) / 255.F);
  if (const Status ok = decode_rotation(images.quats.pixel(i), i, s.rotation); !ok) return tl::unexpected(ok.error());
  if (meta.sh_degree > 0) {
    if (const Status ok = decode_harmonics(meta, images, i, s); !ok) return tl::unexpected(ok.error());
  }
  return s;
}

}  // namespace

Result<SplatFile> decode_sog_files(std::span<const std::byte> meta_bytes, const FetchFile& fetch,
                                   const ReadOptions& options) {
  const DecodeLimits& limits = options.limits;
  auto meta = parse_meta(meta_bytes);
  if (!meta) return tl::unexpected(meta.error());
  if (meta->n > std::min<std::uint64_t>(limits.max_gaussians, std::uint64_t{1} << 28)) {  // WebP's largest image
    return make_error(Errc::limit_exceeded, 0, "meta.json: more Gaussians than the caller or an image allows",
                      std::min<std::uint64_t>(limits.max_gaussians, std::uint64_t{1} << 28), meta->n);
  }
  Images images;
  if (const Status s = fetch_images(fetch, *meta, limits, images); !s) return tl::unexpected(s.error());
  SplatFile file;
  file.format = SplatFormat::sog;
  file.aa_mode = meta->aa_mode;
  PieceFiller filler(file, meta->n, meta->sh_degree, options);
  for (std::uint64_t i = 0; i < meta->n; ++i) {
    const auto splat = decode_splat(*meta, images, i);
    if (!splat) return tl::unexpected(splat.error());
    if (const Status filled = filler.add(*splat); !filled) return tl::unexpected(filled.error());
  }
  return file;
}

bool is_sog(std::span<const std::byte> bytes) {
  return is_zip(bytes) || is_sog_meta(bytes);
}

bool is_sog_meta(std::span<const std::byte> bytes) {
  return is_json_with(bytes, "\"means\"");
}

Result<SplatFile> decode_sog(std::span<const std::byte> bytes, const ReadOptions& options) {
  const auto archive = ZipArchive::open(bytes);
  if (!archive) return tl::unexpected(archive.error());
  const FetchFile fetch = [&](const std::string& name) {
    return archive->read(name, options.limits, "the SOG lacks meta.json or a file that meta.json names");
  };
  const auto meta = fetch("meta.json");
  if (!meta) return tl::unexpected(meta.error());
  auto file = decode_sog_files(*meta, fetch, options);
  if (file) file->bytes = bytes.size();
  return file;
}

bool is_beside(const std::string& name) {
  return !name.empty() && name[0] != '.' && name.find_first_of(std::string_view("/\\\0", 3)) == name.npos;
}

FetchFile fetch_from(const std::string& folder, std::uint64_t& total) {
  return [&folder, &total](const std::string& name) -> Result<Bytes> {
    const auto file = MappedFile::open(folder + "/" + name);
    if (!file) return tl::unexpected(file.error());
    total += file->bytes().size();
    Bytes bytes(file->bytes().begin(), file->bytes().end());
    if (const Status s = file->check_unchanged(); !s) return tl::unexpected(s.error());
    return bytes;
  };
}

Result<SplatFile> decode_sog_folder(std::span<const std::byte> bytes, const std::string& folder,
                                    const ReadOptions& options) {
  std::uint64_t total = bytes.size();
  auto file = decode_sog_files(bytes, fetch_from(folder, total), options);
  if (file) file->bytes = total;
  return file;
}

}  // namespace rgs::detail
