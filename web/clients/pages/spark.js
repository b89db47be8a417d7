// spark.js - pictures by Spark, by its defaults: three.js sorts and draws what SparkRenderer finds in a scene.
// SPDX-License-Identifier: Apache-2.0
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Scene } from "three";
import { pixels } from "./pixels.js";
import { drawBySpark, newCamera, newRenderer, setCamera } from "./three.js";

const camera = newCamera();
const renderer = newRenderer({ width: 1, height: 1 });
const scene = new Scene();
const spark = new SparkRenderer({ renderer });
scene.add(spark);
let mesh;
let drawn;

window.draw = async (url, pinhole) => {
  if (url !== drawn) {
    if (mesh) {
      scene.remove(mesh);
      mesh.dispose();
    }
    mesh = new SplatMesh({ url });
    await mesh.initialized;
    scene.add(mesh);
    drawn = url;
  }
  setCamera(camera, renderer, pinhole);
  await drawBySpark(spark, renderer, scene, camera);
  return { gaussians: mesh.numSplats, rgba: pixels(renderer.domElement) };
};
