// picking.ts - finds the Gaussian that was pointed at, and makes it the pivot.
// SPDX-License-Identifier: Apache-2.0
import { add, dot, kNear, looking, normalised, pinholeOf } from "./cameras.js";
import { type PageStore, worldOf } from "./state.js";

/** How far along a ray its nearest Gaussian is; 0 if none is near it. `eye`: relative to the origin of the means, [n, 3] each. */
export function depthAlong(centres: Iterable<Float32Array>, eye: readonly number[], ray: readonly number[]): number {
  const [rx, ry, rz] = ray as [number, number, number];
  const [ex, ey, ez] = eye as [number, number, number];
  let best = Infinity;
  let depth = 0;
  // Called for millions of Gaussians, so it allocates nothing.
  for (const means of centres) {
    for (let i = 0; i < means.length; i += 3) {
      const tx = (means[i] as number) - ex;
      const ty = (means[i + 1] as number) - ey;
      const tz = (means[i + 2] as number) - ez;
      const along = tx * rx + ty * ry + tz * rz;
      if (along <= kNear) continue;
      const aside = Math.sqrt(Math.max(0, tx * tx + ty * ty + tz * tz - along * along)) / along;
      // Half a degree off the ray costs as much as a third of the distance.
      const cost = along * (1 + (aside / 0.009) ** 2 / 3);
      if (aside < 0.03 && cost < best) {
        best = cost;
        depth = along;
      }
    }
  }
  return depth;
}

/** `x` and `y`: pixels of the element. */
export function focus(store: PageStore, { clientWidth, clientHeight }: HTMLElement, x: number, y: number): void {
  const { view, mode, split, scenes: [left, right] } = store.state;
  const scene = mode === "slider" && right && x > split * clientWidth ? right : left;
  if (!view || !scene) return;
  const { fx, fy, cx = 0, cy = 0 } = pinholeOf(view, clientWidth, clientHeight);
  const direction = [(x - cx) / fx, (y - cy) / fy, 1];
  const ray = normalised([0, 1, 2].map((row) => dot(view.rotation[row] as number[], direction)));
  const depth = depthAlong(scene.centres(), add(view.position, scene.origin, -1), ray);
  if (depth > 0) store.set({ view: { ...view, pivot: add(view.position, ray, depth), rotation: looking(ray, worldOf(store.state).up) } });
}
