// scene.cpp - activates training parameters, and makes FP32 arrays of a file on first use.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/scene.hpp"

#include <tbb/task_arena.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cassert>
#include <cmath>
#include <limits>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

#include "each_gaussian.hpp"
#include "parallel.hpp"
#include "rgs/activate.hpp"
#include "rgs/file.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/quantize.hpp"
#include "rgs/subject_box.hpp"
#include "splat_arrays.hpp"
#include "stream/streamed_state.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kMaxGaussians = std::uint64_t{1} << 31;
constexpr std::uint64_t kGrain = 8192;

// Of activated attributes; log_scale holds scales, opacity_logit opacities.
bool activated_drawable(const SplatView& s, std::uint64_t i, std::uint64_t floats) {
  const auto legal = [](float scale) { return scale >= 0 && std::isfinite(scale); };
  return detail::all_finite(&s.mean[3 * i], 3) && std::all_of(&s.log_scale[3 * i], &s.log_scale[3 * i] + 3, legal) &&
         detail::all_finite(&s.rotation[4 * i], 4) && s.opacity_logit[i] >= 0 && s.opacity_logit[i] <= 1 &&
         detail::all_finite(&s.sh[floats * i], floats);
}

using Drawable = bool(const SplatView& s, std::uint64_t i, std::uint64_t floats);

Status check(const SplatView& s, Drawable& is_drawable, const char* damage) {
  if (!s.consistent())
    return make_error(Errc::bad_argument, Error::kNone, "the sizes of the attributes contradict each other");
  if (s.n >= kMaxGaussians) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than the renderer can index",
                      kMaxGaussians - 1, s.n);
  }
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(s.sh_degree));
  std::atomic<std::uint64_t> first_bad{s.n};
  detail::parallel_ranges(s.n, kGrain, [&](std::uint64_t begin, std::uint64_t end) {
    for (std::uint64_t i = begin; i < end; ++i) {
      if (is_drawable(s, i, floats)) continue;
      std::uint64_t seen = first_bad.load();
      while (i < seen && !first_bad.compare_exchange_weak(seen, i)) {
      }
      return;
    }
  });
  if (first_bad < s.n) return make_error(Errc::bad_value, first_bad, damage);
  return {};
}

Status check(const SplatView& s) {
  return check(s, detail::is_drawable, detail::kNotDrawable);
}

// What a picture uses of them; a file's have been checked by its reader.
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

// FP16 in a file changes the norm as much.
bool is_unit(const float* q) {
  double squared = 0;
  for (int k = 0; k < 4; ++k) squared += static_cast<double>(q[k]) * static_cast<double>(q[k]);
  return std::fabs(squared - 1) <= kUnitNormTolerance;
}

std::uint64_t next_identity() {
  static std::atomic<std::uint64_t> last{0};
  return ++last;
}

// Training parameters to activated ones, in place.
void activate(SplatCloud& s) {
  detail::parallel_ranges(s.size(), kGrain, [&](std::uint64_t begin, std::uint64_t end) {
    for (std::uint64_t i = begin; i < end; ++i) detail::activate(s, i);
  });
}

using Arrays = detail::SplatArrays;

// Copies the rows of these pages, page after page.
void gather(const Arrays& to, const Arrays& from, const std::vector<lod::Page>& pages,
            std::span<const std::uint32_t> chosen) {
  std::vector<std::uint64_t> first;
  std::uint64_t end = 0;
  for (const std::uint32_t page : chosen) first.push_back(std::exchange(end, end + pages[page].count));
  detail::parallel_ranges(chosen.size(), 16, [&](std::uint64_t begin, std::uint64_t last) {
    for (std::uint64_t k = begin; k < last; ++k) {
      const std::uint64_t at = pages[chosen[k]].first, count = pages[chosen[k]].count, i = first[k];
      std::copy_n(&from.mean[3 * at], 3 * count, &to.mean[3 * i]);
      std::copy_n(&from.rotation[4 * at], 4 * count, &to.rotation[4 * i]);
      std::copy_n(&from.scale[3 * at], 3 * count, &to.scale[3 * i]);
      std::copy_n(&from.opacity[at], count, &to.opacity[i]);
      std::copy_n(&from.sh[from.sh_floats * at], from.sh_floats * count, &to.sh[to.sh_floats * i]);
    }
  });
}

// Gaussians first .. first + n - 1.
SceneView view_of(const Arrays& a, std::uint64_t first, std::uint64_t n, int sh_degree, const Origin& origin) {
  return {n,
          sh_degree,
          {a.mean + 3 * first, 3 * n},
          {a.rotation + 4 * first, 4 * n},
          {a.scale + 3 * first, 3 * n},
          {a.opacity + first, n},
          {a.sh + a.sh_floats * first, a.sh_floats * n},
          origin};
}

}  // namespace

