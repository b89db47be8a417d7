// drawing.ts - the stage's picture as a view of the state, and what is done before each frame.
// SPDX-License-Identifier: Apache-2.0
import { add } from "./cameras.js";
import type { Controls } from "./controls.js";
import { advanceFlight } from "./flight.js";
import { advance } from "./path.js";
import type { PageStore } from "./state.js";
import type { Stage } from "./stage.js";

export function drawState(store: PageStore, stage: Stage): void {
  store.subscribe(({ scenes: [left] }) => [left], ([left]) => left && stage.set({ origin: left.origin }));
  store.subscribe(({ view, size }) => [view, size], ([view]) => view && stage.set({ view }));
  store.subscribe(({ background }) => [background], ([background]) => stage.set({ background }));
  store.subscribe(({ scenes, shDegree }) => [scenes, shDegree], ([scenes, shDegree]) => scenes.forEach((scene) => scene?.setShDegree(shDegree)));
  store.subscribe(({ scenes, tint }) => [scenes, tint], ([scenes, tint]) => scenes.forEach((scene) => scene?.setTint(tint)));
  store.subscribe(({ scenes, detailPx }) => [scenes, detailPx], ([[left, right], detailPx]) => {
    stage.set({ antiAliasing: [left?.antiAliasing(detailPx), right?.antiAliasing(detailPx)] });
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
    for (const { min, max } of scene?.boxes() ?? []) stage.drawBox(min, max, scene?.origin ?? []);
  }
}
