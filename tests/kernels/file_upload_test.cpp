// file_upload_test.cpp - files decode to the same bytes on the device as on the host, and are refused alike.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/file_upload.hpp"

#include <doctest/doctest.h>

#include <cstring>

#include "common/check_values.hpp"
#include "common/unpack.hpp"
#include "common/unpack_archive.hpp"
#include "cuda/device_memory.hpp"
#include "device_fixture.hpp"
#include "edit_file.hpp"
#include "random_cloud.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/encode.hpp"
#include "rgs/frame_content.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

using Bytes = std::vector<std::byte>;

Bytes encoded(const SplatCloud& cloud, EncodeOptions options, Profile profile) {
  options.profile = profile;
  auto bytes = encode(cloud.view(), options);
  require_ok(bytes);
  return *std::move(bytes);
}

/// A file's five sections on the device, between guards.
struct DeviceSections {
  explicit DeviceSections(const FileView& file) {
    const std::uint64_t n = file.header().n_gaussians;
    const std::uint64_t sizes[] = {n * kMeanBytes, n * kGeometryBytes, n * sh_bytes(file.header().sh_degree),
                                   file.step_table().size(), file.chunk_table().size()};
    for (std::size_t k = 0; k < 5; ++k) {
      arrays[k] = DeviceArray<std::byte>(sizes[k]);
      places[k] = arrays[k].data();
    }
  }
  std::array<DeviceArray<std::byte>, 5> arrays;
  detail::SectionPlaces places{};
};

void check_same(const DeviceArray<std::byte>& found, std::span<const std::byte> expected) {
  const auto bytes = found.download();
  REQUIRE(bytes.size() == expected.size());
  const auto differing = std::mismatch(bytes.begin(), bytes.end(), expected.begin()).first - bytes.begin();
  CHECK_MESSAGE(differing == static_cast<std::ptrdiff_t>(bytes.size()), "byte ", differing, " of ", bytes.size());
}

// Uploads the file and compares it with the host's decoding.
void check_upload(std::span<const std::byte> bytes, const UploadOptions& options = {}) {
  const auto file = FileView::open(bytes);
  require_ok(file);
  const auto expected = load_direct(*file);
  require_ok(expected);
  const DeviceSections device(*file);
  require_ok(detail::upload_file(*file, device.places, options));
  check_same(device.arrays[0], expected->means());
  check_same(device.arrays[1], expected->geometry());
  check_same(device.arrays[2], expected->sh());
  check_same(device.arrays[3], expected->step_table());
  check_same(device.arrays[4], expected->chunk_table());
}

// The device's answer to a file equals the host's, error and offset included.
bool agrees_with_host(std::span<const std::byte> bytes) {
  const auto file = FileView::open(bytes);
  if (!file) return true;
  const auto expected = load_direct(*file);
  const auto found = DeviceScene::upload(*file);
  const bool is_same = expected.has_value() == found.has_value() &&
                       (expected.has_value() || (expected.error().code == found.error().code &&
                                                 expected.error().offset == found.error().offset));
  if (!is_same) {
    MESSAGE("host: ", expected ? "valid" : text_of(expected.error()),
            "; device: ", found ? "sound" : text_of(found.error()));
  }
  return is_same;
}

// Whether the device refuses the file, not the host that explains the error.
Status refused_by_device(const FileView& file) {
  const auto data = load_direct(file, {.validate = false});
  require_ok(data);
  const DeviceAttributes device(*data);
  cuda::CheckedValues found{};
  const DeviceArray<cuda::CheckedValues> out{std::span<const cuda::CheckedValues>(&found, 1)};
  require_ok(cuda::launch_check_values(std::get<cuda::CompactAttributes>(device.get()),
                                       static_cast<std::uint32_t>(data->size()), out.data(), nullptr));
  found = out.download()[0];
  if (found.n_damaged != 0) return make_error(Errc::bad_value, Error::kNone, "damaged");
  return validate_declarations(file, found.counts);
}

}  // namespace

