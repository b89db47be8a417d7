// instruction_sets.hpp - runs a test under each instruction set that Highway would choose at run time.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <hwy/targets.h>

#include <cstdint>

namespace rgs::test {

/// Calls act() once for each instruction set of the machine that Highway supports, with its kernels enabled.
template <class Act>
void with_each_instruction_set(const Act& act) {
  for (std::int64_t left = hwy::SupportedTargets(); left != 0; left &= left - 1) {
    hwy::SetSupportedTargetsForTest(left & -left);
    hwy::GetChosenTarget().Update(hwy::SupportedTargets());
    act();
    hwy::SetSupportedTargetsForTest(0);  // SupportedTargets() returns all of them again
  }
  hwy::GetChosenTarget().Update(hwy::SupportedTargets());
}

}  // namespace rgs::test
