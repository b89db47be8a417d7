// scene.cpp - activation of training parameters, and FP32 arrays of a file when they are first asked for.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/scene.hpp"

#include <tbb/task_arena.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cassert>
#include <cmath>
#include <limits>
#include <mutex>
#include <utility>
#include <vector>

#include "parallel.hpp"
#include "rgs/file.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kMaxGaussians = std::uint64_t{1} << 31;
constexpr std::uint64_t kGrain = 8192;

bool all_finite(const float* values, std::uint64_t n) {
  return std::all_of(values, values + n, [](float v) { return std::isfinite(v); });
}

// Infinite logits are opacities of 1 and 0, and a log-scale of -inf is a scale of 0.
bool drawable(const SplatView& s, std::uint64_t i, std::uint64_t floats) {
  const auto scaled = [](float log_scale) { return log_scale < std::numeric_limits<float>::infinity(); };
  return all_finite(&s.mean[3 * i], 3) && std::all_of(&s.log_scale[3 * i], &s.log_scale[3 * i] + 3, scaled) &&
         all_finite(&s.rotation[4 * i], 4) && !std::isnan(s.opacity_logit[i]) && all_finite(&s.sh[floats * i], floats);
}

Status check(const SplatView& s) {
  if (!s.consistent())
    return make_error(Errc::bad_argument, Error::kNone, "the sizes of the attributes contradict each other");
  if (s.n >= kMaxGaussians) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than the renderer numbers", kMaxGaussians - 1,
                      s.n);
  }
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(s.sh_degree));
  std::atomic<std::uint64_t> first_bad{s.n};
  detail::parallel_ranges(s.n, kGrain, [&](std::uint64_t begin, std::uint64_t end) {
    for (std::uint64_t i = begin; i < end; ++i) {
      if (drawable(s, i, floats)) continue;
      std::uint64_t seen = first_bad.load();
      while (i < seen && !first_bad.compare_exchange_weak(seen, i)) {
      }
      return;
    }
  });
  if (first_bad < s.n) {
    return make_error(
        Errc::bad_value, first_bad,
        "a Gaussian is damaged: NaN, or an infinity that is no opacity; convert with a repair policy first");
  }
  return {};
}

// What a picture takes from them; a file's have been checked by its reader.
Status check(const std::optional<Declarations>& declared) {
  if (!declared) return {};
  const Declarations& d = *declared;
  if (!(d.z_near > 0 && d.z_near < d.z_far && std::isfinite(d.z_far)) ||
      !(d.low_pass_px2 >= 0 && std::isfinite(d.low_pass_px2))) {
    return make_error(Errc::bad_argument, Error::kNone, "a declared depth range or low-pass is not legal");
  }
  if (!std::all_of(d.origin.begin(), d.origin.end(), [](double x) { return std::fabs(x) <= kMaxOrigin; }))
    return make_error(Errc::bad_argument, Error::kNone, "a declared origin is not finite or beyond 10^12");
  return {};
}

void normalize(float* q) {
  const float length = std::hypot(std::hypot(q[0], q[1]), std::hypot(q[2], q[3]));
  if (length > 0 && std::isfinite(length)) {
    for (int k = 0; k < 4; ++k) q[k] /= length;
  } else {
    q[0] = 1, q[1] = q[2] = q[3] = 0;
  }
}

std::uint64_t next_identity() {
  static std::atomic<std::uint64_t> last{0};
  return ++last;
}

// Training parameters to rendered ones, in place.
void activate(SplatCloud& s) {
  detail::parallel_ranges(s.size(), kGrain, [&](std::uint64_t begin, std::uint64_t end) {
    for (std::uint64_t i = begin; i < end; ++i) {
      for (std::uint64_t k = 3 * i; k < 3 * i + 3; ++k) s.log_scale[k] = scale_from_log(s.log_scale[k]);
      normalize(&s.rotation[4 * i]);
      s.opacity_logit[i] = opacity_from_logit(s.opacity_logit[i]);
    }
  });
}

}  // namespace

struct Scene::Storage {
  std::uint64_t identity = next_identity();
  std::uint64_t n = 0;
  int sh_degree = 0;
  std::optional<Declarations> declarations;
  MappedFile file;  // empty if none is kept
  FileView opened;  // `file`

  mutable std::mutex mutex;                   // of all below
  mutable bool is_validated = false;          // `file`, on the host
  mutable std::optional<DirectData> decoded;  // by load(), until somebody needs it
  mutable std::optional<SceneView> arrays;    // of `activated` or `expanded`
  SplatCloud activated;                       // training parameters, activated
  mutable std::unique_ptr<float[]> expanded;  // of a file

