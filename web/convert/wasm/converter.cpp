// converter.cpp - rgs-convert's code for JavaScript: one PLY in memory to one .rgs; src/conversion.ts calls it.
// SPDX-License-Identifier: Apache-2.0
//
// A function that fails returns a negative number or null; rgs_error() then gives the error. Further results are in rgs_numbers(), as
// FP64, and in rgs_text(). An instance converts once.

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <new>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "convert.hpp"
#include "input_declarations.hpp"
#include "rgs/version.hpp"

#define RGS_EXPORT(name) extern "C" [[clang::export_name(#name)]]
#define RGS_IMPORT(name) extern "C" [[clang::import_module("rgs"), clang::import_name(#name)]]

RGS_IMPORT(out_of_memory) [[noreturn]] void rgs_out_of_memory();
/// A stage's progress; texts end in a zero.
RGS_IMPORT(begin) void rgs_begin(const char* stage, double total, const char* unit);
RGS_IMPORT(advance) void rgs_advance(double units);

namespace {

using namespace rgs;

// Half of it is for what would be in scratch files, which here take memory anyway, but grow without being copied.
constexpr std::uint64_t kLevelsMemory = std::uint64_t{512} << 20;

Error last_error;
std::vector<double> numbers;
std::string text;
AtomicFile output;

ConvertOptions options_of(std::uint32_t profile, bool levels) {
  ConvertOptions options;
  options.encode.profile = profile == 0 ? Profile::packed : profile == 1 ? Profile::direct : Profile::archive;
  options.encode.archive = profile == 4 ? archive_tiny() : profile == 3 ? archive_small() : archive_high();
  if (levels) options.levels = lod::Quality::fast;
  options.memory_bytes = kLevelsMemory;
  options.output.hold = &output;
  return options;
}

// As convert_inputs() of one_scene.cpp, for a PLY without further options.
Result<ConvertSummary> convert(std::span<const std::byte> bytes, ConvertOptions options, Provenance provenance) {
  provenance.source_name.resize(std::min<std::size_t>(provenance.source_name.size(), kMaxProvenanceText));
  const auto ply = PlyFile::open(bytes);
  if (!ply) return tl::unexpected(ply.error());
  EncodeOptions& encode = options.encode;
  encode.axes = ply->declarations().axes;
  const InputDeclarations declared = declared_by(*ply, provenance.source_name);
  encode.provenance = std::move(provenance);
  std::vector<std::string> notes;
  if (const Status s = declare_scene(encode, {&declared, 1}, {}, notes); !s) return tl::unexpected(s.error());
  StageObserver observer;
  observer.begin = [](const char* stage, std::uint64_t total, const char* unit) {
    rgs_begin(stage, static_cast<double>(total), unit);
  };
  observer.advance = [](std::uint64_t units) { rgs_advance(static_cast<double>(units)); };
  return convert_to_rgs(*ply, "", options, observer);
}

template <class... T>
void put(T... values) {
  (numbers.push_back(static_cast<double>(values)), ...);
}

}  // namespace

RGS_EXPORT(rgs_start) void rgs_start() {
  std::set_new_handler([] { rgs_out_of_memory(); });
  text = "rgs-convert " RGS_VERSION;
}

/// Null if out of memory.
RGS_EXPORT(rgs_allocate) void* rgs_allocate(std::uint32_t bytes) {
  return std::malloc(std::max<std::uint32_t>(bytes, 1));
}

/// Code and text on a line each in rgs_text(); offset, expected and found as two halves each in rgs_numbers().
RGS_EXPORT(rgs_error) void rgs_error() {
  text = std::string(errc_name(last_error.code)) + "\n" + last_error.what;
  numbers.clear();
  for (const std::uint64_t value : {last_error.offset, last_error.expected, last_error.found})
    put(value >> 32, value & 0xFFFFFFFFu);
}
RGS_EXPORT(rgs_numbers) const double* rgs_numbers() {
  return numbers.data();
}
RGS_EXPORT(rgs_n_numbers) std::uint32_t rgs_n_numbers() {
  return numbers.size();
}
/// After rgs_start(): the tool's name in the provenance.
RGS_EXPORT(rgs_text) const char* rgs_text() {
  return text.data();
}
RGS_EXPORT(rgs_n_text) std::uint32_t rgs_n_text() {
  return text.size();
}

/// Converts a PLY. `profile`: packed, direct, archive:high, archive:small, archive:tiny. `name` and `tool` are for the provenance. What
/// the report states is in rgs_numbers(), in the order in which src/conversion.ts reads it.
RGS_EXPORT(rgs_convert)
int rgs_convert(const std::byte* bytes, std::uint32_t size, std::uint32_t profile, int levels, const char* name,
                std::uint32_t name_size, const char* tool, std::uint32_t tool_size) {
  const auto made = convert({bytes, size}, options_of(profile, levels != 0),
                            {size, 0, std::string(name, name_size), std::string(tool, tool_size)});
  if (!made) {
    last_error = made.error();
    return -1;
  }
  const ConvertSummary& s = *made;
  numbers.clear();
  put(s.source_bytes, s.output_bytes, s.n_source, s.n_written, s.n_repaired, s.source_sh_degree, s.sh_degree,
      s.n_levels, s.n_pages, s.position_rounding);
  for (const std::uint64_t n : s.defects) put(n);
  return 0;
}

/// Copies bytes of the .rgs.
RGS_EXPORT(rgs_read_output) void rgs_read_output(double offset, std::byte* to, std::uint32_t bytes) {
  (void)output.read_at(static_cast<std::uint64_t>(offset), {to, bytes});
}
