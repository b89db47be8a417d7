// main.ts - starts the page: the state, what shows it, and what the page begins with.
// SPDX-License-Identifier: Apache-2.0
import "./style.css";
import { restore, showLink } from "./address.js";
import { showCameras } from "./cameras-panel.js";
import { Captures } from "./captures.js";
import { showComparison } from "./compare.js";
import { Controls } from "./controls.js";
import { drawState, step } from "./drawing.js";
import { drawReference } from "./frames.js";
import { connectKeys } from "./keys.js";
import { readLink } from "./link.js";
import { readManifest } from "./manifest.js";
import { kLost, kNoGraphics, kNotAsDefined } from "./messages.js";
import { showNames } from "./names.js";
import { readFile } from "./open-scene.js";
import { Opening } from "./opening.js";
import { element, fail, onClick, progressOf, say, showError, showLoading, withdrawError } from "./page.js";
import { showPath } from "./path.js";
import { watchRest } from "./rest.js";
import { bindSettings } from "./settings.js";
import { Stage } from "./stage.js";
import { firstState, type PageStore } from "./state.js";
import { statisticsOf } from "./statistics.js";
import { Store } from "./store.js";

async function main(): Promise<void> {
  const canvas = element("picture", HTMLCanvasElement);
  const store: PageStore = new Store(firstState({ width: canvas.width, height: canvas.height }));
  showLoading(store);
  // Scenes are requested while the engine starts.
  const manifest = readManifest();
  const reading = manifest.then(({ scenes }) => scenes.map((entry) => readFile({ entry, onProgress: progressOf(store) })));
  void reading.then((all) => all.forEach((each) => each.catch(() => undefined))).catch(() => undefined);
  let frame = (_seconds: number): boolean => false;
  const device = new URLSearchParams(location.search).get("device");
  // WebGPU only on request: not every browser that has it can draw with it.
  const stage = await Stage.start(canvas, device === "webgpu" ? ["webgpu", "webgl2"] : ["webgl2"], {
    frame: (seconds) => frame(seconds),
    resized: (size) => store.set({ size }),
    lost: () => showError(kLost),
    restored: () => {
      withdrawError(kLost);
      say("The graphics device is back");
    },
  }).catch(() => showError(kNoGraphics));
  if (!stage) return;
  try {
    if (!stage.isAsDefined) showError(kNotAsDefined);
    const found = await manifest;
    const controls = new Controls(store, canvas);
    // Before what is done only at rest.
    watchRest(store, () => controls.active);
    drawState(store, stage);
    const opening = new Opening(store, stage, found);
    const frames = found.frames ? drawReference(store, found.frames.url) : undefined;
    const captures = new Captures(store, stage, frames, () => opening.allOpened());
    showComparison(store, stage, captures);
    bindSettings(store);
    showNames(store);
    showCameras(store, captures);
    showPath(store);
    showLink(store);
    connectKeys(store);
    onClick("screenshot", () => void captures.screenshot().catch((error: unknown) => fail("The screenshot", error)));
    const showStatistics = statisticsOf(store);
    frame = (seconds) => {
      const isWaiting = step(store, stage, controls, seconds);
      showStatistics(stage.frames);
      return isWaiting;
    };
    const { background, sh_degree: shDegree } = found.settings ?? {};
    const photos = new Map(found.photos.map(({ camera, url }) => [camera, url]));
    store.set({ photos, ...(background ? { background } : {}), ...(shDegree !== undefined ? { shDegree } : {}) });
    const link = readLink(location.hash);
    restore(store, link);
    await opening.begin(await reading, link.mode);
    store.set({ isReady: true });
    document.documentElement.dataset["ready"] = "true";
  } catch (error) {
    fail("The page", error);
  }
}

void main();
