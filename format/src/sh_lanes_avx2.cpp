// sh_lanes_avx2.cpp - the SH codec's loops for x86-64 with AVX2.
// SPDX-License-Identifier: Apache-2.0
#define RGS_LANES_NAMESPACE lanes_avx2
#include "sh_lanes_kernels.hpp"
