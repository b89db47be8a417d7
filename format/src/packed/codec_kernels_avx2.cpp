// codec_kernels_avx2.cpp - the SH codec's loops for x86-64 with AVX2.
// SPDX-License-Identifier: Apache-2.0
#define RGS_KERNELS_NAMESPACE kernels_avx2
#include "packed/codec_kernels_impl.inc"
