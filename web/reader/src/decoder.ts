// decoder.ts - decodes one file in one instance of rgs.wasm, synchronously, in a worker.
// SPDX-License-Identifier: Apache-2.0
import { allocate, outOfMemory, RgsError, type RgsErrorCode } from "./errors.js";
import { type Axis, type Box, kAxes, type Vector3 } from "./head.js";

/** Decoded Gaussians, structure of arrays. */
export interface Gaussians {
  /** Gaussians. */
  readonly n: number;
  /** 0 to 3. */
  readonly shDegree: number;
  /** [n, 3] centres relative to Declarations.origin, world units. */
  readonly means: Float32Array;
  /** [n, 4] unit quaternions w, x, y, z. */
  readonly rotations: Float32Array;
  /** [n, 3] standard deviations along the local axes, world units. */
  readonly scales: Float32Array;
  /** [n] 0 to 1. */
  readonly opacities: Float32Array;
  /** [n, 3] SH of degree 0. */
  readonly sh0: Float32Array;
  /** [n, (shDegree + 1)^2 - 1, 3] the other SH. */
  readonly shN: Float32Array;
}

/** Gaussians as a GPU reads them: docs/format/FORMAT.md, "Attributes". */
export interface StoredGaussians {
  /** Gaussians. */
  readonly n: number;
  /** 0 to 3. */
  readonly shDegree: number;
  /** Stored scale = scale * 2^scaleExponent. */
  readonly scaleExponent: number;
  /** [n, 3] FP32. */
  readonly means: Float32Array;
  /** [n, 8] FP16 w, x, y, z, scales x, y, z, opacity. */
  readonly geometry: Uint16Array;
  /** [n, shBytes] codes; value = step * code. shBytes: 4, 12, 28, 48 by degree. */
  readonly sh: Int8Array;
  /** Gaussian i belongs to chunk floor(i / chunkSize). */
  readonly chunkSize: number;
  /** [nChunks, 8] box of the means, radius, largest opacity: min x, y, z, radius, max x, y, z, opacity. */
  readonly chunkBounds: Float32Array;
  /** [nChunks] index of the chunk's step set. */
  readonly chunkSteps: Uint32Array;
  /** [nStepSets, 4, 3] by degree and channel. */
  readonly steps: Float32Array;
}

/** Limits for untrusted files; beyond them the error is limit_exceeded. */
export interface Limits {
  maxFileBytes?: number;
  maxGaussians?: number;
  /** Decoded bytes of all coded sections. */
  maxDecodedBytes?: number;
}

/** The header of a .spz. */
export interface SpzHeader {
  version: number;
  n: number;
  shDegree: number;
  /** Steps of positions are 2^-fractionalBits. */
  fractionalBits: number;
  antialiased: boolean;
  /** Null if the file declares none. */
  axes: readonly [Axis, Axis, Axis] | null;
}

export interface Range {
  offset: number;
  bytes: number;
}

/** What every use of the module calls. @internal */
export interface Heap {
  memory: WebAssembly.Memory;
  _initialize(): void;
  rgs_start(): void;
  rgs_allocate(bytes: number): number;
  rgs_free(address: number): void;
}

interface Exports extends Heap {
  rgs_error(): void;
  rgs_numbers(): number;
  rgs_n_numbers(): number;
  rgs_text(): number;
  rgs_n_text(): number;
  rgs_rows(): number;
  rgs_file_new(maxFileBytes: number, maxGaussians: number, maxDecodedBytes: number): number;
  rgs_add_part(file: number, offset: number, address: number, bytes: number): void;
  rgs_needs(file: number, fileBytes: number): number;
  rgs_open_parts(file: number, fileBytes: number): number;
  rgs_unread_table(file: number, below: number, most: number): void;
  rgs_extend(file: number, below: number, offset: number, address: number, bytes: number): number;
  rgs_head(file: number): void;
  rgs_levels(file: number): void;
  rgs_read_page(file: number, page: number, address: number, bytes: number, asStored: number): number;
  rgs_open_whole(file: number, address: number, bytes: number): number;
  rgs_next(file: number, asStored: number): number;
  rgs_tables(file: number): void;
  rgs_open_early(file: number, address: number, bytes: number): number;
  rgs_next_early(file: number, nChunks: number): number;
  rgs_finish_early(file: number): number;
  rgs_subject_box(file: number): void;
  rgs_subject_box_of(means: number, opacities: number, n: number): void;
  rgs_source_index(file: number): number;
  rgs_spz_most(beginning: number, fileBytes: number): number;
  rgs_spz(address: number, bytes: number, fileBytes: number, inGzip: number): number;
  rgs_decompress(frames: number, size: number, content: number, contentSize: number): number;
}