TEST_CASE("packed files and archives decode on the device to the host's bytes") {
  if (!device_answers()) return;
  for (const std::uint64_t n : {1u, 63u, 64u, 65u, 255u, 256u, 257u, 16384u, 16385u, 100001u}) {
    if (small_sizes() && n > 300) continue;
    for (const int degree : {0, 1, 2, 3}) {
      for (const std::uint32_t chunk_size : {32u, 96u, 256u, 65536u}) {
        if (n > 20000 && chunk_size != 256 && degree != 3) continue;
        CAPTURE(n);
        CAPTURE(degree);
        CAPTURE(chunk_size);
        SplitMix random{5 * n + static_cast<std::uint64_t>(degree) + chunk_size};
        EncodeOptions options;
        options.chunk_size = chunk_size;
        options.chunk_step_sets = chunk_size != 96;
        options.keep_permutation = n == 257;
        check_upload(encoded(random_cloud(n, degree, random), options, Profile::packed));
        if (chunk_size > kMaxArchiveRows) continue;
        check_upload(encoded(cloud_of(random_splats(84, static_cast<int>(n)), degree), options, Profile::archive));
      }
    }
  }
}

TEST_CASE("an archive decodes in as many rounds as memory needs") {
  if (!device_answers()) return;
  EncodeOptions options;
  options.chunk_size = 32768;  // of which frames have one at least
  const auto bytes = encoded(cloud_of(random_splats(83, small_sizes() ? 33000 : 100000), 0), options, Profile::archive);
  const auto file = FileView::open(bytes);
  require_ok(file);
  struct Memory {
    std::uint64_t most, refused;
  } memory{2 * cuda::archive_frame_bytes(file->frames(SectionType::sh).rows, 0), 0};
  const DeviceAllocator allocator{[](void* user, std::uint64_t size, CudaStream on) -> void* {
                                    auto& m = *static_cast<Memory*>(user);
                                    void* place = nullptr;
                                    if (size > m.most) return ++m.refused, nullptr;
                                    return cudaMallocAsync(&place, size, on) == cudaSuccess ? place : nullptr;
                                  },
                                  [](void*, void* place, std::uint64_t) { cudaFree(place); }, &memory};
  check_upload(bytes, {.allocator = allocator});
  CHECK(memory.refused == (small_sizes() ? 1 : 2));  // two frames, and before them four
  memory.most = 0;                                   // the host decodes
  check_upload(bytes, {.allocator = allocator});
}

TEST_CASE("equal Gaussians of an archive, whose streams are shorter than the steps of their chunks") {
  if (!device_answers()) return;
  EncodeOptions options;
  options.chunk_size = 32;
  check_upload(encoded(cloud_of(std::vector<Splat>(40000, random_splats(85, 1)[0]), 3), options, Profile::archive));
}

TEST_CASE("direct files, archives and files without Gaussians use the same ring") {
  if (!device_answers()) return;
  const std::uint64_t n = small_sizes() ? 300 : 100001;
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    CAPTURE(static_cast<int>(profile));
    const SplatCloud cloud = cloud_of(random_splats(81, static_cast<int>(n)), 3);
    for (const bool validate : {true, false}) check_upload(encoded(cloud, {}, profile), {.validate = validate});
    const auto empty = encoded(SplatCloud(), {}, profile);
    const auto file = FileView::open(empty);
    require_ok(file);
    const auto scene = DeviceScene::upload(*file);
    require_ok(scene);
    CHECK(scene->size() == 0);
  }
}

TEST_CASE("uploads wait for the caller's stream, report their memory, and release what they borrowed") {
  if (!device_answers()) return;
  SplitMix random{83};
  const auto bytes = encoded(random_cloud(small_sizes() ? 300 : 40000, 3, random), {}, Profile::packed);
  cudaStream_t stream = nullptr;
  require_cuda(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking));
  struct Ledger {
    std::uint64_t held = 0, most = 0;
  } ledger;
  const DeviceAllocator allocator{[](void* user, std::uint64_t size, CudaStream on) -> void* {
                                    auto& l = *static_cast<Ledger*>(user);
                                    l.held += size;
                                    l.most = std::max(l.most, l.held);
                                    void* memory = nullptr;
                                    return cudaMallocAsync(&memory, size, on) == cudaSuccess ? memory : nullptr;
                                  },
                                  [](void* user, void* memory, std::uint64_t size) {
                                    static_cast<Ledger*>(user)->held -= size;
                                    cudaFree(memory);
                                  },
                                  &ledger};
  UploadTimes times{-1, -1, -1};
  check_upload(bytes, {.stream = stream, .allocator = allocator, .times = &times});
  CHECK(ledger.held == 0);
  CHECK(ledger.most > 0);
  CHECK(ledger.most <= (std::uint64_t{96} << 20) + sizeof(cuda::CheckedValues));
  CHECK(times.setup_ms >= 0);
  CHECK(times.host_ms >= 0);
  CHECK(times.device_ms >= 0);
  const auto file = FileView::open(bytes);
  require_ok(file);
  {
    const auto scene = DeviceScene::upload(*file, {.stream = stream, .allocator = allocator, .times = &times});
    require_ok(scene);
    CHECK(ledger.held == scene->bytes());
    const auto on_host = DeviceScene::upload(*file, {.decode_on_host = true, .times = &times});
    require_ok(on_host);
    CHECK(on_host->bytes() == scene->bytes());
    CHECK(times.setup_ms == 0);
  }
  CHECK(ledger.held == 0);
  require_cuda(cudaStreamDestroy(stream));
}

