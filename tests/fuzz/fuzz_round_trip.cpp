// fuzz_round_trip.cpp - arbitrary bytes as a cloud and options: what encode() accepts decodes, and re-encodes to the
// same bytes.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <span>

#include "rgs/decode.hpp"
#include "rgs/encode.hpp"

namespace {

void require(bool condition) {
  if (!condition) std::abort();
}

}  // namespace

// Five bytes of options, then Gaussians as arrays of FP32 bit patterns.
extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size < 5) return 0;
  const int degree = data[0] & 3;
  rgs::EncodeOptions options;
  options.chunk_step_sets = (data[0] & 4) != 0;
  options.order = (data[0] & 8) != 0 ? rgs::Order::input : rgs::Order::morton;
  options.keep_permutation = (data[0] & 16) != 0;
  options.profile = (data[0] & 32) != 0 ? rgs::Profile::packed : rgs::Profile::direct;
  options.level = (data[0] & 64) != 0 ? 3 : 1;
  options.on_bad = static_cast<rgs::BadPolicy>(data[1] % 3);
  options.max_bad_fraction = 1;
  options.chunk_size = 32u * (1u + data[2] % 8u);
  options.sh_degree = data[3] & 3;
  options.depth = rgs::DepthRange{0.5f, 1.f + static_cast<float>(data[4]), rgs::DepthSource::by_hand};

  const auto floats = static_cast<std::size_t>(11 + 3 * rgs::sh_coefficients(degree));
  const std::size_t n = std::min<std::size_t>((size - 5) / (4 * floats), 200);
  rgs::SplatCloud cloud;
  cloud.resize(n, degree);
  const std::uint8_t* next = data + 5;
  for (auto* values : {&cloud.mean, &cloud.log_scale, &cloud.rotation, &cloud.opacity_logit, &cloud.sh}) {
    if (values->empty()) continue;
    std::memcpy(values->data(), next, values->size() * sizeof(float));
    next += values->size() * sizeof(float);
  }
  const auto first = rgs::encode(cloud.view(), options);
  if (!first) {
    require(options.on_bad == rgs::BadPolicy::refuse && first.error().code == rgs::Errc::bad_value);
    return 0;
  }
  const auto decoded = rgs::decode(*first);
  require(decoded.has_value());
  // The second encoding knows no source and no damage; the third must repeat it exactly.
  options.on_bad = rgs::BadPolicy::refuse;
  options.keep_permutation = false;
  const auto second = rgs::encode(decoded->view(), options);
  require(second.has_value());
  const auto again = rgs::decode(*second);
  require(again.has_value());
  require(*rgs::encode(again->view(), options) == *second);
  // Attributes equal the first encoding's, in the other profile too.
  options.profile = options.profile == rgs::Profile::packed ? rgs::Profile::direct : rgs::Profile::packed;
  const auto other = rgs::encode(again->view(), options);
  require(other.has_value());
  const auto a = rgs::FileView::open(*first), b = rgs::FileView::open(*second), c = rgs::FileView::open(*other);
  require(a && b && c);
  const auto x = rgs::load_direct(*a), y = rgs::load_direct(*b), z = rgs::load_direct(*c);
  require(x && y && z);
  for (const auto* data_of : {&*y, &*z}) {
    require(std::ranges::equal(x->means(), data_of->means()));
    require(std::ranges::equal(x->geometry(), data_of->geometry()));
    require(std::ranges::equal(x->sh(), data_of->sh()));
    require(std::ranges::equal(x->chunk_table(), data_of->chunk_table()));
    require(std::ranges::equal(x->step_table(), data_of->step_table()));
  }
  return 0;
}