// Fields of Rows in wasm/reader.cpp.
const enum Row {
  n,
  means,
  rotations,
  scales,
  opacities,
  sh0,
  shRest,
  storedMeans,
  storedGeometry,
  storedSh,
  chunks,
  steps,
  nChunks,
  nStepSets,
}

/** The groups of chunks in which a file is decoded while it is read. */
export interface Groups {
  /** Chunks in a group; fewer in the last one. */
  readonly nChunks: number;
  /** The ranges of each group in MEAN, GEOM and SHI8. */
  readonly ranges: readonly (readonly Range[])[];
}

const kNone = 0xffffffffffffffffn;
const kMostMemory = 2 ** 32 - 2 ** 20;

const shBytes = (degree: number): number => [4, 12, 28, 48][degree] as number;
const shFloats = (degree: number): number => 3 * (degree + 1) ** 2;

function emptyGaussians(n: number, shDegree: number): Gaussians {
  return allocate(() => ({
    n,
    shDegree,
    means: new Float32Array(3 * n),
    rotations: new Float32Array(4 * n),
    scales: new Float32Array(3 * n),
    opacities: new Float32Array(n),
    sh0: new Float32Array(3 * n),
    shN: new Float32Array((shFloats(shDegree) - 3) * n),
  }));
}

export function buffersOf(values: object): ArrayBuffer[] {
  if (ArrayBuffer.isView(values)) return [values.buffer as ArrayBuffer];
  return Object.values(values).flatMap((value) => (ArrayBuffer.isView(value) ? [value.buffer as ArrayBuffer] : []));
}

export class Decoder {
  private readonly wasm: Exports;
  private readonly file: number;
  private broken: unknown;

  constructor(module: WebAssembly.Module, limits: Limits) {
    const unwind = (): never => {
      throw outOfMemory();
    };
    const instance = new WebAssembly.Instance(module, { rgs: { out_of_memory: unwind } });
    this.wasm = instance.exports as unknown as Exports;
    this.file = this.run(() => {
      this.wasm._initialize();
      this.wasm.rgs_start();
      return this.wasm.rgs_file_new(
        limits.maxFileBytes ?? 2 ** 40,
        limits.maxGaussians ?? 2 ** 33,
        limits.maxDecodedBytes ?? 2 ** 40,
      );
    });
  }

  addPart(offset: number, bytes: Uint8Array): void {
    this.run(() => this.wasm.rgs_add_part(this.file, offset, this.put(bytes), bytes.length));
  }

  /** Bytes that the gzip stream of an .spz may hold, by its first 16. */
  spzMost(beginning: Uint8Array, fileBytes: number): number {
    this.with(beginning, (at) => this.wasm.rgs_spz_most(at, fileBytes));
    return this.numbers()[0] as number;
  }

  /** Of a whole .spz of version 4, or of what its gzip stream holds; where its streams are, and their decoded size. */
  spz(content: Uint8Array, fileBytes: number, inGzip: boolean): [SpzHeader, (Range & { size: number })[]] {
    this.with(content, (at) => this.wasm.rgs_spz(at, content.length, fileBytes, Number(inGzip)));
    const [version, n, shDegree, fractionalBits, antialiased, ...rest] = this.numbers() as unknown as number[];
    const axes = rest.splice(0, 3).map((code) => kAxes[code]);
    const header = { version, n, shDegree, fractionalBits, antialiased: antialiased === 1, axes: axes[0] === "undeclared" ? null : axes } as SpzHeader;
    const places = [];
    while (rest.length > 0) {
      const [offset, bytes, size] = rest.splice(0, 3) as [number, number, number];
      places.push({ offset, bytes, size });
    }
    return [header, places];
  }

