// convert.ts - the caller's side of the worker.
// SPDX-License-Identifier: Apache-2.0
import { RgsError } from "@roofgs/reader";
import { type Answer, type Job, kProfiles, type Profile, type Progress, type Report } from "./conversion.js";

export { RgsError, type RgsErrorCode } from "@roofgs/reader";
export type { Profile, Progress, Report } from "./conversion.js";

/** A PLY; text is a URL. */
export type Source = Blob | ArrayBuffer | ArrayBufferView | URL | string;

export interface ConvertOptions {
  /** By default "packed". */
  profile?: Profile;
  /** Adds levels of detail. */
  levels?: boolean;
  /** Ends the worker; the promise rejects with the signal's reason. */
  signal?: AbortSignal;
  onProgress?: (progress: Progress) => void;
  /** For the provenance: by default the name of a File or the end of a URL. */
  sourceName?: string;
  /** For the provenance: by default "rgs-convert" and its version, whose code this is. */
  tool?: string;
  /** The compiled `@roofgs/convert/rgs.wasm`, if you load it yourself. */
  wasm?: WebAssembly.Module;
  /** Starts a worker of `@roofgs/convert/worker`, in browsers, for instance from a page that is one file. */
  worker?: () => Worker;
}

export interface Converted {
  /** The .rgs. */
  readonly blob: Blob;
  readonly report: Report;
}

/** A worker of browsers or of Node. @internal */
export interface Port {
  listen(on: { answer(answer: Answer): void; fail(error: unknown): void }): void;
  send(job: Job): void;
  end(): void;
}

/** The end of a URL. */
function nameOf({ pathname }: URL): string {
  const name = pathname.slice(pathname.lastIndexOf("/") + 1);
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
}

/** @internal */
export async function convertWith(start: () => Port, source: Source, options: ConvertOptions): Promise<Converted> {
  const { profile = "packed", levels = false, signal, onProgress, tool, wasm } = options;
  if (!kProfiles.includes(profile)) throw new RgsError({ code: "bad_argument", text: `no such profile: ${String(profile)}` });
  signal?.throwIfAborted();
  let from: Blob | Uint8Array | string;
  let name = "";
  if (source instanceof Blob) {
    from = source;
    name = (source as { name?: string }).name ?? "";
  } else if (source instanceof ArrayBuffer) {
    from = new Uint8Array(source);
  } else if (ArrayBuffer.isView(source)) {
    // A copy for the worker of what is seen, not of all that lies around it.
    from = new Uint8Array(source.buffer, source.byteOffset, source.byteLength).slice();
  } else {
    const url = new URL(source, globalThis.document?.baseURI);
    from = url.href;
    name = nameOf(url);
  }
  return new Promise((resolve, reject) => {
    const port = start();
    const abort = (): void => finish(() => reject(signal?.reason));
    const finish = (settle: () => void): void => {
      signal?.removeEventListener("abort", abort);
      port.end();
      settle();
    };
    signal?.addEventListener("abort", abort, { once: true });
    port.listen({
      answer: (answer) => {
        if ("progress" in answer) onProgress?.(answer.progress);
        else finish(() => ("error" in answer ? reject(new RgsError(answer.error)) : resolve(answer)));
      },
      fail: (error) =>
        finish(() => reject(new RgsError({ code: "unavailable", text: "the worker does not start or has ended" }, { cause: error }))),
    });
    port.send({ source: from, profile, levels, sourceName: options.sourceName ?? name, tool, wasm });
  });
}
