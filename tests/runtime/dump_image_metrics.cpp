// dump_image_metrics.cpp - prints the library's comparison of two raw FP32 pictures, for image_metrics_test.py:
// rgs_dump_image_metrics WIDTH HEIGHT CHANNELS A.raw B.raw  ->  mse psnr largest largest_index ssim flip ms_ssim gmsd
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "rgs/file.hpp"
#include "rgs/image_metrics.hpp"

int main(int argc, char** argv) {
  if (argc != 6) return 2;
  rgs::Image pictures[2];
  for (int i = 0; i < 2; ++i) {
    pictures[i] = rgs::Image::make(std::atoi(argv[1]), std::atoi(argv[2]), std::atoi(argv[3]));
    const auto file = rgs::MappedFile::open(argv[4 + i]);
    if (!file || file->bytes().size() != pictures[i].pixels.size() * sizeof(float)) return 3;
    std::memcpy(pictures[i].pixels.data(), file->bytes().data(), file->bytes().size());
  }
  const auto d = rgs::difference(pictures[0], pictures[1]);
  const auto s = rgs::ssim(pictures[0], pictures[1]);
  const auto f = pictures[0].channels == 3 ? rgs::flip(pictures[0], pictures[1]) : rgs::Result<double>(0);
  const bool holds_window = std::min(pictures[0].width, pictures[0].height) >= 11;
  const auto m = holds_window ? rgs::ms_ssim(pictures[0], pictures[1]) : rgs::Result<double>(0);
  const auto g = rgs::gmsd(pictures[0], pictures[1]);
  if (!d || !s || !f || !m || !g) return 1;
  std::printf("%.17g %.17g %.9g %zu %.17g %.17g %.17g %.17g\n", d->mse, d->psnr, static_cast<double>(d->largest),
              d->largest_index, *s, *f, *m, *g);
}
