// spz.ts - what the engine and the page need of an .spz.
// SPDX-License-Identifier: Apache-2.0
import type { Spz } from "@roofgs/reader";

/** Right, down, forward as in PLY, or right, up, backward. */
export type SpzAxes = "ply" | "opengl";
const kAxes: Readonly<Record<string, SpzAxes>> = { "right,down,forward": "ply", "right,up,backward": "opengl" };

/** Null if the file declares none. */
export function axesOf({ axes }: Spz): SpzAxes | null {
  if (axes === null) return null;
  const known = kAxes[axes.join()];
  if (!known) throw Object.assign(new Error(), { code: "unsupported_feature", text: "it has axes that only rgs-convert turns" });
  return known;
}

/** x, y, z, w of smallest three of 9 bits and sign. */
export function rotationOf(word: number): number[] {
  const largest = word >>> 30;
  const q = [0, 0, 0, 0];
  for (let c = 3, rest = word; c >= 0; --c) {
    if (c === largest) continue;
    q[c] = ((rest & 511) / 511) * Math.SQRT1_2 * (rest & 512 ? -1 : 1);
    rest >>>= 10;
  }
  q[largest] = Math.sqrt(Math.max(0, 1 - q.reduce((sum, value) => sum + value * value, 0)));
  return q;
}

/** Converts rotations of version 2 (x, y, z of 8 bits) to smallest three of 9 bits and sign: 4 bytes. */
export function smallestThree(rotations: Uint8Array): Uint8Array {
  const n = rotations.length / 3;
  const out = new Uint32Array(n);
  for (let i = 0; i < n; ++i) {
    const q = [0, 1, 2].map((c) => (rotations[3 * i + c] as number) / 127.5 - 1);
    q.push(Math.sqrt(Math.max(0, 1 - q.reduce((sum, value) => sum + value * value, 0))));
    const length = Math.hypot(...q);
    const largest = q.reduce((best, value, c) => (Math.abs(value) > Math.abs(q[best] as number) ? c : best), 0);
    const sign = (q[largest] as number) < 0 ? -1 : 1;
    let word = largest;
    for (let c = 0; c < 4; ++c) {
      if (c === largest) continue;
      const value = (sign * (q[c] as number)) / length;
      word = ((word << 10) | (value < 0 ? 0x200 : 0) | Math.min(511, Math.round(Math.abs(value) * Math.SQRT2 * 511))) >>> 0;
    }
    out[i] = word;
  }
  return new Uint8Array(out.buffer);
}
