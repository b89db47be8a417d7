// difference.ts - PSNR and difference map of two pictures.
// SPDX-License-Identifier: Apache-2.0

export interface Difference {
  /** Over RGB with peak 255, dB; Infinity if the pictures are equal. */
  psnrDb: number;
  /** RGBA: black where the pictures are equal, then red, white from a difference of 32 of 255 on. */
  map: Uint8ClampedArray<ArrayBuffer>;
}

const kMost = 32;

/** `a` and `b` are RGBA of the same size. */
export function difference(a: Uint8Array | Uint8ClampedArray, b: Uint8Array | Uint8ClampedArray): Difference {
  if (a.length !== b.length) throw new RangeError("the pictures differ in size");
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