struct Scene::Storage {
  std::uint64_t identity = next_identity();
  std::uint64_t n = 0;
  int sh_degree = 0;
  std::optional<Declarations> declarations;
  MappedFile file;  // empty if no file is kept
  FileView opened;  // `file`, without levels of detail

  // For a file with levels of detail; its bytes are `file` or `copy`.
  std::vector<std::byte> copy;
  std::optional<PagedFile> levels;
  std::shared_ptr<detail::StreamedState> streamed;  // nothing else is used then

  mutable std::mutex mutex;                   // of all below
  mutable bool is_validated = false;          // `file`, on the host
  mutable std::optional<DirectData> decoded;  // by load(), until first needed
  mutable std::optional<SceneView> arrays;    // of `activated` or `expanded`
  SplatCloud activated;                       // training parameters, activated
  mutable std::unique_ptr<float[]> expanded;  // of a file
  mutable std::unique_ptr<float[]> paged;     // of all present pages of `levels`, array after array
  mutable std::uint64_t n_paged = 0;

  Status describe(const FileView& view);
  Status decode(const FileView& view);
  const Origin& origin() const { return declarations ? declarations->origin : kNoOrigin; }
  // The caller holds the mutex or is the scene's only user.
  Result<DirectData> take_direct() const;
  Status expand() const;
  Status expand_pages() const;
  Status expand_leaves() const;
  std::vector<std::uint32_t> finest_present() const;
  SceneView view_of_pages(std::uint64_t first, std::uint64_t count) const {
    return view_of(Arrays(paged.get(), n_paged, sh_degree), first, count, sh_degree, origin());
  }
  Status open_levels(const DecodeLimits& limits, std::span<const std::byte> bytes);
};

// Takes size, SH degree and declarations from the head.
Status Scene::Storage::describe(const FileView& view) {
  n = view.header().n_gaussians;
  if (n >= kMaxGaussians) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than the renderer can index",
                      kMaxGaussians - 1, n);
  }
  sh_degree = view.header().sh_degree;
  declarations = view.declarations();
  return {};
}

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
  if (levels) return expand_leaves();
  const auto data = take_direct();
  if (!data) return tl::unexpected(data.error());
  auto memory = Arrays::memory(n, sh_degree);
  const Arrays to(memory.get(), n, sh_degree);
  const auto fill = [&](std::uint64_t begin, std::uint64_t end) {
    std::array<ActivatedSplat, 64> buffer;
    for (std::uint64_t first = begin; first < end; first += buffer.size()) {
      const auto part = std::span(buffer).first(std::min<std::uint64_t>(buffer.size(), end - first));
      [[maybe_unused]] const Status read = data->read(first, part);
      assert(read.has_value());  // the file is valid
      for (std::uint64_t k = 0; k < part.size(); ++k) to.set(first + k, part[k]);
    }
  };
  // Isolated: this waiting thread could otherwise take up a task of the caller's that wants the mutex.
  tbb::this_task_arena::isolate([&] { detail::parallel_ranges(n, kGrain, fill); });
  expanded = std::move(memory);
  arrays = view_of(to, 0, n, sh_degree, origin());
  return {};
}

// A file with levels of detail, or a prefix of it, whose finest pages then stand for the leaves.
Status Scene::Storage::open_levels(const DecodeLimits& limits, std::span<const std::byte> bytes) {
  auto paged_file = PagedFile::open(bytes, limits);
  if (!paged_file) return tl::unexpected(paged_file.error());
  levels = *std::move(paged_file);
  if (const auto ok = describe(levels->head()); !ok) return ok;
  if (levels->n_present() == 0) {
    return make_error(Errc::pages_missing, bytes.size(), "the end of the file is missing, and with it all pages");
  }
  if (levels->n_present() == levels->n_pages()) return {};
  n = 0;
  for (const std::uint32_t page : finest_present()) n += levels->pages()[page].count;
  return {};
}

std::vector<std::uint32_t> Scene::Storage::finest_present() const {
  return lod::drawn_pages(levels->pages(), {}, 0, levels->n_present());
}

// Leaves are the last pages; the finest pages of a prefix may be any of those present.
Status Scene::Storage::expand_leaves() const {
  if (const auto ok = expand_pages(); !ok) return ok;
  if (levels->n_present() == levels->n_pages()) {
    arrays = view_of_pages(n_paged - n, n);
    return {};
  }
  expanded = Arrays::memory(n, sh_degree);
  const Arrays to(expanded.get(), n, sh_degree);
  gather(to, Arrays(paged.get(), n_paged, sh_degree), levels->pages(), finest_present());
  arrays = view_of(to, 0, n, sh_degree, origin());
  return {};
}

