// measure_packed.cpp - a scene's size in every profile, by section and compression level, and its decoding speed:
// prints the table of docs/records/MEASUREMENTS.md, "Profiles".
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/ply.hpp"

namespace {

double seconds() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

double cpu_seconds() {
  return static_cast<double>(std::clock()) / CLOCKS_PER_SEC;
}

struct Times {
  double wall = 0, cpu = 0;
};

// Median wall time of nine runs, and the smallest CPU time.
template <class F>
Times measure(const F& f) {
  std::vector<Times> runs(9);
  for (Times& run : runs) {
    const double wall = seconds(), cpu = cpu_seconds();
    f();
    run = {seconds() - wall, cpu_seconds() - cpu};
  }
  std::ranges::sort(runs, {}, &Times::wall);
  return {runs[runs.size() / 2].wall, std::ranges::min(runs, {}, &Times::cpu).cpu};
}

int failed(const char* what, const rgs::Error& error) {
  std::fprintf(stderr, "%s: %s\n", what, error.what);
  return rgs::exit_code(error.code);
}

void print_row(const char* name, const rgs::FileView& view) {
  const auto n = static_cast<double>(view.header().n_gaussians);
  std::printf("| %s |", name);
  for (const auto type : {rgs::SectionType::means, rgs::SectionType::geometry, rgs::SectionType::sh}) {
    std::printf(" %.3f |", static_cast<double>(view.stored(type).size()) / n);
  }
  const double tables =
      static_cast<double>(view.stored(rgs::SectionType::sh_steps).size() +
                          view.stored(rgs::SectionType::chunks).size() + view.stored(rgs::SectionType::archive).size());
  std::printf(" %.3f | **%.3f** |", tables / n, static_cast<double>(view.bytes().size()) / n);
}

int measure_level(const rgs::SplatCloud& source, rgs::EncodeOptions options, const char* name) {
  double began = cpu_seconds();
  const auto bytes = rgs::encode(source.view(), options);
  const double encode_cpu = cpu_seconds() - began;
  if (!bytes) return failed("encode", bytes.error());
  const auto view = rgs::FileView::open(*bytes);
  if (!view) return failed("open", view.error());
  print_row(name, *view);
  const auto load = [&](bool validate, unsigned threads) {
    const auto data = rgs::load_direct(*view, {validate, threads});
    if (!data) std::exit(failed("load_direct", data.error()));
  };
  const double decoded = static_cast<double>(view->header().n_gaussians *
                                             (rgs::kMeanBytes + rgs::kGeometryBytes + rgs::sh_bytes(source.sh_degree)));
  std::printf(" %.2f |", encode_cpu);
  for (const unsigned threads : {1u, 2u}) {
    const Times t = measure([&] { load(false, threads); });
    std::printf(" %.1f ms, %.2f GB/s (CPU %.1f ms) |", 1e3 * t.wall, decoded / t.wall / 1e9, 1e3 * t.cpu);
  }
  const Times t = measure([&] { load(true, 2); });
  std::printf(" %.1f ms (CPU %.1f ms) |\n", 1e3 * t.wall, 1e3 * t.cpu);
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 2) return std::fprintf(stderr, "usage: rgs_measure_packed scene.ply [LEVEL...]\n"), 2;
  const auto source = rgs::read_ply(argv[1]);
  if (!source) return failed(argv[1], source.error());
  std::printf(
      "| profile | MEAN | GEOM | SHI8 | tables | bytes per Gaussian | encode CPU s (archive: all threads) | decode, 1 "
      "thread "
      "| 2 threads | with every check, 2 threads |\n|---|---|---|---|---|---|---|---|---|---|\n");
  rgs::EncodeOptions options;
  int status = measure_level(*source, options, "direct");
  options.profile = rgs::Profile::packed;
  for (int i = 2; i < argc || i == 2; ++i) {
    options.level = i < argc ? std::atoi(argv[i]) : 1;
    char name[32];
    std::snprintf(name, sizeof name, "packed, level %d", options.level);
    status |= measure_level(*source, options, name);
  }
  options.profile = rgs::Profile::archive;
  options.archive = rgs::archive_high();
  status |= measure_level(*source, options, "archive:high");
  options.archive = rgs::archive_small();
  return status | measure_level(*source, options, "archive:small");
}