TEST_CASE("the device refuses a damaged file like the host, with the same error and offset") {
  if (!device_answers()) return;
  std::uint64_t n_refused = 0, n_sound = 0;
  for (const int degree : {0, 3}) {
    for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
      SplitMix random{87 + static_cast<std::uint64_t>(degree)};
      EncodeOptions options;
      options.chunk_size = 64;
      options.keep_permutation = true;
      const auto sound = encoded(cloud_of(random_splats(88, 300), degree), options, profile);
      REQUIRE(agrees_with_host(sound));
      const std::uint64_t begin = section_of(sound, "DECL");
      const int n_changes = small_sizes() ? 20 : 400;
      for (int k = 0; k < n_changes; ++k) {
        auto bytes = sound;
        const std::uint64_t at = begin + random.below(bytes.size() - begin);
        bytes[at] ^= static_cast<std::byte>(1 + random.below(255));
        CAPTURE(at);
        if (k % 4 != 0) fix_hashes(bytes);  // so that only values can be wrong
        CHECK(agrees_with_host(bytes));
        const auto file = FileView::open(bytes);
        ++(file && load_direct(*file) ? n_sound : n_refused);
      }
    }
  }
  MESSAGE(n_refused, " refused, ", n_sound, " valid");
  CHECK(n_refused > 40);
}

TEST_CASE("a damaged table is reported with its offset, also without validation") {
  if (!device_answers()) return;
  SplitMix random{89};
  auto bytes = encoded(random_cloud(300, 1, random), {}, Profile::direct);
  const std::uint64_t at = section_of(bytes, "CHNK") + 32;
  put(bytes, at, std::uint32_t{0xFFFF});  // a set of steps that does not exist
  fix_hashes(bytes);
  const auto file = FileView::open(bytes);
  require_ok(file);
  REQUIRE(load_direct(*file, {.validate = false}));  // does not check it
  const auto scene = DeviceScene::upload(*file, {.validate = false});
  REQUIRE_FALSE(scene);
  CHECK(scene.error().code == Errc::bad_value);
  CHECK(scene.error().offset == at);
}

