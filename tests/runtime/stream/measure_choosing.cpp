// measure_choosing.cpp - pages per second that a streamed scene's threads choose and commit when reading and decoding
// only sleep: what the pool's lock, the order of wants and waiting for ancestors leave of the cores. Prints figures of
// docs/records/EXPERIMENTS.md.
// SPDX-License-Identifier: Apache-2.0
//
//   rgs_measure_choosing GAUSSIANS US_A_PAGE THREADS...
//
// Pages have 32 Gaussians, so that decoding takes next to no time.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <glm/gtc/matrix_transform.hpp>
#include <memory>
#include <mutex>
#include <random>
#include <span>
#include <thread>
#include <vector>

#include "render_options.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/levels_writer.hpp"
#include "stream/streamed_state.hpp"
#include "trivial_levels.hpp"
#include "value_or_stop.hpp"

namespace {

using namespace rgs;
using test::value_or_stop;
using Clock = std::chrono::steady_clock;
using Bytes = std::vector<std::byte>;

constexpr float kDetail = 0.5F;                           // px
constexpr int kTurns = 3;                                 // the best counts
constexpr auto kFrame = std::chrono::microseconds(2500);  // a renderer's frame time

/// A ground of 400 x 400 with `n` Gaussians.
Bytes make_town(int n) {
  std::mt19937 random(1);
  const auto uniform = [&](double low, double high) {
    return static_cast<float>(low + (high - low) * static_cast<double>(random()) / 4294967296.0);
  };
  SplatCloud cloud;
  cloud.resize(static_cast<std::uint64_t>(n), 0);
  for (int i = 0; i < n; ++i) {
    Splat s{};
    s.mean[0] = uniform(-200, 200), s.mean[1] = uniform(0, 4), s.mean[2] = uniform(-200, 200);
    s.rotation[0] = 1;
    for (float& log_scale : s.log_scale) log_scale = uniform(-5, -3);
    cloud.set(static_cast<std::uint64_t>(i), s);
  }
  EncodeOptions options;
  options.chunk_size = 32;
  options.profile = Profile::direct;
  options.order = Order::morton;
  const auto plain = value_or_stop(encode(cloud.view(), options), "encode");
  lod::Levels levels =
      test::trivial_levels(value_or_stop(decode(plain), "decode"), {.chunk_size = 32, .page_chunks = 1});
  for (lod::Page& page : levels.pages) page.error *= 100;  // most leaves are wanted
  Bytes bytes;
  value_or_stop(write_levels(levels, options, bytes), "levels");
  return bytes;
}

/// Sleeps for each byte of a page.
class SlowSource final : public ByteSource {
 public:
  SlowSource(std::span<const std::byte> bytes, std::uint64_t first_page, double us_a_byte, Traits traits)
      : bytes_(bytes), first_page_(first_page), us_a_byte_(us_a_byte), traits_(traits) {}
  std::uint64_t size() const override { return bytes_.size(); }
  Status read(std::uint64_t offset, std::span<std::byte> out) override {
    if (offset >= first_page_) {
      std::this_thread::sleep_for(
          std::chrono::duration<double, std::micro>(us_a_byte_ * static_cast<double>(out.size())));
    }
    std::copy_n(bytes_.begin() + static_cast<std::ptrdiff_t>(offset), out.size(), out.begin());
    return {};
  }
  void cancel() noexcept override {}
  Traits traits() const override { return traits_; }

 private:
  std::span<const std::byte> bytes_;
  std::uint64_t first_page_;
  double us_a_byte_;
  Traits traits_;
};

Camera camera_at(const glm::dvec3& eye, const glm::dvec3& target) {
  return value_or_stop(make_camera(glm::lookAt(eye, target, glm::dvec3(0, 1, 0)), {1920, 1080, 1600, 1600, 960, 540},
                                   CameraAxes::opengl),
                       "camera");
}

struct Arrival {
  double ms = 1e9, pages = 0;
};

// Until a view is complete: waiting, or frame by frame.
Arrival arrive(const std::shared_ptr<detail::StreamedState>& state, const Camera& camera, float detail_px, bool waits) {
  const auto settings = value_or_stop(detail::resolve(detail::with_levels({.detail_px = detail_px}, detail_px),
                                                      state->file->head().declarations(), Backend::cpu),
                                      "settings");
  const detail::StreamRule rule{settings, state->file->head().declarations().origin,
                                state->file->head().declarations().z_near, detail_px};
  const auto resident = [&] {
    const std::scoped_lock lock(state->pool->mutex);
    return static_cast<double>(state->residency().n_resident());
  };
  const double before = resident();
  const auto began = Clock::now();
  for (;;) {
    const auto frame = value_or_stop(detail::StreamFrame::begin(state, 1, camera, rule), "frame");
    if (frame.cut().missing == 0) break;
    if (waits) {
      if (!value_or_stop(detail::refine_view(*state, 1, camera, rule, 600), "refine")) std::exit(1);
    } else {
      std::this_thread::sleep_for(kFrame);
    }
  }
  return {std::chrono::duration<double, std::milli>(Clock::now() - began).count(), resident() - before};
}

}  // namespace

int main(int argc, char** argv) {
  const int n = argc < 4 ? 0 : std::atoi(argv[1]);
  const double us_a_page = argc < 4 ? -1 : std::atof(argv[2]);
  if (n <= 0 || us_a_page < 0) {
    std::fputs("usage: rgs_measure_choosing GAUSSIANS US_A_PAGE THREADS...\n", stderr);
    return 2;
  }
  const Bytes bytes = make_town(n);
  const auto file = value_or_stop(PagedFile::open(bytes), "file");
  const double page_bytes = static_cast<double>(file.stored(file.n_pages() - 2).stored_bytes);
  const Camera over = camera_at({0, 120, 260}, {0, 0, 0}), inside = camera_at({40, 3, 40}, {140, 0, 160});
  std::puts("| threads | opening: pages, ms, of what the sleeps allow | jump | with frames: opening | jump |");
  for (int i = 3; i < argc; ++i) {
    const int n_threads = std::atoi(argv[i]);
    std::printf("| %d |", n_threads);
    for (const bool waits : {true, false}) {
      OpenOptions options;
      options.prefetch = false;
      Arrival opening, jump;
      for (int turn = 0; turn < kTurns; ++turn) {
        const auto pool = std::make_shared<detail::StreamPoolState>(std::uint64_t{8} << 30);
        const ByteSource::Traits traits{
            .reads_at_once = n_threads,
            .most_bytes = static_cast<std::uint64_t>(36 * page_bytes),  // as for a file of large pages
            .gap_bytes = static_cast<std::uint64_t>(page_bytes)};
        const auto state = value_or_stop(
            detail::StreamedState::open(
                std::make_unique<SlowSource>(bytes, file.stored(0).offset, us_a_page / page_bytes, traits), options,
                pool),
            "open");
        const auto better = [](Arrival& best, const Arrival& now) { best = now.ms < best.ms ? now : best; };
        arrive(state, inside, 1e9F, true);  // reads the table
        better(opening, arrive(state, inside, kDetail, waits));
        better(jump, arrive(state, over, kDetail, waits));
      }
      for (const Arrival& arrival : {opening, jump}) {
        std::printf(" %.0f, %.1f, %.0f%% |", arrival.pages, arrival.ms,
                    100 * arrival.pages * us_a_page / (1e3 * n_threads * arrival.ms));
      }
    }
    std::puts("");
    std::fflush(stdout);
  }
  return 0;
}
