// lanes_inl.hpp - eight floats at a time, compiled by its includer once for each instruction set.
// SPDX-License-Identifier: Apache-2.0
#if defined(RGS_LOD_LANES_INL) == defined(HWY_TARGET_TOGGLE)
#ifdef RGS_LOD_LANES_INL
#undef RGS_LOD_LANES_INL
#else
#define RGS_LOD_LANES_INL
#endif

#include <hwy/highway.h>

#include <cmath>
#include <cstdint>
#include <cstring>

HWY_BEFORE_NAMESPACE();
namespace rgs::lod {
namespace HWY_NAMESPACE {

using V = float __attribute__((vector_size(32)));
using I = std::int32_t __attribute__((vector_size(32)));
constexpr int kLanes = 8;

#undef RGS_LOD_INLINE
#define RGS_LOD_INLINE inline __attribute__((always_inline))

RGS_LOD_INLINE V set(float x) {
  return V{x, x, x, x, x, x, x, x};
}
RGS_LOD_INLINE V load(const float* p) {
  V v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
RGS_LOD_INLINE void store(float* p, V v) {
  std::memcpy(p, &v, sizeof v);
}
RGS_LOD_INLINE V select(I mask, V a, V b) {
  return mask ? a : b;
}
RGS_LOD_INLINE float sum(V v) {
  return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
}

// 2^p for p in [-126, 1], as in the renderer's rows.
RGS_LOD_INLINE V exp2(V p) {
  const V magic = set(12582912.F);
  const V n = (p + magic) - magic;
  const V f = p - n;
  V e = set(1.327647199e-03F);
  e = e * f + set(9.675541334e-03F);
  e = e * f + set(5.550713273e-02F);
  e = e * f + set(2.402211972e-01F);
  e = e * f + set(6.931469671e-01F);
  e = e * f + set(1.000000072F);
  I bits;
  std::memcpy(&bits, &e, sizeof bits);
  bits += __builtin_convertvector(n, I) << 23;
  V r;
  std::memcpy(&r, &bits, sizeof r);
  return r;
}

// Natural logarithm of x in [2^-20, 2^20], to 3e-6.
RGS_LOD_INLINE V log_of(V x) {
  I bits;
  std::memcpy(&bits, &x, sizeof bits);
  const I exponent = (bits - 0x3f3504f3) >> 23;  // mantissas from sqrt(1/2) to sqrt(2)
  const I mantissa = bits - (exponent << 23);
  V m;
  std::memcpy(&m, &mantissa, sizeof m);
  const V t = (m - set(1)) / (m + set(1)), t2 = t * t;
  const V series = set(2) * t * (set(1) + t2 * (set(1.F / 3) + t2 * (set(1.F / 5) + t2 * set(1.F / 7))));
  return __builtin_convertvector(exponent, V) * set(0.69314718F) + series;
}

RGS_LOD_INLINE V root(V x) {
  float lanes[kLanes];
  store(lanes, x);
  for (float& lane : lanes) lane = std::sqrt(lane);
  return load(lanes);
}

}  // namespace HWY_NAMESPACE
}  // namespace rgs::lod
HWY_AFTER_NAMESPACE();

#endif
