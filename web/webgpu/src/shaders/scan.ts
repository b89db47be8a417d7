// scan.ts - exclusive sums, and from them the sizes of what follows; 256 threads a row.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  values [rows, n] -> sums of those before in the row, totals [rows]; then totals -> counters, workgroups to dispatch
// Cost    8 B a value
// Order   deterministic. Sums end at 2^32 - 1, so that what does not fit is never taken for less

/** Numbers of a frame, in an array of u32. `visible` and `entries` may be more than there is room for; then nothing is drawn. */
export const kCounter = { visible: 0, entries: 1, drawnVisible: 2, drawnEntries: 3, groups: 4, overflow: 5 } as const;
export const kCounters = 8;
/** Values of a workgroup of the radix sort. */
export const kSortItems = 2048;
/** Bytes of `workgroups` by what they work on. */
export const kDispatch = { sortVisible: 0, visible: 12, sortEntries: 24 } as const;

/** Of a pass over as many values as a counter says. */
export const kPassWgsl = /* wgsl */ `
struct Pass {
  counter: u32,
  per: u32,    // values a workgroup
  shift: u32,  // of the digit
  first: u32,  // 1: values are their own places
}
fn workgroups_for(n: u32, per: u32) -> u32 {
  return n / per + select(0u, 1u, n % per != 0u);
}
`;

/** Of 256 values, one a thread: inclusive sums, which `sums` has too. All threads call it. */
export const kBlockScan = /* wgsl */ `
var<workgroup> sums: array<u32, 256>;
fn add(a: u32, b: u32) -> u32 {
  return select(a + b, 0xffffffffu, a + b < a);
}
// By 16 threads, 16 values each: more steps than a tree, fewer barriers.
fn block_scan(thread: u32, value: u32) -> u32 {
  workgroupBarrier();
  sums[thread] = value;
  workgroupBarrier();
  if (thread < 16u) {
    for (var i = 16u * thread + 1u; i < 16u * thread + 16u; i++) { sums[i] = add(sums[i - 1u], sums[i]); }
  }
  workgroupBarrier();
  var sum = sums[thread];
  for (var i = 15u; i < (thread & 240u); i += 16u) { sum = add(sum, sums[i]); }
  workgroupBarrier();
  sums[thread] = sum;
  workgroupBarrier();
  return sum;
}
`;

export const kScan = /* wgsl */ `
${kPassWgsl}${kBlockScan}
@group(0) @binding(0) var<uniform> pass_: Pass;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read_write> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> totals: array<u32>;

const kItems = 8u;

@compute @workgroup_size(256)
fn scan(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) thread: u32) {
  let n = workgroups_for(counters[pass_.counter], pass_.per);
  let row = workgroup.x * n;
  var carry = 0u;
  for (var begin = 0u; begin < n; begin += 256u * kItems) {
    let own = begin + kItems * thread;
    var sum = 0u;
    for (var k = 0u; k < kItems; k++) {
      if (own + k < n) { sum = add(sum, values[row + own + k]); }
    }
    block_scan(thread, sum);
    var before = carry;
    if (thread > 0u) { before = add(carry, sums[thread - 1u]); }
    for (var k = 0u; k < kItems; k++) {
      if (own + k < n) {
        let value = values[row + own + k];
        values[row + own + k] = before;
        before = add(before, value);
      }
    }
    carry = add(carry, sums[255]);
  }
  if (thread == 0u) { totals[workgroup.x] = carry; }
}
`;

/** `which`: 0 after the sum of what is visible, 1 after that of entries. */
export const planOf = (which: 0 | 1): string => /* wgsl */ `
${kPassWgsl}
@group(0) @binding(0) var<storage, read> capacity: array<u32>;
@group(0) @binding(1) var<storage, read> totals: array<u32>;
@group(0) @binding(2) var<storage, read_write> counters: array<u32>;
@group(0) @binding(3) var<storage, read_write> workgroups: array<u32>;

fn dispatch(at: u32, n: u32) {
  workgroups[at] = n;
  workgroups[at + 1u] = 1u;
  workgroups[at + 2u] = 1u;
}

@compute @workgroup_size(1)
fn plan() {
  let fits = totals[0] <= capacity[${which}];
  let n = select(0u, totals[0], fits);
  counters[${which}] = totals[0];
  counters[${2 + which}] = n;
  dispatch(${which === 0 ? 0 : 6}u, workgroups_for(n, ${kSortItems}u));
  ${which === 0 ? "dispatch(3u, workgroups_for(n, 256u));" : ""}
  counters[${kCounter.overflow}] = ${which === 0 ? "" : `counters[${kCounter.overflow}] |`} select(1u, 0u, fits);
}
`;
