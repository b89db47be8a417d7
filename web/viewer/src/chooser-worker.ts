// chooser-worker.ts - the worker of first-view.ts: takes the module, then Gaussians, then the direction of up; answers each.
// SPDX-License-Identifier: Apache-2.0
import type { Vector3 } from "@roofgs/reader";
import { Chooser, type Seen } from "./chooser.js";

let chooser: Chooser;
onmessage = ({ data }: MessageEvent<{ module: WebAssembly.Module } | { part: Seen } | { up: Vector3 }>): void => {
  if ("module" in data) chooser = new Chooser(data.module);
  else if ("part" in data) chooser.add(data.part);
  postMessage({ result: "up" in data ? chooser.choose(data.up) : null });
};
