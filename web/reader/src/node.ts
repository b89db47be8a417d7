// node.ts - the entry for Node.
// SPDX-License-Identifier: Apache-2.0
import { type TransferListItem, Worker } from "node:worker_threads";
import type { Port } from "./client.js";
import type { ZstdStream } from "./decoder.js";
import type { Box } from "./head.js";
import { decompressWith, type OpenOptions, openWith, type RgsFile, type Source, subjectBoxWith } from "./reader.js";
import type { Answer } from "./service.js";
export * from "./index.js";

function startWorker(): Port {
  const worker = new Worker(new URL("./worker-node.js", import.meta.url));
  return {
    send: (request, transfer) => worker.postMessage(request, transfer as TransferListItem[]),
    listen: (on) => {
      worker.on("message", (answer: Answer) => on.answer(answer));
      worker.on("error", (error) => on.fail(error));
      worker.on("messageerror", (error) => on.fail(error));
      worker.unref();
    },
    hold: (held) => (held ? worker.ref() : worker.unref()),
    end: () => void worker.terminate(),
  };
}

/** Opens an .rgs file. Rejects with an RgsError, or with the reason of `options.signal`. */
export function open(source: Source, options: OpenOptions = {}): Promise<RgsFile> {
  return openWith(startWorker, source, options);
}

/** RgsFile.subjectBox of Gaussians that come from elsewhere: `means` [n, 3], `opacities` [n]. */
export function subjectBox(means: Float32Array, opacities: Float32Array, options: Pick<OpenOptions, "wasm"> = {}): Promise<Box> {
  return subjectBoxWith(startWorker, means, opacities, options);
}

/** The contents of Zstandard streams, null for those that are damaged or have another size. */
export function decompress(streams: ZstdStream[], options: Pick<OpenOptions, "wasm"> = {}): Promise<(Uint8Array | null)[]> {
  return decompressWith(startWorker, streams, options);
}
