// consumer.cpp - an outside program on rgs::format: makes a scene in memory, reads it back, handles an error.
// SPDX-License-Identifier: Apache-2.0
#include <cstdio>
#include <rgs/file.hpp>
#include <rgs/splat_cloud.hpp>

int main() {
  rgs::SplatCloud cloud;
  cloud.resize(2, 0);
  rgs::Splat splat{};
  splat.mean[0] = 1.5f;
  cloud.set(1, splat);
  if (cloud.size() != 2 || cloud.mean[3] != 1.5f) {
    std::fprintf(stderr, "the cloud does not hold what was put in\n");
    return 1;
  }

  const auto file = rgs::MappedFile::open("no-such-scene.rgs");
  if (file) {
    std::fprintf(stderr, "a missing file was opened\n");
    return 1;
  }
  std::printf("%zu Gaussians; a missing file gives %s: %s\n", static_cast<std::size_t>(cloud.size()),
              rgs::errc_name(file.error().code), file.error().what);
  return 0;
}
