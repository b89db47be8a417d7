// hostile_test.cpp - damaged and malicious files: an error or a valid decode, never a crash or a large allocation.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <memory>
#include <numeric>
#include <string_view>
#include <vector>

#include "checkout.hpp"
#include "counted_memory.hpp"
#include "edit_file.hpp"
#include "golden_scenes.hpp"
#include "rgs/decode.hpp"
#include "skip.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

Bytes golden(const std::string& name) {
  return read_bytes(source_dir() + "/tests/golden/" + name + ".rgs");
}

// Decodes from an exact-size heap block, so that AddressSanitizer detects any overread. A decoded scene must be
// drawable.
Status decode_exactly(std::span<const std::byte> bytes) {
  const auto exact = std::make_unique<std::byte[]>(bytes.size());
  std::ranges::copy(bytes, exact.get());
  const auto cloud = decode({exact.get(), bytes.size()});
  if (!cloud) return tl::unexpected(cloud.error());
  REQUIRE(cloud->view().consistent());
  for (const auto* values : {&cloud->mean, &cloud->log_scale, &cloud->rotation, &cloud->opacity_logit, &cloud->sh}) {
    for (const float value : *values) REQUIRE(std::isfinite(value));
  }
  return {};
}

// The same sections in another order of the table.
Bytes with_order(const Bytes& file, std::span<const std::uint64_t> order) {
  Bytes out(file.begin(), file.begin() + static_cast<std::ptrdiff_t>(entry_at(order.size()) + 8));
  for (std::size_t i = 0; i < order.size(); ++i) {
    std::memcpy(out.data() + entry_at(i), file.data() + entry_at(order[i]), 64);
    const auto from = get<std::uint64_t>(out, entry_at(i) + 16), size = get<std::uint64_t>(out, entry_at(i) + 24);
    out.resize((out.size() + 255) / 256 * 256);
    put<std::uint64_t>(out, entry_at(i) + 16, out.size());
    const auto bytes = std::span(file).subspan(from, size);
    out.insert(out.end(), bytes.begin(), bytes.end());
  }
  put<std::uint64_t>(out, 16, out.size());
  fix_hashes(out);
  return out;
}

}  // namespace

TEST_CASE("every prefix of a golden file is an error") {
  for (const char* name : {"empty", "two", "degree3", "global", "optional", "packed_degree1", "packed_degree2"}) {
    const Bytes bytes = golden(name);
    CAPTURE(name);
    REQUIRE(decode_exactly(bytes));
    for (std::size_t size = 0; size < bytes.size(); ++size) {
      CAPTURE(size);
      const Status status = decode_exactly(std::span(bytes).first(size));
      REQUIRE_FALSE(status);
      CHECK(status.error().code == Errc::truncated);
      CHECK(status.error().offset == size);
    }
  }
}

TEST_CASE("every prefix with a corrected header is an error") {
  for (const char* name : {"optional", "packed_degree1", "packed_degree2"}) {
    CAPTURE(name);
    const Bytes bytes = golden(name);
    for (std::size_t size = 128; size < bytes.size(); ++size) {
      CAPTURE(size);
      Bytes prefix(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(size));
      put<std::uint64_t>(prefix, 16, size);
      fix_hashes(prefix);
      REQUIRE_FALSE(decode_exactly(prefix));
    }
  }
}

TEST_CASE("every prefix of a frame is an error, and so is a frame with an extra byte") {
  const Bytes bytes = golden("packed_degree1");
  for (const char* type : {"MEAN", "GEOM", "SHI8"}) {
    CAPTURE(type);
    const std::uint64_t section = section_of(bytes, type), entry = entry_of(bytes, type);
    const auto stored = get<std::uint32_t>(bytes, section + 16);
    REQUIRE(get<std::uint32_t>(bytes, section + 4) == 1);  // the frame starts after a table of one entry
    for (std::uint32_t size = 0; size <= stored + 1; ++size) {
      CAPTURE(size);
      Bytes changed(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(section + 32));
      for (std::uint32_t i = 0; i < size; ++i) changed.push_back(i < stored ? bytes[section + 32 + i] : std::byte{0});
      // The following sections are laid out again.
      put<std::uint32_t>(changed, section + 16, size);
      put<std::uint64_t>(changed, entry + 24, 32 + size);
      for (std::uint64_t next = entry + 64; next < entry_at(get<std::uint32_t>(bytes, 52)); next += 64) {
        const auto from = get<std::uint64_t>(bytes, next + 16), length = get<std::uint64_t>(bytes, next + 24);
        changed.resize((changed.size() + 255) / 256 * 256);
        put<std::uint64_t>(changed, next + 16, changed.size());
        changed.insert(changed.end(), bytes.begin() + static_cast<std::ptrdiff_t>(from),
                       bytes.begin() + static_cast<std::ptrdiff_t>(from + length));
      }
      put<std::uint64_t>(changed, 16, changed.size());
      fix_hashes(changed);
      const Status status = decode_exactly(changed);
      if (size == stored) {
        REQUIRE(status);
      } else {
        REQUIRE_FALSE(status);
        CHECK(status.error().code == Errc::corrupt_data);
        CHECK(status.error().offset == section + 32);
      }
    }
  }
}

