// splats.ts - reads PLY, and the codes of SPZ, by ../wasm/splats.cpp: the C++ library's readers. Synchronous, for a worker.
// SPDX-License-Identifier: Apache-2.0
import type { Axis, Declarations, Gaussians, RgsErrorFields, Spz, Vector3 } from "@roofgs/reader";

/** Where x, y and z point. */
export type Axes = readonly [Axis, Axis, Axis];
export const kPlyAxes: Axes = ["right", "down", "forward"];
export const kOpenGlAxes: Axes = ["right", "up", "backward"];

/** Whether both are declared, and differ. */
export const isTurned = (a: Axes, b: Axes): boolean => ![...a, ...b].includes("undeclared") && a.some((axis, i) => axis !== b[i]);

/** The direction of up in these axes; null if they do not have it. */
export function upOf(axes: Axes): Vector3 | null {
  const i = axes.findIndex((axis) => axis === "up" || axis === "down");
  return i < 0 ? null : ([0, 1, 2].map((k) => (k === i ? (axes[i] === "up" ? 1 : -1) : 0)) as unknown as Vector3);
}

export type SpzContent = Pick<Spz, "version" | "n" | "shDegree" | "fractionalBits" | "streams">;

/** What is known of a PLY before its Gaussians are read. */
export interface PlyHead extends Pick<Declarations, "origin" | "aaMode" | "lowPassPx2"> {
  n: number;
  shDegree: number;
}

interface Exports {
  memory: WebAssembly.Memory;
  _initialize(): void;
  rgs_start(): void;
  rgs_append(n: number, expected: number): number;
  rgs_error(): void;
  rgs_numbers(): number;
  rgs_text(): number;
  rgs_n_text(): number;
  rgs_open_ply(...wanted: number[]): number;
  rgs_open_spz(version: number, n: number, shDegree: number, fractionalBits: number, ...axes: number[]): void;
  rgs_read(first: number, n: number): number;
}

const kAxisCodes = ["undeclared", "right", "left", "up", "down", "forward", "backward"] as const;
const kModes = ["undeclared", "classic", "mip_splatting"] as const;
const codesOf = (axes: Axes): number[] => axes.map((axis) => kAxisCodes.indexOf(axis));

export const kOutOfMemory: RgsErrorFields = { code: "host_out_of_memory", text: "a page's memory has 4 GiB" };

/** What the worker of read-splats.ts does, by name. */
export class Splats {
  private readonly wasm: Exports;
  private shDegree = 0;

  constructor(module: WebAssembly.Module) {
    const outOfMemory = (): never => {
      throw kOutOfMemory;
    };
    this.wasm = new WebAssembly.Instance(module, { rgs: { out_of_memory: outOfMemory } }).exports as unknown as Exports;
    this.wasm._initialize();
    this.wasm.rgs_start();
  }

  /** `expected`: bytes of the whole file, 0 if that is not known. */
  append(bytes: Uint8Array, expected: number): void {
    const at = this.wasm.rgs_append(bytes.length, expected) >>> 0;
    new Uint8Array(this.wasm.memory.buffer, at, bytes.length).set(bytes);
  }

  /** Of a PLY whose bytes were appended; throws RgsErrorFields. A declared frame is turned to `wanted`. */
  openPly(wanted: Axes): PlyHead {
    if (this.wasm.rgs_open_ply(...codesOf(wanted)) !== 0) throw this.error();
    const [n, shDegree, x, y, z, mode, lowPassPx2] = this.numbers(7) as [number, number, number, number, number, number, number];
    this.shDegree = shDegree;
    return { n, shDegree, origin: [x, y, z], aaMode: kModes[mode] as PlyHead["aaMode"], lowPassPx2 };
  }

  openSpz({ version, n, shDegree, fractionalBits, streams }: SpzContent, axes: Axes, wanted: Axes): void {
    const all = Object.values(streams);
    const bytes = all.reduce((sum, { length }) => sum + length, 0);
    for (const stream of all) this.append(stream, bytes);
    this.shDegree = shDegree;
    this.wasm.rgs_open_spz(version, n, shDegree, fractionalBits, ...codesOf(axes), ...codesOf(wanted));
  }

  /** Those of Gaussians first .. first + n - 1 that can be drawn. */
  read(first: number, n: number): Gaussians {
    const { shDegree } = this;
    const nRest = 3 * ((shDegree + 1) ** 2 - 1);
    const at = this.wasm.rgs_read(first, n) >>> 0;
    const [kept] = this.numbers(1) as [number];
    let next = at;
    const take = (each: number): Float32Array => {
      const values = new Float32Array(this.wasm.memory.buffer, next, each * kept).slice();
      next += values.byteLength;
      return values;
    };
    const [means, rotations, scales, opacities, sh0, shN] = [3, 4, 3, 1, 3, nRest].map(take) as [Float32Array, Float32Array, Float32Array, Float32Array, Float32Array, Float32Array];
    return { n: kept, shDegree, means, rotations, scales, opacities, sh0, shN };
  }

  private numbers(n: number): number[] {
    return [...new Float64Array(this.wasm.memory.buffer, this.wasm.rgs_numbers() >>> 0, n)];
  }

  private error(): RgsErrorFields {
    this.wasm.rgs_error();
    const bytes = new Uint8Array(this.wasm.memory.buffer, this.wasm.rgs_text() >>> 0, this.wasm.rgs_n_text());
    const [code, text] = new TextDecoder().decode(bytes).split("\n") as [RgsErrorFields["code"], string];
    const [offset] = this.numbers(1) as [number];
    return { code, text, offset: offset < 0 ? undefined : offset };
  }
}
