// page.ts - what the tests drive: a renderer, scenes and pictures of them; sums and sorts by the kernels.
// SPDX-License-Identifier: Apache-2.0
import { type Declarations, open, type PageAction, type RgsFile, type StoredGaussians } from "@roofgs/reader";
import { antiAliasingOf, type Part, type Pinhole, type RenderOptions, requestDevice, SplatRenderer } from "@roofgs/webgpu";
import { readSplats } from "../../viewer/src/read-splats.js";
import type { Axes } from "../../viewer/src/splats.js";
import { kCounter, kCounters, kDispatch, kSortItems } from "../src/shaders/scan.js";
import { kDispatchBytes, Kernels, type Pair, run, Steps } from "../src/steps.js";

let device: GPUDevice;
let kernels: Kernels;
let renderer: SplatRenderer;
let declarations: Declarations;
let file: RgsFile;
let parts: Part[] = [];
const problems: string[] = [];

/** Whether the device has no more than every device has. */
async function start(isLeast: boolean): Promise<void> {
  const adapter = await navigator.gpu.requestAdapter();
  if (!adapter) throw new Error("no adapter");
  device = await (isLeast ? adapter.requestDevice() : requestDevice(adapter));
  device.addEventListener("uncapturederror", ({ error }) => problems.push(error.message));
  kernels = await Kernels.create(device);
}

/** Means in eighths, all further along each axis. */
function shifted(part: StoredGaussians, shift: number): StoredGaussians {
  const means = part.means.map((value) => Math.round(8 * value) / 8 + shift);
  const chunkBounds = part.chunkBounds.map((value, i) => (i % 4 === 3 ? value : value + shift + (i % 8 < 4 ? -1 / 8 : 1 / 8)));
  return { ...part, means, chunkBounds };
}

/** A new renderer with the Gaussians of a file: of one with levels of detail the leaves. `room`: first room for splats and entries. */
async function load(url: string, room?: [number, number], shift?: number): Promise<number> {
  renderer?.destroy();
  file?.close();
  renderer = await SplatRenderer.create(device, room);
  file = await open(url);
  ({ declarations } = file);
  parts = [];
  for await (const part of file.storedParts()) {
    parts.push(renderer.add(shift === undefined ? part : shifted(part, shift)));
    renderer.setParts(parts);
  }
  return file.header.nGaussians;
}

/** The same of a PLY or an SPZ, as arrays. */
async function loadArrays(url: string, room?: [number, number]): Promise<number> {
  renderer?.destroy();
  renderer = await SplatRenderer.create(device, room);
  const axes: Axes = ["right", "down", "forward"];
  const { parts: arrays, n, origin, antiAliasing } = await readSplats(url.endsWith(".ply") ? "ply" : "spz", await fetch(url), axes, axes, () => undefined);
  declarations = { origin, aaMode: antiAliasing.compensated ? "mip_splatting" : "classic", lowPassPx2: antiAliasing.lowPassPx2 } as unknown as Declarations;
  parts = arrays.map((part) => renderer.add(part));
  renderer.setParts(parts);
  return n;
}

/**
 * Draws the three parts of a file and the same in other colours, which lie in another block. `order`: numbers of parts, of the others 3
 * to 5. `isSwapped`: the others are added first.
 */
async function loadTwice(url: string, order: readonly number[], isSwapped: boolean): Promise<void> {
  await load(url);
  const stored: StoredGaussians[] = [];
  for await (const part of file.storedParts()) stored.push(part);
  if (stored.length !== 3) throw new Error(`${stored.length} parts`);
  const both = [...stored, ...stored.map((part) => ({ ...part, sh: part.sh.map((code) => -code) }))];
  for (const part of parts) renderer.remove(part);
  const added = new Map<number, Part>();
  for (const i of isSwapped ? [3, 4, 5, 0, 1, 2] : [0, 1, 2, 3, 4, 5]) added.set(i, renderer.add(both[i] as StoredGaussians));
  parts = order.map((i) => added.get(i) as Part);
  renderer.setParts(parts);
}

/** Draws the cut that the scheduler chooses for a camera; pages are added last to first, between others that leave. */
async function loadCut(pinhole: Pinhole, width: number, detailPx: number): Promise<number> {
  const { levels } = file;
  if (!levels) throw new Error("no levels of detail");
  const schedule = { budget: 2 ** 40, pageBytes: 0, rowBytes: 1, nReaders: 1, mostBytes: 1, gapBytes: 0, prefetches: false };
  const scheduler = await file.pageScheduler(schedule);
  const view = scheduler.addView();
  const position = pinhole.position.map((value, i) => value - (declarations.origin[i] as number));
  const focalPx = (Math.max(pinhole.fx, pinhole.fy) * width) / pinhole.width;
  let drawn: number[] = [];
  const tell = (...events: Parameters<typeof scheduler.step>[0]): PageAction[] => scheduler.step(events, 0);
  for (let reads = -1; reads !== 0; ) {
    reads = 0;
    tell(["looks", view, { position, focalPx, zNear: declarations.zNear, detailPx, mostGaussians: 2 ** 40 }]);
    for (const action of tell(["frame", view])) if (action.is === "draw") drawn = action.pages;
    tell(["frameEnds", view]);
    for (const action of tell(["idle"])) {
      if (action.is !== "read") continue;
      for (reads = 0; reads < action.n; ++reads) tell(["arrived", action.first + reads]);
      tell(["done"]);
    }
  }
  for (const part of parts) renderer.remove(part);
  const stored = new Map<number, StoredGaussians>();
  for (const index of drawn) stored.set(index, await file.readPageStored(index));
  const resident = new Map<number, Part>();
  const guests: Part[] = [];
  for (const index of [...drawn].reverse()) {
    const page = stored.get(index) as StoredGaussians;
    guests.push(renderer.add(page));
    resident.set(index, renderer.add(page));
    if (guests.length % 2 === 0) renderer.remove(guests[guests.length - 2] as Part);
  }
  parts = drawn.map((index) => resident.get(index) as Part);
  renderer.setParts(parts);
  return drawn.length;
}

