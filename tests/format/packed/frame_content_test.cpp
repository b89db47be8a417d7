// frame_content_test.cpp - the device's decoding of a frame's content, run on the host, gives the decoder's bytes.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/frame_content.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cstring>

#include "edit_file.hpp"
#include "golden_scenes.hpp"
#include "packed/frame_codec.hpp"
#include "random_cloud.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/planes.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

std::vector<std::byte> content_of(const FileView& view, SectionType type, std::uint64_t frame) {
  std::vector<std::byte> content(frame_content_bytes(view, type, frame));
  FrameContents reader;
  REQUIRE(reader.read(view, type, frame, content));
  return content;
}

void undo_words(std::span<const std::byte> content, std::uint32_t n, std::byte* rows) {
  const auto* bytes = reinterpret_cast<const std::uint8_t*>(content.data());
  for (std::size_t word = 0; word < 3; ++word) {
    std::uint32_t key = 0;
    for (std::size_t i = 0; i < n; ++i) {
      std::uint32_t folded = 0;
      for (std::size_t k = 0; k < 4; ++k) folded |= std::uint32_t{bytes[(4 * word + k) * n + i]} << (8 * k);
      key += unfold(folded);
      const std::uint32_t bits = bits_of_key(key);
      std::memcpy(rows + 12 * i + 4 * word, &bits, sizeof bits);
    }
  }
}

void undo_geometry(std::span<const std::byte> content, std::uint32_t n, std::byte* rows) {
  const auto* bytes = reinterpret_cast<const std::uint8_t*>(content.data());
  for (std::size_t i = 0; i < n; ++i) {
    std::uint16_t row[8];
    for (std::size_t k = 0; k < 8; ++k) {
      row[k] = static_cast<std::uint16_t>(bytes[2 * k * n + i] | bytes[(2 * k + 1) * n + i] << 8);
    }
    row[0] = static_cast<std::uint16_t>(unfold16(row[0]) + unit_w(row[1], row[2], row[3]));
    std::memcpy(rows + 16 * i, row, sizeof row);
  }
}

template <int kDegree>
void undo_sh(const std::uint8_t* content, std::uint32_t n, std::uint32_t chunk_rows,
             std::span<const RelativeShSteps> steps, std::byte* rows) {
  using Predictor = ShPredictor<kDegree>;
  Predictor predictor;
  for (std::size_t i = 0; i < Predictor::kSlots; ++i) {
    predictor.carry[i] = Predictor::carry_at(content, static_cast<int>(i));
    for (std::size_t j = 0; j < Predictor::kSlots; ++j) {
      predictor.weight[i][j] = Predictor::weight_at(content, static_cast<int>(i), static_cast<int>(j));
    }
  }
  std::vector<std::uint32_t> words(n * sh_bytes(kDegree) / 4, 0xFFFFFFFFu);
  const ShPlanes frame{content + sh_weight_bytes(Predictor::kCodes), steps.data(), n, chunk_rows};
  for (std::uint32_t lane = 0; lane < kShLanes; ++lane) decode_sh_lane<kDegree>(predictor, frame, lane, words.data());
  std::memcpy(rows, words.data(), 4 * words.size());
}

void undo_sh(int degree, std::span<const std::byte> content, std::uint32_t n, std::uint32_t chunk_rows,
             std::span<const RelativeShSteps> steps, std::byte* rows) {
  const auto* bytes = reinterpret_cast<const std::uint8_t*>(content.data());
  switch (degree) {
    case 0: return undo_sh<0>(bytes, n, chunk_rows, steps, rows);
    case 1: return undo_sh<1>(bytes, n, chunk_rows, steps, rows);
    case 2: return undo_sh<2>(bytes, n, chunk_rows, steps, rows);
    default: return undo_sh<3>(bytes, n, chunk_rows, steps, rows);
  }
}

