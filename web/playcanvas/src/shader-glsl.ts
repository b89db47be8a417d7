// shader-glsl.ts - decodes a stored Gaussian: docs/format/FORMAT.md, "Attributes". The engine adds a loadRgs...() for each texture.
// SPDX-License-Identifier: Apache-2.0
import { kRowTexels, kTableColumns } from "./stored.js";

export const kReadGlsl = /* glsl */ `
uvec4 rgsGeometryWords;
uint rgsRow;

vec4 rgsTableTexel(int k) {
  int column = int(rgsRow % ${kTableColumns}u) * ${kRowTexels} + k;
  return texelFetch(rgsTable, ivec2(column, int(rgsRow / ${kTableColumns}u)), 0);
}

float rgsCode(uint word, int byte) {
  return float(int(word << uint(24 - 8 * byte)) >> 24);
}

// The engine calls this one first.
vec3 getCenter() {
  uvec4 words = loadRgsMean();
  rgsRow = words.w;
  rgsGeometryWords = loadRgsGeometry();
  return uintBitsToFloat(words.xyz);
}

// w, x, y, z, as stored.
vec4 getRotation() {
  return normalize(vec4(unpackHalf2x16(rgsGeometryWords.x), unpackHalf2x16(rgsGeometryWords.y)));
}

vec3 getScale() {
  return vec3(unpackHalf2x16(rgsGeometryWords.z), unpackHalf2x16(rgsGeometryWords.w).x) * rgsTableTexel(0).w;
}

vec4 getColor() {
  uint word = loadRgsSh0().x;
  vec3 tint = vec3(rgsTableTexel(1).w, rgsTableTexel(2).w, rgsTableTexel(3).w);
  vec3 dc = vec3(rgsCode(word, 0), rgsCode(word, 1), rgsCode(word, 2)) * rgsTableTexel(0).xyz;
  vec3 rgb = 0.28209479177387814 * dc + 0.5;
  return vec4(tint.x < 0.0 ? rgb : mix(rgb, tint, 0.6), unpackHalf2x16(rgsGeometryWords.w).y);
}

#if SH_BANDS > 0
uint rgsShWords[12];

float rgsShCode(int i) {
  return rgsCode(rgsShWords[i >> 2], i & 3);
}

void readSHData(out vec3 sh[SH_COEFFS], out float scale) {
  uvec4 a = loadRgsSh0();
  rgsShWords[0] = a.x; rgsShWords[1] = a.y; rgsShWords[2] = a.z; rgsShWords[3] = a.w;
  #if SH_BANDS > 1
    uvec4 b = loadRgsSh1();
    rgsShWords[4] = b.x; rgsShWords[5] = b.y; rgsShWords[6] = b.z; rgsShWords[7] = b.w;
  #endif
  #if SH_BANDS > 2
    uvec4 c = loadRgsSh2();
    rgsShWords[8] = c.x; rgsShWords[9] = c.y; rgsShWords[10] = c.z; rgsShWords[11] = c.w;
  #endif
  vec3 step1 = rgsTableTexel(1).xyz;
  vec3 step2 = rgsTableTexel(2).xyz;
  vec3 step3 = rgsTableTexel(3).xyz;
  for (int i = 0; i < SH_COEFFS; ++i) {
    int k = 3 * (i + 1);
    sh[i] = vec3(rgsShCode(k), rgsShCode(k + 1), rgsShCode(k + 2)) * (i < 3 ? step1 : i < 8 ? step2 : step3);
  }
  scale = 1.0;
}
#endif
`;
