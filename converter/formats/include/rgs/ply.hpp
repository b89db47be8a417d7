// ply.hpp - 3DGS scenes in PLY files: streamed, random-access reading and writing.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "rgs/file.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// A 3DGS PLY opened for random access by Gaussian; attributes are read from the mapped file when asked for.
/// Properties are found by name (x y z, f_dc_*, f_rest_*, opacity, scale_*, rot_*), in any order and of any scalar
/// type; other properties and elements are skipped, and the file must end where its header says. Binary (both byte
/// orders) is read in place; ASCII (a line each vertex), and vertices with list properties, are converted once into
/// rows of numbers in an unlinked temporary file in $TMPDIR. Values are passed on as they are, NaN and infinity too.
/// Where FP32 does not hold the coordinates as they are stored (double x, y, z), means are relative to an origin in the
/// middle of the scene: see origin().
/// Reading is thread-safe. The file may lose its name while it is open, but must not change: the size is checked once, in
/// open(), and touching a mapped page behind a new end raises SIGBUS. See check_unchanged().
class PlyFile {
 public:
  /// Errors, header lines with their byte offset: open_failed, read_failed, write_failed (temporary file); bad_magic,
  /// unsupported_version, bad_syntax, bad_value (a comment rgs_KEY with a value that it cannot have), limit_exceeded
  /// (header above 1 MiB); truncated (expected and found bytes; lines in text); trailing_bytes; bad_value (negative list
  /// length); not_gaussian_splats (the missing property is named; 2DGS);
  /// unsupported_feature (packed PLY; a number of f_rest properties that is no degree, in Error::found).
  /// Anything but a regular file is read as by open(int).
  static Result<PlyFile> open(const std::string& path);
  /// Reads from the descriptor's position to its end. A regular file at its start is mapped; anything else (a pipe) is
  /// first copied, above 1 MiB into an unlinked temporary file. The descriptor stays the caller's.
  static Result<PlyFile> open(int fd);
  /// Parses a PLY in memory, which must outlive the object.
  static Result<PlyFile> open(std::span<const std::byte> bytes);

  PlyFile(PlyFile&&) noexcept;
  PlyFile& operator=(PlyFile&&) noexcept;
  ~PlyFile();

  std::uint64_t size() const;                 ///< number of Gaussians
  int sh_degree() const;                      ///< 0..3, by the number of f_rest properties: 0, 9, 24, 45
  std::uint64_t bytes() const;                ///< size of the source
  std::span<const std::byte> source() const;  ///< the source's bytes as they lie on disk (for hashing)
  /// What the header's comments state (docs/user/INTERCHANGE.md): axes, colour space, anti-aliasing, low-pass, metres per
  /// unit; all else is as in the original 3DGS code.
  const Declarations& declarations() const;

  /// That the means read are relative to: mean = float(x - origin), the difference in FP64, so that origin + mean is off by
  /// half an ulp of an FP32 number of the mean's size at most. kNoOrigin if all coordinates are FP32 numbers. Otherwise
  /// the middle of the box of the 2nd to 98th percentile of up to 65536 Gaussians, to the nearest multiple of a power of two
  /// that is at least as large as the box; so that is 0 again for a scene around the world's origin.
  const Origin& origin() const;
  /// From now on means are relative to `origin`, as those of another file are; not thread-safe. |x| <= kMaxOrigin.
  void rebase(const Origin& origin);
  /// That of MappedFile, for a file that was opened by path or descriptor.
  Status check_unchanged() const;

  /// Byte at which row i starts in the source; Error::kNone if rows were converted into a temporary file.
  std::uint64_t row_offset(std::uint64_t i) const;

  /// Gaussians first .. first + out.size() - 1.
  void read(std::uint64_t first, std::span<Splat> out) const;
  /// Gaussians indices[0], indices[1], ... in that order; out.size() == indices.size().
  void gather(std::span<const std::uint32_t> indices, std::span<Splat> out) const;
  /// Hint: how rows [first, first + count) are read next. `done` lets the kernel drop their pages.
  void advise(MappedFile::Access access, std::uint64_t first, std::uint64_t count) const;

 private:
  struct Impl;
  explicit PlyFile(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

/// All Gaussians in memory, means relative to ply.origin(). Errors: host_out_of_memory.
Result<SplatCloud> read_cloud(const PlyFile& ply);
/// The whole file in memory, without an origin: doubles are rounded to FP32 positions, which read_splats() does not do.
Result<SplatCloud> read_ply(const std::string& path);

/// Writes a binary little-endian PLY with the properties of the original 3DGS code in its order: x y z nx ny nz
/// f_dc_0..2 f_rest_* (channel-major) opacity scale_0..2 rot_0..3, all float. With an origin, x y z are double: origin + mean.
/// Rows may be written in any order and from several threads, each once.
class PlyWriter {
 public:
  /// Reserves the space. `stated` is what comments say of the scene, see PlyFile::declarations(); with an
  /// origin coordinates are doubles. Errors: bad_argument (degree, count), and those of AtomicFile::create and reserve.
  static Result<PlyWriter> create(const std::string& path, std::uint64_t n, int sh_degree,
                                  const AtomicFile::Options& options, const Declarations& stated = {});
  /// Rows first .. first + splats.size() - 1. Errors: write_failed.
  Status write(std::uint64_t first, std::span<const Splat> splats);
  /// See AtomicFile::commit: seconds spent syncing.
  Result<double> commit();

 private:
  AtomicFile file_;
  std::uint64_t n_ = 0;
  std::uint64_t header_bytes_ = 0;
  int sh_degree_ = 0;
  Origin origin_ = kNoOrigin;
};

/// The PLY header that PlyWriter writes, "ply\n" to "end_header\n".
std::string ply_header(std::uint64_t n, int sh_degree, const Declarations& stated = {});
/// Bytes of one row that PlyWriter writes: 4 * (17 + 3 * (coefficients - 1)), and 12 more with an origin.
std::uint64_t ply_row_bytes(int sh_degree, const Origin& origin = kNoOrigin);
/// Encodes rows as PlyWriter writes them; out.size() == splats.size() * ply_row_bytes(sh_degree, origin).
void encode_ply_rows(std::span<const Splat> splats, int sh_degree, std::span<std::byte> out,
                     const Origin& origin = kNoOrigin);

}  // namespace rgs