  Status describe(const FileView& view);
  Status decode(const FileView& view);
  const Origin& origin() const { return declarations ? declarations->origin : kNoOrigin; }
  // The caller holds the mutex, or is the only one who knows the scene.
  Result<DirectData> take_direct() const;
  Status expand() const;
};

// What the head says.
Status Scene::Storage::describe(const FileView& view) {
  n = view.header().n_gaussians;
  if (n >= kMaxGaussians) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than the renderer numbers", kMaxGaussians - 1,
                      n);
  }
  sh_degree = view.header().sh_degree;
  declarations = view.declarations();
  return {};
}

// Validates.
Status Scene::Storage::decode(const FileView& view) {
  if (const auto ok = describe(view); !ok) return ok;
  auto data = load_direct(view);
  if (!data) return tl::unexpected(data.error());
  decoded = std::move(*data);
  is_validated = true;
  return {};
}

Result<DirectData> Scene::Storage::take_direct() const {
  if (!decoded) {
    auto data = load_direct(opened, {.validate = !is_validated});
    if (data) is_validated = true;
    return data;
  }
  DirectData data = std::move(*decoded);
  decoded.reset();
  return data;
}

Status Scene::Storage::expand() const {
  if (arrays) return {};
  const auto data = take_direct();
  if (!data) return tl::unexpected(data.error());
  const auto sh_floats = static_cast<std::uint64_t>(3 * sh_coefficients(sh_degree));
  // Not cleared: the threads that fill it touch its pages first.
  auto memory = std::make_unique_for_overwrite<float[]>(n * (11 + sh_floats));
  float* const mean = memory.get();
  float* const rotation = mean + 3 * n;
  float* const scale = rotation + 4 * n;
  float* const opacity = scale + 3 * n;
  float* const sh = opacity + n;
  const auto fill = [&](std::uint64_t begin, std::uint64_t end) {
    std::array<ActivatedSplat, 64> buffer;
    for (std::uint64_t first = begin; first < end; first += buffer.size()) {
      const auto part = std::span(buffer).first(std::min<std::uint64_t>(buffer.size(), end - first));
      [[maybe_unused]] const Status read = data->read(first, part);
      assert(read.has_value());  // the file is valid
      for (std::uint64_t k = 0; k < part.size(); ++k) {
        const ActivatedSplat& s = part[k];
        const std::uint64_t i = first + k;
        std::copy_n(s.mean, 3, &mean[3 * i]);
        std::copy_n(s.rotation, 4, &rotation[4 * i]);
        std::copy_n(s.scale, 3, &scale[3 * i]);
        opacity[i] = s.opacity;
        std::copy_n(s.sh, sh_floats, &sh[sh_floats * i]);
      }
    }
  };
  // Isolated: a task of the caller's that this thread took up while it waits might want the mutex.
  tbb::this_task_arena::isolate([&] { detail::parallel_ranges(n, kGrain, fill); });
  expanded = std::move(memory);
  arrays = SceneView{
      n, sh_degree, {mean, 3 * n}, {rotation, 4 * n}, {scale, 3 * n}, {opacity, n}, {sh, sh_floats * n}, origin()};
  return {};
}

Result<Scene> Scene::load(const SplatView& splats, const std::optional<Declarations>& declared) {
  return detail::guard_memory([&]() -> Result<Scene> {
    Status ok = check(splats);
    if (ok) ok = check(declared);
    if (!ok) return tl::unexpected(ok.error());
    const auto copy = [](std::span<const float> s) { return std::vector<float>(s.begin(), s.end()); };
    return adopt({splats.sh_degree, copy(splats.mean), copy(splats.log_scale), copy(splats.rotation),
                  copy(splats.opacity_logit), copy(splats.sh)},
                 declared);
  });
}

Result<Scene> Scene::load(SplatCloud&& splats, const std::optional<Declarations>& declared) {
  return detail::guard_memory([&]() -> Result<Scene> {
    Status ok = check(splats.view());
    if (ok) ok = check(declared);
    if (!ok) return tl::unexpected(ok.error());
    return adopt(std::move(splats), declared);
  });
}

Scene Scene::adopt(SplatCloud splats, const std::optional<Declarations>& declared) {
  activate(splats);
  auto storage = std::make_shared<Storage>();
  storage->n = splats.size();
  storage->sh_degree = splats.sh_degree;
  storage->declarations = declared;
  storage->activated = std::move(splats);
  const SplatCloud& s = storage->activated;
  storage->arrays =
      SceneView{s.size(), s.sh_degree, s.mean, s.rotation, s.log_scale, s.opacity_logit, s.sh, storage->origin()};
  Scene scene;
  scene.storage_ = std::move(storage);
  return scene;
}

