// checksum.ts - XXH64, the checksum at the end of a Zstandard frame.
// SPDX-License-Identifier: Apache-2.0

const kU64 = 0xffffffffffffffffn;
const kPrimes: readonly [bigint, bigint, bigint, bigint, bigint] = [0x9e3779b185ebca87n, 0xc2b2ae3d27d4eb4fn, 0x165667b19e3779f9n, 0x85ebca77c2b2ae63n, 0x27d4eb2f165667c5n];
/** Low and high halves of the first two. */
const [kLow1, kHigh1] = [0x85ebca87, 0x9e3779b1];
const [kLow2, kHigh2] = [0x27d4eb4f, 0xc2b2ae3d];

/** The upper half of a product of 32 bits by 32. */
function upperProduct(a: number, b: number): number {
  const a0 = a & 0xffff;
  const a1 = a >>> 16;
  const b0 = b & 0xffff;
  const b1 = b >>> 16;
  // Neither sum reaches 2^32.
  const first = Math.imul(a1, b0) + (Math.imul(a0, b0) >>> 16);
  const second = Math.imul(a0, b1) + (first & 0xffff);
  return (Math.imul(a1, b1) + (first >>> 16) + (second >>> 16)) | 0;
}

/** The four accumulators after all whole stripes of 32 bytes. Computed in 32-bit halves, because bigints are six times slower. */
function sumsOf(view: DataView, nStripes: number): bigint[] {
  const [p1, p2] = kPrimes;
  return [(p1 + p2) & kU64, p2, 0n, -p1 & kU64].map((start, lane) => {
    let low = Number(start & 0xffffffffn) | 0;
    let high = Number(start >> 32n) | 0;
    for (let at = 8 * lane, end = at + 32 * nStripes; at < end; at += 32) {
      const lane0 = view.getInt32(at, true);
      const lane1 = view.getInt32(at + 4, true);
      // The lane times the second prime is added, ...
      const product = Math.imul(lane0, kLow2);
      const sum = (low + product) | 0;
      const carry = sum >>> 0 < product >>> 0 ? 1 : 0;
      high = (high + upperProduct(lane0, kLow2) + Math.imul(lane0, kHigh2) + Math.imul(lane1, kLow2) + carry) | 0;
      // ... the sum rotated by 31 bits and multiplied by the first.
      const r0 = (sum << 31) | (high >>> 1);
      const r1 = (high << 31) | (sum >>> 1);
      low = Math.imul(r0, kLow1);
      high = (upperProduct(r0, kLow1) + Math.imul(r0, kHigh1) + Math.imul(r1, kLow1)) | 0;
    }
    return (BigInt(high >>> 0) << 32n) | BigInt(low >>> 0);
  });
}

/** The low 32 bits of XXH64 with seed 0: https://github.com/Cyan4973/xxHash/blob/dev/doc/xxhash_spec.md. */
export function checksumOf(bytes: Uint8Array): number {
  const [p1, p2, p3, p4, p5] = kPrimes;
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const rotated = (x: bigint, bits: bigint): bigint => ((x << bits) | (x >> (64n - bits))) & kU64;
  const round = (lane: bigint): bigint => (rotated((lane * p2) & kU64, 31n) * p1) & kU64;
  const nStripes = Math.floor(bytes.length / 32);
  let at = 32 * nStripes;
  let hash: bigint = p5;
  if (nStripes > 0) {
    const sums = sumsOf(view, nStripes);
    hash = sums.reduce((sum, each, i) => sum + rotated(each, [1n, 7n, 12n, 18n][i] as bigint), 0n) & kU64;
    for (const sum of sums) hash = ((hash ^ round(sum)) * p1 + p4) & kU64;
  }
  hash = (hash + BigInt(bytes.length)) & kU64;
  for (; at + 8 <= bytes.length; at += 8) hash = (rotated(hash ^ round(view.getBigUint64(at, true)), 27n) * p1 + p4) & kU64;
  if (at + 4 <= bytes.length) {
    hash = (rotated(hash ^ ((BigInt(view.getUint32(at, true)) * p1) & kU64), 23n) * p2 + p3) & kU64;
    at += 4;
  }
  for (; at < bytes.length; ++at) hash = (rotated(hash ^ ((BigInt(view.getUint8(at)) * p5) & kU64), 11n) * p1) & kU64;
  hash = ((hash ^ (hash >> 33n)) * p2) & kU64;
  hash = ((hash ^ (hash >> 29n)) * p3) & kU64;
  return Number((hash ^ (hash >> 32n)) & 0xffffffffn);
}