Status Scene::Storage::expand_pages() const {
  if (paged) return {};
  const std::uint32_t n_present = levels->n_present();
  std::uint64_t rows = 0;
  for (std::uint32_t page = 0; page < n_present; ++page) rows += levels->pages()[page].count;
  auto memory = Arrays::memory(rows, sh_degree);
  const Arrays to(memory.get(), rows, sh_degree);
  std::mutex failing;
  Status status;
  std::uint32_t failed = n_present;  // the first damaged page, whichever thread finds one first
  const auto decode = [&](std::uint64_t begin, std::uint64_t end) {
    PageDecoder decoder(*levels);
    const detail::PageMemory page_memory(levels->largest_decoded_bytes());
    for (auto page = static_cast<std::uint32_t>(begin); page < end; ++page) {
      const auto page_rows = decoder.decode(page, levels->bytes(page), page_memory.first(levels->decoded_bytes(page)));
      const Status ok = page_rows ? to.set_page(*levels, page, *page_rows, levels->pages()[page].first)
                                  : Status(tl::unexpected(page_rows.error()));
      if (ok) continue;
      const std::scoped_lock lock(failing);
      if (page < failed) failed = page, status = ok;
      return;
    }
  };
  tbb::this_task_arena::isolate([&] { detail::parallel_ranges(n_present, 4, decode); });
  if (!status) return status;
  paged = std::move(memory);
  n_paged = rows;
  return {};
}

Result<Scene> Scene::load(const SplatView& splats, const std::optional<Declarations>& declared) {
  return detail::guard_memory([&]() -> Result<Scene> {
    Status ok = check(splats);
    if (ok) ok = check(declared);
    if (!ok) return tl::unexpected(ok.error());
    const auto copy = [](std::span<const float> s) { return std::vector<float>(s.begin(), s.end()); };
    SplatCloud cloud{splats.sh_degree,      copy(splats.mean),          copy(splats.log_scale),
                     copy(splats.rotation), copy(splats.opacity_logit), copy(splats.sh)};
    activate(cloud);
    return adopt(std::move(cloud), declared);
  });
}

Result<Scene> Scene::load(SplatCloud&& splats, const std::optional<Declarations>& declared) {
  return detail::guard_memory([&]() -> Result<Scene> {
    Status ok = check(splats.view());
    if (ok) ok = check(declared);
    if (!ok) return tl::unexpected(ok.error());
    activate(splats);
    return adopt(std::move(splats), declared);
  });
}

Result<Scene> Scene::load(const SceneView& activated, const std::optional<Declarations>& declared) {
  return detail::guard_memory([&]() -> Result<Scene> {
    const SplatView splats{activated.n,        activated.sh_degree, activated.mean, activated.scale,
                           activated.rotation, activated.opacity,   activated.sh};
    Status ok =
        check(splats, activated_drawable,
              "a Gaussian is damaged: a value that is not finite, a scale below 0 or an opacity outside 0 to 1");
    if (ok) ok = check(declared);
    if (!ok) return tl::unexpected(ok.error());
    const auto copy = [](std::span<const float> s) { return std::vector<float>(s.begin(), s.end()); };
    SplatCloud cloud{splats.sh_degree,      copy(splats.mean),          copy(splats.log_scale),
                     copy(splats.rotation), copy(splats.opacity_logit), copy(splats.sh)};
    for (std::size_t i = 0; i < cloud.rotation.size(); i += 4) {
      if (!is_unit(&cloud.rotation[i])) detail::normalize_rotation(&cloud.rotation[i]);
    }
    return adopt(std::move(cloud), declared);
  });
}

Scene Scene::adopt(SplatCloud activated, const std::optional<Declarations>& declared) {
  auto storage = std::make_shared<Storage>();
  storage->n = activated.size();
  storage->sh_degree = activated.sh_degree;
  storage->declarations = declared;
  storage->activated = std::move(activated);
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
  if (has_levels(bytes)) {
    return detail::guard_memory([&]() -> Result<Scene> {
      auto storage = std::make_shared<Storage>();
      storage->copy.assign(bytes.begin(), bytes.end());
      Status ok = storage->open_levels(limits, storage->copy);
      if (ok) ok = validate(*storage->levels);
      if (!ok) return tl::unexpected(ok.error());
      Scene scene;
      scene.storage_ = std::move(storage);
      return scene;
    });
  }
  const auto file = FileView::open(bytes, limits);
  if (!file) return tl::unexpected(file.error());
  return load(*file);
}

