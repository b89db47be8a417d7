// roofgs.js - pictures by this project's own page: its stage, with what it does before it draws a scene.
// SPDX-License-Identifier: Apache-2.0
import { viewOf } from "../../viewer/src/cameras.ts";
import { openScene, readFile } from "../../viewer/src/open-scene.ts";
import { kPlyAxes } from "../../viewer/src/splats.ts";
import { Stage } from "../../viewer/src/stage.ts";
import { kApi, newCanvas, pixels } from "./pixels.js";

const kNames = { webgl2: "WebGL 2", webgpu: "WebGPU" };
let stage;
let scene;

window.draw = async (url, pinhole) => {
  const nothing = () => {};
  const on = { frame: () => false, resized: nothing, lost: nothing, restored: nothing, replaced: nothing, ended: nothing };
  stage ??= await Stage.start(newCanvas(pinhole), kApi, on);
  if (stage.api !== kNames[kApi]) throw new Error(`the page draws by ${stage.api}`);
  if (!stage.isAsDefined) throw new Error("the engine has other shaders");
  if (url !== scene?.name) {
    scene?.destroy();
    const read = await readFile({ entry: { name: url, url }, onProgress: nothing });
    scene = await openScene(stage, { name: url, read, spzAxes: "ply", axes: kPlyAxes, side: 0, shDegree: 3, onProgress: nothing, on: {}, signal: new AbortController().signal }).catch(({ text, message }) => {
      throw new Error(text ?? message);
    });
    await scene.complete();
    stage.set({ origin: scene.origin, antiAliasing: [scene.antiAliasing(0), undefined] });
  }
  const { width, height } = pinhole;
  const rgba = await stage.capture(0, viewOf(pinhole, [0, 0, 0]), width, height);
  const picture = new OffscreenCanvas(width, height);
  picture.getContext("2d").putImageData(new ImageData(rgba, width, height), 0, 0);
  return { gaussians: scene.nGaussians, rgba: pixels(picture) };
};
