// cuda_check.cu - compiled at configure time: can this nvcc and host compiler build what the kernels need?
// SPDX-License-Identifier: Apache-2.0
#include <cub/device/device_radix_sort.cuh>
#include <span>

template <class T>
concept Scalar = requires(T x) {
  x* x;
};

__global__ void scale(Scalar auto* values, unsigned n, float factor) {
  const unsigned i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i < n) values[i] *= factor;
}

void launch(std::span<float> values) {
  scale<<<1, 256>>>(values.data(), static_cast<unsigned>(values.size()), 2.0f);
}
