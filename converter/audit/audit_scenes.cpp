// audit_scenes.cpp - scenes in the asset's order, so that ties in depth resolve as in the asset.
// SPDX-License-Identifier: Apache-2.0
#include "audit_scenes.hpp"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <utility>
#include <vector>

#include "rgs/encode.hpp"
#include "rgs/quantize.hpp"

namespace rgs::audit {
namespace {

constexpr std::uint64_t kBlock = 4096;
constexpr std::size_t kAtOnce = 64;
constexpr std::uint64_t kChunk = 256;

void requantise(SplatCloud& cloud, std::uint64_t first, std::uint64_t end, const ShStepSet& set) {
  const auto floats = 3 * static_cast<std::uint64_t>(sh_coefficients(cloud.sh_degree));
  for (std::uint64_t i = first * floats; i < end * floats; ++i) {
    const std::uint64_t k = i % floats;
    const float step = set.of_value(static_cast<int>(k));
    cloud.sh[i] = dequantize_sh(quantize_sh(cloud.sh[i], step), step);
  }
}

ShMagnitudes magnitudes_of(const SplatCloud& cloud, std::uint64_t first, std::uint64_t end) {
  ShMagnitudes magnitudes;
  for (std::uint64_t i = first; i < end; ++i) magnitudes.add(cloud.view().splat(i).sh, cloud.sh_degree);
  return magnitudes;
}

void requantise(SplatCloud& cloud, bool by_chunk) {
  const std::uint64_t n_chunks = (cloud.size() + kChunk - 1) / kChunk;
  const auto end = [&](std::uint64_t chunk) { return std::min(cloud.size(), (chunk + 1) * kChunk); };
  if (by_chunk) {
    tbb::parallel_for(std::uint64_t{0}, n_chunks, [&](std::uint64_t chunk) {
      requantise(cloud, chunk * kChunk, end(chunk), magnitudes_of(cloud, chunk * kChunk, end(chunk)).steps());
    });
    return;
  }
  const ShStepSet set = magnitudes_of(cloud, 0, cloud.size()).steps();
  tbb::parallel_for(std::uint64_t{0}, n_chunks,
                    [&](std::uint64_t chunk) { requantise(cloud, chunk * kChunk, end(chunk), set); });
}

// Only its position: the renderer's options say how it is drawn.
Declarations declared_at(const Origin& origin) {
  Declarations d;
  d.origin = origin;
  return d;
}

}  // namespace

Result<SourceScene> source_scene(const Source& source) {
  SplatCloud cloud;
  cloud.resize(source.size(), source.sh_degree());
  std::array<Splat, kAtOnce> rows;
  std::uint64_t n = 0;
  for (std::uint64_t first = 0; first < source.size(); first += kAtOnce) {
    const auto part = std::span(rows).first(std::min<std::uint64_t>(kAtOnce, source.size() - first));
    source.read(first, part);
    for (Splat& splat : part) {
      const std::uint32_t defects = find_defects(splat, source.sh_degree());
      if (defects == 0 || repair(splat, defects)) cloud.set(n++, splat);
    }
  }
  SourceScene out;
  out.n_left_out = source.size() - n;
  cloud.resize(n, source.sh_degree());
  const bool is_stored = !source.stored_path().empty();
  auto scene = is_stored ? Scene::load(source.stored_path(), source.limits())
                         : Scene::load(std::move(cloud), declared_at(source.origin()));
  if (!scene) return tl::unexpected(scene.error());
  const auto bounds = subject_bounds(*scene);
  if (!bounds) return tl::unexpected(bounds.error());
  out.bounds = *bounds;
  out.scene = std::move(*scene);
  return out;
}

Result<Scene> mixed_scene(const Source& source, const FileView& asset, const Pairing& pairing, Mixture mixture) {
  if (pairing.n_paired != pairing.source_of.size())
    return rgs::make_error(Errc::bad_argument, Error::kNone, "a Gaussian of the asset has no partner in the source");
  const std::uint64_t n = pairing.source_of.size();
  SplatCloud cloud;
  cloud.resize(n, std::max(source.sh_degree(), static_cast<int>(asset.header().sh_degree)));
  tbb::parallel_for(std::uint64_t{0}, (n + kBlock - 1) / kBlock, [&](std::uint64_t block) {
    std::array<Splat, kAtOnce> rows, stored;
    const std::uint64_t end = std::min(n, (block + 1) * kBlock);
    for (std::uint64_t first = block * kBlock; first < end; first += kAtOnce) {
      const auto count = static_cast<std::size_t>(std::min<std::uint64_t>(kAtOnce, end - first));
      source.gather(std::span(pairing.source_of).subspan(first, count), std::span(rows).first(count));
      (void)asset.read(first, std::span(stored).first(count));
      for (std::size_t i = 0; i < count; ++i) {
        // Gaussians that cannot be repaired are not in the asset.
        if (const std::uint32_t defects = find_defects(rows[i], source.sh_degree()); defects != 0)
          repair(rows[i], defects);
        if (mixture == Mixture::stored_sh) std::ranges::copy(stored[i].sh, rows[i].sh);
        if (mixture == Mixture::stored_geometry) {
          std::ranges::copy(rows[i].sh, stored[i].sh);
          rows[i] = stored[i];
        }
        cloud.set(first + i, rows[i]);
      }
    }
  });
  if (mixture == Mixture::file_scales || mixture == Mixture::chunk_step_sets)
    requantise(cloud, mixture == Mixture::chunk_step_sets);
  const bool is_stored = mixture == Mixture::stored_geometry;  // means too
  return Scene::load(std::move(cloud), declared_at(is_stored ? asset.declarations().origin : source.origin()));
}

}  // namespace rgs::audit