  /** The content of Zstandard frames; null if it is not `size` bytes. */
  decompress(frames: Uint8Array, size: number): Uint8Array | null {
    return this.run(() => {
      const from = this.put(frames);
      const to = this.allocate(size);
      const content = this.wasm.rgs_decompress(from, frames.length, to, size) === 0 ? new Uint8Array(this.wasm.memory.buffer, to, size).slice() : null;
      this.wasm.rgs_free(from);
      this.wasm.rgs_free(to);
      return content;
    });
  }

  /** The ranges that openParts() still needs. */
  needs(fileBytes: number): Range[] {
    const n = this.check(() => this.wasm.rgs_needs(this.file, fileBytes));
    const values = this.numbers();
    return Array.from({ length: n }, (_, i) => ({ offset: values[2 * i] as number, bytes: values[2 * i + 1] as number }));
  }

  /** Whether the file has levels of detail. */
  openParts(fileBytes: number): boolean {
    return this.check(() => this.wasm.rgs_open_parts(this.file, fileBytes)) === 1;
  }

  /** What of the page table extend() needs next, below a known page. */
  unreadTable(below: number, most: number): Range {
    this.run(() => this.wasm.rgs_unread_table(this.file, below, most));
    const values = this.numbers();
    return { offset: values[0] as number, bytes: values[1] as number };
  }

  /** For Levels. */
  extend(below: number, offset: number, bytes: Uint8Array): Float64Array {
    this.with(bytes, (at) => this.wasm.rgs_extend(this.file, below, offset, at, bytes.length));
    return this.numbers();
  }

  /** For parseHead(). */
  head(): { values: Float64Array; text: Uint8Array } {
    this.run(() => this.wasm.rgs_head(this.file));
    return { values: this.numbers(), text: this.text() };
  }

  /** For Levels. */
  levels(): Float64Array {
    this.run(() => this.wasm.rgs_levels(this.file));
    return this.numbers();
  }

  readPage(page: number, stored: Uint8Array, shDegree: number): Gaussians {
    this.decodePage(page, stored, false);
    const row = this.rows();
    const out = emptyGaussians(row(Row.n), shDegree);
    this.copyGaussians(out, 0);
    return out;
  }

  readPageStored(
    page: number,
    stored: Uint8Array,
    shape: { shDegree: number; chunkSize: number; scaleExponent: number },
  ): StoredGaussians {
    this.decodePage(page, stored, true);
    const n = this.rows()(Row.n);
    const out = {
      n,
      ...shape,
      means: new Float32Array(3 * n),
      geometry: new Uint16Array(8 * n),
      sh: new Int8Array(shBytes(shape.shDegree) * n),
    };
    this.copyStored(out, 0);
    return { ...out, ...this.tables() };
  }

  /** Memory for a whole file, to be filled with putWhole() before openWhole(). */
  allocateWhole(bytes: number): number {
    return this.run(() => this.allocate(bytes));
  }

  putWhole(address: number, offset: number, bytes: Uint8Array): void {
    new Uint8Array(this.wasm.memory.buffer, address + offset, bytes.length).set(bytes);
  }

  openWhole(address: number, bytes: number): void {
    this.check(() => this.wasm.rgs_open_whole(this.file, address, bytes));
  }

  /**
   * All Gaussians of the finest level of the whole file. Yields the share that is done. The file is checked as a whole at the end, so
   * run the iterator to its end.
   */
  *gaussians(n: number, shDegree: number): Generator<number, Gaussians> {
    const out = emptyGaussians(n, shDegree);
    let done = 0;
    for (;;) {
      this.check(() => this.wasm.rgs_next(this.file, 0));
      const count = this.rows()(Row.n);
      if (count === 0) return out;
      this.copyGaussians(out, done);
      done += count;
      yield done / n;
    }
  }

  /** The same as stored, for files without levels of detail. */
  *storedGaussians(
    n: number,
    shape: { shDegree: number; chunkSize: number; scaleExponent: number },
  ): Generator<number, StoredGaussians> {
    const out = allocate(() => ({
      n,
      ...shape,
      means: new Float32Array(3 * n),
      geometry: new Uint16Array(8 * n),
      sh: new Int8Array(shBytes(shape.shDegree) * n),
    }));
    let done = 0;
    for (;;) {
      this.check(() => this.wasm.rgs_next(this.file, 1));
      const count = this.rows()(Row.n);
      if (count === 0) break;
      this.copyStored(out, done);
      done += count;
      yield done / n;
    }
    this.run(() => this.wasm.rgs_tables(this.file));
    return { ...out, ...this.tables() };
  }

