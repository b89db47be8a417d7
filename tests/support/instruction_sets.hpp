// instruction_sets.hpp - what Highway chooses at run time, chosen by a test.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <hwy/targets.h>

#include <cstdint>

namespace rgs::test {

/// Calls act() once for each instruction set that the machine has and Highway knows, during which kernels are those for it.
template <class Act>
void with_each_instruction_set(const Act& act) {
  for (std::int64_t left = hwy::SupportedTargets(); left != 0; left &= left - 1) {
    hwy::SetSupportedTargetsForTest(left & -left);
    hwy::GetChosenTarget().Update(hwy::SupportedTargets());
    act();
    hwy::SetSupportedTargetsForTest(0);  // SupportedTargets() gives all of them again
  }
  hwy::GetChosenTarget().Update(hwy::SupportedTargets());
}

}  // namespace rgs::test
