// encode.cpp - encodes Gaussians in memory with a SceneWriter.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/encode.hpp"

#include <algorithm>
#include <limits>

#include "rgs/guard_memory.hpp"
#include "rgs/scene_writer.hpp"
#include "rgs/spatial_order.hpp"

namespace rgs {

static Result<std::vector<std::byte>> encode_scene(const SplatView& splats, const EncodeOptions& options) {
  if (!splats.consistent())
    return make_error(Errc::bad_argument, Error::kNone, "the sizes of the splat arrays disagree");
  if (splats.n > std::numeric_limits<std::uint32_t>::max()) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more than 2^32 - 1 Gaussians in one call");
  }
  SceneScan scan(std::min(splats.sh_degree, options.sh_degree), options.on_bad);
  std::vector<std::uint32_t> indices;
  indices.reserve(splats.n);
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    Splat s = splats.splat(i);
    if (scan.add(s)) {
      indices.push_back(static_cast<std::uint32_t>(i));
    } else if (options.on_bad == BadPolicy::refuse) {
      return make_error(Errc::bad_value, i, "a damaged Gaussian at this index; allow dropping or repairing");
    }
  }
  if (options.order == Order::morton) {
    const MortonKey key(scan.robust());
    std::vector<std::uint64_t> keys(indices.size());
    for (std::size_t i = 0; i < indices.size(); ++i) keys[i] = key(&splats.mean[3 * std::size_t{indices[i]}]);
    sort_by_key(keys, indices);
  }
  std::vector<std::byte> file;
  auto writer = SceneWriter::create(file, scan, options, indices);
  if (!writer) return tl::unexpected(writer.error());
  SceneWriter::Batch batch(*writer);
  for (std::uint64_t i = 0; i < writer->n_batches(); ++i) {
    for (batch.begin(i); !batch.complete(); batch.encode_chunk()) {
      std::ranges::transform(batch.source_index(), batch.splats().begin(), [&](auto k) { return splats.splat(k); });
    }
    if (const Status s = writer->add(batch); !s) return tl::unexpected(s.error());
  }
  if (const auto written = writer->finish(); !written) return tl::unexpected(written.error());
  return file;
}

Result<std::vector<std::byte>> encode(const SplatView& splats, const EncodeOptions& options) {
  return detail::guard_memory([&] { return encode_scene(splats, options); });
}

}  // namespace rgs
