// bench.mjs - what a frame takes, and its picture: node bench.mjs scene.rgs cameras.json [--size 1920x1080] [--views 0,10]
// [--frames 50] [--out FOLDER]. Of a file with levels of detail it draws the leaves. Dawn for Node draws; docs/develop/WEBGPU.md says what it needs.
// SPDX-License-Identifier: Apache-2.0
import { mkdirSync, writeFileSync } from "node:fs";
import { open as openFile } from "node:fs/promises";
import { join } from "node:path";
import { parseArgs } from "node:util";
import { crc32, deflateSync } from "node:zlib";
import { antiAliasingOf, requestDevice, SplatRenderer } from "@roofgs/webgpu";
import { open } from "@roofgs/reader";
import { create, globals } from "webgpu";
import { readCameras } from "../playcanvas/test/pictures.mjs";

const { values, positionals } = parseArgs({
  allowPositionals: true,
  options: Object.fromEntries(["size", "views", "frames", "out"].map((name) => [name, { type: "string" }])),
});
const [scene, cameras] = positionals;
if (!cameras) {
  console.error("usage: node bench.mjs scene.rgs cameras.json [--size WxH] [--views 0,1] [--frames N] [--out FOLDER]");
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

function png(pixels) {
  const lines = Buffer.alloc((4 * width + 1) * height);
  for (let y = 0; y < height; ++y) lines.set(pixels.subarray(4 * width * y, 4 * width * (y + 1)), (4 * width + 1) * y + 1);
  const chunk = (type, data) => {
    const body = Buffer.concat([Buffer.from(type), data]);
    const [length, crc] = [Buffer.alloc(4), Buffer.alloc(4)];
    length.writeUInt32BE(data.length);
    crc.writeUInt32BE(crc32(body));
    return Buffer.concat([length, body, crc]);
  };
  const header = Buffer.from([0, 0, 0, 0, 0, 0, 0, 0, 8, 6, 0, 0, 0]);
  header.writeUInt32BE(width, 0);
  header.writeUInt32BE(height, 4);
  const signature = Buffer.from([0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a]);
  return Buffer.concat([signature, chunk("IHDR", header), chunk("IDAT", deflateSync(lines)), chunk("IEND", Buffer.alloc(0))]);
}

Object.assign(globalThis, globals);
// Dawn ends with this object.
globalThis.gpu = create([]);
const adapter = await globalThis.gpu.requestAdapter({ powerPreference: "high-performance" });
if (!adapter) throw new Error("no adapter: is there a Vulkan driver, and libvulkan.so.1?");
const device = await requestDevice(adapter);
device.addEventListener("uncapturederror", ({ error }) => console.error(error.message));
const renderer = await SplatRenderer.create(device);

const handle = await openFile(scene);
const { size } = await handle.stat();
const read = async (offset, bytes) => (await handle.read(Buffer.alloc(bytes), 0, bytes, offset)).buffer;
const file = await open({ size, read });
const { origin } = file.declarations;
const parts = [];
for await (const part of file.storedParts()) parts.push(renderer.add(part));
renderer.setParts(parts);
file.close();

const options = { antiAliasing: antiAliasingOf(file.declarations) };
const target = device.createTexture({ size: [width, height], format: "rgba8unorm", usage: GPUTextureUsage.RENDER_ATTACHMENT });
const hasTimestamps = device.features.has("timestamp-query");
const querySet = hasTimestamps && device.createQuerySet({ type: "timestamp", count: 2 });
const resolved = device.createBuffer({ size: 256, usage: GPUBufferUsage.QUERY_RESOLVE | GPUBufferUsage.COPY_SRC });
const stamps = device.createBuffer({ size: 16, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
const timestampWrites = querySet && { querySet, beginningOfPassWriteIndex: 0, endOfPassWriteIndex: 1 };

/** Milliseconds: of the GPU where it has a clock, else until the queue is done. */
async function timeFrame() {
  const begin = performance.now();
  await renderer.render(target, options, timestampWrites || undefined);
  if (!querySet) {
    await device.queue.onSubmittedWorkDone();
    return performance.now() - begin;
  }
  const encoder = device.createCommandEncoder();
  encoder.resolveQuerySet(querySet, 0, 2, resolved, 0);
  encoder.copyBufferToBuffer(resolved, 0, stamps, 0, 16);
  device.queue.submit([encoder.finish()]);
  await stamps.mapAsync(GPUMapMode.READ);
  const [first, last] = new BigUint64Array(stamps.getMappedRange().slice(0));
  stamps.unmap();
  return Number(last - first) / 1e6;
}
const median = (list) => list.sort((a, b) => a - b)[list.length >> 1];

const { vendor, architecture, description } = adapter.info;
const clock = hasTimestamps ? "timestamps" : "the queue";
console.log(`${vendor} ${architecture} ${description}; ${file.header.nGaussians} Gaussians, ${width}x${height}, median of ${nFrames} frames, ms by ${clock}`);
console.log("view       ms  frames/s in a row     visible     entries");
for (const view of views) {
  renderer.setView(list[view], origin);
  const pixels = await renderer.capture(width, height, options);
  if (values.out) {
    mkdirSync(values.out, { recursive: true });
    writeFileSync(join(values.out, `${String(view).padStart(3, "0")}.png`), png(pixels));
  }
  const { nVisible, nEntries } = await renderer.render(target, options);
  const times = [];
  for (let i = 0; i < nFrames; ++i) times.push(await timeFrame());
  // What an animation sees: the queue is never empty.
  const begin = performance.now();
  const frames = Array.from({ length: nFrames }, () => renderer.render(target, options));
  await Promise.all(frames);
  await device.queue.onSubmittedWorkDone();
  const rate = (1000 * nFrames) / (performance.now() - begin);
  const cells = [[view, 4], [(median(times) ?? 0).toFixed(3), 9], [rate.toFixed(1), 19], [nVisible, 12], [nEntries, 12]];
  console.log(cells.map(([cell, n]) => String(cell).padStart(n)).join(""));
}
// Dawn's threads keep the process.
process.exit(0);
