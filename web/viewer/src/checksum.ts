// checksum.ts - what a frame of Zstandard may end with.
// SPDX-License-Identifier: Apache-2.0

const kU64 = 0xffffffffffffffffn;
const kPrimes: readonly [bigint, bigint, bigint, bigint, bigint] = [0x9e3779b185ebca87n, 0xc2b2ae3d27d4eb4fn, 0x165667b19e3779f9n, 0x85ebca77c2b2ae63n, 0x27d4eb2f165667c5n];

/** XXH64 with seed 0, the low 32 bits: https://github.com/Cyan4973/xxHash/blob/dev/doc/xxhash_spec.md. */
export function checksumOf(bytes: Uint8Array): number {
  const [p1, p2, p3, p4, p5] = kPrimes;
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const rotated = (x: bigint, bits: bigint): bigint => ((x << bits) | (x >> (64n - bits))) & kU64;
  const round = (sum: bigint, lane: bigint): bigint => (rotated((sum + lane * p2) & kU64, 31n) * p1) & kU64;
  let at = 0;
  let hash: bigint = p5;
  if (bytes.length >= 32) {
    const sums: bigint[] = [(p1 + p2) & kU64, p2, 0n, -p1 & kU64];
    for (; at + 32 <= bytes.length; at += 32) sums.forEach((sum, i) => (sums[i] = round(sum, view.getBigUint64(at + 8 * i, true))));
    hash = sums.reduce((sum, each, i) => sum + rotated(each, [1n, 7n, 12n, 18n][i] as bigint), 0n) & kU64;
    for (const sum of sums) hash = ((hash ^ round(0n, sum)) * p1 + p4) & kU64;
  }
  hash = (hash + BigInt(bytes.length)) & kU64;
  for (; at + 8 <= bytes.length; at += 8) hash = (rotated(hash ^ round(0n, view.getBigUint64(at, true)), 27n) * p1 + p4) & kU64;
  if (at + 4 <= bytes.length) {
    hash = (rotated(hash ^ ((BigInt(view.getUint32(at, true)) * p1) & kU64), 23n) * p2 + p3) & kU64;
    at += 4;
  }
  for (; at < bytes.length; ++at) hash = (rotated(hash ^ ((BigInt(view.getUint8(at)) * p5) & kU64), 11n) * p1) & kU64;
  hash = ((hash ^ (hash >> 33n)) * p2) & kU64;
  hash = ((hash ^ (hash >> 29n)) * p3) & kU64;
  return Number((hash ^ (hash >> 32n)) & 0xffffffffn);
}
