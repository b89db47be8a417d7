// ask.ts - a worker that answers one message after the other, by {result} or {error}, and the modules that workers get.
// SPDX-License-Identifier: Apache-2.0

export type Ask = <T>(message: object, transfer?: Transferable[]) => Promise<T>;

const unavailable = (text: string): Error => Object.assign(new Error(), { code: "unavailable", text });

/** Runs `work` with a worker, which ends with it. Rejects with the signal's reason at once. */
export async function withWorker<T>(start: () => Worker, signal: AbortSignal | undefined, work: (ask: Ask) => Promise<T>): Promise<T> {
  signal?.throwIfAborted();
  const worker = start();
  // From the first moment on: a worker may fail before it is asked.
  const ended = new Promise<never>((_, reject) => {
    worker.onerror = ({ message }) => reject(unavailable(`the worker does not start: ${message ?? ""}`));
    signal?.addEventListener("abort", () => reject(signal.reason));
  });
  const ask = <R>(message: object, transfer: Transferable[] = []): Promise<R> => {
    const answer = new Promise<R>((resolve, reject) => {
      worker.onmessage = ({ data }: MessageEvent<{ result: R } | { error: unknown }>) => ("error" in data ? reject(data.error) : resolve(data.result));
    });
    worker.postMessage(message, transfer);
    return Promise.race([answer, ended]);
  };
  try {
    return await Promise.race([work(ask), ended]);
  } finally {
    worker.terminate();
  }
}

/** Compiles a part of this page. */
export async function moduleOf(url: URL, signal?: AbortSignal): Promise<WebAssembly.Module> {
  const answer = await fetch(url, signal ? { signal } : {}).catch((error: unknown) => {
    signal?.throwIfAborted();
    throw unavailable(`its WebAssembly: ${String(error)}`);
  });
  if (!answer.ok) throw unavailable(`its WebAssembly: HTTP ${answer.status}`);
  return WebAssembly.compile(await answer.arrayBuffer());
}
