// hd.hpp - marks functions that compile for the host and for CUDA devices.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#if defined(__CUDACC__)
#define RGS_HD __host__ __device__
#else
#define RGS_HD
#endif
