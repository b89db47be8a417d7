// bench-playcanvas.mjs - what a frame of the PlayCanvas engine takes by its WebGPU path, to compare with bench.mjs: node
// bench-playcanvas.mjs scene.rgs cameras.json [--size 1920x1080] [--views 0,10] [--frames 50]. The engine draws by its defaults, sorts
// on the GPU, and gets a PLY of all Gaussians; a canvas and what else it asks a browser for stand in below.
// SPDX-License-Identifier: Apache-2.0
import { readFileSync } from "node:fs";
import { parseArgs } from "node:util";
import { open } from "@roofgs/reader";
import { create, globals } from "webgpu";
import { readCameras } from "../playcanvas/test/pictures.mjs";

const words = Object.fromEntries(["size", "views", "frames"].map((name) => [name, { type: "string" }]));
const { values, positionals } = parseArgs({ allowPositionals: true, options: words });
const [scene, cameras] = positionals;
if (!cameras) {
  console.error("usage: node bench-playcanvas.mjs scene.rgs cameras.json [--size WxH] [--views 0,1] [--frames N]");
  process.exit(2);
}
const [width, height] = (values.size ?? "1920x1080").split("x").map(Number);
const nFrames = Number(values.frames ?? 50);
const list = readCameras(cameras);
const views = values.views?.split(",").map(Number) ?? [...list.keys()];
if (!views.every((view) => list[view])) {
  console.error(`--views ${values.views}: the views of ${cameras} are 0 to ${list.length - 1}`);
  process.exit(2);
}

async function plyOf(path) {
  const file = await open(new Uint8Array(readFileSync(path)));
  const { means, rotations, scales, opacities, sh0, shN } = await file.read();
  file.close();
  const n = opacities.length;
  const nRest = shN.length / n / 3;
  const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", ...Array.from({ length: 3 * nRest }, (_, i) => `f_rest_${i}`)];
  names.push("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3");
  const rows = new Float32Array(names.length * n);
  const logit = (opacity) => Math.log(Math.max(1e-6, opacity) / Math.max(1e-6, 1 - opacity));
  for (let i = 0; i < n; ++i) {
    const rest = Array.from({ length: 3 * nRest }, (_, k) => shN[3 * (nRest * i + (k % nRest)) + Math.floor(k / nRest)]);
    const three = (values) => values.subarray(3 * i, 3 * i + 3);
    const logs = three(scales).map((scale) => Math.log(Math.max(1e-12, scale)));
    rows.set([...three(means), ...three(sh0), ...rest, logit(opacities[i]), ...logs, ...rotations.subarray(4 * i, 4 * i + 4)], names.length * i);
  }
  const properties = names.map((name) => `property float ${name}\n`).join("");
  return new Blob([`ply\nformat binary_little_endian 1.0\nelement vertex ${n}\n${properties}end_header\n`, rows]);
}
const ply = await plyOf(scene);

Object.assign(globalThis, globals, { gpu: create([]) });
class Element extends EventTarget {
  style = {};
  appendChild() {}
  setAttribute() {}
  getBoundingClientRect = () => ({ left: 0, top: 0, width, height });
}
let texture;
const context = {
  configure({ device, format, usage, viewFormats = [] }) {
    texture = device.createTexture({ size: [width, height], format, usage: usage | GPUTextureUsage.RENDER_ATTACHMENT, viewFormats });
  },
  unconfigure() {},
  getCurrentTexture: () => texture,
};
class HTMLCanvasElement extends Element {
  width = width;
  height = height;
  clientWidth = width;
  clientHeight = height;
  getContext = (kind) => (kind === "webgpu" ? context : null);
}
let nextFrame;
const nothing = ["HTMLElement", "HTMLImageElement", "HTMLVideoElement", "ImageBitmap", "OffscreenCanvas"].map((name) => [name, class {}]);
const browser = {
  ...Object.fromEntries(nothing),
  HTMLCanvasElement,
  window: globalThis,
  document: Object.assign(new EventTarget(), { createElement: () => new HTMLCanvasElement(), body: new Element(), visibilityState: "visible" }),
  navigator: { gpu: globalThis.gpu, userAgent: "", platform: "", appVersion: "", getGamepads: () => [] },
  location: { search: "", href: "file:///", protocol: "file:" },
  addEventListener() {},
  removeEventListener() {},
  requestAnimationFrame: (next) => ((nextFrame = next), 1),
  cancelAnimationFrame() {},
  devicePixelRatio: 1,
  fetch: async () => new Response(ply, { headers: { "content-length": String(ply.size) } }),
};
for (const [name, value] of Object.entries(browser)) Object.defineProperty(globalThis, name, { value, configurable: true, writable: true });
const pc = await import("playcanvas");
const { setPinhole } = await import("@roofgs/playcanvas");

const canvas = new HTMLCanvasElement();
const options = new pc.AppOptions();
options.graphicsDevice = await pc.createGraphicsDevice(canvas, { deviceTypes: ["webgpu"], antialias: false });
if (!options.graphicsDevice.isWebGPU) throw new Error("no adapter: is there a Vulkan driver, and libvulkan.so.1?");
options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
options.resourceHandlers = [pc.GSplatHandler, pc.TextureHandler];
const app = new pc.AppBase(canvas);
app.init(options);
app.start();
const asset = new pc.Asset("scene", "gsplat", { url: "http://localhost/scene.ply", filename: "scene.ply" });
app.assets.add(asset);
await new Promise((resolve, reject) => {
  asset.once("load", resolve);
  asset.once("error", (error) => reject(new Error(error)));
  app.assets.load(asset);
});
const eye = new pc.Entity();
eye.addComponent("camera", { clearColor: new pc.Color(0, 0, 0, 1), farClip: 1e5, nearClip: 0.2 });
app.root.addChild(eye);
const entity = new pc.Entity();
entity.addComponent("gsplat", { asset });
app.root.addChild(entity);
const { queue } = options.graphicsDevice.wgpu;

console.log(`PlayCanvas ${pc.version}; ${asset.resource.numSplats} Gaussians, ${width}x${height}, ${nFrames} frames`);
console.log("view  frames/s in a row");
for (const view of views) {
  const camera = list[view];
  const [fx, fy] = [camera.fx, camera.fy].map((focal) => (focal * width) / camera.width);
  // Each frame from another place, so that each is sorted.
  const draw = (i) => {
    const position = camera.position.map((value, k) => value + (k === 0 ? 1e-4 * (i % 2) : 0));
    setPinhole(eye, { ...camera, width, height, fx, fy, cx: width / 2, cy: height / 2, position });
    nextFrame(performance.now());
  };
  for (let i = 0; i < 10; ++i) draw(i);
  await queue.onSubmittedWorkDone();
  const begin = performance.now();
  for (let i = 0; i < nFrames; ++i) draw(i);
  await queue.onSubmittedWorkDone();
  const rate = (1000 * nFrames) / (performance.now() - begin);
  console.log(String(view).padStart(4) + rate.toFixed(1).padStart(19));
}
// Dawn's threads keep the process.
process.exit(0);
