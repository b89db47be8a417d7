// sh_lanes_avx512.cpp - the SH codec's loops for x86-64 with AVX-512BW.
// SPDX-License-Identifier: Apache-2.0
#define RGS_LANES_NAMESPACE lanes_avx512
#include "sh_lanes_kernels.hpp"
