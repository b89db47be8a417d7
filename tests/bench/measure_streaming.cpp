// measure_streaming.cpp - decoding speed of pages on one core, and time until a streamed town is visible: prints the
// table of docs/records/STREAMING.md.
// SPDX-License-Identifier: Apache-2.0
//
//   rgs_measure_streaming GAUSSIANS DEGREE FOLDER [decode]
//
// FOLDER keeps the town's files, one per profile, for later runs. `decode`: prints only the first rows.
#include <algorithm>
#include <array>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <filesystem>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "build_levels.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/file.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/renderer.hpp"
#include "rgs/scene.hpp"
#include "town_generator.hpp"
#include "value_or_stop.hpp"

namespace {

using namespace rgs;
using test::value_or_stop;
using Clock = std::chrono::steady_clock;

constexpr std::uint64_t kSeed = 1;
constexpr int kTurns = 7;  // of each measurement; the best counts

double seconds_since(Clock::time_point began) {
  return std::chrono::duration<double>(Clock::now() - began).count();
}

SplatCloud make_town(std::uint64_t n, int sh_degree) {
  const TownGenerator town(kSeed, n, sh_degree);
  SplatCloud cloud;
  cloud.resize(n, sh_degree);
  std::vector<Splat> part;
  for (std::uint64_t k = 0; k < town.n_ranges(); ++k) {
    const TownRange range = town.range(k);
    part.resize(range.size());
    range.generate(0, part);
    for (std::uint64_t i = 0; i < part.size(); ++i) cloud.set(town.first(k) + i, part[i]);
  }
  return cloud;
}

// The town with levels, in each profile.
struct Stored {
  const char* name;
  Profile profile;
  std::string path;
};

void write_missing(std::uint64_t n, int sh_degree, const std::vector<Stored>& files) {
  if (std::ranges::all_of(files, [](const Stored& file) { return std::filesystem::exists(file.path); })) return;
  EncodeOptions options;
  options.profile = Profile::direct;
  options.order = Order::morton;
  const auto plain = value_or_stop(encode(make_town(n, sh_degree).view(), options), "encode");
  const auto leaves = value_or_stop(decode(plain), "decode");
  const lod::Levels levels = lod::build_levels(leaves.view());
  for (const Stored& file : files) {
    options.profile = file.profile;
    auto out = value_or_stop(AtomicFile::create(file.path, AtomicFile::Options{.overwrite = true}), file.path.c_str());
    value_or_stop(write_levels(levels, options, out), file.path.c_str());
    value_or_stop(out.commit(), file.path.c_str());
  }
}

struct Decoded {
  double rows_s = 1e9, arrays_s = 1e9;  // on one core
};

// Decodes pages in turn: to the rows that a GPU reads, and to checked FP32 arrays.
Decoded measure_decoding(const PagedFile& file) {
  Decoded best;
  PageDecoder decoder(file);
  std::vector<std::byte> memory(file.largest_decoded_bytes());
  std::array<ActivatedSplat, 64> buffer;
  const auto floats = static_cast<std::size_t>(11 + 3 * sh_coefficients(file.head().header().sh_degree));
  std::vector<float> arrays;
  for (const bool to_arrays : {false, true}) {
    for (int turn = 0; turn < kTurns; ++turn) {
      const std::clock_t began = std::clock();
      for (std::uint32_t page = 0; page < file.n_pages(); ++page) {
        const auto rows = value_or_stop(
            decoder.decode(page, file.bytes(page), std::span(memory).first(file.decoded_bytes(page))), "decode");
        if (!to_arrays) continue;
        if (!check_page_values(file, page, rows)) std::exit(4);
        arrays.resize(rows.n * floats);
        float* to = arrays.data();
        for (std::uint32_t first = 0; first < rows.n; first += buffer.size()) {
          const auto part = std::span(buffer).first(std::min<std::size_t>(buffer.size(), rows.n - first));
          if (!read_page(file, page, rows, first, part)) std::exit(4);
          for (const ActivatedSplat& splat : part) {
            to = std::copy_n(splat.mean, 3, to);
            to = std::copy_n(splat.rotation, 4, to);
            to = std::copy_n(splat.scale, 3, to);
            *to++ = splat.opacity;
            to = std::copy_n(splat.sh, floats - 11, to);
          }
        }
      }
      double& least = to_arrays ? best.arrays_s : best.rows_s;
      least = std::min(least, static_cast<double>(std::clock() - began) / CLOCKS_PER_SEC);
    }
  }
  return best;
}

struct Seen {
  double open_s = 1e9, first_s = 1e9, complete_s = 1e9, first_mb = 0;
};

// A view inside the town, with the file in the system's cache.
Seen measure_streaming(const std::string& path, const Camera& camera) {
  Seen best;
  for (int turn = 0; turn < 3; ++turn) {
    auto renderer = value_or_stop(Renderer::create({.backend = Backend::cpu}), "renderer");
    std::vector<float> rgb(3 * static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height));
    RenderTarget target;
    target.rgb = rgb;
    RenderOptions how;
    how.detail_px = 1;
    const auto began = Clock::now();
    const auto scene = value_or_stop(Scene::open(path, {.pool = *StreamPool::create()}), path.c_str());
    best.open_s = std::min(best.open_s, seconds_since(began));
    const auto first = value_or_stop(renderer.render(scene, camera, target, how), "first frame");
    if (const double seconds = seconds_since(began); seconds < best.first_s) {
      best.first_s = seconds;
      best.first_mb = 1e-6 * static_cast<double>(first.stream.bytes_read);
    }
    if (!value_or_stop(renderer.refine(scene, camera, 600, how), "refine")) std::exit(1);
    best.complete_s = std::min(best.complete_s, seconds_since(began));
  }
  return best;
}

}  // namespace

