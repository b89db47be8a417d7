// lists.ts - lists Gaussians by tile: entries in the order of depth, which a stable sort by tile keeps.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/coverage.hpp
// In/Out  splats, tile counts, order [visible] -> sums a workgroup -> tiles, splats of entries; then sorted tiles -> ranges
// Cost    4 B a Gaussian; 48 B a Gaussian and 8 B an entry; a search a tile
// Launch  256 threads for 256 Gaussians, which they write side by side, so that a large Gaussian is not left to one thread
// Order   deterministic: by depth, then in the order of the scene
import { kConstants, kCoverage, kSplatWgsl, kViewWgsl } from "./math.js";
import { kBlockScan, kCounter } from "./scan.js";

export const kCount = /* wgsl */ `
@group(0) @binding(0) var<storage, read> counters: array<u32>;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> tiles: array<u32>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;

var<workgroup> sum: atomic<u32>;

@compute @workgroup_size(256)
fn count(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) thread: u32) {
  let i = 256u * workgroup.x + thread;
  if (i < counters[${kCounter.drawnVisible}]) { atomicAdd(&sum, tiles[order[i]]); }
  workgroupBarrier();
  if (thread == 0u) { counts[workgroup.x] = atomicLoad(&sum); }
}
`;

export const kEmit = /* wgsl */ `
${kViewWgsl}${kConstants}${kSplatWgsl}${kCoverage}${kBlockScan}
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
@group(0) @binding(4) var<storage, read> counts: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<array<vec4f, 3>>;
@group(0) @binding(6) var<storage, read_write> keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> entries: array<u32>;

// The tile number j that a Gaussian touches. Behind the last one if counts were rounded otherwise: no pixel reads that.
fn tile_of(s: ScreenSplat, j: u32) -> u32 {
  let e = ellipse(s);
  let y = tile_rows(e, view.grid);
  var left = j;
  for (var r = y.x; r < y.y; r++) {
    let x = tiles_in_row(e, r, view.grid);
    if (left < x.y - x.x) { return r * view.grid.x + x.x + left; }
    left -= x.y - x.x;
  }
  return view.grid.x * view.grid.y;
}

@compute @workgroup_size(256)
fn emit(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) thread: u32) {
  if (counters[${kCounter.drawnEntries}] == 0u) { return; }
  let i = 256u * workgroup.x + thread;
  var n = 0u;
  if (i < counters[${kCounter.drawnVisible}]) { n = tiles[order[i]]; }
  block_scan(thread, n);
  let base = counts[workgroup.x];
  for (var at = thread; at < sums[255]; at += 256u) {
    // The first Gaussian whose entries end behind this one.
    var low = 0u;
    for (var stride = 128u; stride > 0u; stride /= 2u) {
      if (sums[low + stride - 1u] <= at) { low += stride; }
    }
    let splat = order[256u * workgroup.x + low];
    let j = at - select(0u, sums[max(low, 1u) - 1u], low > 0u);
    keys[base + at] = tile_of(load_splat(splats[splat]), j);
    entries[base + at] = splat;
  }
}
`;

/** ranges[t]: the first entry of tile t or a later one. */
export const kRanges = /* wgsl */ `
@group(0) @binding(0) var<storage, read> counters: array<u32>;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> ranges: array<u32>;

@compute @workgroup_size(256)
fn find_ranges(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= arrayLength(&ranges)) { return; }
  var low = 0u;
  var high = counters[${kCounter.drawnEntries}];
  while (low < high) {
    let middle = low + (high - low) / 2u;
    if (keys[middle] < id.x) { low = middle + 1u; } else { high = middle; }
  }
  ranges[id.x] = low;
}
`;
