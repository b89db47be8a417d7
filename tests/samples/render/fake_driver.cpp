// fake_driver.cpp - a libcuda.so.1 that has only a version, RGS_FAKE_DRIVER (12040 for CUDA 12.4).
// SPDX-License-Identifier: Apache-2.0
#include <cstdlib>

// Names that CUDA's runtime looks up.
extern "C" {
__attribute__((visibility("default"))) int cuInit(unsigned) {
  return 0;
}
__attribute__((visibility("default"))) int cuDriverGetVersion(int* version) {
  const char* text = std::getenv("RGS_FAKE_DRIVER");
  *version = text == nullptr ? 0 : std::atoi(text);
  return 0;
}
}