TEST_CASE("the device itself checks every rule of stored values") {
  if (!device_answers()) return;
  for (const int degree : {0, 1, 2, 3}) {
    CAPTURE(degree);
    SplitMix random{91 + static_cast<std::uint64_t>(degree)};
    EncodeOptions options;
    options.chunk_size = 96;
    SplatCloud cloud = random_cloud(500, degree, random);
    for (std::size_t i = 0; i < cloud.sh.size(); i += 3 * static_cast<std::size_t>(sh_coefficients(degree))) {
      cloud.sh[i] = 0;  // red of degree 0: its step is 0
      cloud.sh[i + 1] = random.dyadic(-1, 1);
    }
    const auto sound = encoded(cloud, options, Profile::direct);
    const auto judged = [](const Bytes& bytes) {
      const auto file = FileView::open(bytes);
      require_ok(file);
      const bool by_host = !load_direct(*file), by_device = !refused_by_device(*file);
      CHECK(by_host == by_device);
      return by_device;
    };
    CHECK_FALSE(judged(sound));
    const std::uint64_t row_bytes = sh_bytes(degree);
    const auto change = [&](const char* section, std::uint64_t at, const auto& value, bool is_damage = true) {
      CAPTURE(section);
      CAPTURE(at);
      auto bytes = sound;
      put(bytes, section_of(bytes, section) + at, value);
      fix_hashes(bytes);
      CHECK(judged(bytes) == is_damage);
    };
    for (const std::uint64_t row : {0u, 95u, 96u, 499u}) {
      const std::uint64_t mean = row * 12, geometry = row * 16, sh = row * row_bytes;
      for (const std::uint64_t k : {0u, 4u, 8u}) {
        for (const std::uint32_t bits :
             {0x7FC00000u, 0x7F800000u, 0xFF800000u, 0x7F7FFFFFu})  // the last: beyond the box
          change("MEAN", mean + k, bits);
      }
      change("GEOM", geometry, std::uint64_t{0});       // no rotation
      change("GEOM", geometry, std::uint64_t{0xBC00});  // -1, 0, 0, 0
      change("GEOM", geometry, std::uint64_t{0x7E00});  // NaN
      for (const std::uint64_t k : {8u, 10u, 12u}) {
        for (const unsigned bits : {0x7C00u, 0x7E01u, 0x8000u, 0xBC00u, 0x7BFFu})
          change("GEOM", geometry + k, static_cast<std::uint16_t>(bits));
      }
      for (const unsigned bits : {0x3C01u, 0x8000u, 0x7E00u, 0xFFFFu})
        change("GEOM", geometry + 14, static_cast<std::uint16_t>(bits));
      change("SHI8", sh + 1, std::int8_t{-128});
      change("SHI8", sh, std::int8_t{1});                                                  // of the zero step
      if (degree == 0 || degree == 2) change("SHI8", sh + row_bytes - 1, std::int8_t{1});  // padding
    }
    for (const std::uint64_t chunk : {0u, 5u}) {
      for (const std::uint64_t k : {0u, 4u, 8u, 12u, 16u, 20u, 24u, 28u}) {
        auto bytes = sound;
        const std::uint64_t at = section_of(bytes, "CHNK") + 48 * chunk + k;
        put(bytes, at, std::nextafter(get<float>(bytes, at), k < 12 ? -1e30f : 1e30f));
        fix_hashes(bytes);
        const auto file = FileView::open(bytes);
        require_ok(file);
        CHECK(load_direct(*file).has_value() == refused_by_device(*file).has_value());
      }
    }
    for (const std::uint64_t k : {120u, 128u, 136u, 144u}) {
      auto bytes = sound;
      const std::uint64_t at = section_of(bytes, "DECL") + k;
      put(bytes, at, get<std::uint64_t>(bytes, at) + 1);
      fix_hashes(bytes);
      CHECK(judged(bytes));
    }
  }
}