int main(int argc, char** argv) {
  const std::uint64_t n = argc < 4 ? 0 : std::strtoull(argv[1], nullptr, 10);
  const int sh_degree = argc < 4 ? -1 : std::atoi(argv[2]);
  const bool only_decode = argc == 5 && argv[4] == std::string_view("decode");
  if (n == 0 || n > kMaxTownGaussians || sh_degree < 0 || sh_degree > 3 || argc > 5 || (argc == 5 && !only_decode)) {
    std::fputs("usage: rgs_measure_streaming GAUSSIANS DEGREE FOLDER [decode]\n", stderr);
    return 2;
  }
  const auto path = [&](const char* name) {
    return std::string(argv[3]) + "/town-" + argv[1] + "-" + argv[2] + "-" + name + ".rgs";
  };
  const std::vector<Stored> files{{"direct", Profile::direct, path("direct")},
                                  {"packed", Profile::packed, path("packed")},
                                  {"archive", Profile::archive, path("archive")}};
  write_missing(n, sh_degree, files);
  const auto cameras = value_or_stop(parse_camera_json(town_cameras_json(kSeed, 1920, 1080)), "cameras");
  for (const Stored& file : files) {
    const auto mapped = value_or_stop(MappedFile::open(file.path), file.path.c_str());
    const auto paged = value_or_stop(PagedFile::open(mapped.bytes()), file.path.c_str());
    std::uint64_t rows_bytes = 0;
    for (std::uint32_t page = 0; page < paged.n_pages(); ++page) rows_bytes += paged.decoded_bytes(page);
    const auto n_stored = static_cast<double>(paged.n_stored());
    const Decoded decoded = measure_decoding(paged);
    const auto rate = [&](double seconds) {
      std::printf(" %.0f MB/s, %.2f M Gaussians/s |", 1e-6 * static_cast<double>(rows_bytes) / seconds,
                  1e-6 * n_stored / seconds);
    };
    std::printf("| %s | %.2f M Gaussians, %.1f MB as rows | %.1f MB stored | rows", file.name, 1e-6 * n_stored,
                1e-6 * static_cast<double>(rows_bytes), 1e-6 * static_cast<double>(mapped.bytes().size()));
    rate(decoded.rows_s);
    std::printf(" arrays");
    rate(decoded.arrays_s);
    if (!only_decode) {
      const Seen seen = measure_streaming(file.path, cameras.cameras.front());
      std::printf(" open %.1f ms | first picture %.2f s, %.2f MB | complete %.2f s |", 1e3 * seen.open_s, seen.first_s,
                  seen.first_mb, seen.complete_s);
    }
    std::puts("");
    std::fflush(stdout);
  }
  return 0;
}
