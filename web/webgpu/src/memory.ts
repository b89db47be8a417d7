// memory.ts - Gaussians in buffers, as they lie in files: a block has the means and geometry of its rows in one buffer, SH in another.
// SPDX-License-Identifier: Apache-2.0
import type { StoredGaussians } from "@roofgs/reader";
import { kShWords } from "./shaders/project.js";

/** 32-bit words of a row: mean and geometry. */
const kRowWords = 7;
/** Words of `Group` in shaders/math.ts, and Gaussians of one. */
export const kGroupWords = 28;
const kGroupRows = 256;
const kLeastRows = 1 << 16;

/** Buffers for rows of parts; free ranges [begin, end) in order. */
export class Block {
  readonly rows: GPUBuffer;
  readonly sh: GPUBuffer;
  private free: [number, number][];

  constructor(
    device: GPUDevice,
    readonly nRows: number,
    shDegree: number,
  ) {
    const buffer = (words: number): GPUBuffer => device.createBuffer({ size: 4 * words * nRows, usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST });
    this.rows = buffer(kRowWords);
    this.sh = buffer(kShWords[shDegree] as number);
    this.free = [[0, nRows]];
  }

  /** First of n rows, or -1. */
  take(n: number): number {
    const range = this.free.find(([begin, end]) => end - begin >= n);
    if (!range) return -1;
    range[0] += n;
    return range[0] - n;
  }

  give(row: number, n: number): void {
    const ranges = [...this.free, [row, row + n] as [number, number]].sort((a, b) => a[0] - b[0]);
    this.free = [];
    for (const range of ranges) {
      const last = this.free.at(-1);
      if (last && last[1] === range[0]) last[1] = range[1];
      else this.free.push(range);
    }
  }

  destroy(): void {
    this.rows.destroy();
    this.sh.destroy();
  }
}

/** Rows of one block. */
export interface Piece {
  readonly n: number;
  readonly block: Block;
  readonly row: number;
  /** Chunks, [nGroups, kGroupWords]; their order and tint are set when they are drawn. */
  readonly groups: Uint32Array;
}

/** Gaussians on the GPU. */
export interface Part {
  readonly n: number;
  /** @internal */
  readonly pieces: readonly Piece[];
}

/** All parts of a renderer. They have one SH degree. */
export class Memory {
  readonly blocks: Block[] = [];
  shDegree = -1;
  private nRows = 0;

  constructor(private readonly device: GPUDevice) {}

  /** Rows of one block at most. */
  private get mostRows(): number {
    const { maxStorageBufferBindingSize, maxBufferSize } = this.device.limits;
    const words = Math.max(kRowWords, kShWords[this.shDegree] as number);
    return Math.floor(Math.min(maxStorageBufferBindingSize, maxBufferSize) / 4 / words / kGroupRows) * kGroupRows;
  }

  add(part: StoredGaussians): Part {
    if (this.shDegree >= 0 && this.shDegree !== part.shDegree) throw new RangeError("parts of different SH degrees");
    this.shDegree = part.shDegree;
    const most = this.mostRows - (this.mostRows % part.chunkSize);
    const pieces: Piece[] = [];
    for (let begin = 0; begin < part.n; begin += most) pieces.push(this.addRows(part, begin, Math.min(most, part.n - begin)));
    return { n: part.n, pieces };
  }

  remove({ pieces }: Part): void {
    for (const { block, row, n } of pieces) block.give(row, n);
  }

  destroy(): void {
    for (const block of this.blocks) block.destroy();
  }

  /** `begin` is a chunk's. */
  private addRows(part: StoredGaussians, begin: number, n: number): Piece {
    let row = -1;
    let block = this.blocks.find((each) => (row = each.take(n)) >= 0);
    if (!block) {
      // As many again, so that there are few blocks.
      block = new Block(this.device, Math.max(n, Math.min(this.mostRows, Math.max(kLeastRows, this.nRows))), this.shDegree);
      row = block.take(n);
      this.nRows += block.nRows;
      this.blocks.push(block);
    }
    const shBytes = 4 * (kShWords[this.shDegree] as number);
    const { queue } = this.device;
    const write = (to: GPUBuffer, at: number, from: ArrayBufferView, rowBytes: number): void =>
      queue.writeBuffer(to, at, from.buffer as ArrayBuffer, from.byteOffset + rowBytes * begin, rowBytes * n);
    write(block.rows, 12 * row, part.means, 12);
    write(block.rows, 12 * block.nRows + 16 * row, part.geometry, 16);
    write(block.sh, shBytes * row, part.sh, shBytes);
    return { n, block, row, groups: groupsOf(part, begin, n, row) };
  }
}

function groupsOf(part: StoredGaussians, begin: number, n: number, row: number): Uint32Array {
  const { chunkSize } = part;
  const records: number[][] = [];
  const bits = (values: Float32Array): Uint32Array => new Uint32Array(values.buffer, values.byteOffset, values.length);
  const [bounds, steps] = [bits(part.chunkBounds), bits(part.steps)];
  const unit = bits(new Float32Array([2 ** -part.scaleExponent]))[0] as number;
  for (let at = begin; at < begin + n; ) {
    const chunk = Math.floor(at / chunkSize);
    const count = Math.min(kGroupRows, begin + n - at, (chunk + 1) * chunkSize - at);
    const set = 12 * (part.chunkSteps[chunk] as number);
    records.push([row + at - begin, count, 0, unit, ...steps.subarray(set, set + 12), ...bounds.subarray(8 * chunk, 8 * chunk + 8), 0, 0, 0, 0]);
    at += count;
  }
  return Uint32Array.from(records.flat());
}