const base64 = (bytes: Uint8Array | Uint8ClampedArray): string => btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));

type Options = RenderOptions & { coarser?: boolean };

/** RGBA of the picture, as base64; with the anti-aliasing that the file declares unless the options have another. */
async function picture(pinhole: Pinhole, width: number, height: number, { coarser = false, ...options }: Options = {}): Promise<string> {
  renderer.setView(pinhole, declarations.origin);
  return base64(await renderer.capture(width, height, { antiAliasing: antiAliasingOf(declarations, coarser), ...options }));
}

/** What render() draws in a texture of another format, as base64, and whether the frame was complete. */
async function rendered(pinhole: Pinhole, width: number, height: number, background?: number[]): Promise<[string, boolean]> {
  const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC;
  const target = device.createTexture({ size: [width, height], format: "bgra8unorm", usage });
  renderer.setView(pinhole, declarations.origin);
  const { isComplete } = await renderer.render(target, { antiAliasing: antiAliasingOf(declarations), ...(background ? { background } : {}) });
  const bytesPerRow = Math.ceil(width / 64) * 256;
  const buffer = device.createBuffer({ size: bytesPerRow * height, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
  const encoder = device.createCommandEncoder();
  encoder.copyTextureToBuffer({ texture: target }, { buffer, bytesPerRow }, [width, height]);
  device.queue.submit([encoder.finish()]);
  await buffer.mapAsync(GPUMapMode.READ);
  const rows = new Uint8Array(buffer.getMappedRange());
  const pixels = Uint8Array.from({ length: 4 * width * height }, (_, i) => {
    const [y, x, channel] = [Math.floor(i / 4 / width), Math.floor(i / 4) % width, i % 4];
    return rows[bytesPerRow * y + 4 * x + (channel === 3 ? 3 : 2 - channel)] as number;
  });
  return [base64(pixels), isComplete];
}

/** RGBA of a PNG, as base64. */
async function decode(url: string): Promise<string> {
  const blob = await (await fetch(url)).blob();
  const bitmap = await createImageBitmap(blob, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
  const context = canvas.getContext("2d") as OffscreenCanvasRenderingContext2D;
  context.drawImage(bitmap, 0, 0);
  return base64(context.getImageData(0, 0, bitmap.width, bitmap.height).data);
}

/** Runs steps over buffers of given values; returns the buffers that `of` names. */
async function compute(n: number, values: readonly Uint32Array[], build: (steps: Steps, buffers: readonly GPUBuffer[]) => readonly GPUBuffer[]): Promise<number[][]> {
  const usage = GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST | GPUBufferUsage.COPY_SRC;
  const buffer = (words: ArrayLike<number>, more = 0): GPUBuffer => {
    const made = device.createBuffer({ size: Math.max(16, 4 * words.length), usage: usage | more });
    device.queue.writeBuffer(made, 0, Uint32Array.from(words));
    return made;
  };
  const counts = Array.from({ length: kCounters }, () => n);
  const [counters, totals] = [buffer(counts), buffer(new Uint32Array(256))];
  const workgroups = buffer(Array.from({ length: kDispatchBytes / 4 }, (_, i) => (i % 3 === 0 ? Math.ceil(n / kSortItems) : 1)), GPUBufferUsage.INDIRECT);
  const steps = new Steps(kernels, { counters, totals, histogram: buffer(new Uint32Array(256 * (Math.ceil(n / kSortItems) + 1))) });
  const results = [...build(steps, values.map((each) => buffer(each))), totals];
  const encoder = device.createCommandEncoder();
  const pass = encoder.beginComputePass();
  run(pass, steps.list, workgroups);
  pass.end();
  const reads = results.map((from) => {
    const read = device.createBuffer({ size: from.size, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
    encoder.copyBufferToBuffer(from, 0, read, 0, from.size);
    return read;
  });
  device.queue.submit([encoder.finish()]);
  await Promise.all(reads.map((read) => read.mapAsync(GPUMapMode.READ)));
  return reads.map((read) => [...new Uint32Array(read.getMappedRange())]);
}

/** Exclusive sums of n values, and their total. */
async function sums(values: number[]): Promise<[number[], number]> {
  const [found, totals] = await compute(values.length, [Uint32Array.from(values)], (steps, [buffer]) => {
    steps.sums(kCounter.visible, 1, buffer as GPUBuffer);
    return [buffer as GPUBuffer];
  });
  return [(found as number[]).slice(0, values.length), (totals as number[])[0] as number];
}

/** Keys by their lower `bits`, and where they were. */
async function sort(keys: number[], bits: number): Promise<[number[], number[]]> {
  const own = Uint32Array.from(keys);
  const [sorted, places] = await compute(keys.length, [own, own, own, own], (steps, [a, b, c, d]) => {
    const [pair, order] = [[a, b], [c, d]] as unknown as [Pair, Pair];
    const at = steps.sort(kCounter.visible, kDispatch.sortVisible, bits, pair, order, true);
    return [pair[at], order[at]];
  });
  return [(sorted as number[]).slice(0, keys.length), (places as number[]).slice(0, keys.length)];
}

Object.assign(window, { splats: { start, load, loadArrays, loadTwice, loadCut, picture, rendered, decode, sums, sort, problems: () => problems } });
