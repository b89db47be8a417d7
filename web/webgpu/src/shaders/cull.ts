// cull.ts - which Gaussians are in view; one workgroup a chunk, one thread a Gaussian.
// SPDX-License-Identifier: Apache-2.0
//
// Math    kernels/src/common/cull_chunk.cuh, rgs/math/projection.hpp; docs/format/RENDERING.md "A Gaussian on the image"
// In/Out  chunks in the order that is drawn, rows -> a bit a Gaussian, their number a chunk
// Cost    112 B a chunk; 28 B a Gaussian of chunks in view, 44 B of arrays
// Order   deterministic
import { kConstants, kCoverage, kSplatWgsl, kViewWgsl, type Layout, projectionOf } from "./math.js";

export const cullOf = (layout: Layout): string => /* wgsl */ `
${kViewWgsl}${kConstants}${kSplatWgsl}${kCoverage}
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> block: Block;
@group(0) @binding(2) var<storage, read> rows: array<u32>;
@group(0) @binding(3) var<storage, read> groups: array<Group>;
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;
@group(0) @binding(5) var<storage, read_write> flags: array<u32>;
${projectionOf(layout)}

// False only if no tile can list a Gaussian of the chunk.
fn chunk_in_view(g: Group) -> bool {
  let low = from_camera(g.low);
  let high = from_camera(g.high);
  let center = 0.5 * (low + high);
  let half = 0.5 * (high - low);
  let size = dot(abs(center) + half, vec3f(1.0));
  var beyond = false;
  for (var i = 0; i < 6; i++) {
    let p = view.planes[i];
    let distance = dot(p.normal, center) + p.offset;
    beyond = beyond || distance > dot(p.extent, half) + p.reach * g.radius + p.rounding.x * size;
  }
  return !beyond;
}

fn in_view(row: u32, scale_unit: f32) -> bool {
  let p = project_row(row, scale_unit);
  if (!p.valid) { return false; }
  let s = screen_splat(p, vec3f());
  if (s.level < 0.0) { return false; }
  let e = ellipse(s);
  let y = tile_rows(e, view.grid);
  let x = tile_columns(e, view.grid);
  return y.x < y.y && x.x < x.y;
}

var<workgroup> mask: array<atomic<u32>, 8>;

@compute @workgroup_size(256)
fn cull(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) thread: u32) {
  let index = group_index(workgroup);
  if (index >= block.n_groups) { return; }
  let g = groups[block.first_group + index];
  if (thread < g.count && chunk_in_view(g) && in_view(g.row + thread, g.scale_unit)) {
    atomicOr(&mask[thread / 32u], 1u << (thread % 32u));
  }
  workgroupBarrier();
  if (thread < 8u) { flags[8u * g.order + thread] = atomicLoad(&mask[thread]); }
  if (thread == 0u) {
    var n = 0u;
    for (var i = 0u; i < 8u; i++) { n += countOneBits(atomicLoad(&mask[i])); }
    counts[g.order] = n;
  }
}
`;
