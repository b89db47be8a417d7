// row_kernels_test.cpp - vectorised row checks against a check row by row.
// SPDX-License-Identifier: Apache-2.0
#include "file/row_kernels.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <random>
#include <utility>
#include <vector>

#include "instruction_sets.hpp"
#include "rgs/quantize.hpp"

using namespace rgs;
using namespace rgs::detail;
using rgs::test::with_each_instruction_set;

namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity(), kNan = std::numeric_limits<float>::quiet_NaN();

/// At an odd address and without slack, so that AddressSanitizer detects any overread.
template <class Row>
class Misaligned {
 public:
  explicit Misaligned(const std::vector<Row>& rows) : bytes_(new std::byte[1 + rows.size() * sizeof(Row)]) {
    if (!rows.empty()) std::memcpy(bytes_.get() + 1, rows.data(), rows.size() * sizeof(Row));
  }
  const std::byte* data() const { return bytes_.get() + 1; }

 private:
  std::unique_ptr<std::byte[]> bytes_;
};

struct Rows {
  std::vector<std::array<float, 3>> means;
  std::vector<std::array<std::uint16_t, 8>> geometry;
};

/// Legal, often at the limits.
Rows rows_of(std::size_t n, std::mt19937& random) {
  Rows rows;
  const auto one_of = [&random](const auto& values) { return values[random() % std::size(values)]; };
  const auto side = random() % 3;  // of 0, for boxes that end there
  for (std::size_t i = 0; i < n; ++i) {
    const auto coordinate = [&] {
      constexpr float kEnds[] = {0.F, -0.F, 0x1p-149F, -0x1p-149F, 3.4e38F, -3.4e38F};
      const float x = random() % 4 == 0 ? one_of(kEnds) : static_cast<float>(random() % 2000) - 1000.F;
      return x == 0 || side == 0 ? x : std::copysign(x, side == 1 ? 1.F : -1.F);
    };
    rows.means.push_back({coordinate(), coordinate(), coordinate()});
    std::array<std::uint16_t, 8> row{};
    float q[4] = {};
    for (float& x : q) x = static_cast<float>(random() % 2001) - 1000.F;
    if (random() % 4 == 0) q[1] = -0.F;
    if (random() % 4 == 0) q[2] = q[3] = 1e-6F;
    if (q[0] == 0 && q[1] == 0) q[1] = 1;
    quantize_rotation(q, row.data());
    for (std::size_t k = 4; k < 7; ++k) {
      constexpr std::uint16_t kEnds[] = {0, 1, 0x03FF, 0x0400, 0x7BFF};
      row[k] = static_cast<std::uint16_t>(random() % 3 == 0 ? one_of(kEnds) : random() % 0x7C00);
    }
    constexpr std::uint16_t kEnds[] = {0, 1, 0x3BFF, 0x3C00};
    row[7] = static_cast<std::uint16_t>(random() % 3 == 0 ? one_of(kEnds) : random() % 0x3C01);
    rows.geometry.push_back(row);
  }
  return rows;
}

/// One by one.
RowSummary summary_of(const Rows& rows) {
  RowSummary summary;
  for (std::size_t i = 0; i < rows.means.size(); ++i) {
    for (std::size_t k = 0; k < 3; ++k) {
      const float x = rows.means[i][k] + 0.F;
      summary.means.min[k] = i == 0 ? x : std::min(summary.means.min[k], x);
      summary.means.max[k] = i == 0 ? x : std::max(summary.means.max[k], x);
      summary.largest_scale = std::max(summary.largest_scale, rows.geometry[i][4 + k]);
    }
    summary.largest_opacity = std::max(summary.largest_opacity, rows.geometry[i][7]);
    summary.counts.add(rows.geometry[i].data());
  }
  return summary;
}

bool same_bits(const std::array<float, 3>& a, const std::array<float, 3>& b) {
  return std::memcmp(a.data(), b.data(), sizeof a) == 0;
}
bool same_but_counts(const RowSummary& a, const RowSummary& b) {
  return same_bits(a.means.min, b.means.min) && same_bits(a.means.max, b.means.max) &&
         a.largest_scale == b.largest_scale && a.largest_opacity == b.largest_opacity;
}
bool same(const RowSummary& a, const RowSummary& b) {
  return same_but_counts(a, b) && a.counts.scale_subnormal == b.counts.scale_subnormal &&
         a.counts.scale_zero == b.counts.scale_zero && a.counts.opacity_zero == b.counts.opacity_zero &&
         a.counts.opacity_one == b.counts.opacity_one;
}

