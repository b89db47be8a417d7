// image_file.cpp - pictures are encoded in memory by a module and then written atomically.
// SPDX-License-Identifier: Apache-2.0
#include "image_file.hpp"

#include <dlfcn.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <cerrno>
#include <filesystem>
#include <utility>
#include <vector>

#include "image_codec.hpp"
#include "startable_threads.hpp"

namespace rgs {
namespace {

// A library below OpenImageIO starts so many threads while it is loaded, and ends the program if it cannot.
constexpr unsigned kLoadingThreads = 4;

// Where the module may be: in a build, installed, and where a build of another project has it.
constexpr const char* kModuleFolders[] = {"$ORIGIN/../lib/roofgs", "$ORIGIN/../" RGS_LIBDIR "/roofgs",
#ifdef RGS_MODULE_FOLDER
                                          RGS_MODULE_FOLDER
#endif
};

Result<const ImageCodec*> load_codec() {
  if (tool::startable_threads(kLoadingThreads) < kLoadingThreads)
    return tl::unexpected(
        Error{.code = Errc::host_out_of_memory, .what = "cannot start the threads of OpenImageIO", .system = EAGAIN});
  static std::string why = "pictures cannot be read or written";
  for (const char* const place : kModuleFolders) {
    void* const module = ::dlopen((std::string(place) + "/librgs-pictures.so").c_str(), RTLD_LAZY | RTLD_LOCAL);
    void* const entry = module == nullptr ? nullptr : ::dlsym(module, "rgs_image_codec");
    if (entry != nullptr) return reinterpret_cast<decltype(&rgs_image_codec)>(entry)();
    why += std::string("; ") + ::dlerror();
  }
  const bool lacks_memory = why.find("annot allocate memory") != why.npos;
  return make_error(lacks_memory ? Errc::host_out_of_memory : Errc::open_failed, Error::kNone, why.c_str());
}

// Loaded at the first picture and kept.
const Result<const ImageCodec*>& image_codec() {
  static const Result<const ImageCodec*> codec = load_codec();
  return codec;
}

Status check(const Image& image, ImageFormat format, const ImageFileOptions& options) {
  if (image.channels != 1 && (options.depth || (image.channels != 3 && image.channels != 4)))
    return make_error(Errc::bad_argument, Error::kNone, "a picture has 1, 3 or 4 channels, and depth has 1");
  if (options.depth && (format == ImageFormat::png || format == ImageFormat::jpeg))
    return make_error(Errc::bad_argument, Error::kNone, "depth needs floating point: name the file .exr or .tif");
  if (image.channels == 4 && format == ImageFormat::jpeg)
    return make_error(Errc::bad_argument, Error::kNone, "JPEG has no alpha: name the file .png, .tif or .exr");
  constexpr int kMaxJpegSide = 65500;
  if (format == ImageFormat::jpeg && std::max(image.width, image.height) > kMaxJpegSide)
    return make_error(Errc::bad_argument, Error::kNone,
                      "JPEG holds at most 65,500 pixels a side: name the file .png, .tif or .exr");
  return {};
}

Result<std::vector<std::byte>> encode(const Image& image, ImageFormat format, const ImageFileOptions& options) {
  if (!image_codec()) return tl::unexpected(image_codec().error());
  std::vector<std::byte> bytes;
  if ((*image_codec())->encode(image, format, options, bytes)) return bytes;
  return make_error(Errc::write_failed, Error::kNone, "the picture cannot be encoded");
}

// Finds out why a file cannot be opened; the module does not say.
Status check_picture(const std::string& path) {
  if (const auto mapped = MappedFile::open(path); !mapped) return tl::unexpected(mapped.error());
  return load_image_formats();
}

tl::unexpected<Error> no_picture() {
  return make_error(Errc::bad_syntax, Error::kNone, "not a picture format that OpenImageIO reads, or damaged");
}

}  // namespace

Result<ImageFormat> image_format(const std::string& path) {
  std::string extension = std::filesystem::path(path).extension().string();
  std::transform(extension.begin(), extension.end(), extension.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  constexpr std::array<std::pair<const char*, ImageFormat>, 6> kNames{{{".png", ImageFormat::png},
                                                                       {".jpg", ImageFormat::jpeg},
                                                                       {".jpeg", ImageFormat::jpeg},
                                                                       {".tif", ImageFormat::tiff},
                                                                       {".tiff", ImageFormat::tiff},
                                                                       {".exr", ImageFormat::exr}}};
  for (const auto& [name, format] : kNames)
    if (extension == name) return format;
  return make_error(Errc::bad_argument, Error::kNone, "a picture's name must end in .png, .jpg, .tif or .exr");
}

Status write_image(const std::string& path, const Image& image, const ImageFileOptions& options) {
  const auto format = image_format(path);
  if (!format) return tl::unexpected(format.error());
  if (const Status s = check(image, *format, options); !s) return s;
  auto file = AtomicFile::create(path, options.file);
  if (!file) return tl::unexpected(file.error());
  const auto bytes = encode(image, *format, options);
  if (!bytes) return tl::unexpected(bytes.error());
  if (auto status = file->write_at(0, *bytes); !status) return status;
  return file->commit().map([](double) {});
}

Image with_alpha(const Image& rgb, std::span<const float> alpha) {
  Image rgba = Image::make(rgb.width, rgb.height, 4);
  for (std::size_t i = 0; i < alpha.size(); ++i) {
    std::copy_n(rgb.pixels.data() + 3 * i, 3, rgba.pixels.data() + 4 * i);
    rgba.pixels[4 * i + 3] = alpha[i];
  }
  return rgba;
}

Result<std::vector<std::byte>> encode_image(const Image& image, ImageFormat format, const ImageFileOptions& options) {
  if (format != ImageFormat::png && format != ImageFormat::jpeg)
    return make_error(Errc::bad_argument, Error::kNone, "only PNG and JPEG can be encoded in memory");
  ImageFileOptions colour = options;
  colour.depth = false;
  if (const Status s = check(image, format, colour); !s) return tl::unexpected(s.error());
  return encode(image, format, colour);
}

Status load_image_formats() {
  return image_codec().map([](const ImageCodec*) {});
}

Result<ImageExtent> read_image_extent(const std::string& path) {
  if (Status ok = check_picture(path); !ok) return tl::unexpected(ok.error());
  if (const auto extent = (*image_codec())->extent(path)) return *extent;
  return no_picture();
}

Result<Image> read_image(const std::string& path) {
  if (Status ok = check_picture(path); !ok) return tl::unexpected(ok.error());
  if (auto image = (*image_codec())->decode(path)) return *std::move(image);
  return no_picture();
}

}  // namespace rgs
