// packed_test.cpp - Profile::packed decodes to the bytes of Profile::direct, whole and by chunk.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstring>

#include "edit_file.hpp"
#include "golden_scenes.hpp"
#include "instruction_sets.hpp"
#include "packed/codec_kernels.hpp"
#include "random_cloud.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

struct Pair {
  Bytes direct, packed;
};

Pair encode_both(const SplatCloud& cloud, EncodeOptions options) {
  options.profile = Profile::direct;
  auto direct = encode(cloud.view(), options);
  options.profile = Profile::packed;
  auto packed = encode(cloud.view(), options);
  REQUIRE(direct);
  REQUIRE(packed);
  return {std::move(*direct), std::move(*packed)};
}

void check_same(std::span<const std::byte> a, std::span<const std::byte> b) {
  REQUIRE(a.size() == b.size());
  CHECK(std::ranges::equal(a, b));
}

// All decoded data, from both files.
void check_equal(const Pair& pair, const LoadOptions& options = {}) {
  const auto a = FileView::open(pair.direct), b = FileView::open(pair.packed);
  REQUIRE(a);
  REQUIRE(b);
  CHECK_FALSE(a->coded());
  CHECK(b->coded());
  const Declarations& d = a->declarations();
  const bool has_origin = d.origin != kNoOrigin, is_new = d.crs != Crs() || d.first_view != FirstView();
  CHECK(a->header().version_minor == (is_new ? 5 : has_origin ? 3 : 0));
  CHECK(b->header().version_minor == (is_new ? 5 : has_origin ? 3 : 1));
  REQUIRE(validate(*b));
  const auto x = load_direct(*a, options), y = load_direct(*b, options);
  REQUIRE(x);
  REQUIRE(y);
  CHECK(y->size() == a->header().n_gaussians);
  check_same(x->means(), y->means());
  check_same(x->geometry(), y->geometry());
  check_same(x->sh(), y->sh());
  check_same(x->chunk_table(), y->chunk_table());
  check_same(x->step_table(), y->step_table());
  check_same(a->stored(SectionType::declarations), b->stored(SectionType::declarations));
  check_same(a->stored(SectionType::permutation), b->stored(SectionType::permutation));
  check_same(a->stored(SectionType::provenance), b->stored(SectionType::provenance));
}

}  // namespace

TEST_CASE("packed files decode to the bytes of direct files") {
  for (const GoldenScene& scene : golden_scenes()) {
    CAPTURE(scene.name);
    check_equal(encode_both(scene.cloud, scene.options));
  }
}

TEST_CASE("scenes of equal Gaussians, for which no predictor can be fitted, decode exactly") {
  SplitMix random{61};
  for (const int degree : {0, 1, 2, 3}) {
    for (const std::uint64_t n : {64u, 256u, 20000u}) {
      for (const bool zero : {false, true}) {
        CAPTURE(degree);
        CAPTURE(n);
        CAPTURE(zero);
        SplatCloud cloud;
        cloud.resize(n, degree);
        Splat s = random_cloud(1, degree, random).view().splat(0);
        for (float& x : s.sh) x = zero ? 0.f : random.dyadic(-1, 1);
        for (std::uint64_t i = 0; i < n; ++i) cloud.set(i, s);
        check_equal(encode_both(cloud, {}));
      }
    }
  }
}

TEST_CASE("packed sections of every size around lanes, chunks and frames decode exactly") {
  for (const std::uint64_t n : {1u, 31u, 63u, 64u, 65u, 127u, 128u, 1000u, 16383u, 16384u, 16385u, 40000u}) {
    for (const int degree : {0, 1, 2, 3}) {
      if (n > 2000 && degree != 3 && n != 16385) continue;
      CAPTURE(n);
      CAPTURE(degree);
      EncodeOptions options;
      options.chunk_size = n % 2 == 0 ? 256 : 96;
      options.keep_permutation = n == 1000;
      options.chunk_step_sets = n != 127;
      SplitMix random{7 * n + static_cast<std::uint64_t>(degree)};
      check_equal(encode_both(random_cloud(n, degree, random), options));
    }
  }
}

