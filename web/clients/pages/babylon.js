// babylon.js - pictures by Babylon.js, from cameras in the axes of 3DGS, by its defaults, but for the hand of the axes with glTF.
// SPDX-License-Identifier: Apache-2.0
import { FreeCamera } from "@babylonjs/core/Cameras/freeCamera.js";
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { WebGPUEngine } from "@babylonjs/core/Engines/webgpuEngine.js";
import { ImportMeshAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import { Color4 } from "@babylonjs/core/Maths/math.color.js";
import { Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { Scene } from "@babylonjs/core/scene.js";
import "@babylonjs/loaders/glTF/index.js";
import "@babylonjs/loaders/SPLAT/index.js";
import { kApi, kFar, newCanvas, nextFrame, pixels } from "./pixels.js";

window.draw = async (url, pinhole) => {
  const { position, rotation, width, height, fx, fy, cx, cy, near = 0.2 } = pinhole;
  const isGltf = url.endsWith(".glb");
  // Of glTF: left, up, forward. Of a PLY, in left-handed axes: right, up, forward.
  const turned = ([right, down, forward]) => new Vector3(isGltf ? -right : right, -down, forward);
  const canvas = newCanvas(pinhole);
  const engine = kApi === "webgpu" ? await WebGPUEngine.CreateAsync(canvas) : new Engine(canvas, false, { alpha: false });
  const scene = new Scene(engine);
  Object.assign(scene, { useRightHandedSystem: isGltf, clearColor: new Color4(0, 0, 0, 1) });
  const camera = new FreeCamera("camera", turned(position), scene);
  const axis = (k) => turned(rotation.map((row) => row[k]));
  camera.upVector = axis(1).negate();
  camera.setTarget(camera.position.add(axis(2)));
  Object.assign(camera, { minZ: near, maxZ: kFar });
  // With other focal lengths in x and y, and principal points.
  const projection = camera.getProjectionMatrix(true).clone();
  const [depth, toward] = projection.m.slice(10);
  projection.setRowFromFloats(0, (2 * fx) / width, 0, 0, 0);
  projection.setRowFromFloats(1, 0, (2 * fy) / height, 0, 0);
  projection.setRowFromFloats(2, toward * ((2 * cx) / width - 1), toward * (1 - (2 * cy) / height), depth, toward);
  camera.freezeProjectionMatrix(projection);
  const { meshes } = await ImportMeshAsync(url, scene);
  const splats = meshes.find((mesh) => mesh.getClassName() === "GaussianSplattingMesh");
  const draw = () => {
    engine.beginFrame();
    scene.render();
    engine.endFrame();
  };
  do {
    draw();
    await nextFrame();
  } while (!(splats.isReady(true) && splats._isDepthSortSettled));
  draw();
  const found = { gaussians: splats.splatCount, rgba: pixels(canvas) };
  engine.dispose();
  canvas.remove();
  return found;
};
