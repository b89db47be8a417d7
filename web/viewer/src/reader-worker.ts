// reader-worker.ts - the workers for the page in a folder; the reader finds its own by itself.
// SPDX-License-Identifier: Apache-2.0
export const worker: (() => Worker) | undefined = undefined;
export const startChooser = (): Worker => new Worker(new URL("./chooser-worker.ts", import.meta.url), { type: "module" });
export const startSplats = (): Worker => new Worker(new URL("./splats-worker.ts", import.meta.url), { type: "module" });
