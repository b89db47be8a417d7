// sort.ts - a stable radix sort of 32-bit keys with values, 8 bits a pass; 256 threads for 2,048 of them.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  keys, values [n] -> digits' counts [256, workgroups], their sums by scan.ts -> keys, values by digit
// Cost    20 B a key and pass
// Shared  9 KiB: who of 256 threads has which digit, and where each digit's next key goes
// Order   deterministic and stable. Chained scans need workgroups that wait for each other, which WebGPU does not promise, so a
//         pass reads keys twice
import { kBlockScan, kPassWgsl, kSortItems } from "./scan.js";

export const kHistogram = /* wgsl */ `
${kPassWgsl}
@group(0) @binding(0) var<uniform> pass_: Pass;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> histogram: array<u32>;

var<workgroup> bins: array<atomic<u32>, 256>;

@compute @workgroup_size(256)
fn count_digits(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) thread: u32) {
  let n = counters[pass_.counter];
  for (var j = 0u; j < ${kSortItems / 256}u; j++) {
    let i = workgroup.x * ${kSortItems}u + 256u * j + thread;
    if (i < n) { atomicAdd(&bins[(keys[i] >> pass_.shift) & 255u], 1u); }
  }
  workgroupBarrier();
  histogram[thread * workgroups_for(n, pass_.per) + workgroup.x] = atomicLoad(&bins[thread]);
}
`;

export const kScatter = /* wgsl */ `
${kPassWgsl}${kBlockScan}
@group(0) @binding(0) var<uniform> pass_: Pass;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read> histogram: array<u32>;
@group(0) @binding(5) var<storage, read> totals: array<u32>;
@group(0) @binding(6) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(7) var<storage, read_write> values_out: array<u32>;

var<workgroup> next: array<u32, 256>;
// Bit t of word w is thread 32 w + t; digit d of word w is at 256 w + d.
var<workgroup> masks: array<atomic<u32>, 2048>;

@compute @workgroup_size(256)
fn scatter(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) thread: u32) {
  let n = counters[pass_.counter];
  let total = totals[thread];
  next[thread] = block_scan(thread, total) - total + histogram[thread * workgroups_for(n, pass_.per) + workgroup.x];
  let word = thread / 32u;
  let bit = 1u << (thread % 32u);
  for (var j = 0u; j < ${kSortItems / 256}u; j++) {
    workgroupBarrier();
    let i = workgroup.x * ${kSortItems}u + 256u * j + thread;
    var key = 0u;
    var digit = 0u;
    if (i < n) {
      key = keys[i];
      digit = (key >> pass_.shift) & 255u;
      atomicOr(&masks[256u * word + digit], bit);
    }
    workgroupBarrier();
    var before = 0u;
    var all = 0u;
    var first = 0u;
    if (i < n) {
      for (var w = 0u; w < 8u; w++) {
        let mask = atomicLoad(&masks[256u * w + digit]);
        all += countOneBits(mask);
        before += countOneBits(mask & select(select(0u, bit - 1u, w == word), 0xffffffffu, w < word));
      }
      first = next[digit];
    }
    workgroupBarrier();
    if (i < n) {
      if (before + 1u == all) { next[digit] = first + all; }
      atomicStore(&masks[256u * word + digit], 0u);
      keys_out[first + before] = key;
      if (pass_.first != 0u) {
        values_out[first + before] = i;
      } else {
        values_out[first + before] = values[i];
      }
    }
  }
}
`;
