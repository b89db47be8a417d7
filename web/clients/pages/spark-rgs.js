// spark-rgs.js - pictures of .rgs files by Spark, as @roofgs/spark has it draw.
// SPDX-License-Identifier: Apache-2.0
import { open } from "@roofgs/reader";
import { readSplats, rendererOptions } from "@roofgs/spark";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Scene } from "three";
import { pixels } from "./pixels.js";
import { drawBySpark, newCamera, newRenderer, setCamera } from "./three.js";

window.draw = async (url, pinhole) => {
  const camera = newCamera();
  const renderer = newRenderer({ width: 1, height: 1 });
  const file = await open(url);
  const extSplats = await readSplats(file);
  const spark = new SparkRenderer({ renderer, ...rendererOptions(file.declarations) });
  file.close();
  const scene = new Scene();
  scene.add(spark, new SplatMesh({ extSplats }));
  setCamera(camera, renderer, pinhole);
  await drawBySpark(spark, renderer, scene, camera);
  const rgba = pixels(renderer.domElement);
  renderer.dispose();
  return { gaussians: extSplats.numSplats, rgba };
};
