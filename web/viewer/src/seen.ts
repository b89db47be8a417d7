// seen.ts - Gaussians that the engine loaded, as first-view.ts takes them.
// SPDX-License-Identifier: Apache-2.0
import type { Gaussians } from "@roofgs/reader";
import { type GSplatData, Quat, type Texture, Vec3, Vec4 } from "playcanvas";

export type Part = Pick<Gaussians, "means" | "rotations" | "scales" | "opacities">;

/** Gaussians in a part. */
const kPart = 1 << 16;
/** Where an SOG has them. */
const kImages = ["means_l", "means_u", "quats", "scales", "sh0"] as const;

/** Of a compressed PLY, or an SOG, whose images are in memory until all parts are taken. */
export async function* seenOf(data: GSplatData): AsyncGenerator<Part> {
  const all = data as unknown as Partial<Record<string, Omit<Texture, "_levels"> & { _levels: unknown[] }>>;
  const images = kImages.flatMap((name) => all[name] ?? []);
  const before = images.map(({ _levels }) => _levels[0]);
  const [mean, turn, scale, colour] = [new Vec3(), new Quat(), new Vec3(), new Vec4()];
  try {
    for (const image of images) image._levels[0] = await image.read(0, 0, image.width, image.height, { immediate: true });
    const rows = data.createIter(mean, turn, scale, colour);
    for (let first = 0; first < data.numSplats; first += kPart) {
      const n = Math.min(kPart, data.numSplats - first);
      const part = { means: new Float32Array(3 * n), rotations: new Float32Array(4 * n), scales: new Float32Array(3 * n), opacities: new Float32Array(n) };
      for (let i = 0; i < n; ++i) {
        rows.read(first + i);
        part.means.set([mean.x, mean.y, mean.z], 3 * i);
        part.rotations.set([turn.w, turn.x, turn.y, turn.z], 4 * i);
        part.scales.set([Math.exp(scale.x), Math.exp(scale.y), Math.exp(scale.z)], 3 * i);
        part.opacities[i] = colour.w;
      }
      yield part;
    }
  } finally {
    images.forEach(({ _levels }, i) => (_levels[0] = before[i]));
  }
}