  /** For a file without levels whose large sections are still being read; reader.cpp says what must be present. */
  openEarly(address: number, bytes: number): Groups {
    this.check(() => this.wasm.rgs_open_early(this.file, address, bytes));
    const [nChunks, ...values] = this.numbers();
    const range = (i: number): Range => ({ offset: values[2 * i] as number, bytes: values[2 * i + 1] as number });
    const ranges = Array.from({ length: values.length / 6 }, (_, i) => [range(3 * i), range(3 * i + 1), range(3 * i + 2)]);
    return { nChunks: nChunks as number, ranges };
  }

  /** Decodes the next chunks of such a file, from `firstChunk` on; their bytes must be present. */
  nextEarly(firstChunk: number, nChunks: number, shape: { shDegree: number; chunkSize: number; scaleExponent: number }): StoredGaussians {
    this.check(() => this.wasm.rgs_next_early(this.file, nChunks));
    const n = this.rows()(Row.n);
    const out = allocate(() => ({
      n,
      ...shape,
      means: new Float32Array(3 * n),
      geometry: new Uint16Array(8 * n),
      sh: new Int8Array(shBytes(shape.shDegree) * n),
    }));
    this.copyStored(out, 0);
    return { ...out, ...this.tables(firstChunk, Math.ceil(n / shape.chunkSize)) };
  }

  /** Checks such a file as a whole, after all its chunks. */
  finishEarly(): void {
    this.check(() => this.wasm.rgs_finish_early(this.file));
  }

  /** Of a file with levels of detail, of one that is read early, or of a whole one. */
  subjectBox(): Box {
    this.run(() => this.wasm.rgs_subject_box(this.file));
    return this.box();
  }

  subjectBoxOf(means: Float32Array, opacities: Float32Array): Box {
    this.run(() => {
      const [at, weights] = [means, opacities].map((array) => this.put(new Uint8Array(array.buffer, array.byteOffset, array.byteLength))) as [number, number];
      this.wasm.rgs_subject_box_of(at, weights, opacities.length);
      for (const address of [at, weights]) this.wasm.rgs_free(address);
    });
    return this.box();
  }

  private box(): Box {
    const [a, b, c, d, e, f] = this.numbers() as unknown as [...Vector3, ...Vector3];
    return { min: [a, b, c], max: [d, e, f] };
  }

  /** Positions in the source, null if the file keeps none. */
  sourceIndex(): Float64Array | null {
    return this.run(() => this.wasm.rgs_source_index(this.file)) === 1 ? this.numbers() : null;
  }

  private decodePage(page: number, stored: Uint8Array, asStored: boolean): void {
    this.with(stored, (at) => this.wasm.rgs_read_page(this.file, page, at, stored.length, Number(asStored)));
  }

  /** Copies the rows that were decoded last to `out`, from row `at` on. */
  private copyGaussians(out: Gaussians, at: number): void {
    const row = this.rows();
    const n = row(Row.n);
    const copy = (field: Row, to: Float32Array, columns: number): void => {
      if (columns > 0) to.set(new Float32Array(this.wasm.memory.buffer, row(field), n * columns), at * columns);
    };
    copy(Row.means, out.means, 3);
    copy(Row.rotations, out.rotations, 4);
    copy(Row.scales, out.scales, 3);
    copy(Row.opacities, out.opacities, 1);
    copy(Row.sh0, out.sh0, 3);
    copy(Row.shRest, out.shN, shFloats(out.shDegree) - 3);
  }

  private copyStored(out: Pick<StoredGaussians, "means" | "geometry" | "sh" | "shDegree">, at: number): void {
    const row = this.rows();
    const n = row(Row.n);
    const buffer = this.wasm.memory.buffer;
    // As bytes, because arrays in the file are aligned to 4 bytes only.
    const copy = (field: Row, to: Float32Array | Uint16Array | Int8Array, rowBytes: number): void => {
      new Uint8Array(to.buffer).set(new Uint8Array(buffer, row(field), n * rowBytes), at * rowBytes);
    };
    copy(Row.storedMeans, out.means, 12);
    copy(Row.storedGeometry, out.geometry, 16);
    copy(Row.storedSh, out.sh, shBytes(out.shDegree));
  }

