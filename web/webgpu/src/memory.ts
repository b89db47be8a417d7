// memory.ts - Gaussians in buffers, as they lie in files or as FP32 arrays: a block has means and shapes of its rows in one buffer, SH in
// another.
// SPDX-License-Identifier: Apache-2.0
import type { Gaussians, StoredGaussians } from "@roofgs/reader";
import type { Layout } from "./shaders/math.js";
import { kShWords } from "./shaders/project.js";

/** Words of `Group` in shaders/math.ts, and Gaussians of one. */
export const kGroupWords = 28;
const kGroupRows = 256;
const kLeastRows = 1 << 16;
/** Of a box that is always in view: what writes arrays seldom orders them in space. */
const kFar = 1e37;

/** An attribute, and 32-bit words of it in a row. */
type Column = readonly [values: ArrayBufferView, words: number];

/** In the order of the buffers. */
function columnsOf(part: StoredGaussians | Gaussians): { rows: readonly Column[]; sh: readonly Column[] } {
  const { means, shDegree } = part;
  if ("geometry" in part) return { rows: [[means, 3], [part.geometry, 4]], sh: [[part.sh, kShWords[shDegree] as number]] };
  const { rotations, scales, opacities, sh0, shN } = part;
  return { rows: [[means, 3], [rotations, 4], [scales, 3], [opacities, 1]], sh: [[sh0, 3], [shN, 3 * ((shDegree + 1) ** 2 - 1)]] };
}
const wordsOf = (columns: readonly Column[]): number => columns.reduce((sum, [, words]) => sum + words, 0);

/** Buffers for rows of parts; free ranges [begin, end) in order. */
export class Block {
  readonly rows: GPUBuffer;
  readonly sh: GPUBuffer;
  private free: [number, number][];

  constructor(
    device: GPUDevice,
    readonly nRows: number,
    rowWords: number,
    shWords: number,
  ) {
    const buffer = (words: number): GPUBuffer => device.createBuffer({ size: 4 * words * nRows, usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST });
    this.rows = buffer(rowWords);
    this.sh = buffer(shWords);
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

/** All parts of a renderer. They have one layout and one SH degree. */
export class Memory {
  readonly blocks: Block[] = [];
  layout: Layout = "stored";
  shDegree = -1;
  private nRows = 0;

  constructor(private readonly device: GPUDevice) {}

  /** Rows of one block at most, of so many words in one buffer. */
  private mostRows(words: number): number {
    const { maxStorageBufferBindingSize, maxBufferSize } = this.device.limits;
    return Math.floor(Math.min(maxStorageBufferBindingSize, maxBufferSize) / 4 / words / kGroupRows) * kGroupRows;
  }

  /** `nRows`: of this part and those that come next, if that is known. */
  add(part: StoredGaussians | Gaussians, nRows?: number): Part {
    const layout = "geometry" in part ? "stored" : "arrays";
    if (this.shDegree >= 0 && (this.shDegree !== part.shDegree || this.layout !== layout)) throw new RangeError("parts of different kinds or SH degrees");
    this.shDegree = part.shDegree;
    this.layout = layout;
    const { rows, sh } = columnsOf(part);
    const mostRows = this.mostRows(Math.max(wordsOf(rows), wordsOf(sh)));
    const most = mostRows - (mostRows % ("geometry" in part ? part.chunkSize : kGroupRows));
    const pieces: Piece[] = [];
    for (let begin = 0; begin < part.n; begin += most) pieces.push(this.addRows(part, begin, Math.min(most, part.n - begin), mostRows, nRows && nRows - begin));
    return { n: part.n, pieces };
  }

  remove({ pieces }: Part): void {
    for (const { block, row, n } of pieces) block.give(row, n);
  }

  destroy(): void {
    for (const block of this.blocks) block.destroy();
  }

  /** `begin` is a chunk's. */
  private addRows(part: StoredGaussians | Gaussians, begin: number, n: number, mostRows: number, nRows: number | undefined): Piece {
    const { rows, sh } = columnsOf(part);
    let row = -1;
    let block = this.blocks.find((each) => (row = each.take(n)) >= 0);
    if (!block) {
      // As many again, so that there are few blocks.
      block = new Block(this.device, Math.max(n, Math.min(mostRows, nRows ?? Math.max(kLeastRows, this.nRows))), wordsOf(rows), wordsOf(sh));
      row = block.take(n);
      this.nRows += block.nRows;
      this.blocks.push(block);
    }
    for (const [to, columns] of [[block.rows, rows], [block.sh, sh]] as const) {
      let before = 0;
      for (const [values, words] of columns) {
        this.device.queue.writeBuffer(to, 4 * (before * block.nRows + words * row), values.buffer as ArrayBuffer, values.byteOffset + 4 * words * begin, 4 * words * n);
        before += words;
      }
    }
    return { n, block, row, groups: "geometry" in part ? groupsOf(part, begin, n, row) : groupsOfArrays(n, row) };
  }
}

function groupsOfArrays(n: number, row: number): Uint32Array {
  const groups = new Uint32Array(kGroupWords * Math.ceil(n / kGroupRows));
  const floats = new Float32Array(groups.buffer);
  for (let at = 0, begin = 0; begin < n; begin += kGroupRows, at += kGroupWords) {
    groups.set([row + begin, Math.min(kGroupRows, n - begin)], at);
    floats.set([-kFar, -kFar, -kFar, 0, kFar, kFar, kFar], at + 16);
  }
  return groups;
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
