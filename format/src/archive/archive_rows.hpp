// archive_rows.hpp - the Gaussians of an archive until it is written.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "rgs/file.hpp"
#include "rgs/result.hpp"
#include "rgs/scene_writer.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::detail {

/// An archive's encoder goes through its Gaussians several times. Until it has, they lie where the output will be: on disk
/// they take no memory that the system cannot take back.
class ArchiveRows {
 public:
  /// Errors: Sink::reserve()'s and truncate()'s.
  static Result<ArchiveRows> create(Sink sink, std::uint64_t n, int sh_degree);
  /// Several threads may set different rows. Limits `splats` to what codes can hold. Errors: Sink::write_at()'s.
  Status set(std::uint64_t first, std::span<Splat> splats);
  /// All rows, until replace(). Errors: Sink::view()'s.
  Result<SplatView> view();
  /// Makes `file` the sink's contents. Errors: Sink::write_at()'s and truncate()'s.
  Status replace(std::span<const std::byte> file);

 private:
  ArchiveRows(Sink sink, std::uint64_t n, int sh_degree) : sink_(sink), n_(n), sh_degree_(sh_degree) {}
  std::uint64_t sh_values() const { return static_cast<std::uint64_t>(3 * sh_coefficients(sh_degree_)); }

  Sink sink_;
  std::uint64_t n_;
  int sh_degree_;
  MappedFile mapped_;
};

}  // namespace rgs::detail
