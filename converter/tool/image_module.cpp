// image_module.cpp - loads the module that knows other picture formats than PNG and JPEG.
// SPDX-License-Identifier: Apache-2.0
#include <dlfcn.h>

#include <cerrno>
#include <string>

#include "image_codec.hpp"
#include "startable_threads.hpp"

namespace rgs {
namespace {

// A library below OpenImageIO starts so many threads while it is loaded, and ends the program if it cannot.
constexpr unsigned kLoadingThreads = 4;

// Where the module may be: in a build, installed, beside the shared library that this may be in, and where a build of
// another project has it.
constexpr const char* kModuleFolders[] = {"$ORIGIN/../lib/roofgs", "$ORIGIN/../" RGS_LIBDIR "/roofgs", "$ORIGIN/roofgs",
#ifdef RGS_MODULE_FOLDER
                                          RGS_MODULE_FOLDER
#endif
};

}  // namespace

Result<const ImageCodec*> load_image_module() {
  if (tool::startable_threads(kLoadingThreads) < kLoadingThreads)
    return tl::unexpected(
        Error{.code = Errc::host_out_of_memory, .what = "cannot start the threads of OpenImageIO", .system = EAGAIN});
  static std::string why =
      "OpenEXR, TIFF and all formats but PNG and JPEG need lib/roofgs/librgs-pictures.so, which cannot be loaded: "
      "install Debian's packages roofgs and roofgs-pictures, or use PNG";
  for (const char* const place : kModuleFolders) {
    void* const module = ::dlopen((std::string(place) + "/librgs-pictures.so").c_str(), RTLD_LAZY | RTLD_LOCAL);
    void* const entry = module == nullptr ? nullptr : ::dlsym(module, "rgs_image_codec");
    if (entry != nullptr) return reinterpret_cast<decltype(&rgs_image_codec)>(entry)();
    why += std::string("; ") + ::dlerror();
  }
  const bool lacks_memory = why.find("annot allocate memory") != why.npos;
  return make_error(lacks_memory ? Errc::host_out_of_memory : Errc::unavailable, Error::kNone, why.c_str());
}

}  // namespace rgs
