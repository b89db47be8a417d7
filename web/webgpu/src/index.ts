// index.ts - .rgs files by WebGPU.
// SPDX-License-Identifier: Apache-2.0
export type { Part } from "./memory.js";
export { type Frame, requestDevice, SplatRenderer } from "./renderer.js";
export { type AntiAliasing, antiAliasingOf, type Pinhole, type RenderOptions } from "./view.js";
