// web.ts - the entry for browsers.
// SPDX-License-Identifier: Apache-2.0
/**
 * Reads .rgs files, in browsers and in Node.
 * @module @roofgs/reader
 */
import type { Port } from "./client.js";
import type { Box } from "./head.js";
import { type OpenOptions, openWith, readSpzWith, type RgsFile, type Source, subjectBoxWith } from "./reader.js";
import type { Answer } from "./service.js";
import type { Spz } from "./spz.js";
export * from "./index.js";

function startWorker(make: OpenOptions["worker"]): Port {
  // Bundlers recognise this form.
  const worker = make?.() ?? new Worker(new URL("./worker-web.js", import.meta.url), { type: "module" });
  return {
    send: (request, transfer) => worker.postMessage(request, transfer),
    listen: (on) => {
      worker.onmessage = (event: MessageEvent<Answer>) => on.answer(event.data);
      worker.onerror = (event) => on.fail(event);
      worker.onmessageerror = (event) => on.fail(event);
    },
    hold: () => undefined,
    end: () => worker.terminate(),
  };
}

/** Opens an .rgs file: reads header, declarations and the table of pages. Rejects with an RgsError, or the signal's reason. */
export function open(source: Source, options: OpenOptions = {}): Promise<RgsFile> {
  return openWith(() => startWorker(options.worker), source, options);
}

/** RgsFile.subjectBox of Gaussians that come from elsewhere: `means` [n, 3], `opacities` [n] 0 to 1. */
export function subjectBox(means: Float32Array, opacities: Float32Array, options: Pick<OpenOptions, "wasm" | "worker"> = {}): Promise<Box> {
  return subjectBoxWith(() => startWorker(options.worker), means, opacities, options);
}

/** Header, declared axes and streams of a whole .spz, as `rgs-convert` checks them. Rejects with an RgsError. */
export function readSpz(bytes: Uint8Array<ArrayBuffer>, options: Pick<OpenOptions, "wasm" | "worker"> = {}): Promise<Spz> {
  return readSpzWith(() => startWorker(options.worker), bytes, options);
}