TEST_CASE("a range of chunks equals that part of the whole file and needs only its own frames") {
  SplitMix random{11};
  EncodeOptions options;
  options.chunk_size = 512;
  options.keep_permutation = true;
  Pair pair = encode_both(random_cloud(50000, 1, random), options);
  const auto view = FileView::open(pair.packed);
  REQUIRE(view);
  const auto whole = load_direct(*view);
  REQUIRE(whole);
  const std::uint64_t n_chunks = view->header().n_chunks;
  REQUIRE(view->frames(SectionType::means).frames.size() == 4);
  struct Range {
    std::uint64_t first, count;
  };
  for (const Range& wanted : {Range{0, 1}, {31, 1}, {32, 1}, {30, 4}, {97, 1}, {0, 98}, {98, 0}}) {
    const std::uint64_t first = wanted.first, count = wanted.count;
    CAPTURE(first);
    CAPTURE(count);
    for (const std::uint64_t file : {0u, 1u}) {
      const auto range = read_chunks(FileView::open(file == 0 ? pair.direct : pair.packed).value(), first, count);
      REQUIRE(range);
      CHECK(range->first_chunk() == first);
      CHECK(range->n_chunks() == count);
      const std::uint64_t begin = std::min<std::uint64_t>(512 * first, 50000), n = range->size();
      CHECK(range->first() == begin);
      CHECK(n == std::min<std::uint64_t>(512 * (first + count), 50000) - begin);
      check_same(range->means(), whole->means().subspan(begin * kMeanBytes, n * kMeanBytes));
      check_same(range->geometry(), whole->geometry().subspan(begin * kGeometryBytes, n * kGeometryBytes));
      check_same(range->sh(), whole->sh().subspan(begin * sh_bytes(1), n * sh_bytes(1)));
    }
  }
  REQUIRE(n_chunks == 98);

  // A damaged frame breaks only its own rows, and the error has its offset.
  const CodedFrame frame = view->frames(SectionType::sh).frames[2];
  pair.packed[frame.offset + frame.stored_bytes / 2] ^= std::byte{1};
  CHECK(read_chunks(*view, 0, 64));
  CHECK(read_chunks(*view, 96, 2));
  for (const unsigned threads : {1u, 2u, 5u}) {
    const auto damaged = load_direct(*view, {true, threads});
    REQUIRE_FALSE(damaged);
    CHECK(damaged.error().code == Errc::checksum_mismatch);
    CHECK(damaged.error().offset == frame.offset);
  }
  REQUIRE_FALSE(validate(*view));
  CHECK(validate(*view).error().offset == view->find(SectionType::sh)->offset);
}

TEST_CASE("Gaussians read from a coded file equal those of the direct one, across frames") {
  SplitMix random{12};
  EncodeOptions options;
  options.chunk_size = 4096;
  const Pair pair = encode_both(random_cloud(40000, 2, random), options);
  const auto a = FileView::open(pair.direct), b = FileView::open(pair.packed);
  auto c = FileView::open(pair.packed);
  REQUIRE(c->preload());
  const FileView copy = *c;
  const auto data = load_direct(*b, {false, 3});
  REQUIRE(data);
  for (const std::uint64_t first : {0u, 16380u, 39990u}) {
    std::vector<ActivatedSplat> x(10), y(10), z(10);
    REQUIRE(a->read(first, x));
    REQUIRE(b->read(first, y));
    REQUIRE(data->read(first, z));
    CHECK(std::memcmp(x.data(), y.data(), sizeof(ActivatedSplat) * x.size()) == 0);
    CHECK(std::memcmp(x.data(), z.data(), sizeof(ActivatedSplat) * x.size()) == 0);
    std::ranges::fill(z, ActivatedSplat{});
    REQUIRE(copy.read(first, z));
    CHECK(std::memcmp(x.data(), z.data(), sizeof(ActivatedSplat) * x.size()) == 0);
  }
}

