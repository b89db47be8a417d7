// splats-worker.ts - the worker of read-splats.ts: takes the module, then calls of Splats by their names; answers each.
// SPDX-License-Identifier: Apache-2.0
import { kOutOfMemory, Splats } from "./splats.js";

let splats: Splats;
onmessage = ({ data }: MessageEvent<{ module: WebAssembly.Module } | { call: "append" | "openPly" | "openSpz" | "read"; args: never }>): void => {
  try {
    let result: unknown;
    if ("module" in data) splats = new Splats(data.module);
    else result = (splats[data.call] as (...args: unknown[]) => unknown)(...(data.args as unknown[]));
    const arrays = Object.values(result ?? {}).filter((value) => value instanceof Float32Array);
    postMessage({ result }, { transfer: arrays.map(({ buffer }) => buffer) });
  } catch (error) {
    postMessage({ error: error instanceof RangeError ? kOutOfMemory : error });
  }
};
