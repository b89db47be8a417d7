// reference_images_test.cpp - a trained scene against images by an independent renderer of the original definition.
// SPDX-License-Identifier: Apache-2.0
//
// Needs south/ of the measurement data (data_folder.hpp).
#include <doctest/doctest.h>
#include <zstd.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <string>
#include <vector>

#include "checkout.hpp"
#include "data_folder.hpp"
#include "image_file.hpp"
#include "renderer_fixture.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/file.hpp"
#include "rgs/ply.hpp"
#include "skip.hpp"

namespace fs = std::filesystem;
using namespace rgs;
using namespace rgs::test;

namespace {

fs::path south() {
  return data_folder() / "south";
}

// The scene's PLY file in the build folder, unpacked once.
std::string unpacked_scene() {
  const std::string path = binary_dir() + "/south.ply";
  if (fs::exists(path)) return path;
  const auto packed = MappedFile::open((south() / "south.ply.zst").string());
  REQUIRE(packed);
  auto out = AtomicFile::create(path, {.overwrite = true, .sync = false});
  REQUIRE(out);
  ZSTD_DCtx* const context = ZSTD_createDCtx();
  std::vector<std::byte> chunk(ZSTD_DStreamOutSize());
  ZSTD_inBuffer in{packed->bytes().data(), packed->bytes().size(), 0};
  std::uint64_t offset = 0;
  std::size_t left = 1;
  while (left != 0) {
    ZSTD_outBuffer piece{chunk.data(), chunk.size(), 0};
    left = ZSTD_decompressStream(context, &piece, &in);
    REQUIRE_FALSE(ZSTD_isError(left));
    REQUIRE((left == 0 || in.pos < in.size || piece.pos > 0));
    REQUIRE(out->write_at(offset, std::span(chunk).first(piece.pos)));
    offset += piece.pos;
  }
  ZSTD_freeDCtx(context);
  REQUIRE(out->commit());
  return path;
}

}  // namespace

TEST_CASE("a trained scene matches images of the original definition to 60 dB in 8 bits") {
  if (!fs::exists(south() / "south.ply.zst"))
    return skip_without_data("no measurement data in " + south().string() + "; set RGS_DATA_DIR");
  auto cloud = read_ply(unpacked_scene());
  REQUIRE(cloud);
  const auto scene = Scene::load(std::move(*cloud));
  REQUIRE(scene);
  const auto cameras = read_cameras((south() / "cameras.json").string());
  REQUIRE(cameras);
  const auto bench_cameras = read_cameras((south() / "bench_cameras.json").string());
  REQUIRE(bench_cameras);
  auto renderer = Renderer::create();
  REQUIRE(renderer);

  int n_images = 0;
  for (const auto& entry : fs::directory_iterator(south() / "reference")) {
    const std::string name = entry.path().stem().string();
    CAPTURE(name);
    const auto reference = read_image(entry.path().string());
    REQUIRE(reference);
    REQUIRE(reference->channels == 3);
    const bool is_bench = name.starts_with("bench");
    const auto& list = is_bench ? *bench_cameras : *cameras;
    const auto found = is_bench
                           ? list.begin()
                           : std::find_if(list.begin(), list.end(), [&](const Camera& c) { return c.name == name; });
    REQUIRE(found != list.end());
    const Camera camera = resized(*found, reference->width, reference->height);
    std::vector<float> rgb(reference->pixels.size());
    const auto stats = renderer->render(*scene, camera, {.rgb = rgb}, baseline_options());
    REQUIRE(stats);
    double sum = 0, largest = 0;
    for (std::size_t i = 0; i < rgb.size(); ++i) {
      const double d = std::round(255 * std::clamp(rgb[i], 0.0F, 1.0F)) - std::round(255 * reference->pixels[i]);
      sum += d * d;
      largest = std::max(largest, std::abs(d));
    }
    const double db = 10 * std::log10(255.0 * 255.0 * static_cast<double>(rgb.size()) / std::max(sum, 1e-9));
    MESSAGE(name, ": ", db, " dB, largest difference ", largest, "/255, ", stats->total_ms, " ms");
    CHECK(db >= 60);
    ++n_images;
  }
  CHECK(n_images > 0);
}
