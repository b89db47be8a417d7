// load-engine.ts - the engine, which pages that draw by WebGPU do not fetch.
// SPDX-License-Identifier: Apache-2.0
export const loadEngine = () =>
  import("./engine.js").catch((error: unknown) => {
    throw Object.assign(new Error(), { code: "open_failed", text: `the PlayCanvas engine: ${String(error)}` });
  });
