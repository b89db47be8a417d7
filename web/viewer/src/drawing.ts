// drawing.ts - the engine's picture as a view of the state, and what is done before each frame.
// SPDX-License-Identifier: Apache-2.0
import { add } from "./cameras.js";
import type { Controls } from "./controls.js";
import { advanceFlight } from "./flight.js";
import { advance } from "./path.js";
import type { PageStore } from "./state.js";
import type { Stage } from "./stage.js";

export function drawState(store: PageStore, stage: Stage): void {
  store.subscribe(({ scenes }) => [scenes], ([[left, right]]) => {
    if (left) stage.setOrigin(left.origin);
    for (const scene of [left, right]) scene?.place(left?.origin ?? scene.origin);
  });
  // The stage takes the view relative to its origin, so after that.
  store.subscribe(({ view, size, scenes }) => [view, size, scenes], ([view]) => view && stage.setView(view));
  store.subscribe(({ background }) => [background], ([background]) => stage.setBackground(background));
  store.subscribe(({ scenes, shDegree }) => [scenes, shDegree], ([scenes, shDegree]) => scenes.forEach((scene) => scene?.setShDegree(shDegree)));
  store.subscribe(({ scenes, tint }) => [scenes, tint], ([scenes, tint]) => scenes.forEach((scene) => scene?.setTint(tint)));
  store.subscribe(({ scenes, detailPx }) => [scenes, detailPx], ([[left, right], detailPx]) => {
    if (left) stage.setAntiAliasing(0, left.antiAliasing(detailPx));
    if (right) stage.setAntiAliasing(1, right.antiAliasing(detailPx));
  });
  // What is done before each frame depends on these.
  store.subscribe(({ detailPx, budget, statistics, bounds, playing, flight, frame }) => [detailPx, budget, statistics, bounds, playing, flight, frame], () => stage.request());
}

/** Called before each frame. Returns whether pages are still to come, or the view is moving. */
export function step(store: PageStore, stage: Stage, controls: Controls, seconds: number): boolean {
  const now = performance.now();
  controls.step(seconds);
  advance(store, seconds);
  advanceFlight(store, now);
  const { view, size, scenes, detailPx, budget: mostGaussians, playing, flight, bounds } = store.state;
  if (!view) return false;
  for (const scene of scenes) {
    if (!scene?.hasPages) continue;
    const position = add(view.position, scene.origin, -1);
    scene.look({ position, focalPx: Math.max(1, view.aspect) * view.focal * size.width, detailPx, mostGaussians }, now);
  }
  store.set({ nChanges: scenes.reduce((sum, scene) => sum + (scene?.nChanges ?? 0), 0) });
  // Boxes last for one frame.
  if (bounds && stage.isToDraw) drawBounds(store, stage);
  return controls.active || playing !== undefined || flight !== undefined || scenes.some((scene) => scene !== undefined && scene.pages.wanted > 0);
}

function drawBounds({ state: { scenes } }: PageStore, stage: Stage): void {
  for (const scene of scenes) {
    if (!scene) continue;
    const shift = add(scene.origin, scenes[0]?.origin ?? [0, 0, 0], -1);
    for (const { min, max } of scene.boxes()) stage.drawBox(add(min, shift), add(max, shift), [1, 0.8, 0.1]);
  }
}
