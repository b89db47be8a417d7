// node.ts - the entry for Node.
// SPDX-License-Identifier: Apache-2.0
import { type TransferListItem, Worker } from "node:worker_threads";
import type { Port } from "./client.js";
import type { Box } from "./head.js";
import { type OpenOptions, openWith, readSpzWith, type RgsFile, type Source, subjectBoxWith } from "./reader.js";
import type { Answer } from "./service.js";
import type { Spz } from "./spz.js";
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

/** Opens an .rgs file: reads header, declarations and the table of pages. Rejects with an RgsError, or the signal's reason. */
export function open(source: Source, options: OpenOptions = {}): Promise<RgsFile> {
  return openWith(startWorker, source, options);
}

/** RgsFile.subjectBox of Gaussians that come from elsewhere: `means` [n, 3], `opacities` [n] 0 to 1. */
export function subjectBox(means: Float32Array, opacities: Float32Array, options: Pick<OpenOptions, "wasm"> = {}): Promise<Box> {
  return subjectBoxWith(startWorker, means, opacities, options);
}

/** Header, declared axes and streams of a whole .spz, as `rgs-convert` checks them. Rejects with an RgsError. */
export function readSpz(bytes: Uint8Array<ArrayBuffer>, options: Pick<OpenOptions, "wasm"> = {}): Promise<Spz> {
  return readSpzWith(startWorker, bytes, options);
}
