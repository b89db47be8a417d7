// web.ts - the entry for browsers.
// SPDX-License-Identifier: Apache-2.0
import type { Port } from "./client.js";
import type { ZstdStream } from "./decoder.js";
import type { Box } from "./head.js";
import { decompressWith, type OpenOptions, openWith, type RgsFile, type Source, subjectBoxWith } from "./reader.js";
import type { Answer } from "./service.js";
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

/** Opens an .rgs file. Rejects with an RgsError, or with the reason of `options.signal`. */
export function open(source: Source, options: OpenOptions = {}): Promise<RgsFile> {
  return openWith(() => startWorker(options.worker), source, options);
}

/** RgsFile.subjectBox of Gaussians that come from elsewhere: `means` [n, 3], `opacities` [n]. */
export function subjectBox(means: Float32Array, opacities: Float32Array, options: Pick<OpenOptions, "wasm" | "worker"> = {}): Promise<Box> {
  return subjectBoxWith(() => startWorker(options.worker), means, opacities, options);
}

/** The contents of Zstandard streams, null for those that are damaged or have another size. */
export function decompress(streams: ZstdStream[], options: Pick<OpenOptions, "wasm" | "worker"> = {}): Promise<(Uint8Array | null)[]> {
  return decompressWith(() => startWorker(options.worker), streams, options);
}