Result<Scene> Scene::load(const FileView& file) {
  return detail::guard_memory([&]() -> Result<Scene> {
    auto storage = std::make_shared<Storage>();
    Status ok = storage->decode(file);
    if (ok) ok = storage->expand();
    if (!ok) return tl::unexpected(ok.error());
    Scene scene;
    scene.storage_ = std::move(storage);
    return scene;
  });
}

Result<Scene> Scene::load(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto file = FileView::open(bytes, limits);
  if (!file) return tl::unexpected(file.error());
  return load(*file);
}

Result<Scene> Scene::load(const std::string& path, const DecodeLimits& limits) {
  auto file = MappedFile::open(path);
  if (!file) return tl::unexpected(file.error());
  return load(*std::move(file), limits);
}

Result<Scene> Scene::load(MappedFile&& file, const DecodeLimits& limits) {
  return detail::guard_memory([&]() -> Result<Scene> {
    auto opened = FileView::open(file.bytes(), limits);
    if (!opened) return tl::unexpected(opened.error());
    auto storage = std::make_shared<Storage>();
    if (const auto ok = storage->decode(*opened); !ok) return tl::unexpected(ok.error());
    storage->opened = *std::move(opened);
    storage->file = std::move(file);
    Scene scene;
    scene.storage_ = std::move(storage);
    return scene;
  });
}

Result<Scene> Scene::open(const std::string& path, const DecodeLimits& limits) {
  auto file = MappedFile::open(path);
  if (!file) return tl::unexpected(file.error());
  return open(*std::move(file), limits);
}

Result<Scene> Scene::open(MappedFile&& file, const DecodeLimits& limits) {
  return detail::guard_memory([&]() -> Result<Scene> {
    auto opened = FileView::open(file.bytes(), limits);
    if (!opened) return tl::unexpected(opened.error());
    auto storage = std::make_shared<Storage>();
    if (const auto ok = storage->describe(*opened); !ok) return tl::unexpected(ok.error());
    storage->opened = *std::move(opened);
    storage->file = std::move(file);
    Scene scene;
    scene.storage_ = std::move(storage);
    return scene;
  });
}

std::uint64_t Scene::size() const {
  return storage_ ? storage_->n : 0;
}
int Scene::sh_degree() const {
  return storage_ ? storage_->sh_degree : 0;
}
const std::optional<Declarations>& Scene::declarations() const {
  static const std::optional<Declarations> kNone;
  return storage_ ? storage_->declarations : kNone;
}
const Origin& Scene::origin() const {
  return storage_ ? storage_->origin() : kNoOrigin;
}
std::uint64_t Scene::identity() const {
  return storage_ ? storage_->identity : 0;
}
bool Scene::has_file() const {
  return storage_ && !storage_->file.bytes().empty();
}

const FileView* Scene::file() const {
  return has_file() ? &storage_->opened : nullptr;
}
bool Scene::is_validated() const {
  if (!has_file()) return false;
  const std::scoped_lock lock(storage_->mutex);
  return storage_->is_validated;
}
bool Scene::is_decoded() const {
  if (!has_file()) return false;
  const std::scoped_lock lock(storage_->mutex);
  return storage_->decoded && storage_->opened.coded();
}

std::uint64_t Scene::bytes() const {
  if (!storage_) return 0;
  const std::scoped_lock lock(storage_->mutex);
  std::uint64_t total = 0;
  if (const auto& a = storage_->arrays) {
    for (const auto& array : {a->mean, a->rotation, a->scale, a->opacity, a->sh}) total += array.size_bytes();
  }
  if (const auto& d = storage_->decoded) {
    const FileView& file = d->file();
    if (file.frames(SectionType::means).rows > 0) total += d->means().size();  // 0: not coded, and so not decoded
    if (file.frames(SectionType::geometry).rows > 0) total += d->geometry().size();
    if (file.frames(SectionType::sh).rows > 0) total += d->sh().size();
  }
  return total;
}

Result<SceneView> Scene::view() const {
  if (!storage_) return SceneView();
  return detail::guard_memory([&]() -> Result<SceneView> {
    const std::scoped_lock lock(storage_->mutex);
    if (const auto ok = storage_->expand(); !ok) return tl::unexpected(ok.error());
    return *storage_->arrays;
  });
}

Result<DirectData> Scene::direct() const {
  if (!has_file()) return make_error(Errc::bad_argument, Error::kNone, "the scene keeps no file");
  return detail::guard_memory([&] {
    const std::scoped_lock lock(storage_->mutex);
    return storage_->take_direct();
  });
}

}  // namespace rgs
