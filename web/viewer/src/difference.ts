// difference.ts - how far two pictures are apart.
// SPDX-License-Identifier: Apache-2.0

export interface Difference {
  /** Of RGB, peak 255, dB; Infinity of equal pictures. */
  psnrDb: number;
  /** RGBA; black where both are equal, over red to white at 32 of 255. */
  map: Uint8ClampedArray<ArrayBuffer>;
}

const kMost = 32;

/** Two RGBA pictures of one size. */
export function difference(a: Uint8Array | Uint8ClampedArray, b: Uint8Array | Uint8ClampedArray): Difference {
  if (a.length !== b.length) throw new RangeError("pictures of two sizes have no difference");
  const map = new Uint8ClampedArray(a.length);
  let sum = 0;
  for (let i = 0; i < a.length; i += 4) {
    let most = 0;
    for (let c = i; c < i + 3; ++c) {
      const d = Math.abs((a[c] as number) - (b[c] as number));
      sum += d * d;
      most = Math.max(most, d);
    }
    const share = most / kMost;
    map[i] = 510 * share;
    map[i + 1] = 510 * (share - 0.5);
    map[i + 2] = 510 * (share - 0.75);
    map[i + 3] = 255;
  }
  return { psnrDb: -10 * Math.log10(sum / ((a.length / 4) * 3) / 255 ** 2), map };
}
