// three.js - what the pages of clients above three.js share: its renderer as these clients' examples make it, and its camera.
// SPDX-License-Identifier: Apache-2.0
import { Matrix4, PerspectiveCamera, WebGLRenderer } from "three";
import { kFar, newCanvas, nextFrame } from "./pixels.js";

export function newRenderer(size) {
  const renderer = new WebGLRenderer({ canvas: newCanvas(size), antialias: false });
  renderer.setClearColor(0x000000, 1);
  return renderer;
}

/** Of a camera in the axes of 3DGS. */
export function setCamera(camera, renderer, { position, rotation, width, height, fx, fy, cx, cy, near = 0.2 }) {
  renderer.setSize(width, height, false);
  const [x, y, z] = rotation;
  // Columns right, up, backward.
  const toWorld = new Matrix4(x[0], -x[1], -x[2], position[0], y[0], -y[1], -y[2], position[1], z[0], -z[1], -z[2], position[2], 0, 0, 0, 1);
  toWorld.decompose(camera.position, camera.quaternion, camera.scale);
  camera.setViewOffset(width, height, width / 2 - cx, height / 2 - cy, width, height);
  // After setViewOffset(), which makes pixels square.
  Object.assign(camera, { fov: (2 * Math.atan(height / 2 / fy) * 180) / Math.PI, aspect: width / fx / (height / fy), near, far: kFar });
  camera.updateProjectionMatrix();
  camera.updateMatrixWorld(true);
}

export const newCamera = () => new PerspectiveCamera();

/** A picture by Spark, once it has sorted for this camera. */
export async function drawBySpark(spark, renderer, scene, camera) {
  const sorted = async () => {
    while (spark.sorting || spark.sortDirty || spark.sortTimeoutId !== -1) await nextFrame();
  };
  scene.updateMatrixWorld(true);
  renderer.render(scene, camera);
  await sorted();
  // By itself it keeps the order, and the colours, of views that are much alike.
  await spark.update({ scene, camera });
  await sorted();
  renderer.render(scene, camera);
}