TEST_CASE("compression levels decode alike, and none is larger than the first") {
  SplitMix random{13};
  const SplatCloud cloud = random_cloud(5000, 3, random);
  EncodeOptions options;
  options.profile = Profile::packed;
  std::size_t first = 0;
  for (const int level : {1, 2, 9, kMaxLevel}) {
    CAPTURE(level);
    options.level = level;
    const auto bytes = encode(cloud.view(), options);
    REQUIRE(bytes);
    if (level == 1) first = bytes->size();
    CHECK(bytes->size() <= first);
    CHECK(decode(*bytes));
  }
  for (const int level : {0, -1, kMaxLevel + 1}) {
    options.level = level;
    REQUIRE_FALSE(encode(cloud.view(), options));
    CHECK(encode(cloud.view(), options).error().code == Errc::bad_argument);
  }
}

TEST_CASE("prediction shrinks similar neighbours") {
  // Colours that follow one another and each other: the residual is little more than the noise, 8 levels of 254.
  SplitMix random{14};
  SplatCloud cloud = random_cloud(16384, 3, random);
  float walk[16] = {};
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    for (std::size_t k = 0; k < 16; ++k) {
      walk[k] = 0.97f * walk[k] + 0.1f * random.dyadic(-1, 1);
      for (std::size_t c = 0; c < 3; ++c) {
        cloud.sh[48 * i + 3 * k + c] = walk[k] * (1.f - 0.2f * static_cast<float>(c)) + 0.02f * random.dyadic(-1, 1);
      }
    }
  }
  EncodeOptions options;
  options.order = Order::input;
  const Pair pair = encode_both(cloud, options);
  const auto view = FileView::open(pair.packed);
  CHECK(view->stored(SectionType::sh).size() <
        0.8 * static_cast<double>(FileView::open(pair.direct)->stored(SectionType::sh).size()));
}

