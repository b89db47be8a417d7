// stored.ts - packs stored Gaussians into textures.
// SPDX-License-Identifier: Apache-2.0
import type { ReadOptions, RgsFile, StoredGaussians } from "@roofgs/reader";

/** Texels of a row of the table: FP32 step of degree 0 to 3 by channel, and in w 2^-scaleExponent and the part's colour. */
export const kRowTexels = 4;
/** Rows side by side in the table's texture. */
export const kTableColumns = 512;

/** 32-bit words of SH codes of a Gaussian, by degree: 4, 12, 28, 48 bytes. */
const kShWords = [1, 3, 7, 12] as const;
export const kShTextures = [1, 1, 2, 3] as const;

/** Red, green, blue, 0 to 1. */
export type Colour = readonly [number, number, number];

/** Gaussians of files or pages, packed for textures. */
export interface Packed {
  readonly n: number;
  readonly shDegree: number;
  /** [n, 4] FP32 bits of the mean, row of the table. */
  mean(out: Uint32Array): void;
  /** [n, 4] eight FP16: rotation w, x, y, z, scale x, y, z, opacity. */
  geometry(out: Uint32Array): void;
  /** [n, shTextureWords()] SH codes from 16 * `texture` on. */
  sh(texture: number, out: Uint32Array): void;
  readonly nRows: number;
  /** [nRows, kRowTexels, 4]. `shDegree` above which steps are 0; colours by part, if any. */
  table(out: Float32Array, shDegree: number, colours?: readonly Colour[]): void;
}

/** 32-bit words per Gaussian in an SH texture. */
export function shTextureWords(shDegree: number): 1 | 4 {
  return shDegree === 0 ? 1 : 4;
}

function words(array: Uint16Array | Int8Array | Float32Array): Uint32Array {
  return new Uint32Array(array.buffer, array.byteOffset, array.byteLength / 4);
}

/** `parts` have one SH degree; there is at least one. */
export function pack(parts: readonly StoredGaussians[]): Packed {
  const first = parts[0];
  if (!first) throw new RangeError("no Gaussians to draw");
  const shDegree = first.shDegree;
  if (parts.some((part) => part.shDegree !== shDegree)) throw new RangeError("parts of different SH degrees");
  const shWords = kShWords[shDegree] as number;
  const nSets = (part: StoredGaussians): number => part.steps.length / 12;
  return {
    n: parts.reduce((sum, part) => sum + part.n, 0),
    shDegree,
    mean(out) {
      let at = 0;
      let row = 0;
      for (const part of parts) {
        const means = words(part.means);
        for (let i = 0; i < part.n; ++i) {
          out[at++] = means[3 * i] as number;
          out[at++] = means[3 * i + 1] as number;
          out[at++] = means[3 * i + 2] as number;
          out[at++] = row + (part.chunkSteps[Math.floor(i / part.chunkSize)] as number);
        }
        row += nSets(part);
      }
    },
    geometry(out) {
      let at = 0;
      for (const part of parts) {
        out.set(words(part.geometry), at);
        at += 4 * part.n;
      }
    },
    sh(texture, out) {
      const stride = shTextureWords(shDegree);
      const begin = 4 * texture;
      const count = Math.min(stride, shWords - begin);
      let at = 0;
      for (const part of parts) {
        const codes = words(part.sh);
        for (let i = 0; i < part.n; ++i, at += stride) {
          for (let k = 0; k < count; ++k) out[at + k] = codes[shWords * i + begin + k] as number;
        }
      }
    },
    nRows: parts.reduce((sum, part) => sum + nSets(part), 0),
    table(out, shDegreeDrawn, colours) {
      let at = 0;
      for (const [i, part] of parts.entries()) {
        const colour = colours?.[i];
        for (let set = 0; set < nSets(part); ++set) {
          for (let degree = 0; degree < 4; ++degree, at += 4) {
            const drawn = degree <= shDegreeDrawn;
            for (let c = 0; c < 3; ++c) out[at + c] = drawn ? (part.steps[12 * set + 3 * degree + c] as number) : 0;
            // -1: no tint.
            out[at + 3] = degree === 0 ? 2 ** -part.scaleExponent : (colour?.[degree - 1] ?? -1);
          }
        }
      }
    },
  };
}

/** All Gaussians of a file's finest level as parts for RgsResource. Rejects as readStored() does. */
export async function readStoredParts(file: RgsFile, options: ReadOptions = {}): Promise<StoredGaussians[]> {
  if (!file.levels) return [await file.readStored(options)];
  const parts: StoredGaussians[] = [];
  for await (const part of file.storedParts(options)) parts.push(part);
  return parts;
}
