// client.ts - the caller's side of the worker: requests as promises.
// SPDX-License-Identifier: Apache-2.0
import { RgsError } from "./errors.js";
import type { Answer, Request, Requests } from "./service.js";

/** A worker of browsers or of Node. */
export interface Port {
  send(request: Request, transfer: ArrayBuffer[]): void;
  /** Called once, before anything is sent. */
  listen(on: { answer(answer: Answer): void; fail(error: unknown): void }): void;
  /** `held` while an answer is awaited: a worker of Node keeps the process alive only then. */
  hold(held: boolean): void;
  end(): void;
}

export interface CallOptions {
  transfer?: ArrayBuffer[];
  signal?: AbortSignal | undefined;
  onProgress?: ((share: number) => void) | undefined;
}

interface Waiting {
  resolve(result: unknown): void;
  reject(error: unknown): void;
  onProgress: ((share: number) => void) | undefined;
}

export class Client {
  private readonly waiting = new Map<number, Waiting>();
  private nextId = 1;
  private ended: RgsError | undefined;

  constructor(private readonly port: Port) {
    port.listen({
      answer: (answer) => this.receive(answer),
      fail: (error) =>
        this.end(new RgsError({ code: "unavailable", text: `the worker does not start: ${describe(error)}` }, { cause: error })),
    });
  }

  /** Rejects with an RgsError, or with the signal's reason. */
  call<K extends keyof Requests>(name: K, args: Requests[K][0], options: CallOptions = {}): Promise<Requests[K][1]> {
    const { transfer = [], signal, onProgress } = options;
    if (this.ended) return Promise.reject(this.ended);
    if (signal?.aborted) return Promise.reject(signal.reason);
    const id = this.nextId++;
    return new Promise((resolve, reject) => {
      const abort = (): void => {
        // Its answer will be ignored.
        this.port.send({ id: 0, name: "cancel", args: { id } }, []);
        this.waiting.delete(id);
        this.port.hold(this.waiting.size > 0);
        reject(signal?.reason);
      };
      signal?.addEventListener("abort", abort, { once: true });
      const leave = (): void => signal?.removeEventListener("abort", abort);
      this.waiting.set(id, {
        resolve: (result) => {
          leave();
          resolve(result as Requests[K][1]);
        },
        reject: (error) => {
          leave();
          reject(error);
        },
        onProgress,
      });
      this.port.hold(true);
      this.port.send({ id, name, args } as Request, transfer);
    });
  }

  end(error = new RgsError({ code: "bad_argument", text: "the file has been closed" })): void {
    if (this.ended) return;
    this.ended = error;
    this.port.end();
    for (const waiting of this.waiting.values()) waiting.reject(error);
    this.waiting.clear();
  }

  private receive(answer: Answer): void {
    const waiting = this.waiting.get(answer.id);
    if (!waiting) return;
    if ("progress" in answer) {
      waiting.onProgress?.(answer.progress);
      return;
    }
    this.waiting.delete(answer.id);
    this.port.hold(this.waiting.size > 0);
    if ("error" in answer) waiting.reject(new RgsError(answer.error));
    else waiting.resolve(answer.result);
  }
}

function describe(error: unknown): string {
  const message = (error as { message?: unknown } | null)?.message;
  return typeof message === "string" && message !== "" ? message : "its script cannot be loaded";
}