bool check(const Rows& rows, RowSummary& summary) {
  const Misaligned means(rows.means);
  const Misaligned geometry(rows.geometry);
  return row_kernels().check(means.data(), geometry.data(), rows.means.size(), summary);
}
bool summarize(const Rows& rows, RowSummary& summary) {
  const Misaligned means(rows.means);
  const Misaligned geometry(rows.geometry);
  return row_kernels().summarize(means.data(), geometry.data(), rows.means.size(), summary);
}

}  // namespace

TEST_CASE("every instruction set finds legal rows legal, and their contents") {
  int n_sets = 0;
  with_each_instruction_set([&n_sets] {
    ++n_sets;
    std::mt19937 random{11};
    for (std::size_t turn = 0; turn < 700; ++turn) {
      const Rows rows = rows_of(1 + turn % 70, random);
      const RowSummary expected = summary_of(rows);
      RowSummary checked, summarized;
      REQUIRE(check(rows, checked));
      REQUIRE(summarize(rows, summarized));
      REQUIRE(same(checked, expected));
      REQUIRE(same_but_counts(summarized, expected));
    }
  });
#if defined(__x86_64__)
  CHECK(n_sets >= 2);  // also without vectors
#endif
}

TEST_CASE("every instruction set finds a broken rule in each row") {
  with_each_instruction_set([] {
    std::mt19937 random{12};
    for (std::size_t n = 1; n <= 70; ++n) {
      const Rows legal = rows_of(n, random);
      const auto breaks = [&](const auto& change) {
        std::size_t n_seen = 0;
        for (std::size_t row = 0; row < n; ++row) {
          Rows rows = legal;
          change(rows.means[row], rows.geometry[row]);
          RowSummary summary;
          n_seen += !check(rows, summary);
        }
        return n_seen == n;
      };
      for (std::size_t k = 0; k < 3; ++k) {
        for (const float value : {kNan, -kNan, kInfinity, -kInfinity}) {
          CHECK(breaks([&](auto& mean, auto&) { mean[k] = value; }));
        }
        for (const int code : {0x7C00, 0x7C01, 0x7FFF, 0x8000, 0x8001, 0xBC00, 0xFC00, 0xFFFF}) {
          CHECK(breaks([&](auto&, auto& row) { row[4 + k] = static_cast<std::uint16_t>(code); }));
        }
      }
      for (std::size_t k = 0; k < 4; ++k) {
        for (const int code : {0x7C00, 0x7E00, 0xFC00, 0xFFFF, 0x7BFF, 0x3D00, 0xBD00}) {
          CHECK(breaks([&](auto&, auto& row) { row[k] = static_cast<std::uint16_t>(code); }));
        }
      }
      CHECK(breaks([](auto&, auto& row) { row[0] = static_cast<std::uint16_t>(row[0] | 0x8000); }));
      CHECK(breaks([](auto&, auto& row) { row[0] = row[1] = row[2] = row[3] = 0; }));
      for (const int code : {0x3C01, 0x7C00, 0x7E00, 0x8000, 0xBC00, 0xFFFF}) {
        CHECK(breaks([&](auto&, auto& row) { row[7] = static_cast<std::uint16_t>(code); }));
      }
    }
  });
}

TEST_CASE("the quick check accepts no illegal norm, and every legal norm not within 2^-20 of a limit") {
  with_each_instruction_set([] {
    std::mt19937 random{13};
    int n_legal = 0, n_illegal = 0, n_open = 0;
    for (int turn = 0; turn < 200000; ++turn) {
      Rows rows = rows_of(1, random);
      // Of a random direction, near one of the limits.
      double q[4], squared = 0;
      for (double& x : q) x = static_cast<double>(random()) / 4294967296.0, squared += x * x;
      const double norm = 1 + (turn % 2 == 0 ? 1 : -1) * kStoredNormTolerance;
      auto row = rows.geometry[0];
      squared /= norm;
      double stored = 0;
      for (std::size_t k = 0; k < 4; ++k) {
        row[k] = half_from_float(static_cast<float>(q[k] / std::sqrt(squared)));
        const auto x = static_cast<double>(float_from_half(row[k]));
        stored += x * x;
      }
      rows.means.assign(16, rows.means[0]), rows.geometry.assign(16, row);
      RowSummary summary;
      const bool found = check(rows, summary), is_legal = is_unit_quaternion(row.data());
      if (found && !is_legal) FAIL("accepted, but illegal");
      if (!found && is_legal) {
        ++n_open;
        CHECK(std::abs(stored - 1) > kStoredNormTolerance - 0x1p-20);
      }
      n_legal += is_legal, n_illegal += !is_legal;
    }
    CHECK(n_legal > 50000);
    CHECK(n_illegal > 50000);
    CHECK(n_open < 2000);
  });
}