  /** Tables of `nChunks` chunks from `first` on, with their step sets; of all by default. */
  private tables(first = 0, nChunks = this.rows()(Row.nChunks)): Pick<StoredGaussians, "chunkBounds" | "chunkSteps" | "steps"> {
    const row = this.rows();
    const buffer = this.wasm.memory.buffer;
    const entries = new DataView(buffer, row(Row.chunks) + 48 * first, 48 * nChunks);
    const chunkBounds = new Float32Array(8 * nChunks);
    const chunkSteps = new Uint32Array(nChunks);
    let [least, most] = nChunks === row(Row.nChunks) ? [0, row(Row.nStepSets) - 1] : [Infinity, -1];
    for (let i = 0; i < nChunks; ++i) {
      for (let k = 0; k < 8; ++k) chunkBounds[8 * i + k] = entries.getFloat32(48 * i + 4 * k, true);
      const set = entries.getUint32(48 * i + 32, true);
      chunkSteps[i] = set;
      least = Math.min(least, set);
      most = Math.max(most, set);
    }
    if (most < least) least = 0;
    for (let i = 0; i < nChunks; ++i) (chunkSteps[i] as number) -= least;
    const steps = new Float32Array(12 * (most + 1 - least));
    new Uint8Array(steps.buffer).set(new Uint8Array(buffer, row(Row.steps) + 48 * least, 4 * steps.length));
    return { chunkBounds, chunkSteps, steps };
  }

  private allocate(bytes: number): number {
    const address = bytes > kMostMemory ? 0 : this.wasm.rgs_allocate(bytes) >>> 0;
    if (address === 0) throw outOfMemory();
    return address;
  }

  private put(bytes: Uint8Array): number {
    const address = this.allocate(bytes.length);
    new Uint8Array(this.wasm.memory.buffer, address, bytes.length).set(bytes);
    return address;
  }

  /** Calls what may fail with bytes in this module's memory. */
  private with(bytes: Uint8Array, f: (address: number) => number): void {
    this.check(() => {
      const address = this.put(bytes);
      const status = f(address);
      this.wasm.rgs_free(address);
      return status;
    });
  }

  private numbers(): Float64Array {
    return new Float64Array(this.wasm.memory.buffer, this.wasm.rgs_numbers() >>> 0, this.wasm.rgs_n_numbers()).slice();
  }

  private text(): Uint8Array {
    return new Uint8Array(this.wasm.memory.buffer, this.wasm.rgs_text() >>> 0, this.wasm.rgs_n_text()).slice();
  }

  private rows(): (field: Row) => number {
    const fields = new Uint32Array(this.wasm.memory.buffer, this.wasm.rgs_rows() >>> 0, Row.nStepSets + 1);
    return (field) => fields[field] as number;
  }

  /** Throws the library's error if `f` returns a negative number. */
  private check(f: () => number): number {
    const result = this.run(f);
    if (result >= 0) return result;
    this.wasm.rgs_error();
    const [code, text] = new TextDecoder().decode(this.text()).split("\n") as [RgsErrorCode, string];
    const values = this.numbers();
    const number = (i: number): bigint | undefined => {
      const value = (BigInt(values[2 * i] as number) << 32n) | BigInt(values[2 * i + 1] as number);
      return value === kNone ? undefined : value;
    };
    const offset = number(0);
    throw new RgsError({
      code,
      text,
      offset: offset === undefined ? undefined : Number(offset),
      expected: number(1),
      found: number(2),
    });
  }

  /** After a trap, or out of memory, the instance cannot be used any more. */
  private run<T>(f: () => T): T {
    if (this.broken !== undefined) throw this.broken;
    try {
      return f();
    } catch (error) {
      this.broken =
        error instanceof RgsError
          ? error
          : new RgsError({ code: "internal", text: `the decoder failed: ${String(error)}` }, { cause: error });
      throw this.broken;
    }
  }
}
