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

/// A 3DGS PLY opened for random access by Gaussian; attributes are read from the mapped file on demand.
/// Properties are found by name (x y z, f_dc_*, f_rest_*, opacity, scale_*, rot_*), in any order and of any scalar
/// type; other properties and elements are skipped, and the file must end where its header says. Binary (both byte
/// orders) is read in place; ASCII (one line per vertex) and vertices with list properties are converted once into rows
/// of numbers in an unlinked temporary file in $TMPDIR. Values are passed on as stored, NaN and infinity too. If FP32
/// cannot hold the coordinates (double x, y, z), means are relative to an origin in the middle of the scene: see
/// origin().
/// Reading is thread-safe. An open file may be unlinked but must not change: open() checks the size once, and touching
/// a mapped page past a new end raises SIGBUS. See check_unchanged().
class PlyFile {
 public:
  /// Errors, for header lines with their byte offset: open_failed, read_failed, write_failed (temporary file);
  /// bad_magic, unsupported_version, bad_syntax, bad_value (a comment rgs_KEY with an invalid value), limit_exceeded
  /// (header above 1 MiB); truncated (expected and found bytes; lines in text); trailing_bytes; bad_value (negative list
  /// length); not_gaussian_splats (names the missing property; 2DGS); unsupported_feature (packed PLY; an f_rest count that
  /// fits no degree, in Error::found). Anything but a regular file is read as by open(int).
  static Result<PlyFile> open(const std::string& path);
  /// Reads from the descriptor's position to its end. A regular file at its start is mapped; anything else (a pipe) is
  /// copied first, above 1 MiB into an unlinked temporary file. The caller keeps the descriptor.
  static Result<PlyFile> open(int fd);
  /// Parses a PLY in memory, which must outlive the object.
  static Result<PlyFile> open(std::span<const std::byte> bytes);

  PlyFile(PlyFile&&) noexcept;
  PlyFile& operator=(PlyFile&&) noexcept;
  ~PlyFile();

  std::uint64_t size() const;                 ///< number of Gaussians
  int sh_degree() const;                      ///< 0..3, from the number of f_rest properties: 0, 9, 24, 45
  std::uint64_t bytes() const;                ///< size of the source
  std::span<const std::byte> source() const;  ///< the source's bytes as on disk (for hashing)
  /// Axes, colour space, anti-aliasing, low-pass and metres per unit from the header's comments
  /// (docs/user/INTERCHANGE.md); all else is as in the original 3DGS code.
  const Declarations& declarations() const;

  /// The origin of the means: mean = float(x - origin), subtracted in FP64, so origin + mean is off by at most half an
  /// ulp of an FP32 number of the mean's size. kNoOrigin if all coordinates are FP32 numbers. Otherwise the middle of
  /// the box of the 2nd to 98th percentile of up to 65536 Gaussians, rounded to a multiple of a power of two at least
  /// as large as the box; a scene around the world's origin thus gets 0.
  const Origin& origin() const;
  /// Largest rounding of a coordinate in the rows read so far, world units; 0 if all coordinates are FP32 numbers.
  double position_rounding() const;
  /// Whether read() sets Splat::mean_rest: positions are not FP32.
  bool has_rests() const;
  /// Makes further means relative to `origin`, for example that of another file; not thread-safe. |x| <= kMaxOrigin.
  void rebase(const Origin& origin);
  /// See MappedFile; for a file opened by path or descriptor.
  Status check_unchanged() const;

  /// Offset of row i in the source; Error::kNone if rows were converted into a temporary file.
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
/// The whole file in memory, without an origin: doubles are rounded to FP32 positions, unlike in read_splats().
Result<SplatCloud> read_ply(const std::string& path);

/// Writes a binary little-endian PLY with the original 3DGS code's properties in its order: x y z nx ny nz f_dc_0..2
/// f_rest_* (channel-major) opacity scale_0..2 rot_0..3, all float. With an origin, x y z are double: origin + mean.
/// Rows may be written in any order and from several threads, each once.
class PlyWriter {
 public:
  /// Reserves the space. `stated` goes into comments, see PlyFile::declarations(). Errors: bad_argument (degree,
  /// count), and those of AtomicFile::create and reserve.
  static Result<PlyWriter> create(const std::string& path, std::uint64_t n, int sh_degree,
                                  const AtomicFile::Options& options, const Declarations& stated = {});
  /// Rows first .. first + splats.size() - 1. Errors: write_failed.
  Status write(std::uint64_t first, std::span<const Splat> splats);
  /// See AtomicFile::commit: returns seconds spent syncing.
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
/// Bytes of one PlyWriter row: 4 * (17 + 3 * (coefficients - 1)), and 12 more with an origin.
std::uint64_t ply_row_bytes(int sh_degree, const Origin& origin = kNoOrigin);
/// Encodes rows as PlyWriter does; out.size() == splats.size() * ply_row_bytes(sh_degree, origin).
void encode_ply_rows(std::span<const Splat> splats, int sh_degree, std::span<std::byte> out,
                     const Origin& origin = kNoOrigin);

}  // namespace rgs
