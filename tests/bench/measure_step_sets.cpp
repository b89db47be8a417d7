// measure_step_sets.cpp - error and size of one SH step set per file and of sets per chunk of several sizes: prints the
// table of docs/records/QUANTISATION.md.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <numbers>
#include <optional>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/math/sh.hpp"
#include "rgs/ply.hpp"

namespace {

struct Errors {
  double rms = 0, p999 = 0, max = 0;
};

Errors summarise(std::vector<float>& errors) {
  if (errors.empty()) return {};
  double sum = 0;
  for (const float e : errors) sum += static_cast<double>(e) * static_cast<double>(e);
  const auto at = errors.begin() + static_cast<std::ptrdiff_t>((errors.size() - 1) * 999 / 1000);
  std::nth_element(errors.begin(), at, errors.end());
  return {std::sqrt(sum / static_cast<double>(errors.size())), static_cast<double>(*at),
          static_cast<double>(*std::max_element(at, errors.end()))};
}

void print(const char* name, std::vector<float>& errors) {
  const Errors e = summarise(errors);
  std::printf(" | %s %.4g / %.4g / %.4g", name, e.rms, e.p999, e.max);
}

double angle_degrees(const float a[4], const float b[4]) {
  double dot = 0, aa = 0, bb = 0;
  for (int i = 0; i < 4; ++i) {
    dot += static_cast<double>(a[i]) * static_cast<double>(b[i]);
    aa += static_cast<double>(a[i]) * static_cast<double>(a[i]);
    bb += static_cast<double>(b[i]) * static_cast<double>(b[i]);
  }
  // |q - q'| resolves small angles; acos of the dot product does not.
  double squared = 0;
  const double sign = dot < 0 ? -1 : 1;
  for (int i = 0; i < 4; ++i) {
    const double d = static_cast<double>(a[i]) / std::sqrt(aa) - sign * static_cast<double>(b[i]) / std::sqrt(bb);
    squared += d * d;
  }
  return 4 * std::asin(std::min(1.0, std::sqrt(squared) / 2)) * 180 / std::numbers::pi;
}

// Errors of one encoding of `source`, as rows of a Markdown table.
int measure(const rgs::SplatCloud& source, const char* name, const rgs::EncodeOptions& options, bool geometry) {
  rgs::EncodeOptions with_permutation = options;
  with_permutation.keep_permutation = true;
  const auto bytes = rgs::encode(source.view(), with_permutation);
  if (!bytes) return std::fprintf(stderr, "encode: %s\n", bytes.error().what), 1;
  const auto file = rgs::FileView::open(*bytes);
  if (!file) return std::fprintf(stderr, "open: %s\n", file.error().what), 1;
  const std::uint64_t n = file->header().n_gaussians;
  std::array<std::vector<float>, 4> by_degree;
  std::vector<float> colour, rotation, scale, opacity;
  std::vector<rgs::Splat> decoded(4096);
  for (std::uint64_t first = 0; first < n; first += decoded.size()) {
    const auto part = std::span(decoded).first(std::min<std::uint64_t>(decoded.size(), n - first));
    if (const auto s = file->read(first, part); !s) return std::fprintf(stderr, "read: %s\n", s.error().what), 1;
    for (std::size_t i = 0; i < part.size(); ++i) {
      const rgs::Splat original = source.view().splat(file->source_index(first + i));
      const rgs::Splat& stored = part[i];
      for (std::size_t k = 0; k < 48; ++k) {
        const float error = std::abs(stored.sh[k] - original.sh[k]);
        by_degree[static_cast<std::size_t>(rgs::sh_degree_of(static_cast<int>(k / 3)))].push_back(error);
      }
      for (int axis = 0; axis < 6; ++axis) {
        float direction[3] = {0, 0, 0};
        direction[axis % 3] = axis < 3 ? 1.f : -1.f;
        const rgs::math::Vec3<float> d{direction[0], direction[1], direction[2]};
        const auto basis = rgs::math::sh_basis(source.sh_degree, d);
        const auto coefficient = [](const rgs::Splat& s) {
          return [&s](int k) { return rgs::math::Vec3<float>{s.sh[3 * k], s.sh[3 * k + 1], s.sh[3 * k + 2]}; };
        };
        const auto a = rgs::math::sh_color(source.sh_degree, basis, coefficient(original));
        const auto b = rgs::math::sh_color(source.sh_degree, basis, coefficient(stored));
        for (const float e : {a.x - b.x, a.y - b.y, a.z - b.z}) colour.push_back(255 * std::abs(e));
      }
      if (!geometry) continue;
      rotation.push_back(static_cast<float>(angle_degrees(original.rotation, stored.rotation)));
      for (std::size_t k = 0; k < 3; ++k) {
        scale.push_back(static_cast<float>(100 * std::abs(std::expm1(static_cast<double>(stored.log_scale[k]) -
                                                                     static_cast<double>(original.log_scale[k])))));
      }
      const auto sigmoid = [](float logit) { return 1 / (1 + std::exp(-static_cast<double>(logit))); };
      opacity.push_back(static_cast<float>(std::abs(sigmoid(stored.opacity_logit) - sigmoid(original.opacity_logit))));
    }
  }
  if (geometry) {
    std::printf("| FP16 geometry");
    print("rotation (degrees)", rotation);
    print("scale (%)", scale);
    print("opacity", opacity);
    std::printf(" |\n");
    return 0;
  }
  const double bytes_per_gaussian =
      static_cast<double>(bytes->size() - file->stored(rgs::SectionType::permutation).size()) / static_cast<double>(n);
  std::printf("| %s | %.3f", name, bytes_per_gaussian);
  for (auto& errors : by_degree) print("", errors);
  print("", colour);
  std::printf(" |\n");
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) return std::fprintf(stderr, "usage: rgs_measure_step_sets scene.ply\n"), 2;
  const auto source = rgs::read_ply(argv[1]);
  if (!source)
    return std::fprintf(stderr, "%s: %s\n", argv[1], source.error().what), rgs::exit_code(source.error().code);
  std::printf(
      "| step sets | bytes per Gaussian | degree 0 | degree 1 | degree 2 | degree 3 | colour (8-bit levels) |\n");
  std::printf("|---|---|---|---|---|---|---|\n");
  rgs::EncodeOptions options;
  options.chunk_step_sets = false;
  int failed = measure(*source, "one for the file", options, false);
  options.chunk_step_sets = true;
  for (const std::uint32_t chunk_size : {4096u, 1024u, 256u, 64u}) {
    char name[32];
    std::snprintf(name, sizeof name, "per %u", chunk_size);
    options.chunk_size = chunk_size;
    failed |= measure(*source, name, options, false);
  }
  return failed | measure(*source, "", options, true);
}
