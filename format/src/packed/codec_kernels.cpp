// codec_kernels.cpp - chooses the SH codec's loops for the machine.
// SPDX-License-Identifier: Apache-2.0
#include "packed/codec_kernels.hpp"

namespace rgs::detail {

const CodecKernels& codec_kernels() {
#if defined(RGS_HAS_X86_KERNELS)
  // All that format/CMakeLists.txt lets the compiler use in that file: -mavx512bw implies F.
  static const bool avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                             __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq");
  static const CodecKernels& chosen = avx512                           ? kernels_avx512::kKernels
                                      : __builtin_cpu_supports("avx2") ? kernels_avx2::kKernels
                                                                       : kernels_base::kKernels;
  return chosen;
#else
  return kernels_base::kKernels;
#endif
}

}  // namespace rgs::detail
