// streamed_fixture.hpp - a town of boxes as a file with levels of detail, sources that misbehave, and flying cameras.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <glm/gtc/matrix_transform.hpp>
#include <memory>
#include <mutex>
#include <span>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "await.hpp"
#include "renderer_fixture.hpp"
#include "rgs/byte_source.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/scene.hpp"
#include "trivial_levels.hpp"

namespace rgs::test {

using Bytes = std::vector<std::byte>;

struct TownOptions {
  Profile profile = Profile::direct;
  int n = 20000;
  int sh_degree = 1;
  std::uint32_t page_chunks = 4;  // of 32
  unsigned seed = 17;
  bool has_large = true;
};

/// Gaussians on a ground of 40 x 40, most small, some as large as a house, a few larger than the town, in pages of a
/// few chunks of 32.
inline Bytes town(const TownOptions& o = {}) {
  Random random(o.seed);
  std::vector<Splat> splats;
  for (int i = 0; i < o.n; ++i) {
    Splat s =
        splat_at(random.uniform(-20, 20), random.uniform(0, 4), random.uniform(-20, 20), 1, random.uniform(0.1, 0.995));
    const double largest = !o.has_large ? 0.01 : i % 2000 == 0 ? 60 : i % 100 == 0 ? 6 : 0.4;
    for (float& log_scale : s.log_scale) log_scale = static_cast<float>(std::log(random.log_uniform(0.005, largest)));
    const auto q = cast<float>(random.rotation());
    s.rotation[0] = q.w, s.rotation[1] = q.x, s.rotation[2] = q.y, s.rotation[3] = q.z;
    for (int k = 0; k < 48; ++k) s.sh[k] = static_cast<float>(random.uniform(-1, 1) * (k < 3 ? 1.5 : 0.2));
    splats.push_back(s);
  }
  EncodeOptions options;
  options.chunk_size = 32;
  options.profile = Profile::direct;
  const auto plain = encode(cloud_of(splats, o.sh_degree).view(), options);
  REQUIRE(plain);
  auto cloud = decode(*plain);
  REQUIRE(cloud);
  options.profile = o.profile;
  options.order = Order::morton;
  lod::Levels levels = trivial_levels(*cloud, {.chunk_size = 32, .page_chunks = o.page_chunks});
  for (lod::Page& page : levels.pages) page.error *= 20;  // some of each level in every picture
  Bytes bytes;
  REQUIRE(write_levels(levels, options, bytes));
  return bytes;
}

/// Seconds, for waits that end by themselves.
inline constexpr double kLong = 1e7;

/// Bytes in memory, with faults of a source.
struct Script {
  std::atomic<int> delay_us{0};                                         ///< of each read
  std::atomic<int> fails_every{0};                                      ///< n: each n-th read is read_failed
  std::atomic<bool> fails{false};                                       ///< all reads are
  std::atomic<int> fails_next{0};                                       ///< this many reads are
  std::atomic<std::uint64_t> gone_from{0}, gone_to{0};                  ///< unreadable bytes
  std::atomic<bool> is_shut{false};                                     ///< reads wait
  std::atomic<std::uint64_t> shut_from{0}, shut_to{~std::uint64_t{0}};  ///< except those with none of these bytes
  std::atomic<std::uint64_t> flip_from{0}, flip_to{0};                  ///< bytes that arrive flipped
  std::atomic<bool> flips_once{false};                                  ///< only their first read
  std::atomic<int> n_reads{0}, n_at_once{0}, most_at_once{0}, n_flipped{0};
  std::atomic<std::uint64_t> n_bytes{0};
  std::mutex mutex;
  std::condition_variable opened;
  bool is_cancelled = false;
  int n_held = 0, n_allowed = 0;  // waiting reads; those that may go on

  std::vector<double> limits;  ///< of set_limit()
  /// Lets a waiting read go on, if there is one.
  void let_one_go() {
    const std::scoped_lock lock(mutex);
    if (n_allowed < n_held) ++n_allowed;
    opened.notify_all();
  }
  void open_gate() {
    const std::scoped_lock lock(mutex);
    is_shut = false;
    opened.notify_all();
  }
};

class ScriptedSource final : public ByteSource {
 public:
  ScriptedSource(std::span<const std::byte> bytes, std::shared_ptr<Script> script, Traits traits = {})
      : bytes_(bytes), script_(std::move(script)), traits_(traits) {}
  std::uint64_t size() const override { return bytes_.size(); }
  Status read(std::uint64_t offset, std::span<std::byte> out) override {
    Script& s = *script_;
    const int now = ++s.n_at_once;
    for (int most = s.most_at_once; now > most && !s.most_at_once.compare_exchange_weak(most, now);) {
    }
    const Status done = read_now(s, offset, out);
    --s.n_at_once;
    return done;
  }
  void cancel() noexcept override {
    const std::scoped_lock lock(script_->mutex);
    script_->is_cancelled = true;
    script_->opened.notify_all();
  }
  void set_limit(double seconds) override { script_->limits.push_back(seconds); }
  Traits traits() const override { return traits_; }

