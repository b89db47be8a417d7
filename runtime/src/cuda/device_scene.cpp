// device_scene.cpp - uploads scenes: FP32 attributes, or a file's sections or pages in their direct layout.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/device_scene.hpp"

#include <array>
#include <chrono>
#include <memory>
#include <span>

#include "cuda/file_upload.hpp"
#include "cuda/page_upload.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

using detail::device_status;
using detail::SceneStorage;

using Clock = std::chrono::steady_clock;

constexpr std::uint64_t kMaxGaussians = std::uint64_t{1} << 31;

double ms_since(Clock::time_point start) {
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

Status check_size(std::uint64_t n) {
  if (n < kMaxGaussians) return {};
  return make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than the renderer can index", kMaxGaussians - 1,
                    n);
}

Status check(const SceneView& s) {
  if (const auto ok = check_size(s.n); !ok) return ok;
  if (s.sh_degree < 0 || s.sh_degree > kMaxShDegree) {
    return make_error(Errc::bad_argument, Error::kNone, "the SH degree is not 0..3");
  }
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(s.sh_degree));
  if (s.mean.size() != 3 * s.n || s.rotation.size() != 4 * s.n || s.scale.size() != 3 * s.n ||
      s.opacity.size() != s.n || s.sh.size() != floats * s.n) {
    return make_error(Errc::bad_argument, Error::kNone, "the sizes of the attributes contradict each other");
  }
  return {};
}

using Sections = std::array<std::span<const std::byte>, 5>;
using Places = detail::SectionPlaces;

// Places each section at a multiple of 256 bytes of one allocation.
Result<Places> place_sections(const std::array<std::uint64_t, 5>& sizes, SceneStorage& storage,
                              const UploadOptions& options) {
  const auto aligned = [](std::uint64_t bytes) { return (bytes + 255) / 256 * 256; };
  const auto memory = detail::DeviceMemory::create(options.allocator);
  if (!memory) return tl::unexpected(memory.error());
  std::uint64_t total = 0;
  for (const std::uint64_t bytes : sizes) total += aligned(bytes);
  const Status ok = storage.memory.reserve(total, *memory, options.stream);
  if (!ok) return tl::unexpected(ok.error());
  Places places{};
  std::byte* next = storage.memory.as<std::byte>();
  for (std::size_t k = 0; k < sizes.size(); next += aligned(sizes[k++])) places[k] = next;
  return places;
}

Result<Places> copy_sections(const Sections& sections, SceneStorage& storage, const UploadOptions& options) {
  std::array<std::uint64_t, 5> sizes{};
  for (std::size_t k = 0; k < sections.size(); ++k) sizes[k] = sections[k].size();
  const auto places = place_sections(sizes, storage, options);
  if (!places) return places;
  Status ok;
  if (options.asynchronous) ok = storage.copied.emplace().create();
  if (!ok) return tl::unexpected(ok.error());
  for (std::size_t k = 0; k < sections.size(); ++k) {
    if (!ok || sections[k].empty()) continue;
    ok = device_status(
        cudaMemcpyAsync((*places)[k], sections[k].data(), sections[k].size(), cudaMemcpyHostToDevice, options.stream),
        "a scene could not be copied to the device");
  }
  if (ok && options.asynchronous) ok = storage.copied->record(options.stream);
  if (!ok || !options.asynchronous) {  // after an error too: the memory is freed
    const Status done =
        device_status(cudaStreamSynchronize(options.stream), "a scene could not be copied to the device");
    if (ok) ok = done;
  }
  if (!ok) return tl::unexpected(ok.error());
  return places;
}

}  // namespace

Result<DeviceScene> DeviceScene::upload(const SceneView& scene, const UploadOptions& options) {
  return detail::guard_memory([&]() -> Result<DeviceScene> {
    if (const auto ok = check(scene); !ok) return tl::unexpected(ok.error());
    auto storage = std::make_shared<SceneStorage>();
    storage->n = scene.n;
    storage->sh_degree = scene.sh_degree;
    storage->origin = scene.origin;
    const auto placed =
        copy_sections({std::as_bytes(scene.mean), std::as_bytes(scene.rotation), std::as_bytes(scene.scale),
                       std::as_bytes(scene.opacity), std::as_bytes(scene.sh)},
                      *storage, options);
    if (!placed) return tl::unexpected(placed.error());
    const auto floats = [&placed](std::size_t k) { return reinterpret_cast<const float*>((*placed)[k]); };
    storage->attributes = cuda::Fp32Attributes{floats(0), floats(1), floats(2), floats(3), floats(4), scene.sh_degree};
    DeviceScene result;
    result.storage_ = std::move(storage);
    return result;
  });
}

Result<DeviceScene> DeviceScene::upload(const DirectData& data, const UploadOptions& options) {
  return detail::guard_memory([&]() -> Result<DeviceScene> {
    const Header& header = data.header();
    if (const auto ok = check_size(data.size()); !ok) return tl::unexpected(ok.error());
    for (std::uint64_t i = 0; i < data.n_chunks(); ++i) {  // a chunk's SH step set is an index
      if (const auto entry = data.file().chunk(data.first_chunk() + i); !entry) return tl::unexpected(entry.error());
    }
    const auto chunks =
        data.chunk_table().subspan(data.first_chunk() * kChunkEntryBytes, data.n_chunks() * kChunkEntryBytes);
    auto storage = std::make_shared<SceneStorage>();
    storage->n = data.size();
    storage->sh_degree = header.sh_degree;
    storage->declarations = data.file().declarations();
    storage->origin = storage->declarations->origin;
    const auto placed =
        copy_sections({data.means(), data.geometry(), data.sh(), data.step_table(), chunks}, *storage, options);
    if (!placed) return tl::unexpected(placed.error());
    storage->attributes = detail::compact_attributes(header, *placed);
    DeviceScene result;
    result.storage_ = std::move(storage);
    return result;
  });
}

