// gsplatjs.js - pictures by gsplat.js, by its defaults but for the fade-in and for the far plane, which is at 100. It has no principal
// points, and takes focal lengths at the first picture alone: each gets a renderer of its own.
// SPDX-License-Identifier: Apache-2.0
import { Camera, Matrix3, PLYLoader, Quaternion, Scene, Vector3, WebGLRenderer } from "gsplat";
import { kFar, newCanvas, nextFrame, pixels } from "./pixels.js";

window.draw = async (url, pinhole) => {
  const { position, rotation, width, height, fx, fy, near = 0.2 } = pinhole;
  const canvas = newCanvas(pinhole);
  const renderer = new WebGLRenderer(canvas, []);
  const scene = new Scene();
  const camera = new Camera();
  Object.assign(camera.data, { near, far: kFar, fx, fy });
  camera.position = new Vector3(...position);
  camera.rotation = Quaternion.FromMatrix3(new Matrix3(...rotation.flat()));
  const { data } = await PLYLoader.LoadAsync(url, scene);
  renderer.setSize(width, height);
  const { renderProgram: program } = renderer;
  // Its worker tells nothing when an order stays, and may be behind by several pictures.
  let before;
  do {
    before = program.depthIndex;
    renderer.render(scene, camera);
    for (let i = 0; i < 30 && program.depthIndex === before; ++i) await nextFrame();
  } while (program.depthIndex !== before || before.length !== data.vertexCount);
  renderer.render(scene, camera);
  const rgba = pixels(canvas);
  renderer.dispose();
  renderer.gl.getExtension("WEBGL_lose_context").loseContext();
  canvas.remove();
  return { gaussians: data.vertexCount, rgba };
};
