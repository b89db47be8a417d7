// roofgs.js - pictures by this project's own page: its stage, with what it does before it draws a scene.
// SPDX-License-Identifier: Apache-2.0
import { viewOf } from "../../viewer/src/cameras.ts";
import { openScene, readFile } from "../../viewer/src/open-scene.ts";
import { Stage } from "../../viewer/src/stage.ts";
import { kApi, newCanvas, pixels } from "./pixels.js";

let stage;
let scene;

window.draw = async (url, pinhole) => {
  stage ??= await Stage.start(newCanvas(pinhole), [kApi], { frame: () => false, resized() {}, lost() {}, restored() {} });
  if (stage.app.graphicsDevice.deviceType !== kApi) throw new Error(`the engine draws by ${stage.app.graphicsDevice.deviceType}`);
  if (!stage.isAsDefined) throw new Error("the engine has other shaders");
  if (url !== scene?.name) {
    scene?.destroy();
    const onProgress = () => {};
    const read = await readFile({ entry: { name: url, url }, onProgress });
    scene = await openScene(stage, { name: url, read, spzAxes: "ply", side: 0, onProgress, on: {} });
    await scene.complete();
    stage.setOrigin(scene.origin);
    scene.place(scene.origin);
    stage.setAntiAliasing(0, scene.antiAliasing(0));
  }
  const { width, height } = pinhole;
  const rgba = await stage.capture(0, viewOf(pinhole, [0, 0, 0]), width, height);
  const picture = new OffscreenCanvas(width, height);
  picture.getContext("2d").putImageData(new ImageData(rgba, width, height), 0, 0);
  return { gaussians: scene.nGaussians, rgba: pixels(picture) };
};
