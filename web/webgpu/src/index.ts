// index.ts - .rgs files by WebGPU.
// SPDX-License-Identifier: Apache-2.0
export { type AntiAliasing, antiAliasingOf, type Pinhole } from "@roofgs/reader";
export type { Part } from "./memory.js";
export { type Colour, type Frame, requestDevice, SplatRenderer } from "./renderer.js";
export type { RenderOptions } from "./view.js";
