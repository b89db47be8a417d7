// result.cpp - names of the error codes.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/result.hpp"

namespace rgs {

const char* errc_name(Errc code) {
  switch (code) {
    case Errc::internal: return "internal";
    case Errc::cancelled: return "cancelled";
    case Errc::bad_argument: return "bad_argument";
    case Errc::bad_camera: return "bad_camera";
    case Errc::unavailable: return "unavailable";
    case Errc::open_failed: return "open_failed";
    case Errc::read_failed: return "read_failed";
    case Errc::write_failed: return "write_failed";
    case Errc::output_exists: return "output_exists";
    case Errc::output_unusable: return "output_unusable";
    case Errc::device_failed: return "device_failed";
    case Errc::device_out_of_memory: return "device_out_of_memory";
    case Errc::host_out_of_memory: return "host_out_of_memory";
    case Errc::truncated: return "truncated";
    case Errc::bad_magic: return "bad_magic";
    case Errc::unsupported_version: return "unsupported_version";
    case Errc::reserved_bits: return "reserved_bits";
    case Errc::bad_header: return "bad_header";
    case Errc::bad_section: return "bad_section";
    case Errc::section_overlap: return "section_overlap";
    case Errc::section_gap: return "section_gap";
    case Errc::trailing_bytes: return "trailing_bytes";
    case Errc::checksum_mismatch: return "checksum_mismatch";
    case Errc::missing_section: return "missing_section";
    case Errc::duplicate_section: return "duplicate_section";
    case Errc::unknown_required: return "unknown_required";
    case Errc::unsupported_codec: return "unsupported_codec";
    case Errc::size_mismatch: return "size_mismatch";
    case Errc::limit_exceeded: return "limit_exceeded";
    case Errc::bad_value: return "bad_value";
    case Errc::bad_syntax: return "bad_syntax";
    case Errc::not_gaussian_splats: return "not_gaussian_splats";
    case Errc::unsupported_feature: return "unsupported_feature";
    case Errc::too_many_bad: return "too_many_bad";
    case Errc::corrupt_data: return "corrupt_data";
    case Errc::gate_failed: return "gate_failed";
    case Errc::pages_missing: return "pages_missing";
  }
  return "unknown";
}

}  // namespace rgs