// All frames of a packed file through the device's functions.
void check_undone(std::span<const std::byte> file) {
  const auto view = FileView::open(file);
  REQUIRE(view);
  const auto direct = load_direct(*view);
  REQUIRE(direct);
  const Header& h = view->header();
  std::vector<std::byte> means(direct->means().size()), geometry(direct->geometry().size()), sh(direct->sh().size());
  for (const auto& [type, rows] : {std::pair(SectionType::means, &means), std::pair(SectionType::geometry, &geometry),
                                   std::pair(SectionType::sh, &sh)}) {
    const FrameTable& table = view->frames(type);
    for (std::uint64_t f = 0; f < table.frames.size(); ++f) {
      const auto content = content_of(*view, type, f);
      const std::uint32_t n = rows_of_frame(*view, type, f);
      std::byte* const to = rows->data() + f * table.rows * (rows->size() / h.n_gaussians);
      if (type == SectionType::means) {
        undo_words(content, n, to);
      } else if (type == SectionType::geometry) {
        undo_geometry(content, n, to);
      } else {
        const auto steps = relative_sh_steps(*view, f);
        REQUIRE(steps);
        undo_sh(h.sh_degree, content, n, h.chunk_size, *steps, to);
      }
    }
  }
  CHECK(std::ranges::equal(means, direct->means()));
  CHECK(std::ranges::equal(geometry, direct->geometry()));
  CHECK(std::ranges::equal(sh, direct->sh()));
}

std::vector<std::byte> packed(const SplatCloud& cloud, EncodeOptions options) {
  options.profile = Profile::packed;
  auto bytes = encode(cloud.view(), options);
  REQUIRE(bytes);
  return std::move(*bytes);
}

}  // namespace

TEST_CASE("the device's functions decode contents of frames to rows") {
  for (const std::uint64_t n : {1u, 63u, 64u, 65u, 255u, 256u, 257u, 1000u, 16384u, 40001u}) {
    for (const int degree : {0, 1, 2, 3}) {
      if (n > 2000 && degree < 3) continue;
      for (const std::uint32_t chunk_size : {32u, 96u, 256u, 65536u}) {
        CAPTURE(n);
        CAPTURE(degree);
        CAPTURE(chunk_size);
        SplitMix random{3 * n + static_cast<std::uint64_t>(degree) + chunk_size};
        EncodeOptions options;
        options.chunk_size = chunk_size;
        options.chunk_step_sets = chunk_size != 96;
        check_undone(packed(random_cloud(n, degree, random), options));
      }
    }
  }
  for (const GoldenScene& scene : golden_scenes()) {
    CAPTURE(scene.name);
    if (scene.cloud.size() != 0) check_undone(packed(scene.cloud, scene.options));
  }
}

TEST_CASE("any content, even one that no writer makes, becomes the same SH on host and device") {
  SplitMix random{17};
  detail::ShLanes lanes;
  for (int degree = 0; degree <= kMaxShDegree; ++degree) {
    for (const std::uint32_t n : {1u, 64u, 130u, 777u}) {
      const std::uint32_t chunk_rows = n % 2 == 0 ? 32 : 96;
      const int n_codes = 3 * sh_coefficients(degree);
      std::vector<std::byte> content(sh_weight_bytes(n_codes) + n * static_cast<std::uint32_t>(n_codes));
      for (std::byte& b : content) b = static_cast<std::byte>(random.below(256));
      std::vector<ShStepSet> sets((n + chunk_rows - 1) / chunk_rows);
      for (ShStepSet& set : sets) {
        for (auto& of_degree : set.step) {
          for (float& step : of_degree) step = random.below(4) == 0 ? 0.f : random.dyadic(0, 1);
        }
      }
      const detail::ShFrame frame{degree, chunk_rows, sets};
      std::vector<std::byte> expected(n * sh_bytes(degree)), found(expected.size());
      const auto* bytes = reinterpret_cast<const std::uint8_t*>(content.data());
      detail::decode_sh_planes(lanes, {bytes, content.size()}, n, frame, expected);
      undo_sh(degree, content, n, chunk_rows, detail::relative_sh_steps(frame), found.data());
      CAPTURE(degree);
      CAPTURE(n);
      CHECK(expected == found);
    }
  }
}

