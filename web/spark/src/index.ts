// index.ts - .rgs files in Spark, above three.js.
// SPDX-License-Identifier: Apache-2.0
/**
 * Draws .rgs files with Spark.
 * @module @roofgs/spark
 */
import { type AntiAliasing, type DeclaredAntiAliasing, type Gaussians, type ReadOptions, type RgsFile, antiAliasingOf } from "@roofgs/reader";
import { ExtSplats, type SparkRendererOptions, utils } from "@sparkjsdev/spark";

export { RgsError, type RgsErrorCode } from "@roofgs/reader";

const kSh0 = 0.28209479177387814;
/** By degree: SH terms besides degree 0. */
const kTerms = [0, 3, 8, 15] as const;

/**
 * Three numbers as 8 bits each of a power of two, and signs: Spark's `decodeExtRgb()` reads them. Its own encoder takes the power
 * below the largest number, to which it then clamps it.
 */
function packRgb(r: number, g: number, b: number): number {
  const most = Math.max(Math.abs(r), Math.abs(g), Math.abs(b));
  const power = most > 0 ? Math.max(-15, Math.min(16, Math.ceil(Math.log2(most)))) : -15;
  const code = (v: number): number => Math.min(255, Math.round(Math.abs(v) * 255 * 2 ** -power));
  const signs = (r < 0 ? 1 : 0) | (g < 0 ? 2 : 0) | (b < 0 ? 4 : 0);
  return (code(r) | (code(g) << 8) | (code(b) << 16) | (((power + 15) << 27) | (signs << 24))) >>> 0;
}

/** `shN` as [n, 4] words of Spark's textures: terms of degrees 1, 2 and 3 in the order of their texels. */
function packSh({ n, shDegree, shN }: Gaussians, most: number): Record<string, Uint32Array> {
  const terms = kTerms[shDegree] as number;
  const textures = [
    ["sh1", 0, shDegree === 1 ? 3 : 4],
    ["sh2", 4, 4],
    ["sh3a", 8, 4],
    ["sh3b", 12, 3],
  ] as const;
  const out: Record<string, Uint32Array> = {};
  for (const [key, first, count] of textures) {
    if (first >= terms) break;
    const words = new Uint32Array(4 * most);
    for (let i = 0; i < n; ++i) {
      for (let k = 0; k < count; ++k) {
        const at = 3 * (terms * i + first + k);
        words[4 * i + k] = packRgb(shN[at] as number, shN[at + 1] as number, shN[at + 2] as number);
      }
    }
    out[key] = words;
  }
  return out;
}

/**
 * Gaussians in Spark's larger encoding, for `new SplatMesh({ extSplats })`: FP32 means, FP16 colours, opacities and logarithms of
 * scales, rotations of 32 bits, SH of all degrees, 8 bits for the largest of a term's three channels. Relative to the file's
 * origin and in its axes: turn and move the mesh.
 */
export function packSplats(gaussians: Gaussians): ExtSplats {
  const { n, means, rotations, scales, opacities, sh0 } = gaussians;
  const { maxSplats } = utils.getTextureSize(n);
  const arrays: [Uint32Array, Uint32Array] = [new Uint32Array(4 * maxSplats), new Uint32Array(4 * maxSplats)];
  const at = (array: Float32Array, index: number): number => array[index] as number;
  for (let i = 0; i < n; ++i) {
    const [x, y, z, q] = [3 * i, 3 * i + 1, 3 * i + 2, 4 * i];
    const colour = (index: number): number => 0.5 + kSh0 * at(sh0, index);
    utils.encodeExtSplat(
      arrays,
      i,
      at(means, x),
      at(means, y),
      at(means, z),
      at(scales, x),
      at(scales, y),
      at(scales, z),
      at(rotations, q + 1),
      at(rotations, q + 2),
      at(rotations, q + 3),
      at(rotations, q),
      at(opacities, i),
      colour(x),
      colour(y),
      colour(z),
    );
  }
  return new ExtSplats({ extArrays: arrays, numSplats: n, extra: packSh(gaussians, maxSplats) });
}

/** packSplats() of all Gaussians of a file's finest level. Rejects as RgsFile.read() does. */
export async function readSplats(file: RgsFile, options: ReadOptions = {}): Promise<ExtSplats> {
  return packSplats(await file.read(options));
}

/**
 * Options of a SparkRenderer that bring its picture nearer to the one that the file defines: low-pass, cut-off and order; the
 * positions between mesh and picture stay FP32. They hold for all meshes of a renderer.
 */
export function rendererOptions(declared: DeclaredAntiAliasing): Partial<SparkRendererOptions> {
  const { lowPassPx2, compensated }: AntiAliasing = antiAliasingOf(declared);
  return {
    preBlurAmount: compensated ? 0 : lowPassPx2,
    blurAmount: compensated ? lowPassPx2 : 0,
    // Where an opacity of 1 falls to 1/255.
    maxStdDev: Math.sqrt(2 * Math.log(255)),
    minAlpha: 1 / 255,
    maxPixelRadius: 8192,
    sortRadial: false,
    accumExtSplats: true,
  };
}
