// blend.ts - blends each tile's list front to back; 256 threads a tile, one pixel each.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/blend.hpp; docs/format/RENDERING.md "A pixel"
// In/Out  splats, entries and ranges of tiles -> pixels
// Cost    48 B an entry and tile; some 15 flops and an exponential an entry and pixel
// Shared  12 KiB: 256 splats
// Order   deterministic. A frame that had no room leaves the picture as it was
import { kConstants, kSplatWgsl, kViewWgsl } from "./math.js";
import { kCounter } from "./scan.js";

export const kBlend = /* wgsl */ `
${kViewWgsl}${kConstants}${kSplatWgsl}
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> ranges: array<u32>;
@group(0) @binding(3) var<storage, read> entries: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<array<vec4f, 3>>;
@group(0) @binding(5) var picture: texture_storage_2d<rgba8unorm, write>;

var<workgroup> staged: array<array<vec4f, 3>, 256>;
var<workgroup> n_finished: atomic<u32>;
var<workgroup> all_finished: bool;

@compute @workgroup_size(16, 16)
fn blend(@builtin(workgroup_id) tile: vec3u, @builtin(global_invocation_id) pixel: vec3u, @builtin(local_invocation_index) thread: u32) {
  if (counters[${kCounter.overflow}] != 0u) { return; }
  let number = tile.y * view.grid.x + tile.x;
  let end = ranges[number + 1u];
  let is_inside = all(pixel.xy < view.size);
  var is_finished = !is_inside;
  if (is_finished) { atomicAdd(&n_finished, 1u); }
  var color = vec3f();
  var transmittance = 1.0;
  for (var begin = ranges[number]; begin < end; begin += 256u) {
    workgroupBarrier();
    if (begin + thread < end) { staged[thread] = splats[entries[begin + thread]]; }
    if (thread == 0u) { all_finished = atomicLoad(&n_finished) == 256u; }
    if (workgroupUniformLoad(&all_finished)) { break; }
    let n = min(256u, end - begin);
    for (var i = 0u; i < n && !is_finished; i++) {
      let s = load_splat(staged[i]);
      let d = s.mean - vec2f(pixel.xy);
      let power = -0.5 * (s.conic.x * d.x * d.x + s.conic.z * d.y * d.y) - s.conic.y * d.x * d.y;
      let alpha = min(kAlphaMax, s.opacity * exp(power));
      if (power > 0.0 || alpha < kAlphaMin) { continue; }
      let next = transmittance * (1.0 - alpha);
      if (next < kTransmittanceMin) {
        is_finished = true;
        atomicAdd(&n_finished, 1u);
        break;
      }
      color += alpha * transmittance * s.color;
      transmittance = next;
    }
  }
  if (is_inside) { textureStore(picture, pixel.xy, vec4f(color + transmittance * view.background, 1.0 - transmittance)); }
}
`;

/** Copies the picture to a texture of any format. */
export const kShow = /* wgsl */ `
@group(0) @binding(0) var picture: texture_2d<f32>;

@vertex
fn corner(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
  return vec4f(f32(i & 1u) * 4.0 - 1.0, f32(i >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}
@fragment
fn show(@builtin(position) at: vec4f) -> @location(0) vec4f {
  return textureLoad(picture, vec2u(at.xy), 0);
}
`;
