// babylon.js - a page that clients.test.mjs drives: pictures by Babylon.js, from cameras in the axes of 3DGS.
// SPDX-License-Identifier: Apache-2.0
import { FreeCamera } from "@babylonjs/core/Cameras/freeCamera.js";
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { ImportMeshAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import { Color4 } from "@babylonjs/core/Maths/math.color.js";
import { Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { Scene } from "@babylonjs/core/scene.js";
import "@babylonjs/loaders/glTF/index.js";
import { newCanvas, nextFrame, pixels } from "./pixels.js";

/** Of glTF: left, up, forward. */
const turned = ([right, down, forward]) => new Vector3(-right, -down, forward);

window.draw = async (url, { position, rotation, height, fy }, [w, h]) => {
  const canvas = newCanvas([w, h]);
  const scene = new Scene(new Engine(canvas, false, { alpha: false }));
  Object.assign(scene, { useRightHandedSystem: true, clearColor: new Color4(0, 0, 0, 1) });
  const camera = new FreeCamera("camera", turned(position), scene);
  const axis = (k) => turned(rotation.map((row) => row[k]));
  camera.upVector = axis(1).negate();
  camera.setTarget(camera.position.add(axis(2)));
  Object.assign(camera, { fov: 2 * Math.atan(height / 2 / fy), minZ: 0.2, maxZ: 1e5 });
  const { meshes } = await ImportMeshAsync(url, scene);
  const splats = meshes.find((mesh) => mesh.getClassName() === "GaussianSplattingMesh");
  do {
    scene.render();
    await nextFrame();
  } while (!(splats.isReady(true) && splats._isDepthSortSettled));
  scene.render();
  const found = { gaussians: splats.splatCount, rgba: pixels(canvas) };
  scene.getEngine().dispose();
  canvas.remove();
  return found;
};
