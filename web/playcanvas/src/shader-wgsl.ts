// shader-wgsl.ts - shader-glsl.ts for WebGPU.
// SPDX-License-Identifier: Apache-2.0
import { kRowTexels, kTableColumns } from "./stored.js";

export const kReadWgsl = /* wgsl */ `
var<private> rgsGeometryWords: vec4u;
var<private> rgsRow: u32;

fn rgsTableTexel(k: u32) -> vec4f {
  let column = (rgsRow % ${kTableColumns}u) * ${kRowTexels}u + k;
  return textureLoad(rgsTable, vec2i(i32(column), i32(rgsRow / ${kTableColumns}u)), 0);
}

fn rgsCode(word: u32, byte: u32) -> f32 {
  return f32(bitcast<i32>(word << (24u - 8u * byte)) >> 24u);
}

// The engine calls this one first.
fn getCenter() -> vec3f {
  let words: vec4<u32> = loadRgsMean();
  rgsRow = words.w;
  rgsGeometryWords = loadRgsGeometry();
  return bitcast<vec3f>(words.xyz);
}

// w, x, y, z, as stored.
fn getRotation() -> vec4f {
  return normalize(vec4f(unpack2x16float(rgsGeometryWords.x), unpack2x16float(rgsGeometryWords.y)));
}

fn getScale() -> vec3f {
  return vec3f(unpack2x16float(rgsGeometryWords.z), unpack2x16float(rgsGeometryWords.w).x) * rgsTableTexel(0u).w;
}

fn getColor() -> vec4f {
  let word: u32 = loadRgsSh0().x;
  let tint = vec3f(rgsTableTexel(1u).w, rgsTableTexel(2u).w, rgsTableTexel(3u).w);
  let dc = vec3f(rgsCode(word, 0u), rgsCode(word, 1u), rgsCode(word, 2u)) * rgsTableTexel(0u).xyz;
  let rgb = 0.28209479177387814 * dc + 0.5;
  return vec4f(select(mix(rgb, tint, 0.6), rgb, tint.x < 0.0), unpack2x16float(rgsGeometryWords.w).y);
}

#if SH_BANDS > 0
var<private> rgsShWords: array<u32, 12>;

fn rgsShCode(i: u32) -> f32 {
  return rgsCode(rgsShWords[i >> 2u], i & 3u);
}

fn readSHData(sh: ptr<function, array<half3, SH_COEFFS>>, scale: ptr<function, f32>) {
  let a: vec4<u32> = loadRgsSh0();
  rgsShWords[0] = a.x; rgsShWords[1] = a.y; rgsShWords[2] = a.z; rgsShWords[3] = a.w;
  #if SH_BANDS > 1
    let b: vec4<u32> = loadRgsSh1();
    rgsShWords[4] = b.x; rgsShWords[5] = b.y; rgsShWords[6] = b.z; rgsShWords[7] = b.w;
  #endif
  #if SH_BANDS > 2
    let c: vec4<u32> = loadRgsSh2();
    rgsShWords[8] = c.x; rgsShWords[9] = c.y; rgsShWords[10] = c.z; rgsShWords[11] = c.w;
  #endif
  let step1 = rgsTableTexel(1u).xyz;
  let step2 = rgsTableTexel(2u).xyz;
  let step3 = rgsTableTexel(3u).xyz;
  for (var i: i32 = 0; i < SH_COEFFS; i++) {
    let k = 3u * (u32(i) + 1u);
    let codes = vec3f(rgsShCode(k), rgsShCode(k + 1u), rgsShCode(k + 2u));
    sh[i] = half3(codes * select(select(step3, step2, i < 8), step1, i < 3));
  }
  *scale = 1.0;
}
#endif
`;
