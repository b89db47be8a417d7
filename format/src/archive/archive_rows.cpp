// archive_rows.cpp - rows of training parameters in a sink: means, scales, rotations, opacities, SH.
// SPDX-License-Identifier: Apache-2.0
#include "archive/archive_rows.hpp"

#include <algorithm>
#include <vector>

#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {

Result<ArchiveRows> ArchiveRows::create(Sink sink, std::uint64_t n, int sh_degree) {
  ArchiveRows rows(sink, n, sh_degree);
  const std::uint64_t bytes = sizeof(float) * n * (11 + rows.sh_values());
  if (Status s = sink.reserve(bytes); !s) return tl::unexpected(s.error());
  if (Status s = sink.truncate(bytes); !s) return tl::unexpected(s.error());
  return rows;
}

Status ArchiveRows::set(std::uint64_t first, std::span<Splat> splats) {
  for (Splat& s : splats) {
    for (float& value : s.log_scale) value = std::max(value, -kMaxLogScale);  // codes cannot hold -inf
  }
  return guard_memory([&]() -> Status {
    std::vector<float> values;
    std::uint64_t before = 0;  // values of the fields before
    const auto write = [&](std::uint64_t width, const auto& field) -> Status {
      values.clear();
      for (const Splat& s : splats) values.insert(values.end(), field(s), field(s) + width);
      const std::uint64_t at = before + first * width;
      before += n_ * width;
      return sink_.write_at(sizeof(float) * at, std::as_bytes(std::span(values)));
    };
    if (Status s = write(3, [](const Splat& x) { return x.mean; }); !s) return s;
    if (Status s = write(3, [](const Splat& x) { return x.log_scale; }); !s) return s;
    if (Status s = write(4, [](const Splat& x) { return x.rotation; }); !s) return s;
    if (Status s = write(1, [](const Splat& x) { return &x.opacity_logit; }); !s) return s;
    return write(sh_values(), [](const Splat& x) { return x.sh; });
  });
}

Result<SplatView> ArchiveRows::view() {
  const auto bytes = sink_.view(mapped_);
  if (!bytes) return tl::unexpected(bytes.error());
  const auto* at = reinterpret_cast<const float*>(bytes->data());
  const auto field = [&](std::uint64_t width) {
    const std::span values(at, n_ * width);
    at += values.size();
    return values;
  };
  return SplatView{n_, sh_degree_, field(3), field(3), field(4), field(1), field(sh_values())};
}

Status ArchiveRows::replace(std::span<const std::byte> file) {
  mapped_ = {};  // Windows shortens no mapped file
  if (Status s = sink_.write_at(0, file); !s) return s;
  return sink_.truncate(file.size());
}

}  // namespace rgs::detail
