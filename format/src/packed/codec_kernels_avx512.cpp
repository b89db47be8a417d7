// codec_kernels_avx512.cpp - the SH codec's loops for x86-64 with AVX-512 F, BW, VL and DQ.
// SPDX-License-Identifier: Apache-2.0
#define RGS_KERNELS_NAMESPACE kernels_avx512
#include "packed/codec_kernels_impl.inc"
