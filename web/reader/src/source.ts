// source.ts - sources of a file's bytes: memory, a Blob, a web server, or the caller's own.
// SPDX-License-Identifier: Apache-2.0
import { RgsError } from "./errors.js";

/** A file that is read by ranges, several at a time. */
export interface RangeSource {
  /** Bytes of the file; if undefined, the file's header is believed. */
  readonly size: number | undefined;
  /** Exactly these bytes; `offset + bytes` is at most `size`. If the size is unknown, fewer at the end of the file. */
  read(offset: number, bytes: number, signal?: AbortSignal): Promise<Uint8Array>;
}

/** How a URL is read. */
export interface UrlOptions {
  /** Sent with each request. */
  headers?: Record<string, string>;
  /** As fetch() has it. */
  credentials?: RequestCredentials;
  /** Of one read, in a row without a byte; 2 by default. Pauses of 0.25 s, doubled up to 8 s. */
  retries?: number;
  /** A request fails if the server sends nothing for so long; 30,000 by default. */
  silenceMs?: number;
  /** @internal Calls `ring` after so many ms, unless what it returns is called before. */
  startTimer?: (ms: number, ring: () => void) => () => void;
}

/** Bytes of the first request. */
const kFirstBytes = 1 << 16;
/** Largest file that is kept whole, from a server without ranges. */
const kMostWhole = 2 ** 32;

/** @internal */
export class MemorySource implements RangeSource {
  readonly size: number;
  constructor(private readonly bytes: Uint8Array) {
    this.size = bytes.length;
  }
  read(offset: number, bytes: number): Promise<Uint8Array> {
    return Promise.resolve(this.bytes.slice(offset, offset + bytes));
  }
}

/** @internal */
export class BlobSource implements RangeSource {
  readonly size: number;
  constructor(private readonly blob: Blob) {
    this.size = blob.size;
  }
  async read(offset: number, bytes: number): Promise<Uint8Array> {
    try {
      return new Uint8Array(await this.blob.slice(offset, offset + bytes).arrayBuffer());
    } catch (error) {
      throw new RgsError(
        { code: "read_failed", text: "the file cannot be read, or has changed since it was chosen", offset },
        { cause: error },
      );
    }
  }
}

/** `again`: seconds after which another try may help. */
class Failure extends Error {
  constructor(
    message: string,
    readonly again?: number,
  ) {
    super(message);
  }
}

/** The bytes of a read, and how many have come. */
interface Filled {
  offset: number;
  out: Uint8Array;
  done: number;
  mayEnd?: boolean;
  whole?: Whole;
}

/** A file that comes whole, of at most `most` bytes. */
interface Whole {
  most: number;
  tooLarge: Error;
  onProgress(soFar: Uint8Array): void;
}

/** What must not change from answer to answer. */
interface Pin {
  size: number | undefined;
  etag: string | null;
  modified: string | null;
}

const kOtherBytes = "the server answers with other bytes than were asked for";

/** @internal */
export class UrlSource implements RangeSource {
  private constructor(
    private readonly url: string,
    private readonly options: UrlOptions,
    private readonly pin: Pin,
    private first: Uint8Array,
  ) {}

  /**
   * Requests the beginning of the file. A server without ranges sends the whole file, which is kept, up to `maxBytes`; `onProgress` is
   * called with all bytes so far, and may throw an RgsError to end it.
   */
  static async open(
    url: string,
    options: UrlOptions,
    signal?: AbortSignal,
    onProgress?: (soFar: Uint8Array, total: number | undefined) => void,
    maxBytes = Infinity,
  ): Promise<RangeSource> {
    const filled: Filled = { offset: 0, out: new Uint8Array(kFirstBytes), done: 0 };
    let source: UrlSource | undefined;
    return retried("open_failed", filled, options, signal, async (timed) => {
      if (!source) Object.assign(filled, { out: new Uint8Array(kFirstBytes), done: 0 });
      const answer = await request(url, options, filled, timed.signal);
      if (source) {
        source.check(answer, filled);
      } else if (answer.status === 206) {
        const range = rangeOf(answer);
        const expected = range ? Math.min(kFirstBytes, range.total) : lengthOf(answer);
        filled.mayEnd = expected === undefined;
        filled.out = filled.out.subarray(0, expected);
        const pin = { size: range?.total, etag: tagOf(answer), modified: answer.headers.get("last-modified") };
        source = new UrlSource(url, options, pin, filled.out);
        source.check(answer, filled);
      } else {
        const length = answer.status === 416 ? 0 : lengthOf(answer);
        const most = Math.min(kMostWhole, maxBytes);
        filled.whole = {
          most,
          tooLarge: new RgsError({ code: "limit_exceeded", text: "the server has no ranges, and the file is too large to be kept whole" }),
          onProgress: (soFar) => onProgress?.(soFar, length),
        };
        if ((length ?? 0) > most) throw filled.whole.tooLarge;
        filled.out = new Uint8Array(length ?? Math.min(most, kFirstBytes));
        filled.mayEnd = length === undefined;
      }
      await fill(answer, filled, timed);
      const { out, done } = filled;
      if (!source) return new MemorySource(done < out.length ? out.slice(0, done) : out);
      if (done < kFirstBytes) source.pin.size ??= done;
      source.first = out.subarray(0, done);
      return source;
    });
  }

