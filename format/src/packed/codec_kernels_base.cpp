// codec_kernels_base.cpp - the SH codec's loops for any machine.
// SPDX-License-Identifier: Apache-2.0
#define RGS_KERNELS_NAMESPACE kernels_base
#include "packed/codec_kernels_impl.inc"
