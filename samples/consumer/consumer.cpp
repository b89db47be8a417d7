// consumer.cpp - an outside program on rgs::format: writes a scene made in memory, reads it back, handles an error.
// SPDX-License-Identifier: Apache-2.0
#include <cstdio>
#include <rgs/decode.hpp>
#include <rgs/encode.hpp>
#include <rgs/file.hpp>
#include <rgs/splat_cloud.hpp>
#include <rgs/version.hpp>
#include <string_view>

#ifdef PACKAGE_VERSION
static_assert(std::string_view(RGS_VERSION) == PACKAGE_VERSION);
#endif

namespace {

int make_error(const rgs::Error& error) {
  std::fprintf(stderr, "%s: %s\n", rgs::errc_name(error.code), error.what);
  return rgs::exit_code(error.code);
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fprintf(stderr, "usage: consumer SCENE.rgs\n");
    return 2;
  }
  rgs::SplatCloud cloud;
  cloud.resize(2, 0);
  rgs::Splat splat{};
  cloud.set(0, splat);
  splat.mean[0] = 1.5f;
  cloud.set(1, splat);

  const auto bytes = rgs::encode(cloud.view());
  if (!bytes) return make_error(bytes.error());
  auto out = rgs::AtomicFile::create(argv[1], {.overwrite = true});
  if (!out) return make_error(out.error());
  if (const auto written = out->write_at(0, *bytes); !written) return make_error(written.error());
  if (const auto committed = out->commit(); !committed) return make_error(committed.error());

  const auto file = rgs::MappedFile::open(argv[1]);
  if (!file) return make_error(file.error());
  const auto back = rgs::decode(file->bytes());
  if (!back) return make_error(back.error());
  if (back->size() != 2) {
    std::fprintf(stderr, "the file does not hold what was put in\n");
    return 1;
  }

  const auto missing = rgs::MappedFile::open("no-such-scene.rgs");
  if (missing) {
    std::fprintf(stderr, "a missing file was opened\n");
    return 1;
  }
  std::printf("%zu Gaussians; a missing file gives %s: %s\n", static_cast<std::size_t>(back->size()),
              rgs::errc_name(missing.error().code), missing.error().what);
  return 0;
}
