// blend_paper.hpp - the paper's blending kernel, called by blend.cu.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "sorted/blend.hpp"

namespace rgs::cuda {

/// Folded exponent, two pixels a thread, approximate exp; colour and alpha only.
void run_paper_blend(const BlendArguments& arguments, Stream stream);

}  // namespace rgs::cuda