  get size(): number | undefined {
    return this.pin.size;
  }

  async read(offset: number, bytes: number, signal?: AbortSignal): Promise<Uint8Array> {
    if (offset + bytes <= this.first.length) return this.first.slice(offset, offset + bytes);
    const filled = { offset, out: new Uint8Array(bytes), done: 0 };
    return retried("read_failed", filled, this.options, signal, async (timed) => {
      const answer = await request(this.url, this.options, filled, timed.signal);
      this.check(answer, filled);
      await fill(answer, filled, timed);
      return filled.out;
    });
  }

  private check(answer: Response, { offset, out, done }: Filled): void {
    const range = rangeOf(answer);
    const { pin } = this;
    // Fields that both answers have must be equal; at least one of the pinned ones must be there.
    const pinned = [[pin.etag, tagOf(answer)], [pin.modified, answer.headers.get("last-modified")]].filter(([was]) => was);
    const isOther = pinned.some(([was, is]) => is && was !== is) || (pinned.length > 0 && !pinned.some(([, is]) => is));
    if (isOther || (range && range.total !== (pin.size ?? range.total))) {
      throw new Failure("the file has changed on the server: open it again");
    }
    if (answer.status !== 206) throw new Failure("the server no longer answers with ranges");
    const left = out.length - done;
    if ((range && (range.begin !== offset + done || range.end !== offset + out.length)) || (lengthOf(answer) ?? left) !== left) {
      throw new Failure(kOtherBytes);
    }
  }
}

/** One try. Its signal aborts with the caller's, or when the server is silent for too long. */
interface Timed {
  signal: AbortSignal;
  heard(): void;
}

function started(ms: number, ring: () => void): () => void {
  const timer = setTimeout(ring, ms);
  return () => clearTimeout(timer);
}

async function retried<T>(
  code: "open_failed" | "read_failed",
  filled: Filled,
  options: UrlOptions,
  signal: AbortSignal | undefined,
  attempt: (timed: Timed) => Promise<T>,
): Promise<T> {
  const { retries = 2, silenceMs = 30_000, startTimer = started } = options;
  let failures = 0;
  let most = 0;
  for (;;) {
    signal?.throwIfAborted();
    const own = new AbortController();
    let silent = false;
    let again: number | undefined = 0;
    let stopTimer = (): void => undefined;
    const heard = (): void => {
      stopTimer();
      stopTimer = startTimer(silenceMs, () => {
        silent = true;
        own.abort();
      });
    };
    const abort = (): void => own.abort(signal?.reason);
    signal?.addEventListener("abort", abort, { once: true });
    heard();
    try {
      return await attempt({ signal: own.signal, heard });
    } catch (error) {
      signal?.throwIfAborted();
      if (error instanceof RgsError) throw error;
      if (filled.done > most) failures = 0;
      most = Math.max(most, filled.done);
      if (error instanceof Failure) again = error.again;
      if (again === undefined || failures >= retries) {
        const text = silent ? `the server has sent nothing for ${silenceMs / 1000} s` : reason(error);
        throw new RgsError({ code, text, offset: filled.offset + filled.done || undefined }, { cause: error });
      }
    } finally {
      stopTimer();
      signal?.removeEventListener("abort", abort);
      own.abort();  // drops the unread rest of the answer
    }
    await pause(1000 * retryPause(failures++, again, Math.random()), signal, startTimer);
  }
}

