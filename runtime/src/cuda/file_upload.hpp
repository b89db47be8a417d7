// file_upload.hpp - a file's attributes to the device, decoded and checked there.
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

/// Fills `places` with all of the file and waits for it. What has Codec::planes is decompressed by the host's threads and
/// becomes rows on the device; Codec::archive is decoded by the host. Everything passes through a ring of page-locked
/// memory, so that the host never holds the scene (but an archive's). All checks of load_direct() are made if
/// options.validate asks for them, otherwise those of frames' hashes and of what kernels use as an index. Errors: those of
/// load_direct(), with its offsets; device_out_of_memory, device_failed. After an error nothing is at work.
Status upload_file(const FileView& file, const SectionPlaces& places, const UploadOptions& options);

}  // namespace rgs::detail
