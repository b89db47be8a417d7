// result.hpp - the library's error type and value-or-error return type.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <tl/expected.hpp>

#include "rgs/api.hpp"

namespace RGS_API rgs {

/// All kinds of failure. The hundreds digit is the class, and the class is the exit code of every program: 1xx
/// internal, 2xx usage, 3xx input/output, 4xx malformed or unsupported input, 5xx quality gate, 6xx incomplete input.
enum class Errc : std::uint16_t {
  internal = 100,  ///< a bug in this library
  cancelled,       ///< stopped by the caller

  bad_argument = 200,  ///< an option is out of its documented range
  bad_camera,          ///< a camera has a non-finite or non-positive parameter
  unavailable,         ///< the requested feature is not built, or no device answers

  open_failed = 300,  ///< a file could not be opened
  read_failed,        ///< reading failed, or the file changed while being read
  write_failed,       ///< writing, syncing or renaming failed (disk full, permissions)
  output_exists,      ///< the output exists and overwriting was not requested
  output_unusable,    ///< the output is a directory, or not a regular file
  device_failed,      ///< a CUDA call failed
  device_out_of_memory,
  host_out_of_memory,  ///< memory has run out; what the call held is freed

  truncated = 400,      ///< the data ends before what the header promises
  bad_magic,            ///< not this format
  unsupported_version,  ///< the major version is unknown
  reserved_bits,        ///< a reserved field is not zero
  bad_header,           ///< a header field is out of range or contradicts another
  bad_section,          ///< a section entry is out of range, misaligned or out of order
  section_overlap,      ///< two sections share bytes
  section_gap,          ///< bytes in no section, or padding that is not zero
  trailing_bytes,       ///< bytes after the last section
  checksum_mismatch,    ///< stored and computed XXH3-64 differ
  missing_section,      ///< a required section is absent
  duplicate_section,    ///< a known section occurs twice
  unknown_required,     ///< an unknown section carries the must-understand bit
  unsupported_codec,    ///< a section's codec is unknown
  size_mismatch,        ///< a section's size contradicts the counts in the header
  limit_exceeded,       ///< a count or size is above the caller's DecodeLimits
  bad_value,            ///< a stored value is out of its legal range (non-finite, bad enumerator, bad index)
  bad_syntax,           ///< text that does not parse (PLY header, JSON, camera file)
  not_gaussian_splats,  ///< a well-formed file that does not hold 3D Gaussian splats
  unsupported_feature,  ///< well-formed, but of a kind that this program does not read
  too_many_bad,         ///< more damaged Gaussians than the policy allows
  corrupt_data,         ///< coded bytes that do not decode

  gate_failed = 500,  ///< a quality condition set by the caller does not hold

  pages_missing = 600,  ///< a prefix of a file with levels of detail: a whole scene, but without its finest pages
};

/// Exit code of an error: 1 internal, 2 usage, 3 input/output, 4 malformed input, 5 quality gate, 6 incomplete but
/// usable input.
constexpr int exit_code(Errc code) {
  return static_cast<int>(code) / 100;
}

/// A failure: static text, offset and two numbers; copying it never allocates.
struct Error {
  static constexpr std::uint64_t kNone = ~std::uint64_t{0};

  Errc code = Errc::internal;
  std::uint64_t offset = kNone;    ///< byte in the input where it was noticed; kNone: none
  const char* what = "";           ///< static text: what is wrong and, if useful, what to do
  std::uint64_t expected = kNone;  ///< the expected count, size or hash; kNone if not numeric
  std::uint64_t found = kNone;     ///< the actual one; kNone if not numeric
  int system = 0;                  ///< errno of the failed system call, 0 if none
};

template <class T>
using Result = tl::expected<T, Error>;
using Status = tl::expected<void, Error>;
// No exception crosses a function that returns one of these. All of them may return host_out_of_memory; plain
// containers and functions that return them (SplatCloud::resize()) throw std::bad_alloc as the standard library does.

inline tl::unexpected<Error> make_error(Errc code, std::uint64_t offset, const char* what,
                                        std::uint64_t expected = Error::kNone, std::uint64_t found = Error::kNone,
                                        int system = 0) {
  return tl::unexpected<Error>(Error{code, offset, what, expected, found, system});
}

/// Short stable name of an error code, e.g. "checksum_mismatch", for --json output and tests.
const char* errc_name(Errc code);

}  // namespace rgs
