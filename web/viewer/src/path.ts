// path.ts - plays the path through the cameras.
// SPDX-License-Identifier: Apache-2.0
import { add, axisOf, type CameraEntry, looking, normalised, pathPosition, viewOf } from "./cameras.js";
import type { Page } from "./page.js";
import { type PageStore, worldOf } from "./state.js";

/** Seconds from one camera to the next. */
const kPathSeconds = 2;

/** Starts or stops. */
export function play(store: PageStore): void {
  const { playing, cameras } = store.state;
  store.set({ playing: playing === undefined && cameras.length > 1 ? 0 : undefined });
}

/** Called before each frame. */
export function advance(store: PageStore, seconds: number): void {
  const { playing: before, cameras, view } = store.state;
  if (before === undefined || !view) return;
  const playing = (before + seconds / (kPathSeconds * (cameras.length - 1))) % 1;
  const { position, segment, share } = pathPosition(cameras.map((camera) => camera.position), playing);
  const [from, to] = [cameras[segment], cameras[segment + 1]] as [CameraEntry, CameraEntry];
  const forward = add(add([0, 0, 0], axisOf(from.rotation, 2), 1 - share), axisOf(to.rotation, 2), share);
  const up = add(add([0, 0, 0], axisOf(from.rotation, 1), share - 1), axisOf(to.rotation, 1), -share);
  const pivot = add(position, normalised(forward), worldOf(store.state).speed);
  store.set({ playing, view: { ...viewOf(from, pivot), position, rotation: looking(forward, up) } });
}

export function showPath(page: Page): void {
  const { store } = page;
  page.onClick("play", () => play(store));
  store.subscribe(({ playing }) => [playing !== undefined], ([isPlaying]) => page.element("play", HTMLButtonElement).setAttribute("aria-pressed", String(isPlaying)));
}