/** @internal Seconds until a retry, after failures in a row; `random`, 0 to 1, spreads requests. */
export function retryPause(failures: number, retryAfter: number, random: number): number {
  const own = Math.min(8, 0.25 * 2 ** failures) * (0.75 + 0.25 * random);
  return Math.max(own, Math.min(retryAfter, 30));
}

function reason(error: unknown): string {
  const { message, cause } = error as { message?: string; cause?: { message?: string } };
  const text = [message, cause?.message].filter((part) => part !== undefined && part !== "").join(": ");
  return error instanceof Failure ? text : `the request failed: ${text}`;
}

function pause(ms: number, signal: AbortSignal | undefined, startTimer: typeof started): Promise<void> {
  return new Promise((resolve) => {
    const end = (): void => {
      stop();
      signal?.removeEventListener("abort", end);
      resolve();
    };
    const stop = startTimer(ms, end);
    signal?.addEventListener("abort", end);
  });
}

const kTemporary = new Set([408, 429, 500, 502, 503, 504]);

/** Requests what has not come: an answer of 200, 206, or 416 for an empty file. */
async function request(url: string, options: UrlOptions, { offset, out, done }: Filled, signal: AbortSignal): Promise<Response> {
  const headers: Record<string, string> = { ...options.headers, range: `bytes=${offset + done}-${offset + out.length - 1}` };
  const init: RequestInit = { headers, signal, redirect: "follow" };
  if (options.credentials !== undefined) init.credentials = options.credentials;
  const answer = await fetch(url, init);
  const { status } = answer;
  const isOther = (status === 206 && isCoded(answer)) || answer.headers.get("content-type")?.startsWith("multipart/") === true;
  if (isOther) throw new Failure(kOtherBytes);
  if (status === 206 || status === 200 || (status === 416 && rangeOf(answer)?.total === 0)) return answer;
  const after = answer.headers.get("retry-after") ?? "0";
  const again = kTemporary.has(status) ? Number(after) || (Date.parse(after) - Date.now()) / 1000 || 0 : undefined;
  throw new Failure(`the server answers with HTTP ${status}`, again);
}

/** Content-Range, which CORS may hide; null if absent. */
function rangeOf(answer: Response): { begin: number; end: number; total: number } | null {
  const text = answer.headers.get("content-range");
  if (text === null) return null;
  const match = /^bytes +(?:(\d{1,15})-(\d{1,15})|\*)\/(\d{1,15})$/i.exec(text);
  if (!match) throw new Failure(kOtherBytes);
  return { begin: Number(match[1]), end: Number(match[2]) + 1, total: Number(match[3]) };
}

/** ETag. Servers that compress may weaken it; it still names the same file. */
function tagOf(answer: Response): string | null {
  return answer.headers.get("etag")?.replace(/^W\//, "") ?? null;
}

function isCoded(answer: Response): boolean {
  return (answer.headers.get("content-encoding") ?? "identity") !== "identity";
}

/** Length of the decoded body, undefined where it is not known. */
function lengthOf(answer: Response): number | undefined {
  const text = answer.headers.get("content-length");
  return !isCoded(answer) && text !== null && /^\d{1,15}$/.test(text) ? Number(text) : undefined;
}

/** Adds an answer's body. */
async function fill(answer: Response, filled: Filled, timed: Timed): Promise<void> {
  const { whole } = filled;
  const reader = answer.body?.getReader();
  while (reader && (whole || filled.done < filled.out.length)) {
    const next = await reader.read();
    timed.heard();
    if (next.done) break;
    const { out, done } = filled;
    const end = done + next.value.length;
    if (whole && end > out.length) {
      if (end > whole.most) throw whole.tooLarge;
      filled.mayEnd = true;  // CORS may hide an encoding
      filled.out = new Uint8Array(Math.min(whole.most, Math.max(2 * out.length, end)));
      filled.out.set(out.subarray(0, done));
    }
    filled.out.set(next.value.subarray(0, filled.out.length - done), done);
    filled.done = Math.min(end, filled.out.length);
    whole?.onProgress(filled.out.subarray(0, filled.done));
  }
  if (filled.done < filled.out.length && !filled.mayEnd) throw new Failure(`the answer ends after ${filled.done} bytes`, 0);
}
