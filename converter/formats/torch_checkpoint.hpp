// torch_checkpoint.hpp - gsplat's checkpoints, as torch.save() of PyTorch 1.6 or newer writes them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// Whether the bytes are a zip archive with a data.pkl.
bool is_torch_checkpoint(std::span<const std::byte> bytes);

/// The tensors of checkpoint["splats"], or of the checkpoint itself: those of .npz, of torch.float16, 32 or 64.
/// Executes nothing: of Python's pickles it reads dictionaries, lists, tuples, numbers, texts and tensors; all else is
/// unsupported_feature with its offset in data.pkl.
Result<SplatFile> decode_torch_checkpoint(std::span<const std::byte> bytes, const DecodeLimits& limits);

}  // namespace rgs::detail