TEST_CASE("rows are summed up for any GEOM, unless a mean is not finite") {
  with_each_instruction_set([] {
    std::mt19937 random{14};
    for (std::size_t n = 1; n <= 70; ++n) {
      Rows rows = rows_of(n, random);
      for (auto& row : rows.geometry) {
        for (auto& code : row) code = static_cast<std::uint16_t>(random() % (n % 2 == 0 ? 0x8000 : 0x10000));
      }
      RowSummary summary;
      REQUIRE(summarize(rows, summary));
      REQUIRE(same_but_counts(summary, summary_of(rows)));
      for (std::size_t i = 0; i < n; ++i) {
        for (std::size_t k = 0; k < 3; ++k) {
          const float before = std::exchange(rows.means[i][k], i % 2 == 0 ? kNan : -kInfinity);
          REQUIRE(!summarize(rows, summary));
          rows.means[i][k] = before;
        }
      }
    }
  });
}

TEST_CASE("counts of the largest chunk do not overflow") {
  with_each_instruction_set([] {
    for (const std::uint16_t opacity : {std::uint16_t{0}, std::uint16_t{0x3C00}}) {
      for (const std::uint16_t scale : {std::uint16_t{0}, std::uint16_t{1}}) {
        Rows rows;
        rows.means.assign(kMaxChunkSize, {1, 2, 3});
        rows.geometry.assign(kMaxChunkSize, {0x3C00, 0, 0, 0, scale, scale, scale, opacity});
        RowSummary summary;
        CHECK(check(rows, summary));
        CHECK(summary.counts.scale_zero == (scale == 0 ? 3 * kMaxChunkSize : 0));
        CHECK(summary.counts.scale_subnormal == (scale == 0 ? 0 : 3 * kMaxChunkSize));
        CHECK(summary.counts.opacity_zero == (opacity == 0 ? kMaxChunkSize : 0));
        CHECK(summary.counts.opacity_one == (opacity == 0 ? 0 : kMaxChunkSize));
      }
    }
  });
}

TEST_CASE("every instruction set finds an illegal SH code in each byte") {
  with_each_instruction_set([] {
    std::mt19937 random{15};
    for (int degree = 0; degree <= 3; ++degree) {
      const std::size_t stride = sh_bytes(degree), n_codes = 3 * static_cast<std::size_t>(sh_coefficients(degree));
      for (std::size_t n = 1; n <= 70; ++n) {
        ShStepSet steps;
        for (auto& row : steps.step) {
          for (float& step : row) step = random() % 4 == 0 ? 0.F : 0.5F;
        }
        const auto is_coded = [&](std::size_t at) {
          return at % stride < n_codes && steps.of_value(static_cast<int>(at % stride)) != 0;
        };
        std::vector<std::uint8_t> bytes(n * stride);
        for (std::size_t i = 0; i < bytes.size(); ++i) {
          if (is_coded(i)) bytes[i] = static_cast<std::uint8_t>(random() % 255 + 0x81);  // any but 0x80
        }
        const ShRowMask mask(steps, degree);
        const auto is_legal = [&] {
          const Misaligned rows(bytes);
          return row_kernels().check_sh(rows.data(), bytes.size(), mask);
        };
        REQUIRE(is_legal());
        for (std::size_t i = 0; i < bytes.size(); i += n < 5 || n > 68 ? 1 : 1 + random() % 13) {
          const std::uint8_t before = bytes[i];
          bytes[i] = 0x80;
          REQUIRE(!is_legal());
          if (!is_coded(i)) {
            bytes[i] = static_cast<std::uint8_t>(1U << random() % 7);
            REQUIRE(!is_legal());
          }
          bytes[i] = before;
        }
      }
    }
  });
}