TEST_CASE("bytes after the end are an error") {
  for (const std::size_t extra : {1u, 255u, 256u, 4096u}) {
    Bytes bytes = golden("two");
    const std::size_t size = bytes.size();
    bytes.resize(size + extra);
    const Status status = decode_exactly(bytes);
    REQUIRE_FALSE(status);
    CHECK(status.error().code == Errc::trailing_bytes);
    CHECK(status.error().offset == size);
    put<std::uint64_t>(bytes, 16, bytes.size());
    fix_hashes(bytes);
    CHECK_FALSE(decode_exactly(bytes));
  }
}

TEST_CASE("every single-byte change is an error while its hash is wrong") {
  for (const char* name : {"empty", "two", "optional", "degree3", "packed_degree1", "packed_global"}) {
    CAPTURE(name);
    Bytes bytes = golden(name);
    const std::uint64_t head = section_of(bytes, "SHSC");  // head and DECL: all values
    for (std::size_t i = 0; i < bytes.size(); ++i) {
      CAPTURE(i);
      const std::byte original = bytes[i];
      const auto changed = [&](unsigned value) {
        bytes[i] = static_cast<std::byte>(value);
        if (bytes[i] != original) REQUIRE_FALSE(decode_exactly(bytes));
      };
      const auto old = static_cast<unsigned>(original);
      if (i < head && std::string_view(name) == "optional") {
        for (unsigned value = 0; value < 256; ++value) changed(value);
      } else {
        for (const unsigned value : {old + 1, old - 1, old ^ 0x80u, 0xFFu}) changed(value & 0xFFu);
      }
      bytes[i] = original;
    }
  }
}

TEST_CASE("every single-byte change with corrected hashes is an error or a valid decode") {
  std::uint64_t errors = 0, decodes = 0;
  for (const char* name :
       {"empty", "two", "optional", "global", "degree3", "packed_degree0", "packed_degree1", "packed_global"}) {
    CAPTURE(name);
    const Bytes golden_bytes = golden(name);
    Bytes bytes = golden_bytes;
    const std::uint64_t head = section_of(bytes, "SHSC");
    for (std::size_t i = 0; i < bytes.size(); ++i) {
      CAPTURE(i);
      const auto old = static_cast<unsigned>(bytes[i]);
      const auto changed = [&](unsigned value) {
        bytes[i] = static_cast<std::byte>(value);
        fix_hashes(bytes);
        ++(decode_exactly(bytes) ? decodes : errors);
        bytes = golden_bytes;
      };
      if (i < head && std::string_view(name) == "optional") {
        for (unsigned value = 0; value < 256; ++value) changed(value);
      } else {
        for (const unsigned value : {old + 1, old - 1, old ^ 0x80u, 0xFFu}) changed(value & 0xFFu);
      }
    }
  }
  MESSAGE(errors << " errors, " << decodes << " valid decodes");
  CHECK(errors > 1000);
  CHECK(decodes > 1000);
}

