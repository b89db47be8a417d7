// chooser.ts - choose_first_view() of the C++ library, by ../wasm/first_view.cpp. Synchronous, for a worker.
// SPDX-License-Identifier: Apache-2.0
import type { FirstView, Gaussians, StoredGaussians, Vector3 } from "@roofgs/reader";

/** What a view of Gaussians depends on, as either of the two has it. */
export type Seen = Pick<Gaussians, "means" | "rotations" | "scales" | "opacities"> | Pick<StoredGaussians, "means" | "geometry" | "scaleExponent">;

interface Exports {
  memory: WebAssembly.Memory;
  _initialize(): void;
  rgs_start(): void;
  rgs_allocate(bytes: number): number;
  rgs_free(address: number): void;
  rgs_sample(means: number, scales: number, rotations: number, opacities: number, n: number): void;
  rgs_sample_stored(means: number, geometry: number, scaleExponent: number, n: number): void;
  rgs_first_view(x: number, y: number, z: number): number;
}

const kKinds = [null, "outside", "inside"] as const;

export class Chooser {
  private readonly wasm: Exports;

  constructor(module: WebAssembly.Module) {
    this.wasm = new WebAssembly.Instance(module).exports as unknown as Exports;
    this.wasm._initialize();
    this.wasm.rgs_start();
  }

  /** Adds Gaussians of the scene. */
  add(part: Seen): void {
    const { means } = part;
    const n = means.length / 3;
    const arrays = "geometry" in part ? [means, part.geometry] : [means, part.scales, part.rotations, part.opacities];
    const at = arrays.map(({ buffer, byteOffset, byteLength }) => {
      const address = this.wasm.rgs_allocate(byteLength) >>> 0;
      new Uint8Array(this.wasm.memory.buffer, address, byteLength).set(new Uint8Array(buffer, byteOffset, byteLength));
      return address;
    }) as [number, number, number, number];
    if ("geometry" in part) this.wasm.rgs_sample_stored(at[0], at[1], part.scaleExponent, n);
    else this.wasm.rgs_sample(...at, n);
    for (const address of at) this.wasm.rgs_free(address);
  }

  /** Null if none of them is visible. */
  choose(up: Vector3): FirstView | null {
    const address = this.wasm.rgs_first_view(...up) >>> 0;
    const [kind, ...values] = new Float32Array(this.wasm.memory.buffer, address, 11) as unknown as number[];
    const vector = (i: number): Vector3 => values.slice(i, i + 3) as unknown as Vector3;
    const name = kKinds[kind as number];
    return name ? { kind: name, position: vector(0), pivot: vector(3), up: vector(6), horizontalFov: values[9] as number } : null;
  }
}
