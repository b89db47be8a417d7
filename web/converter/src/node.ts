// node.ts - the entry for Node.
// SPDX-License-Identifier: Apache-2.0
import { Worker } from "node:worker_threads";
import type { Answer } from "./conversion.js";
import { type Converted, convertWith, type ConvertOptions, type Port, type Source } from "./convert.js";
export { RgsError, type RgsErrorCode } from "./convert.js";
export type { Converted, ConvertOptions, Profile, Progress, Report, Source } from "./convert.js";

function start(): Port {
  const worker = new Worker(new URL("./worker-node.js", import.meta.url));
  return {
    listen: (on) => {
      worker.on("message", (answer: Answer) => on.answer(answer));
      worker.on("error", (error) => on.fail(error));
      worker.on("messageerror", (error) => on.fail(error));
    },
    send: (job) => worker.postMessage(job),
    end: () => void worker.terminate(),
  };
}

/** Converts a PLY to an .rgs. Rejects with an RgsError, or with the reason of `options.signal`. */
export function convert(source: Source, options: ConvertOptions = {}): Promise<Converted> {
  return convertWith(start, source, options);
}
