// engine.ts - all that needs the PlayCanvas engine, for pages to load when they need it.
// SPDX-License-Identifier: Apache-2.0
export { EngineRenderer } from "./engine-renderer.js";
export { EngineScene } from "./engine-scene.js";