TEST_CASE("contents that no writer makes decode alike on device and host") {
  if (!device_answers()) return;
  SplitMix random{97};
  for (int degree = 0; degree <= kMaxShDegree; ++degree) {
    for (const std::uint32_t n : {1u, 64u, 130u, 16384u}) {
      if (small_sizes() && n > 200) continue;
      CAPTURE(degree);
      CAPTURE(n);
      const std::uint32_t chunk_size = n % 4 == 0 ? 256 : 32;
      const int n_codes = 3 * sh_coefficients(degree);
      Bytes content(sh_weight_bytes(n_codes) + n * static_cast<std::uint32_t>(n_codes));
      for (std::byte& b : content) b = static_cast<std::byte>(random.below(256));
      std::vector<RelativeShSteps> steps((n + chunk_size - 1) / chunk_size);
      for (RelativeShSteps& s : steps) {
        for (std::int16_t& step : s.step) step = static_cast<std::int16_t>(random.below(257));
      }
      const auto decode = [&]<int kDegree>() {
        using Predictor = ShPredictor<kDegree>;
        const auto* bytes = reinterpret_cast<const std::uint8_t*>(content.data());
        Predictor predictor;
        for (std::size_t i = 0; i < Predictor::kSlots; ++i) {
          predictor.carry[i] = Predictor::carry_at(bytes, static_cast<int>(i));
          for (std::size_t j = 0; j < Predictor::kSlots; ++j) {
            predictor.weight[i][j] = Predictor::weight_at(bytes, static_cast<int>(i), static_cast<int>(j));
          }
        }
        std::vector<std::uint32_t> rows(n * sh_bytes(kDegree) / 4);
        const ShPlanes frame{bytes + sh_weight_bytes(n_codes), steps.data(), n, chunk_size};
        for (std::uint32_t lane = 0; lane < kShLanes; ++lane)
          decode_sh_lane<kDegree>(predictor, frame, lane, rows.data());
        return rows;
      };
      const auto expected = degree == 0   ? decode.operator()<0>()
                            : degree == 1 ? decode.operator()<1>()
                            : degree == 2 ? decode.operator()<2>()
                                          : decode.operator()<3>();
      const DeviceArray<std::byte> device_content{std::span<const std::byte>(content)};
      const DeviceArray<RelativeShSteps> device_steps{std::span<const RelativeShSteps>(steps)};
      const DeviceArray<std::uint32_t> rows(expected.size());
      require_ok(cuda::launch_unpack_sh({reinterpret_cast<const std::uint8_t*>(device_content.data()),
                                         device_steps.data(), n, chunk_size, degree, rows.data()},
                                        nullptr));
      CHECK(rows.download() == expected);
    }
  }
  // Words that wrap, and rotations without w.
  const std::uint32_t n = 3000;
  Bytes content(16 * n);
  for (std::byte& b : content) b = static_cast<std::byte>(random.below(256));
  const auto* bytes = reinterpret_cast<const std::uint8_t*>(content.data());
  const DeviceArray<std::byte> device_content{std::span<const std::byte>(content)};
  const auto* const device_bytes = reinterpret_cast<const std::uint8_t*>(device_content.data());
  std::vector<std::uint32_t> means(3 * n);
  std::vector<std::uint16_t> geometry(8 * n);
  std::uint32_t key[3] = {};
  for (std::uint32_t i = 0; i < n; ++i) {
    for (std::uint32_t word = 0; word < 3; ++word) {
      std::uint32_t folded = 0;
      for (std::uint32_t k = 0; k < 4; ++k) folded |= std::uint32_t{bytes[(4 * word + k) * n + i]} << (8 * k);
      key[word] += unfold(folded);
      means[3 * i + word] = bits_of_key(key[word]);
    }
    std::uint16_t* const row = &geometry[8 * i];
    for (std::uint32_t k = 0; k < 8; ++k) {
      row[k] = static_cast<std::uint16_t>(bytes[2 * k * n + i] | bytes[(2 * k + 1) * n + i] << 8);
    }
    row[0] = static_cast<std::uint16_t>(unfold16(row[0]) + unit_w(row[1], row[2], row[3]));
  }
  const DeviceArray<std::uint32_t> device_means(means.size());
  const DeviceArray<std::uint16_t> device_geometry(geometry.size());
  require_ok(cuda::launch_unpack_means(device_bytes, n, reinterpret_cast<float*>(device_means.data()), nullptr));
  require_ok(cuda::launch_unpack_geometry(device_bytes, n, device_geometry.data(), nullptr));
  CHECK(device_means.download() == means);
  CHECK(device_geometry.download() == geometry);
}

TEST_CASE("an opened scene is drawn like a loaded one, and refused like it") {
  if (!device_answers()) return;
  SplitMix random{101};
  const auto bytes = encoded(cloud_of(random_splats(82, small_sizes() ? 300 : 20000), 3), {}, Profile::packed);
  char path[] = "/tmp/rgs_upload_XXXXXX";
  const int fd = mkstemp(path);
  REQUIRE(fd >= 0);
  REQUIRE(write(fd, bytes.data(), bytes.size()) == static_cast<ssize_t>(bytes.size()));
  const Camera camera = front_camera(120, 70);
  auto renderer = Renderer::create({.backend = Backend::cuda});
  require_ok(renderer);
  const auto picture = [&](const Scene& scene) {
    Frame frame = Frame::of(camera);
    require_ok(renderer->render(scene, camera, frame.target()));
    return frame.rgb;
  };
  const auto loaded = Scene::load(std::string(path)), opened = Scene::open(std::string(path));
  require_ok(loaded);
  require_ok(opened);
  require_ok(renderer->prepare(*opened));
  CHECK(picture(*opened) == picture(*loaded));
  CHECK(picture(*loaded) == picture(*opened));  // load()'s decoded sections are freed by now
  CHECK_FALSE(opened->is_validated());          // by the host

  auto damaged = bytes;
  damaged[damaged.size() - 100] ^= std::byte{1};
  REQUIRE(pwrite(fd, damaged.data(), damaged.size(), 0) == static_cast<ssize_t>(damaged.size()));
  const auto scene = Scene::open(std::string(path));
  require_ok(scene);
  const Status refused = renderer->prepare(*scene);
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::checksum_mismatch);
  close(fd);
  unlink(path);
}
