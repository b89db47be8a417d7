// sh_lanes_base.cpp - the SH codec's loops for any machine.
// SPDX-License-Identifier: Apache-2.0
#define RGS_LANES_NAMESPACE lanes_base
#include "sh_lanes_kernels.hpp"