TEST_CASE("counts near 2^32 and 2^64 are refused without arithmetic overflow") {
  const DecodeLimits unlimited{~std::uint64_t{0}, ~std::uint64_t{0}};
  const Bytes original = golden("optional");
  for (const int power : {31, 32, 33, 58, 59, 60, 61, 62, 63, 64}) {
    for (int delta = -2; delta <= 2; ++delta) {
      const std::uint64_t n = (power == 64 ? 0 : std::uint64_t{1} << power) + static_cast<std::uint64_t>(delta);
      if (n < 1000) continue;  // wrapped around
      CAPTURE(n);
      for (const std::uint64_t field : {16u, 24u, 32u, 40u}) {
        Bytes bytes = original;
        put(bytes, field, n);
        if (field == 24) put(bytes, 32, n / 256 + (n % 256 != 0 ? 1 : 0));
        fix_hashes(bytes);
        CHECK_FALSE(FileView::open(bytes, unlimited));
      }
      for (std::uint64_t section = 0; section < 8; ++section) {
        for (const std::uint64_t field : {16u, 24u, 32u}) {
          Bytes bytes = original;
          put(bytes, entry_at(section) + field, n);
          if (field == 24) put(bytes, entry_at(section) + 32, n);
          fix_hashes(bytes);
          CHECK_FALSE(FileView::open(bytes, unlimited));
        }
      }
    }
  }
  // Here 12 * n wraps around to the section's 72 bytes.
  Bytes bytes = original;
  const std::uint64_t n = (std::uint64_t{1} << 62) + 6, chunks = n / 256 + 1;
  put(bytes, 24, n);
  put(bytes, 32, chunks);
  fix_hashes(bytes);
  const auto view = FileView::open(bytes, unlimited);
  REQUIRE_FALSE(view);
  CHECK(view.error().code == Errc::size_mismatch);
}

TEST_CASE("the caller's limits hold") {
  const Bytes bytes = golden("degree3");
  DecodeLimits limits;
  limits.max_gaussians = 40;
  limits.max_file_bytes = bytes.size();
  CHECK(FileView::open(bytes, limits));
  limits.max_gaussians = 39;
  CHECK(FileView::open(bytes, limits).error().code == Errc::limit_exceeded);
  CHECK(FileView::open(bytes, limits).error().offset == 24);
  limits.max_gaussians = 40;
  limits.max_file_bytes = bytes.size() - 1;
  CHECK(FileView::open(bytes, limits).error().code == Errc::limit_exceeded);
  CHECK(FileView::open(bytes, limits).error().offset == 16);
}

TEST_CASE("the size of the file limits what coded sections decode to") {
  SplatCloud cloud;
  cloud.resize(50000, 3);
  for (std::size_t i = 0; i < cloud.size(); ++i) cloud.set(i, {});
  EncodeOptions options;
  options.profile = Profile::packed;
  const auto bytes = encode(cloud.view(), options);
  REQUIRE(bytes);
  CHECK(bytes->size() < 50000);  // 3.8 MB decoded
  CHECK(decode(*bytes));
  DecodeLimits limits;
  limits.max_expansion = 10;
  const auto view = FileView::open(*bytes, limits);
  REQUIRE_FALSE(view);
  CHECK(view.error().code == Errc::limit_exceeded);
  CHECK(view.error().offset == entry_of(*bytes, "GEOM") + 32);
}

TEST_CASE("sections may be in any order, and errors do not depend on it") {
  for (const char* name : {"optional", "packed_degree3", "archive_degree3", "archive3_degree3"}) {
    CAPTURE(name);
    const Bytes original = golden(name);
    const auto expected = decode(original);
    REQUIRE(expected);
    std::vector<std::uint64_t> order(get<std::uint32_t>(original, 52));
    std::iota(order.begin(), order.end(), 0u);
    for (std::size_t turn = 0; turn < order.size(); ++turn) {
      CAPTURE(turn);
      std::rotate(order.begin(), order.begin() + 1, order.end());
      if (turn % 2 == 0) std::ranges::reverse(order);
      Bytes bytes = with_order(original, order);
      const auto cloud = decode(bytes);
      REQUIRE(cloud);
      CHECK(cloud->mean == expected->mean);
      CHECK(cloud->sh == expected->sh);
      if (get<std::uint16_t>(bytes, 10) < 2) continue;
      // Frames of 320 rows are one frame here as well.
      for (const char* type : {"GEOM", "SHI8"}) {
        Bytes changed = bytes;
        const std::uint64_t rows = section_of(changed, std::string_view(type) == "GEOM" ? "MEAN" : type);
        put<std::uint32_t>(changed, rows, 320);
        fix_hashes(changed);
        const Status status = decode_exactly(changed);
        REQUIRE_FALSE(status);
        CHECK(status.error().code == Errc::bad_value);
        CHECK(status.error().offset == section_of(changed, type));
      }
    }
  }
}