TEST_CASE("w of every kind of quaternion equals that of the decoder's vectors") {
  SplitMix random{23};
  constexpr std::size_t kCount = 1024;
  std::vector<std::uint8_t> planes(6 * kCount);
  std::vector<std::uint16_t> w(kCount);
  for (int round = 0; round < 16; ++round) {
    for (std::size_t i = 0; i < kCount; ++i) {
      for (std::size_t k = 0; k < 3; ++k) {  // any FP16, or one below 1
        const std::uint64_t half = round % 2 == 0 ? random.below(65536) : random.below(0x3C00) | random.below(2) << 15;
        planes[2 * k * kCount + i] = static_cast<std::uint8_t>(half);
        planes[(2 * k + 1) * kCount + i] = static_cast<std::uint8_t>(half >> 8);
      }
    }
    detail::codec_kernels().unit_w(planes.data(), kCount, kCount, w.data());
    for (std::size_t i = 0; i < kCount; ++i) {
      const auto half = [&](std::size_t k) {
        return static_cast<std::uint16_t>(planes[2 * k * kCount + i] | planes[(2 * k + 1) * kCount + i] << 8);
      };
      REQUIRE(w[i] == unit_w(half(0), half(1), half(2)));
    }
  }
}

TEST_CASE("a damaged frame has no content") {
  SplitMix random{29};
  auto file = packed(random_cloud(1000, 2, random), {});
  const auto view = FileView::open(file);
  REQUIRE(view);
  FrameContents reader;
  for (const SectionType type : {SectionType::means, SectionType::geometry, SectionType::sh}) {
    const CodedFrame frame = view->frames(type).frames[0];
    std::vector<std::byte> content(frame_content_bytes(*view, type, 0));
    file[frame.offset + frame.stored_bytes / 2] ^= std::byte{1};
    const Status read = reader.read(*view, type, 0, content);
    file[frame.offset + frame.stored_bytes / 2] ^= std::byte{1};
    REQUIRE_FALSE(read);
    CHECK(read.error().code == Errc::checksum_mismatch);
    CHECK(read.error().offset == frame.offset);
  }
}

TEST_CASE("what validate() checks besides the Gaussians is checked without them") {
  SplitMix random{31};
  EncodeOptions options;
  options.keep_permutation = true;
  const auto file = packed(random_cloud(1000, 1, random), options);
  const auto view = FileView::open(file);
  REQUIRE(view);
  const auto direct = load_direct(*view);
  REQUIRE(direct);
  ValueCounts counts;
  for (std::uint64_t i = 0; i < direct->size(); ++i) {
    std::uint16_t row[8];
    std::memcpy(row, direct->geometry().data() + 16 * i, sizeof row);
    CHECK(is_unit_quaternion(row));
    counts.add(row);
  }
  CHECK(validate_tables(*view));
  CHECK(validate_declarations(*view, counts));
  ++counts.opacity_one;
  const Status found = validate_declarations(*view, counts);
  REQUIRE_FALSE(found);
  CHECK(found.error().code == Errc::bad_value);
  CHECK(found.error().offset == view->find(SectionType::declarations)->offset + 144);

  auto twice = file;
  const std::uint64_t at = view->find(SectionType::permutation)->offset;
  std::copy_n(twice.begin() + static_cast<std::ptrdiff_t>(at), 4, twice.begin() + static_cast<std::ptrdiff_t>(at) + 4);
  const auto damaged = FileView::open(twice);
  REQUIRE(damaged);
  const Status tables = validate_tables(*damaged);
  REQUIRE_FALSE(tables);
  CHECK(tables.error().code == Errc::checksum_mismatch);
}

TEST_CASE("words of four SH codes are checked like their codes") {
  for (std::uint32_t value = 0; value < 256; ++value) {
    for (int byte = 0; byte < 4; ++byte) {
      const std::uint32_t others = ~(0xFFu << (8 * byte)), word = value << (8 * byte) | (0x01010101u & others);
      CHECK(are_stored_codes(word, 0xFFFFFFFFu) == (value != 0x80));
      CHECK(are_stored_codes(value << (8 * byte), others) == (value == 0));
    }
  }
}
