// probe_test.cpp - a device's measured rates against its description.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include "device_fixture.hpp"
#include "probe.hpp"

TEST_CASE("measured rates are within the limits of the device's clock and width") {
  if (!rgs::test::device_answers()) return;
  if (rgs::test::small_sizes()) return rgs::test::skip("rates under a sanitizer mean nothing");
  const auto rates = rgs::cuda::measure_rates();
  rgs::test::require_ok(rates);
  int device = 0, processors = 0, kilohertz = 0, bus_bits = 0, memory_kilohertz = 0;
  rgs::test::require_cuda(cudaGetDevice(&device));
  rgs::test::require_cuda(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device));
  rgs::test::require_cuda(cudaDeviceGetAttribute(&kilohertz, cudaDevAttrClockRate, device));
  rgs::test::require_cuda(cudaDeviceGetAttribute(&bus_bits, cudaDevAttrGlobalMemoryBusWidth, device));
  rgs::test::require_cuda(cudaDeviceGetAttribute(&memory_kilohertz, cudaDevAttrMemoryClockRate, device));
  // No multiprocessor since Turing issues more than 128 FP32 lanes, 32 special ones or one load of a warp per clock. A
  // probe that the compiler removed would be far above, one that measures its own overhead far below.
  const double clocks = 1e3 * kilohertz * processors;
  CHECK(rates->fp32 < 1.05 * 128 * clocks);
  CHECK(rates->fp32 > 0.2 * 64 * clocks);
  CHECK(rates->special < 1.05 * 32 * clocks);
  CHECK(rates->special > 0.2 * 16 * clocks);
  CHECK(rates->shared_loads < 1.05 * clocks);
  CHECK(rates->shared_loads > 0.05 * clocks);
  // Double data rate, and the share of it that both copies reach.
  const double bus = 2 * 1e3 * memory_kilohertz * bus_bits / 8;
  CHECK(rates->copy_bytes < 1.05 * bus);
  CHECK(rates->copy_bytes > 0.3 * bus);
  CHECK(rates->l2_bytes > rates->copy_bytes);
}
