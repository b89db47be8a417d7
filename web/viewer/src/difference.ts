// difference.ts - PSNR and difference map of two pictures, in the colours of rgs-audit's reports.
// SPDX-License-Identifier: Apache-2.0

export interface Difference {
  /** Over RGB with peak 255, dB; Infinity if the pictures are equal. */
  psnrDb: number;
  /** RGBA: the largest difference of a pixel's channels, by kHeat from 0 to `top`; white above. */
  map: Uint8ClampedArray<ArrayBuffer>;
  /** Levels of 255: a round number that at most one pixel in a thousand exceeds. */
  top: number;
}

/** RGB, 0 to 255, at equal steps: black, violet, red, orange, yellow, each lighter than the one before. */
export const kHeat: readonly (readonly [number, number, number])[] = [[0, 0, 5], [77, 18, 122], [176, 41, 97], [237, 105, 36], [250, 191, 36], [252, 255, 163]];
const kTops = [1, 2, 5, 10, 20, 50, 100, 200];

function heat(share: number): readonly [number, number, number] {
  if (share > 1) return [255, 255, 255];
  const at = share * (kHeat.length - 1);
  const i = Math.min(Math.floor(at), kHeat.length - 2);
  const [a, b] = [kHeat[i] as readonly number[], kHeat[i + 1] as readonly number[]];
  return [0, 1, 2].map((c) => (a[c] as number) + (at - i) * ((b[c] as number) - (a[c] as number))) as [number, number, number];
}

/** `a` and `b` are RGBA of the same size. */
export function difference(a: Uint8Array | Uint8ClampedArray, b: Uint8Array | Uint8ClampedArray): Difference {
  if (a.length !== b.length) throw new RangeError("the pictures differ in size");
  const n = a.length / 4;
  const levels = new Uint8Array(n);
  const counts = new Uint32Array(256);
  let sum = 0;
  for (let i = 0; i < n; ++i) {
    let most = 0;
    for (let c = 4 * i; c < 4 * i + 3; ++c) {
      const d = Math.abs((a[c] as number) - (b[c] as number));
      sum += d * d;
      most = Math.max(most, d);
    }
    levels[i] = most;
    counts[most] = (counts[most] as number) + 1;
  }
  const above = (level: number): number => counts.subarray(level + 1).reduce((all, each) => all + each, 0);
  const top = kTops.find((level) => above(level) * 1000 <= n) ?? 255;
  const colours = Array.from(counts, (_, level) => heat(level / top));
  const map = new Uint8ClampedArray(a.length).fill(255);
  levels.forEach((level, i) => map.set(colours[level] as readonly [number, number, number], 4 * i));
  return { psnrDb: -10 * Math.log10(sum / (n * 3) / 255 ** 2), map, top };
}