TEST_CASE("sections of unknown types are skipped, whatever their codec and decoded size") {
  for (const char* name : {"optional", "packed_edges", "archive_degree1", "archive3_degree1"}) {
    const Bytes original = golden(name);
    const std::uint64_t perm = entry_of(original, "PERM"), section = section_of(original, "PERM");
    const bool archive = get<std::uint16_t>(original, 10) >= 2;
    const auto expected = decode(original);
    REQUIRE(expected);
    // ARCH is an unknown type before version 1.2, that of golden "optional" and "packed_edges".
    for (const char* type : {"ZZZZ", "ARCH"}) {
      if (archive && std::string_view(type) == "ARCH") continue;
      for (const std::uint32_t codec : {0u, 1u, 2u, 3u, 4u, ~0u}) {
        CAPTURE(name);
        CAPTURE(type);
        CAPTURE(codec);
        Bytes bytes = original;
        std::memcpy(bytes.data() + perm, type, 4);
        put(bytes, perm + 8, codec);
        put(bytes, perm + 32, ~std::uint64_t{0});
        fix_hashes(bytes);
        const auto view = FileView::open(bytes);
        REQUIRE(view);
        CHECK(validate(*view));
        CHECK((view->archive() != nullptr) == archive);
        const auto cloud = decode(bytes);
        REQUIRE(cloud);
        CHECK(cloud->mean == expected->mean);
        CHECK(cloud->log_scale == expected->log_scale);
        CHECK(cloud->rotation == expected->rotation);
        CHECK(cloud->opacity_logit == expected->opacity_logit);
        CHECK(cloud->sh == expected->sh);
        bytes[section] ^= std::byte{1};  // its hash is checked nevertheless
        const Status status = validate(*FileView::open(bytes));
        REQUIRE_FALSE(status);
        CHECK(status.error().code == Errc::checksum_mismatch);
        CHECK(status.error().offset == section);
      }
    }
  }
}

TEST_CASE("unknown types may appear twice, also in files of later minor versions") {
  for (const unsigned minor : {0u, 1u, 2u, 3u, 65535u}) {
    CAPTURE(minor);
    Bytes bytes = golden("optional");
    for (const std::uint64_t entry : {entry_of(bytes, "PERM"), entry_of(bytes, "PROV")}) {
      std::memcpy(bytes.data() + entry, "ZZZZ", 4);
      put(bytes, entry + 8, 2u);
    }
    put(bytes, 10, static_cast<std::uint16_t>(minor));
    fix_hashes(bytes);
    CHECK(decode_exactly(bytes));
  }
}

TEST_CASE("unspecified enumerators in DECL are refused") {
  struct Field {
    std::uint64_t at;
    unsigned low, high;
  };
  const Bytes original = golden("two");
  const std::uint64_t declarations = section_of(original, "DECL");
  for (const Field& f :
       {Field{3, 0, 2}, {4, 1, 1}, {5, 1, 1}, {6, 0, 2}, {7, 1, 1}, {8, 1, 2}, {9, 1, 3}, {10, 1, 2}}) {
    CAPTURE(f.at);
    for (unsigned value = 0; value < 256; ++value) {
      CAPTURE(value);
      Bytes bytes = original;
      put(bytes, declarations + f.at, static_cast<std::uint8_t>(value));
      fix_hashes(bytes);
      const auto view = FileView::open(bytes);
      REQUIRE(view.has_value() == (value >= f.low && value <= f.high));
      if (view) continue;
      CHECK(view.error().code == Errc::bad_value);
      CHECK(view.error().offset == declarations + f.at);
    }
  }
}

TEST_CASE("a small file causes no large allocation") {
  if (!counts_memory()) return skip("a sanitizer has the allocator");
  constexpr std::int64_t kMemory = 4 << 20;
  const auto decoded_within_memory = [&](const Bytes& bytes, const DecodeLimits& limits) {
    const std::int64_t before = live_bytes();
    reset_peak_bytes();
    const auto cloud = decode(bytes, limits);
    CHECK(peak_bytes() - before < kMemory);
    if (!cloud) CHECK(cloud.error().code != Errc::host_out_of_memory);  // never requested
    return cloud.has_value();
  };
  // Large counts, and the largest chunks with a few Gaussians.
  Bytes large_chunks = golden("two");
  put<std::uint32_t>(large_chunks, 48, 65536);
  fix_hashes(large_chunks);
  CHECK(decoded_within_memory(large_chunks, {}));
  for (const std::uint64_t n : {std::uint64_t{1} << 32, std::uint64_t{1} << 60, ~std::uint64_t{0}}) {
    Bytes bytes = golden("optional");
    put(bytes, 24, n);
    put(bytes, 32, n / 256 + (n % 256 != 0 ? 1 : 0));
    fix_hashes(bytes);
    CHECK_FALSE(decoded_within_memory(bytes, {~std::uint64_t{0}, ~std::uint64_t{0}}));
  }
}
