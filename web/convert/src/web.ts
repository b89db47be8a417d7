// web.ts - the entry for browsers.
// SPDX-License-Identifier: Apache-2.0
/**
 * Converts PLY files to .rgs, in browsers and in Node.
 * @module @roofgs/convert
 */
import type { Answer } from "./conversion.js";
import { type Converted, convertWith, type ConvertOptions, type Port, type Source } from "./convert.js";
export { RgsError, type RgsErrorCode } from "./convert.js";
export type { Converted, ConvertOptions, Profile, Progress, Report, Source } from "./convert.js";

function start(make: ConvertOptions["worker"]): Port {
  // Bundlers recognise this form.
  const worker = make?.() ?? new Worker(new URL("./worker-web.js", import.meta.url), { type: "module" });
  return {
    listen: (on) => {
      worker.onmessage = (event: MessageEvent<Answer>) => on.answer(event.data);
      worker.onerror = (event) => on.fail(event);
      worker.onmessageerror = (event) => on.fail(event);
    },
    send: (job) => worker.postMessage(job),
    end: () => worker.terminate(),
  };
}

/** Converts a PLY to an .rgs. Rejects with an RgsError, or with the reason of `options.signal`. */
export function convert(source: Source, options: ConvertOptions = {}): Promise<Converted> {
  return convertWith(() => start(options.worker), source, options);
}