 private:
  Status read_now(Script& s, std::uint64_t offset, std::span<std::byte> out) {
    const int number = ++s.n_reads;
    s.n_bytes += out.size();
    {
      std::unique_lock lock(s.mutex);
      const bool is_free = offset >= s.shut_to || offset + out.size() <= s.shut_from;
      ++s.n_held;
      s.opened.wait(lock, [&] { return is_free || !s.is_shut || s.n_allowed > 0 || s.is_cancelled; });
      --s.n_held;
      if (s.is_cancelled) return make_error(Errc::cancelled, offset, "cancelled");
      if (s.is_shut && !is_free) --s.n_allowed;
    }
    if (s.delay_us > 0) std::this_thread::sleep_for(std::chrono::microseconds(s.delay_us));
    if (s.fails || (s.fails_every > 0 && number % s.fails_every == 0))
      return make_error(Errc::read_failed, offset, "the test's source fails");
    for (int n = s.fails_next; n > 0;) {
      if (s.fails_next.compare_exchange_weak(n, n - 1))
        return make_error(Errc::read_failed, offset, "the test's source fails a few times");
    }
    if (offset < s.gone_to && offset + out.size() > s.gone_from)
      return make_error(Errc::read_failed, offset, "the test's source has lost a range");
    if (offset > bytes_.size() || out.size() > bytes_.size() - offset)
      return make_error(Errc::read_failed, offset, "beyond the end");
    std::copy_n(bytes_.begin() + static_cast<std::ptrdiff_t>(offset), out.size(), out.begin());
    const std::uint64_t from = std::max<std::uint64_t>(s.flip_from, offset),
                        to = std::min<std::uint64_t>(s.flip_to, offset + out.size());
    if (from < to && !(s.flips_once && s.n_flipped > 0)) {
      ++s.n_flipped;
      for (std::uint64_t at = from; at < to; ++at) out[at - offset] ^= std::byte{0x40};
    }
    return {};
  }
  std::span<const std::byte> bytes_;
  std::shared_ptr<Script> script_;
  Traits traits_;
};

struct Streaming {
  std::uint64_t memory = std::uint64_t{256} << 20;
  std::optional<StreamPool> pool = {};
  bool prefetch = true;
  ByteSource::Traits traits = {};
};

inline Result<Scene> try_streaming(const Bytes& bytes, std::shared_ptr<Script> script, const Streaming& o = {}) {
  OpenOptions options;
  options.prefetch = o.prefetch;
  options.pool = o.pool;
  if (!options.pool) {
    auto pool = StreamPool::create({.host_memory = o.memory});
    REQUIRE(pool);
    options.pool = *pool;
  }
  return Scene::open(std::make_unique<ScriptedSource>(bytes, std::move(script), o.traits), options);
}
inline Scene streamed(const Bytes& bytes, std::shared_ptr<Script> script = std::make_shared<Script>(),
                      const Streaming& o = {}) {
  auto scene = try_streaming(bytes, std::move(script), o);
  if (!scene) MESSAGE(std::string(scene.error().what), " ", scene.error().expected);
  REQUIRE(scene);
  return *std::move(scene);
}

inline Scene whole(const Bytes& bytes) {
  auto scene = Scene::load(bytes);
  REQUIRE(scene);
  return *std::move(scene);
}

inline Renderer cpu_renderer(int threads = 0) {
  auto renderer = Renderer::create({.backend = Backend::cpu, .threads = threads});
  REQUIRE(renderer);
  return *std::move(renderer);
}

/// Looks at `target` from `eye`; y is up.
inline Camera camera_at(const glm::dvec3& eye, const glm::dvec3& target, int width = 96, int height = 64) {
  auto camera = make_camera(glm::lookAt(eye, target, glm::dvec3(0, 1, 0)),
                            {width, height, 0.9 * width, 0.9 * width, width / 2.0, height / 2.0}, CameraAxes::opengl);
  REQUIRE(camera);
  return *camera;
}

/// Over, in and far from the town.
inline std::vector<Camera> town_cameras(unsigned seed, int n) {
  Random random(seed);
  std::vector<Camera> cameras;
  for (int i = 0; i < n; ++i) {
    const double far = i % 4 == 0 ? 80 : 20;
    const glm::dvec3 eye(random.uniform(-far, far), random.uniform(0.5, i % 4 == 1 ? 40 : 5),
                         random.uniform(-far, far));
    cameras.push_back(camera_at(eye, {random.uniform(-20, 20), random.uniform(-2, 6), random.uniform(-20, 20)}));
  }
  return cameras;
}

inline RenderOptions at_detail(float px) {
  RenderOptions options;
  options.detail_px = px;
  return options;
}

/// Of a streamed scene, a frame of the resident pages.
inline Frame draw(Renderer& renderer, const Scene& scene, const Camera& camera, const RenderOptions& options = {}) {
  Frame frame = Frame::of(camera);
  const auto stats = renderer.render(scene, camera, frame.target(), options);
  REQUIRE(stats);
  frame.stats = *stats;
  return frame;
}

inline bool is_same_picture(const Frame& a, const Frame& b) {
  return a.rgb == b.rgb && a.alpha == b.alpha && a.depth == b.depth && a.blended == b.blended;
}

}  // namespace rgs::test
