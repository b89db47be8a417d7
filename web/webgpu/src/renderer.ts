// renderer.ts - draws parts of files by compute kernels: project, sort by depth, list by tile, blend. docs/develop/WEBGPU.md.
// SPDX-License-Identifier: Apache-2.0
import type { Gaussians, Pinhole, StoredGaussians } from "@roofgs/reader";
import { type Block, kGroupWords, Memory, type Part } from "./memory.js";
import { kCounter, kCounters, kDispatch, kSortItems } from "./shaders/scan.js";
import { bind, kDispatchBytes, Kernels, run, type Step, Steps } from "./steps.js";
import { kViewBytes, type RenderOptions, tileGrid, viewBytes } from "./view.js";

/** Red, green, blue, 0 to 1. */
export type Colour = readonly [number, number, number];

/** What a frame needed. */
export interface Frame {
  /** Gaussians in view. */
  readonly nVisible: number;
  /** (tile, Gaussian) pairs. */
  readonly nEntries: number;
  /** False: there was no room, the picture is still that of the frame before, and the next frame has room. */
  readonly isComplete: boolean;
}

/** First room: splats, entries. */
const kLeastRoom = [1 << 16, 1 << 18] as const;
const kSplatBytes = 48;
/** Of a tint in a colour, as @roofgs/playcanvas has it. */
const kTintShare = 0.6;
/** Workgroups along x where there may be more than a dispatch takes along one axis; group_index() in shaders/math.ts. */
const kGridColumns = 1 << 15;
/** Constants of the browser's, which other runtimes set after this module is loaded. */
const storage = (): number => GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST | GPUBufferUsage.COPY_SRC;

/** A device with as large buffers as the adapter has. */
export function requestDevice(adapter: GPUAdapter): Promise<GPUDevice> {
  const { maxStorageBufferBindingSize, maxBufferSize } = adapter.limits;
  return adapter.requestDevice({
    requiredLimits: { maxStorageBufferBindingSize, maxBufferSize },
    requiredFeatures: adapter.features.has("timestamp-query") ? ["timestamp-query"] : [],
  });
}

const isSame = (a: readonly unknown[], b: readonly unknown[]): boolean => a.length === b.length && a.every((each, i) => each === b[i]);

export class SplatRenderer {
  private readonly memory: Memory;
  private readonly view: GPUBuffer;
  private readonly capacity: GPUBuffer;
  private readonly counters: GPUBuffer;
  private readonly workgroups: GPUBuffer;
  /** By name; made anew where a frame needs more room. */
  private readonly buffers = new Map<string, GPUBuffer>();
  private readonly idle: GPUBuffer[] = [];
  private parts: readonly Part[] = [];
  private tints: readonly Colour[] = [];
  private nGroups = 0;
  private readonly ranges = new Map<Block, { first: number; n: number; uniform: GPUBuffer }>();
  private camera: { pinhole: Pinhole; origin: readonly number[] } | undefined;
  private picture: GPUTexture | undefined;
  private steps: readonly Step[] | undefined;
  private isDestroyed = false;