Result<Scene> Scene::load(const std::string& path, const DecodeLimits& limits) {
  auto file = MappedFile::open(path);
  if (!file) return tl::unexpected(file.error());
  return load(*std::move(file), limits);
}

Result<Scene> Scene::open_levels(MappedFile&& file, const DecodeLimits& limits) {
  auto storage = std::make_shared<Storage>();
  storage->file = std::move(file);
  if (const auto ok = storage->open_levels(limits, storage->file.bytes()); !ok) return tl::unexpected(ok.error());
  Scene scene;
  scene.storage_ = std::move(storage);
  return scene;
}

Result<Scene> Scene::load(MappedFile&& file, const DecodeLimits& limits) {
  return detail::guard_memory([&]() -> Result<Scene> {
    if (has_levels(file.bytes())) {
      auto scene = open_levels(std::move(file), limits);
      if (!scene) return scene;
      if (const Status ok = validate(*scene->levels()); !ok) return tl::unexpected(ok.error());
      return scene;
    }
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

Result<Scene> Scene::open(MappedFile&& file, const DecodeLimits& limits) {
  return detail::guard_memory([&]() -> Result<Scene> {
    if (has_levels(file.bytes())) return open_levels(std::move(file), limits);
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

Scene::Scene(std::shared_ptr<detail::StreamedState> state) {
  auto storage = std::make_shared<Storage>();
  storage->n = state->file->head().header().n_gaussians;
  storage->sh_degree = state->file->head().header().sh_degree;
  storage->declarations = state->file->head().declarations();
  storage->streamed = std::move(state);
  storage_ = std::move(storage);
}

const std::shared_ptr<detail::StreamedState>& Scene::streamed() const {
  static const std::shared_ptr<detail::StreamedState> kNone;
  return storage_ ? storage_->streamed : kNone;
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
  return storage_ && !storage_->levels && !storage_->file.bytes().empty();
}

const PagedFile* Scene::levels() const {
  return storage_ && storage_->levels ? &*storage_->levels : nullptr;
}

Result<SceneView> Scene::all_pages() const {
  if (levels() == nullptr) return make_error(Errc::bad_argument, Error::kNone, "the scene has no levels of detail");
  return detail::guard_memory([&]() -> Result<SceneView> {
    const std::scoped_lock lock(storage_->mutex);
    if (const auto ok = storage_->expand_pages(); !ok) return tl::unexpected(ok.error());
    return storage_->view_of_pages(0, storage_->n_paged);
  });
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
    // The leaves are part of all pages.
    const bool is_paged = storage_->paged && !storage_->expanded;
    for (const auto& array : {a->mean, a->rotation, a->scale, a->opacity, a->sh})
      total += is_paged ? 0 : array.size_bytes();
  }
  total += storage_->copy.size() +
           storage_->n_paged * sizeof(float) * static_cast<std::uint64_t>(11 + 3 * sh_coefficients(sh_degree()));
  if (const auto& d = storage_->decoded) {
    const FileView& file = d->file();
    if (file.frames(SectionType::means).rows > 0) total += d->means().size();  // 0 rows: not coded, so not decoded
    if (file.frames(SectionType::geometry).rows > 0) total += d->geometry().size();
    if (file.frames(SectionType::sh).rows > 0) total += d->sh().size();
  }
  return total;
}

Result<SceneView> Scene::view() const {
  if (!storage_) return SceneView();
  if (is_streamed())
    return make_error(Errc::bad_argument, Error::kNone, "a streamed scene has no arrays: open it without a pool");
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

Result<SceneBounds> subject_bounds(const Scene& scene) {
  if (scene.is_streamed()) return scene.streamed()->subject;
  if (!scene.has_file()) {
    const auto view = scene.view();
    if (!view) return tl::unexpected(view.error());
    return placed(subject_box(view->mean, view->opacity), view->origin);
  }
  // The FP32 arrays of a file take many times as much as these.
  std::vector<float> mean, opacity;
  mean.reserve(3 * scene.size());
  opacity.reserve(scene.size());
  const auto add = [&](const ActivatedSplat& splat) {
    mean.insert(mean.end(), splat.mean, splat.mean + 3);
    opacity.push_back(splat.opacity);
  };
  if (const Status s = each_gaussian(*scene.file(), add); !s) return tl::unexpected(s.error());
  return placed(subject_box(mean, opacity), scene.origin());
}

}  // namespace rgs
