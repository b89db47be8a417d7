// exp2_approximate.cuh - the exponential that both kinds of blending evaluate.
// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace rgs::cuda {

/// 2^x by the special function unit; subnormal results are 0.
__device__ inline float exp2_approximate(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

}  // namespace rgs::cuda
