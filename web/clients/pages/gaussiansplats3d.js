// gaussiansplats3d.js - pictures by GaussianSplats3D, by its defaults: no SH. Without its loop, controls, fade-in and spinner; its workers
// share no memory, for which a page's server must send headers.
// SPDX-License-Identifier: Apache-2.0
import { SceneFormat, SceneRevealMode, Viewer } from "@mkkellogg/gaussian-splats-3d";
import { nextFrame, pixels } from "./pixels.js";
import { newCamera, newRenderer, setCamera } from "./three.js";

const camera = newCamera();
const renderer = newRenderer({ width: 1, height: 1 });
let viewer;
let drawn;

window.draw = async (url, pinhole) => {
  setCamera(camera, renderer, pinhole);
  if (url !== drawn) {
    await viewer?.dispose();
    const off = { selfDrivenMode: false, useBuiltInControls: false, sharedMemoryForWorkers: false };
    viewer = new Viewer({ renderer, camera, ...off, sceneRevealMode: SceneRevealMode.Instant });
    await viewer.addSplatScene(url, { format: SceneFormat.Ply, showLoadingUI: false });
    drawn = url;
  }
  const sorted = async () => {
    while (viewer.sortRunning) await nextFrame();
  };
  viewer.update();
  await sorted();
  // By itself it keeps the order of views that are much alike, and sorts in several steps.
  do {
    await viewer.runSplatSort(true, true);
    await sorted();
  } while (await viewer.runSplatSort());
  await sorted();
  viewer.update();
  await sorted();
  viewer.render();
  return { gaussians: viewer.splatMesh.getSplatCount(), rgba: pixels(renderer.domElement) };
};
