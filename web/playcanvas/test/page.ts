// page.ts - what the picture test drives: an engine, a scene and pictures of it.
// SPDX-License-Identifier: Apache-2.0
import { drawAsDefined, type Pinhole, resizePinhole, RgsParser, type RgsResource, setPinhole } from "@roofgs/playcanvas";
import {
  AppBase,
  AppOptions,
  Asset,
  CameraComponentSystem,
  Color,
  createGraphicsDevice,
  Entity,
  type GraphicsDevice,
  GSplatComponentSystem,
  GSplatHandler,
  PIXELFORMAT_RGBA8,
  RenderTarget,
  Texture,
  TextureHandler,
} from "playcanvas";

let app: AppBase;
let camera: Entity;
let ready = false;
/** Or as the engine draws by itself. */
let isAsDefined = true;
/** Rejects when the device is lost, which ends no frame. */
let lost: Promise<never>;
/** Resolves when a device that was lost is back. */
let restored: Promise<void>;

function watch(device: GraphicsDevice): void {
  // The engine says nothing of a device that the browser has destroyed.
  const { wgpu } = device as { wgpu?: { lost: Promise<{ message: string }> } };
  lost = new Promise((_, reject) => {
    device.once("devicelost", () => reject(new Error("the device is lost")));
    wgpu?.lost.then(({ message }) => reject(new Error(`the device is lost: ${message}`)));
  });
  lost.catch(() => undefined);
}

async function start(type: string, asDefined: boolean): Promise<string> {
  const canvas = document.createElement("canvas");
  document.body.append(canvas);
  const device = await createGraphicsDevice(canvas, { deviceTypes: [type], antialias: false });
  watch(device);
  restored = new Promise((resolve) => {
    device.on("devicerestored", () => {
      watch(device);
      resolve();
    });
  });
  const options = new AppOptions();
  options.graphicsDevice = device;
  options.componentSystems = [CameraComponentSystem, GSplatComponentSystem];
  options.resourceHandlers = [GSplatHandler, TextureHandler];
  app = new AppBase(canvas);
  app.init(options);
  app.loader.getHandler("gsplat")?.addParser(new RgsParser(app));
  camera = new Entity("camera");
  camera.addComponent("camera", { clearColor: new Color(0, 0, 0, 1), farClip: 10000 });
  app.root.addChild(camera);
  // Of a second camera the shaders are changed already.
  for (let i = 0; asDefined && i < 2; ++i) if (!camera.camera || !drawAsDefined(app, camera.camera)) throw new Error("the engine has other shaders");
  isAsDefined = asDefined;
  app.systems.gsplat?.on("frame:ready", (_camera: unknown, _layer: unknown, isReady: boolean, loading: number) => {
    ready = isReady && loading === 0;
  });
  app.autoRender = false;
  app.start();
  return device.deviceType;
}

/** Resolves with the number of Gaussians, rejects with the error. */
function load(url: string): Promise<number> {
  return new Promise((resolve, reject) => {
    const asset = new Asset("scene", "gsplat", { url });
    asset.on("load", () => {
      const entity = new Entity("scene");
      entity.addComponent("gsplat", { asset });
      app.root.addChild(entity);
      const { antiAliasing, numSplats } = asset.resource as RgsResource;
      if (isAsDefined && camera.camera) drawAsDefined(app, camera.camera, antiAliasing);
      resolve(numSplats);
    });
    asset.on("error", (error: unknown) => reject(error));
    app.assets.add(asset);
    app.assets.load(asset);
  });
}

/** Parameters of the scene's gsplats. */
function set(parameters: object): void {
  Object.assign(app.scene.gsplat, parameters);
}

/** One at a time: software rendering falls behind frames that nobody waits for. */
function frame(): Promise<void> {
  app.renderNextFrame = true;
  return new Promise((resolve) => app.once("postrender", () => resolve()));
}

/** OpenGL reads the lower row first. */
function flipRows(pixels: Uint8Array, width: number): void {
  const rows = pixels.slice();
  const bytes = 4 * width;
  for (let at = 0; at < rows.length; at += bytes) pixels.set(rows.subarray(at, at + bytes), rows.length - bytes - at);
}

function base64(pixels: Uint8Array | Uint8ClampedArray): string {
  return btoa(Array.from(pixels, (byte) => String.fromCharCode(byte)).join(""));
}

/** Where the engine sorts in a worker, a frame is right when it is drawn after the sorting that its camera asked for. */
async function drawn<T>(read: () => Promise<T>): Promise<T> {
  // By itself it sorts on a GPU that computes.
  const sortsOnCpu = isAsDefined || !app.graphicsDevice.isWebGPU;
  const sorted = sortsOnCpu ? new Promise<void>((resolve) => app.scene.once("gsplat:sorted", () => resolve())) : undefined;
  await frame();
  await sorted;
  do await frame();
  while (!ready);
  return read();
}

/** RGBA of the picture, upper row first, as base64. */
async function picture(pinhole: Pinhole, width: number, height: number): Promise<string> {
  const colorBuffer = new Texture(app.graphicsDevice, { width, height, format: PIXELFORMAT_RGBA8, mipmaps: false });
  const target = new RenderTarget({ colorBuffer, depth: true });
  setPinhole(camera, resizePinhole(pinhole, width, height));
  if (!camera.camera) throw new Error("no camera");
  camera.camera.renderTarget = target;
  const read = async () => (await colorBuffer.read(0, 0, width, height, { renderTarget: target, immediate: true })) as Uint8Array;
  const pixels = await Promise.race([drawn(read), lost]);
  if (app.graphicsDevice.isWebGL2) flipRows(pixels, width);
  camera.camera.renderTarget = null as unknown as RenderTarget;
  target.destroy();
  colorBuffer.destroy();
  return base64(pixels);
}

/** RGBA of a PNG, as base64. */
async function decode(url: string): Promise<string> {
  const blob = await (await fetch(url)).blob();
  const bitmap = await createImageBitmap(blob, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
  const context = canvas.getContext("2d") as OffscreenCanvasRenderingContext2D;
  context.drawImage(bitmap, 0, 0);
  const pixels = context.getImageData(0, 0, bitmap.width, bitmap.height).data;
  return base64(pixels);
}

Object.assign(window, { engine: { start, load, set, picture, decode, restored: () => restored } });
