// fuzz_info.cpp - arbitrary bytes as an .rgs file, through everything that rgs-info prints, and decoded whole.
// SPDX-License-Identifier: Apache-2.0
#include <cstdlib>
#include <string>

#include "info_json.hpp"
#include "info_report.hpp"
#include "info_text.hpp"
#include "rgs/decode.hpp"

#if defined(RGS_LIBFUZZER)
#include "rgs_mutator.hpp"

extern "C" std::size_t LLVMFuzzerCustomMutator(std::uint8_t* data, std::size_t size, std::size_t max_size,
                                               unsigned seed) {
  return rgs::fuzz::mutate_rgs(data, size, max_size, seed);
}
#endif

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const auto bytes = std::as_bytes(std::span(data, size));
  rgs::tool::InfoOptions all, one, of_levels, compared;
  all.verify = true;
  all.statistics = true;
  one.chunk = size % 3;
  of_levels.page = size % 5;
  compared.verify = true;
  compared.levels_share = 0.01;
  const auto whole = rgs::tool::inspect("a", bytes, all), chunk = rgs::tool::inspect("a", bytes, one),
             page = rgs::tool::inspect("a", bytes, of_levels), levels = rgs::tool::inspect("a", bytes, compared);
  for (const auto* report : {&whole, &chunk, &page, &levels}) {
    const std::string text = rgs::tool::info_text(*report, true);  // empty for an error before the first line
    if (rgs::tool::info_json(*report).empty() || (text.empty() && !report->error)) std::abort();
  }
  const auto cloud = rgs::decode(bytes);
  // A valid file decodes, and every error has a description.
  if (whole.verified && !whole.error && !cloud) std::abort();
  if (!cloud && cloud.error().what[0] == '\0') std::abort();
  return 0;
}
