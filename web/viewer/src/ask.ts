// ask.ts - a worker that answers one message after the other, by {result} or {error}.
// SPDX-License-Identifier: Apache-2.0

export type Ask = <T>(message: object, transfer?: Transferable[]) => Promise<T>;

/** Runs `work` with a worker, which ends with it. Rejects with the signal's reason at once. */
export async function withWorker<T>(start: () => Worker, signal: AbortSignal | undefined, work: (ask: Ask) => Promise<T>): Promise<T> {
  signal?.throwIfAborted();
  const worker = start();
  const ask = <R>(message: object, transfer: Transferable[] = []): Promise<R> =>
    new Promise((resolve, reject) => {
      worker.onmessage = ({ data }: MessageEvent<{ result: R } | { error: unknown }>) => ("error" in data ? reject(data.error) : resolve(data.result));
      worker.onerror = ({ message: text }) => reject(new Error(text));
      worker.postMessage(message, transfer);
    });
  const aborted = new Promise<never>((_, reject) => signal?.addEventListener("abort", () => reject(signal.reason)));
  try {
    return await Promise.race([work(ask), aborted]);
  } finally {
    worker.terminate();
  }
}