  private constructor(
    readonly device: GPUDevice,
    private readonly kernels: Kernels,
    private room: readonly [number, number],
  ) {
    this.memory = new Memory(device);
    this.view = device.createBuffer({ size: kViewBytes, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
    this.capacity = device.createBuffer({ size: 8, usage: storage() });
    this.counters = device.createBuffer({ size: 4 * kCounters, usage: storage() });
    this.workgroups = device.createBuffer({ size: kDispatchBytes, usage: GPUBufferUsage.STORAGE | GPUBufferUsage.INDIRECT });
  }

  /** The device is the caller's. It may have default limits: then a picture shows at most 2.7 million Gaussians at a time. */
  static async create(device: GPUDevice, room: readonly [number, number] = kLeastRoom): Promise<SplatRenderer> {
    return new SplatRenderer(device, await Kernels.create(device), room);
  }

  /** A renderer of other Gaussians by the same device, at once. */
  another(): SplatRenderer {
    return new SplatRenderer(this.device, this.kernels, kLeastRoom);
  }

  /**
   * Copies Gaussians to the device, all of one SH degree: of readStored(), storedParts() or readPageStored(), or all FP32 arrays, of
   * read() or from elsewhere, whose rotations need not be normalised. `nRows`: Gaussians of this part and those that are added next, if
   * that is known: buffers are no larger then.
   */
  add(part: StoredGaussians | Gaussians, nRows?: number): Part {
    return this.memory.add(part, nRows);
  }

  /** It may be drawn no more. */
  remove(part: Part): void {
    this.memory.remove(part);
  }

  /** What the next frames draw. Gaussians of equal depth are drawn in this order. `tints`: of parts, or none. */
  setParts(parts: readonly Part[], tints: readonly Colour[] = []): void {
    if (isSame(parts, this.parts) && isSame(tints, this.tints)) return;
    this.parts = [...parts];
    this.tints = tints;
    const byBlock = new Map<Block, { groups: Uint32Array; order: number; tint: Colour | undefined }[]>();
    this.nGroups = 0;
    for (const [i, { pieces }] of parts.entries()) {
      for (const { block, groups } of pieces) {
        const list = byBlock.get(block) ?? [];
        list.push({ groups, order: this.nGroups, tint: tints[i] });
        byBlock.set(block, list);
        this.nGroups += groups.length / kGroupWords;
      }
    }
    const groups = new Uint32Array(kGroupWords * this.nGroups);
    const floats = new Float32Array(groups.buffer);
    let at = 0;
    for (const { uniform } of this.ranges.values()) uniform.destroy();
    this.ranges.clear();
    for (const [block, list] of byBlock) {
      const first = at / kGroupWords;
      for (const { groups: own, order, tint } of list) {
        groups.set(own, at);
        for (let i = 0; i < own.length / kGroupWords; ++i, at += kGroupWords) {
          groups[at + 2] = order + i;
          if (tint) floats.set([...tint, kTintShare], at + 24);
        }
      }
      const uniform = this.device.createBuffer({ size: 16, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
      const n = at / kGroupWords - first;
      this.device.queue.writeBuffer(uniform, 0, Uint32Array.of(first, n, block.nRows, 0));
      this.ranges.set(block, { first, n, uniform });
    }
    this.reserve("groups", groups.byteLength);
    this.device.queue.writeBuffer(this.buffers.get("groups") as GPUBuffer, 0, groups);
    this.steps = undefined;
  }

  /** `origin`: Declarations.origin, to which parts are relative. */
  setView(pinhole: Pinhole, origin: readonly number[] = [0, 0, 0]): void {
    this.camera = { pinhole, origin };
  }

  /**
   * Draws into a texture with the usage RENDER_ATTACHMENT, in its size: the pinhole's horizontal field of view. All that is submitted,
   * is so when it returns; the promise tells later whether the frame was complete. Rejects with a RangeError if the device cannot hold
   * what the picture needs.
   */
  render(target: GPUTexture, options: RenderOptions = {}, timestampWrites?: GPUComputePassTimestampWrites): Promise<Frame> {
    const { width, height, format } = target;
    const encoder = this.device.createCommandEncoder();
    const picture = this.encode(encoder, width, height, options, timestampWrites);
    const pipeline = this.kernels.show(format);
    const { firstColumn = 0 } = options;
    const loadOp = options.firstColumn === undefined ? "clear" : "load";
    const pass = encoder.beginRenderPass({ colorAttachments: [{ view: target.createView(), loadOp, storeOp: "store" }] });
    pass.setScissorRect(firstColumn, 0, width - firstColumn, height);
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, bind(this.device, pipeline, [picture.createView()]));
    pass.draw(3);
    pass.end();
    return this.submit(encoder);
  }

  /** A complete picture, RGBA row by row: colours over the background, and 1 - T. */
  async capture(width: number, height: number, options: RenderOptions = {}): Promise<Uint8Array<ArrayBuffer>> {
    const bytesPerRow = Math.ceil((4 * width) / 256) * 256;
    const buffer = this.device.createBuffer({ size: bytesPerRow * height, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
    try {
      let frame: Frame;
      do {
        const encoder = this.device.createCommandEncoder();
        const texture = this.encode(encoder, width, height, options);
        encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow }, [width, height]);
        frame = await this.submit(encoder);
      } while (!frame.isComplete);
      await buffer.mapAsync(GPUMapMode.READ);
      const rows = new Uint8Array(buffer.getMappedRange());
      const pixels = new Uint8Array(4 * width * height);
      for (let y = 0; y < height; ++y) pixels.set(rows.subarray(bytesPerRow * y, bytesPerRow * y + 4 * width), 4 * width * y);
      return pixels;
    } finally {
      buffer.destroy();
    }
  }

  destroy(): void {
    this.isDestroyed = true;
    this.memory.destroy();
    this.picture?.destroy();
    const own = [this.view, this.capacity, this.counters, this.workgroups, ...this.buffers.values(), ...this.idle];
    for (const buffer of own) buffer.destroy();
    for (const { uniform } of this.ranges.values()) uniform.destroy();
  }

  private encode(encoder: GPUCommandEncoder, width: number, height: number, options: RenderOptions, timestampWrites?: GPUComputePassTimestampWrites): GPUTexture {
    if (this.isDestroyed) throw new Error("the renderer is destroyed");
    if (!this.camera) throw new Error("no view is set");
    const { queue } = this.device;
    if (this.picture?.width !== width || this.picture.height !== height) {
      this.picture?.destroy();
      const usage = GPUTextureUsage.STORAGE_BINDING | GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_SRC | GPUTextureUsage.RENDER_ATTACHMENT;
      this.picture = this.device.createTexture({ size: [width, height], format: "rgba8unorm", usage });
      // Shown if there is no room for the first frame.
      const [r, g, b] = options.background ?? [0, 0, 0];
      const clearValue = [r, g, b, 0] as number[];
      encoder.beginRenderPass({ colorAttachments: [{ view: this.picture.createView(), loadOp: "clear", storeOp: "store", clearValue }] }).end();
      this.steps = undefined;
    }
    this.steps ??= this.plan(this.picture);
    queue.writeBuffer(this.view, 0, viewBytes(this.camera.pinhole, this.camera.origin, width, height, options, this.room));
    queue.writeBuffer(this.capacity, 0, Uint32Array.from(this.room));
    queue.writeBuffer(this.counters, 4 * kCounter.groups, Uint32Array.of(this.nGroups));
    const pass = encoder.beginComputePass(timestampWrites ? { timestampWrites } : undefined);
    run(pass, this.steps, this.workgroups);
    pass.end();
    return this.picture;
  }

  private async submit(encoder: GPUCommandEncoder): Promise<Frame> {
    const { room } = this;
    const read = this.idle.pop() ?? this.device.createBuffer({ size: 4 * kCounters, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
    encoder.copyBufferToBuffer(this.counters, 0, read, 0, 4 * kCounters);
    this.device.queue.submit([encoder.finish()]);
    await read.mapAsync(GPUMapMode.READ);
    const numbers = new Uint32Array(read.getMappedRange().slice(0));
    read.unmap();
    this.idle.push(read);
    const [nVisible, nEntries] = [numbers[kCounter.visible] as number, numbers[kCounter.entries] as number];
    const isComplete = numbers[kCounter.overflow] === 0;
    // Another frame may have made room already.
    if (!isComplete && room === this.room) this.makeRoom(nVisible, nEntries);
    return { nVisible, nEntries, isComplete };
  }

  /** For half as many again as a frame needed. Where splats had no room there are no entries. */
  private makeRoom(nVisible: number, nEntries: number): void {
    const { maxStorageBufferBindingSize, maxBufferSize } = this.device.limits;
    const bytes = Math.min(maxStorageBufferBindingSize, maxBufferSize);
    const roomFor = (n: number, room: number, most: number, what: string): number => {
      if (n > most) throw new RangeError(`the picture needs ${n} ${what}, and the device's buffers hold ${most}: draw a coarser detail, or a smaller picture`);
      return n > room ? Math.min(most, Math.ceil(1.5 * n)) : room;
    };
    const [splats, entries] = this.room;
    const mostSplats = Math.min(0xffff * 256, Math.floor(bytes / kSplatBytes));
    const mostEntries = Math.min(0xffff * kSortItems, Math.floor(bytes / 4));
    this.room = [roomFor(nVisible, splats, mostSplats, "Gaussians"), roomFor(nEntries, entries, mostEntries, "pairs of a tile and a Gaussian")];
    this.steps = undefined;
  }

  /** A buffer of at least so many bytes; its contents are lost where it grows. */
  private reserve(name: string, bytes: number): GPUBuffer {
    const old = this.buffers.get(name);
    if (old && old.size >= bytes) return old;
    old?.destroy();
    const buffer = this.device.createBuffer({ label: name, size: Math.max(16, Math.ceil(bytes / 4) * 4), usage: storage() });
    this.buffers.set(name, buffer);
    return buffer;
  }

  /** The kernels of a frame, in order. */
  private plan(picture: GPUTexture): readonly Step[] {
    const { kernels: k, view, counters, workgroups } = this;
    const [nSplats, nEntries] = this.room;
    const [columns, rows] = tileGrid(picture.width, picture.height);
    const nTiles = columns * rows;
    const sortWorkgroups = Math.ceil(Math.max(nSplats, nEntries) / kSortItems);
    const splats = this.reserve("splats", kSplatBytes * nSplats);
    const pair = (name: string, n: number): [GPUBuffer, GPUBuffer] => [this.reserve(`${name} a`, 4 * n), this.reserve(`${name} b`, 4 * n)];
    const [depths, order] = [pair("depths", nSplats), pair("order", nSplats)];
    const [tiles, entries] = [pair("tiles", nEntries), pair("entries", nEntries)];
    const tileCounts = this.reserve("tile counts", 4 * nSplats);
    const counts = this.reserve("counts", 4 * Math.max(this.nGroups, Math.ceil(nSplats / 256)));
    const flags = this.reserve("flags", 32 * this.nGroups);
    const groups = this.reserve("groups", 0);
    const histogram = this.reserve("histogram", 4 * 256 * sortWorkgroups);
    const totals = this.reserve("totals", 4 * 256);
    // Of the exact size, which its kernel asks for.
    this.buffers.get("ranges")?.destroy();
    this.buffers.delete("ranges");
    const ranges = this.reserve("ranges", Math.max(16, 4 * (nTiles + 1)));

    const steps = new Steps(k, { counters, totals, histogram });
    const grid = (n: number): number[] => [Math.min(n, kGridColumns), Math.ceil(n / kGridColumns)];
    const { layout, shDegree } = this.memory;
    for (const [block, { n, uniform }] of this.ranges) steps.add(k.cull(layout), grid(n), view, uniform, block.rows, groups, counts, flags);
    steps.sums(kCounter.groups, 1, counts);
    steps.add(k.planVisible, [1], this.capacity, totals, counters, workgroups);
    for (const [block, { n, uniform }] of this.ranges) {
      steps.add(k.project(layout, shDegree), grid(n), view, uniform, block.rows, groups, counts, flags, block.sh, splats, depths[0], tileCounts);
    }
    // Positive floats have 31 bits.
    const inOrder = order[steps.sort(kCounter.drawnVisible, kDispatch.sortVisible, 31, depths, order, true)];
    steps.add(k.count, kDispatch.visible, counters, inOrder, tileCounts, counts);
    steps.sums(kCounter.drawnVisible, 256, counts);
    steps.add(k.planEntries, [1], this.capacity, totals, counters, workgroups);
    steps.add(k.emit, kDispatch.visible, view, counters, inOrder, tileCounts, counts, splats, tiles[0], entries[0]);
    const listed = steps.sort(kCounter.drawnEntries, kDispatch.sortEntries, 32 - Math.clz32(nTiles), tiles, entries, false);
    steps.add(k.ranges, [Math.ceil(ranges.size / 4 / 256)], counters, tiles[listed], ranges);
    steps.add(k.blend, [columns, rows], view, counters, ranges, entries[listed], splats, picture.createView());
    return steps.list;
  }
}
