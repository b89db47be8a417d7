// sh_lanes.cpp - chooses the SH codec's loops for the machine.
// SPDX-License-Identifier: Apache-2.0
#include "sh_lanes.hpp"

namespace rgs::detail {

const ShKernels& sh_kernels() {
#if defined(RGS_HAS_X86_LANES)
  static const ShKernels& chosen = __builtin_cpu_supports("avx512bw") ? lanes_avx512::kKernels
                                   : __builtin_cpu_supports("avx2")   ? lanes_avx2::kKernels
                                                                      : lanes_base::kKernels;
  return chosen;
#else
  return lanes_base::kKernels;
#endif
}

}  // namespace rgs::detail
