// seen.ts - Gaussians that the engine loaded, as first-view.ts takes them.
// SPDX-License-Identifier: Apache-2.0
import type { Gaussians, Spz } from "@roofgs/reader";
import { GSplatData, Quat, type Texture, Vec3, Vec4 } from "playcanvas";
import { rotationOf } from "./spz.js";

export type Part = Pick<Gaussians, "means" | "rotations" | "scales" | "opacities">;

/** Gaussians in a part. */
const kPart = 1 << 16;
/** Where an SOG has them. */
const kImages = ["means_l", "means_u", "quats", "scales", "sh0"] as const;

type Row = readonly [mean: readonly number[], rotation: readonly number[], scale: readonly number[], opacity: number];

function* partsOf(total: number, row: (i: number) => Row): Generator<Part> {
  for (let first = 0; first < total; first += kPart) {
    const n = Math.min(kPart, total - first);
    const part = { means: new Float32Array(3 * n), rotations: new Float32Array(4 * n), scales: new Float32Array(3 * n), opacities: new Float32Array(n) };
    for (let i = 0; i < n; ++i) {
      const [mean, rotation, scale, opacity] = row(first + i);
      part.means.set(mean, 3 * i);
      part.rotations.set(rotation, 4 * i);
      part.scales.set(scale, 3 * i);
      part.opacities[i] = opacity;
    }
    yield part;
  }
}

/** Of a PLY, a compressed one, or an SOG. */
export async function seenOf(data: GSplatData): Promise<Iterable<Part>> {
  const images = data as unknown as Partial<Record<string, Texture & { _levels: unknown[] }>>;
  for (const name of kImages) {
    const image = images[name];
    if (image) image._levels[0] = await image.read(0, 0, image.width, image.height, { immediate: true });
  }
  const [mean, turn, scale, colour] = [new Vec3(), new Quat(), new Vec3(), new Vec4()];
  const rows = data.createIter(mean, turn, scale, colour);
  // Only a PLY's are no logarithms here.
  const activated = data instanceof GSplatData ? (value: number): number => value : Math.exp;
  return partsOf(data.numSplats, (i) => {
    rows.read(i);
    return [[mean.x, mean.y, mean.z], [turn.w, turn.x, turn.y, turn.z], [activated(scale.x), activated(scale.y), activated(scale.z)], colour.w];
  });
}

/** Of an .spz, whose `rotations` have 4 bytes; with `isYUp` turned half around x. */
export function seenOfSpz({ n, streams: { scales, alphas } }: Spz, rotations: Uint8Array, centers: Float32Array, isYUp: boolean): Iterable<Part> {
  const words = new DataView(rotations.buffer, rotations.byteOffset, rotations.byteLength);
  return partsOf(n, (i) => {
    const [x, y, z, w] = rotationOf(words.getUint32(4 * i, true)) as [number, number, number, number];
    const [a, b, c] = centers.subarray(3 * i, 3 * i + 3) as unknown as [number, number, number];
    const scale = [0, 1, 2].map((k) => Math.exp((scales[3 * i + k] as number) / 16 - 10));
    return [isYUp ? [a, -b, -c] : [a, b, c], isYUp ? [-x, w, -z, y] : [w, x, y, z], scale, (alphas[i] as number) / 255];
  });
}
