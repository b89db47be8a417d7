// node.ts - the entry for Node.
// SPDX-License-Identifier: Apache-2.0
import { Worker } from "node:worker_threads";
import type { Answer, Job } from "./conversion.js";
import { type Converted, convertWith, type ConvertOptions, type Port, type Source } from "./convert.js";
export { RgsError, type RgsErrorCode } from "./convert.js";
export type { Converted, ConvertOptions, Profile, Progress, Report, Source } from "./convert.js";

async function post(worker: Worker, job: Job): Promise<void> {
  try {
    worker.postMessage(job);
  } catch (error) {
    if (!(job.source instanceof Blob)) throw error;
    // Node does not send a Blob of a file to another thread.
    const bytes = await job.source.arrayBuffer();
    worker.postMessage({ ...job, source: new Uint8Array(bytes) }, [bytes]);
  }
}

function start(): Port {
  const worker = new Worker(new URL("./worker-node.js", import.meta.url));
  return {
    listen: (on) => {
      worker.on("message", (answer: Answer) => on.answer(answer));
      worker.on("error", (error) => on.fail(error));
      worker.on("messageerror", (error) => on.fail(error));
    },
    send: (job) => void post(worker, job).catch((error: unknown) => worker.emit("error", error)),
    end: () => void worker.terminate(),
  };
}

/** Converts a PLY to an .rgs. Rejects with an RgsError, or with the reason of `options.signal`. */
export function convert(source: Source, options: ConvertOptions = {}): Promise<Converted> {
  return convertWith(start, source, options);
}