Result<DeviceScene> DeviceScene::upload_decoded(const FileView& file, const UploadOptions& options) {
  const auto start = Clock::now();
  const auto data = load_direct(file, {options.validate, 0});
  if (!data) return tl::unexpected(data.error());
  const double host_ms = ms_since(start);
  UploadOptions waiting = options;
  waiting.asynchronous = false;
  auto scene = upload(*data, waiting);
  if (scene && options.times != nullptr) *options.times = {0, host_ms, ms_since(start) - host_ms};
  return scene;
}

Result<DeviceScene> DeviceScene::upload(const FileView& file, const UploadOptions& options) {
  return detail::guard_memory([&]() -> Result<DeviceScene> {
    const Header& header = file.header();
    if (const auto ok = check_size(header.n_gaussians); !ok) return tl::unexpected(ok.error());
    if (options.decode_on_host) return upload_decoded(file, options);
    const auto start = Clock::now();
    auto storage = std::make_shared<SceneStorage>();
    storage->n = header.n_gaussians;
    storage->sh_degree = header.sh_degree;
    storage->declarations = file.declarations();
    storage->origin = storage->declarations->origin;
    const std::uint64_t n = header.n_gaussians;
    const auto placed = place_sections({n * kMeanBytes, n * kGeometryBytes, n * sh_bytes(header.sh_degree),
                                        file.step_table().size(), file.chunk_table().size()},
                                       *storage, options);
    if (!placed) {
      // A damaged file is reported as such even without a device.
      if (placed.error().code == Errc::device_failed && options.validate) {
        if (const auto data = load_direct(file); !data) return tl::unexpected(data.error());
      }
      return tl::unexpected(placed.error());
    }
    const double placed_ms = ms_since(start);
    UploadTimes times;
    UploadOptions timed = options;
    timed.times = &times;
    if (const auto ok = detail::upload_file(file, *placed, timed); !ok) return tl::unexpected(ok.error());
    storage->attributes = detail::compact_attributes(header, *placed);
    times.setup_ms += placed_ms;
    times.device_ms = ms_since(start) - times.setup_ms - times.host_ms;  // includes freeing the staging memory
    if (options.times != nullptr) *options.times = times;
    DeviceScene result;
    result.storage_ = std::move(storage);
    return result;
  });
}

Result<DeviceScene> DeviceScene::upload(const PagedFile& file, const UploadOptions& options) {
  return detail::guard_memory([&]() -> Result<DeviceScene> {
    const FileView& head = file.head();
    const Header& header = head.header();
    const detail::PagePlan plan(file);
    if (plan.n_pages == 0) {
      return make_error(Errc::pages_missing, head.bytes().size(),
                        "the end of the file is missing, and with it all pages");
    }
    if (const auto ok = check_size(plan.n_rows()); !ok) return tl::unexpected(ok.error());
    const auto start = Clock::now();
    auto storage = std::make_shared<SceneStorage>();
    storage->n = plan.n_finest;
    storage->sh_degree = header.sh_degree;
    storage->declarations = head.declarations();
    storage->origin = storage->declarations->origin;
    detail::ScenePages& pages = storage->pages.emplace();
    pages.n_pages = plan.n_pages;
    pages.chunk_size = plan.chunk_size;
    pages.n_chunks = plan.n_chunks();
    const std::vector<cuda::CutPage> table = plan.table(file);
    const std::uint64_t table_bytes = table.size() * sizeof(cuda::CutPage);
    const auto memory = detail::DeviceMemory::create(options.allocator);
    if (!memory) return tl::unexpected(memory.error());
    Status ok = pages.table.reserve(table_bytes, *memory, options.stream);
    if (!ok) return tl::unexpected(ok.error());
    const auto placed = place_sections(plan.section_bytes(header.sh_degree), *storage, options);
    if (!placed) return tl::unexpected(placed.error());
    ok = device_status(
        cudaMemcpyAsync(pages.table.as<void>(), table.data(), table_bytes, cudaMemcpyHostToDevice, options.stream),
        "the table of pages could not be copied to the device");
    const double setup_ms = ms_since(start);
    const Status uploaded = detail::upload_pages(file, plan, *placed, options.stream);  // waits, also for the table
    if (ok) ok = uploaded;
    const double uploaded_ms = ms_since(start);
    storage->attributes = cuda::PagedAttributes{detail::compact_attributes(header, *placed)};
    if (!ok) return tl::unexpected(ok.error());
    if (options.times != nullptr) {
      *options.times = {setup_ms, uploaded_ms - setup_ms, ms_since(start) - uploaded_ms};
    }
    DeviceScene result;
    result.storage_ = std::move(storage);
    return result;
  });
}

std::uint64_t DeviceScene::size() const {
  return storage_ ? storage_->n : 0;
}
int DeviceScene::sh_degree() const {
  return storage_ ? storage_->sh_degree : 0;
}
bool DeviceScene::compact() const {
  return storage_ && !std::holds_alternative<cuda::Fp32Attributes>(storage_->attributes);
}
bool DeviceScene::has_levels() const {
  return storage_ && storage_->pages;
}
std::uint64_t DeviceScene::bytes() const {
  return storage_ ? storage_->bytes() : 0;
}
const Origin& DeviceScene::origin() const {
  return storage_ ? storage_->origin : kNoOrigin;
}
const std::optional<Declarations>& DeviceScene::declarations() const {
  static const std::optional<Declarations> kNone;
  return storage_ ? storage_->declarations : kNone;
}

}  // namespace rgs
