// file_upload.hpp - copies a file's attributes to the device and decodes and checks them there.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>

#include "common/attributes.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/decode.hpp"

namespace rgs::detail {

/// MEAN, GEOM, SHI8, SHSC, CHNK in device memory.
using SectionPlaces = std::array<std::byte*, 5>;

cuda::CompactAttributes compact_attributes(const Header& header, const SectionPlaces& places);

/// Fills `places` with the whole file and waits for it. Host threads decompress Codec::planes, and the device makes
/// rows of it; it decodes Codec::archive by itself. The host decodes Codec::archive_draco, and an archive for which the
/// device lacks memory. All data passes through a ring of page-locked memory, so the host never holds another scene.
/// Makes all checks of load_direct() if options.validate is set, else those of frames' hashes and of values that kernels
/// use as an index. Errors: those of load_direct(), with its offsets;
/// device_out_of_memory, device_failed. After an error nothing is running.
Status upload_file(const FileView& file, const SectionPlaces& places, const UploadOptions& options);

}  // namespace rgs::detail
