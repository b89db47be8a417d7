// seen.ts - Gaussians that the engine loaded, as first-view.ts takes them.
// SPDX-License-Identifier: Apache-2.0
import type { Gaussians } from "@roofgs/reader";
import { type GSplatData, Quat, type Texture, Vec3, Vec4 } from "playcanvas";

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

/** Of a compressed PLY, or an SOG, whose images are in memory until all parts are taken. */
export async function* seenOf(data: GSplatData): AsyncGenerator<Part> {
  const all = data as unknown as Partial<Record<string, Omit<Texture, "_levels"> & { _levels: unknown[] }>>;
  const images = kImages.flatMap((name) => all[name] ?? []);
  const before = images.map(({ _levels }) => _levels[0]);
  for (const image of images) image._levels[0] = await image.read(0, 0, image.width, image.height, { immediate: true });
  const [mean, turn, scale, colour] = [new Vec3(), new Quat(), new Vec3(), new Vec4()];
  const rows = data.createIter(mean, turn, scale, colour);
  const parts = partsOf(data.numSplats, (i) => {
    rows.read(i);
    return [[mean.x, mean.y, mean.z], [turn.w, turn.x, turn.y, turn.z], [Math.exp(scale.x), Math.exp(scale.y), Math.exp(scale.z)], colour.w];
  });
  try {
    yield* parts;
  } finally {
    images.forEach(({ _levels }, i) => (_levels[0] = before[i]));
  }
}