TEST_CASE("every instruction set writes the same bits") {
  using namespace rgs::detail;
  std::vector<const CodecKernels*> all;
  with_each_instruction_set([&all] {
    const CodecKernels* kernels = &codec_kernels();
    if (std::ranges::find(all, kernels) == all.end()) all.push_back(kernels);
  });
#if defined(__x86_64__)
  CHECK(all.size() >= 2);  // also without vectors
#endif
  SplitMix random{15};
  const auto bits = [&random] { return static_cast<std::uint16_t>(random.below(65536)); };
  ShWeights weights;
  weights.n = kShMaxCodes;
  for (auto& w : weights.weights) w = static_cast<std::int16_t>(static_cast<std::int8_t>(bits()) * 256);
  for (auto& w : weights.carry) w = static_cast<std::int16_t>(static_cast<std::int8_t>(bits()) * 256);
  auto start = std::make_unique<ShLanes>();
  for (auto* block : {start->value, start->error}) {
    for (int i = 0; i < kShMaxCodes; ++i) {
      for (int l = 0; l < kShLanes; ++l) block[i][l] = static_cast<std::int16_t>(bits());
    }
  }
  for (int k = 0; k < 12; ++k) {
    for (int l = 0; l < kShLanes; ++l) {
      start->step[k][l] = static_cast<std::int16_t>(bits() % 257);
      start->inverse[k][l] = sh_inverse_step(start->step[k][l]);
    }
  }
  std::vector<std::uint8_t> residual(kShMaxCodes * kShLanes), planes(6 * 64);
  for (auto& byte : residual) byte = static_cast<std::uint8_t>(bits());
  for (auto& byte : planes) byte = static_cast<std::uint8_t>(bits());
  std::vector<std::int16_t> pairs(3 * 2 * kShLanes), matrix(5 * 6);
  for (auto* values : {&pairs, &matrix}) {
    for (std::int16_t& x : *values) x = static_cast<std::int16_t>(bits());
  }
  pairs[0] = pairs[1] = matrix[0] = matrix[1] = -32768;  // the one product of a pair that wraps
  std::vector<float> a(48), b(48);
  for (auto* values : {&a, &b}) {
    for (float& x : *values) x = random.dyadic(-3, 3);
  }

  struct Outcome {
    std::unique_ptr<ShLanes> lanes;
    std::vector<std::uint8_t> residual;
    std::vector<std::int8_t> rows, few;
    std::vector<std::uint16_t> w;
    std::vector<float> same, lagged;
    std::vector<std::int32_t> sums;
  };
  std::vector<Outcome> outcomes;
  for (const CodecKernels* kernels : all) {
    Outcome& o = outcomes.emplace_back();
    o.lanes = std::make_unique<ShLanes>(*start);
    for (int turn = 0; turn < 3; ++turn) kernels->decode(*o.lanes, weights, residual.data(), kShLanes);
    o.rows.resize(48 * 64);
    kernels->store(*o.lanes, 48, 64, o.rows.data(), 48);
    o.few.resize(12 * 7);
    kernels->store(*o.lanes, 12, 7, o.few.data(), 12);
    // Encoding the third turn's output restores its residual.
    auto again = std::make_unique<ShLanes>(*start);
    for (int turn = 0; turn < 2; ++turn) kernels->decode(*again, weights, residual.data(), kShLanes);
    std::memcpy(again->codes, o.lanes->codes, sizeof again->codes);
    o.residual.resize(residual.size());
    kernels->encode(*again, weights, o.residual.data(), kShLanes);
    CHECK(o.residual == residual);
    o.w.resize(64);
    kernels->unit_w(planes.data(), 64, 64, o.w.data());
    o.same.resize(48 * 48, 0.5f);
    o.lagged.resize(48 * 48, 0.5f);
    kernels->correlate(a.data(), b.data(), 48, o.same.data(), o.lagged.data());
    o.sums.resize(5 * kShLanes);
    kernels->mix(pairs.data(), matrix.data(), 3, 5, o.sums.data());
    const Outcome& base = outcomes.front();
    CHECK(std::memcmp(o.lanes->value, base.lanes->value, sizeof base.lanes->value) == 0);
    CHECK(std::memcmp(o.lanes->error, base.lanes->error, sizeof base.lanes->error) == 0);
    CHECK(std::memcmp(o.lanes->codes, base.lanes->codes, sizeof base.lanes->codes) == 0);
    CHECK(o.rows == base.rows);
    CHECK(o.few == base.few);
    CHECK(o.w == base.w);
    CHECK(o.sums == base.sums);
    CHECK(o.same == base.same);
    CHECK(o.lagged == base.lagged);
  }
  for (std::size_t out = 0; out < 5; ++out) {  // by FORMAT: sums of products mod 2^32
    std::uint32_t sum = 0;
    for (std::size_t k = 0; k < 6; ++k) {
      sum += static_cast<std::uint32_t>(matrix[6 * out + k] * pairs[(k / 2 * kShLanes + 9) * 2 + k % 2]);
    }
    CHECK(outcomes[0].sums[out * kShLanes + 9] == static_cast<std::int32_t>(sum));
  }
  for (int lane = 0; lane < 64; ++lane) {
    for (int code = 0; code < 48; ++code) {
      REQUIRE(outcomes[0].rows[static_cast<std::size_t>(48 * lane + code)] == outcomes[0].lanes->codes[code][lane]);
    }
  }
}

TEST_CASE("axes of a coordinate reference system that are those of the scene are not stored") {
  EncodeOptions options = golden_options();
  options.crs = {"EPSG:4978", options.axes};
  const auto bytes = encode(golden_cloud(6, 0, 1).view(), options);
  REQUIRE(bytes);
  CHECK(FileView::open(*bytes)->declarations().crs == Crs{"EPSG:4978", {}});
}
