// playcanvas.js - pictures by the PlayCanvas engine itself, by its defaults but for the clear colour, which is grey.
// SPDX-License-Identifier: Apache-2.0
import { setPinhole } from "@roofgs/playcanvas";
import {
  AppBase,
  AppOptions,
  Asset,
  CameraComponentSystem,
  Color,
  createGraphicsDevice,
  Entity,
  GSplatComponentSystem,
  GSplatHandler,
  TextureHandler,
} from "playcanvas";
import { kApi, kFar, newCanvas, pixels } from "./pixels.js";

let app;
let eye;
let asset;

async function start(canvas) {
  const options = new AppOptions();
  options.graphicsDevice = await createGraphicsDevice(canvas, { deviceTypes: [kApi] });
  // It takes another API than asked for without a word.
  if (options.graphicsDevice.deviceType !== kApi) throw new Error(`the engine draws by ${options.graphicsDevice.deviceType}`);
  options.componentSystems = [CameraComponentSystem, GSplatComponentSystem];
  options.resourceHandlers = [GSplatHandler, TextureHandler];
  app = new AppBase(canvas);
  app.init(options);
  app.autoRender = false;
  app.start();
  eye = new Entity();
  eye.addComponent("camera", { clearColor: new Color(0, 0, 0, 1), farClip: kFar });
  app.root.addChild(eye);
}

function frame() {
  app.renderNextFrame = true;
  return new Promise((resolve) => app.once("postrender", resolve));
}

async function load(url) {
  if (asset) {
    app.assets.remove(asset);
    asset.unload();
  }
  asset = new Asset(url, "gsplat", { url, filename: url.split("/").pop() });
  const loaded = new Promise((resolve, reject) => {
    asset.once("load", resolve);
    asset.once("error", (error) => reject(new Error(error)));
  });
  app.assets.add(asset);
  app.assets.load(asset);
  await loaded;
}

window.draw = async (url, pinhole) => {
  if (!app) await start(newCanvas(pinhole));
  app.graphicsDevice.setResolution(pinhole.width, pinhole.height);
  if (url !== asset?.name) await load(url);
  setPinhole(eye, pinhole);
  eye.camera.nearClip = pinhole.near ?? 0.2;
  // A new one, because the engine keeps colours of views within 10 degrees.
  const sorted = kApi === "webgl2" ? new Promise((resolve) => app.scene.once("gsplat:sorted", resolve)) : undefined; // else on the GPU
  const scene = new Entity();
  scene.addComponent("gsplat", { asset });
  app.root.addChild(scene);
  let ready = false;
  const heard = app.systems.gsplat.on("frame:ready", (_camera, _layer, isReady, loading) => (ready = isReady && loading === 0));
  await frame();
  await sorted;
  do await frame();
  while (!ready);
  // One frame takes over the order, the next one shows it.
  await frame();
  const found = { gaussians: asset.resource.numSplats, rgba: pixels(app.graphicsDevice.canvas) };
  heard.off();
  scene.destroy();
  return found;
};
