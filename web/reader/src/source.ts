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

export interface UrlOptions {
  /** Sent with each request. */
  headers?: Record<string, string>;
  credentials?: RequestCredentials;
  /** Tries of a request that fails for a reason that may be temporary; 3 by default. */
  attempts?: number;
  /** A request fails if the server sends nothing for so long; 30,000 by default. */
  silenceMs?: number;
  /** @internal Calls `ring` after so many ms, unless what it returns is called before. */
  startTimer?: (ms: number, ring: () => void) => () => void;
}

/** Bytes of the first request. */
const kFirstBytes = 1 << 16;
/** Largest file that is kept whole, from a server without ranges. */
const kMostWhole = 2 ** 32;
const kTooLarge = "the server has no ranges, and the file is too large to be kept whole";

export class MemorySource implements RangeSource {
  readonly size: number;
  constructor(private readonly bytes: Uint8Array) {
    this.size = bytes.length;
  }
  read(offset: number, bytes: number): Promise<Uint8Array> {
    return Promise.resolve(this.bytes.slice(offset, offset + bytes));
  }
}

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

/** A failure that another try may mend. */
class Temporary extends Error {}

/** What must not change from answer to answer. */
interface Pin {
  size: number | undefined;
  etag: string | null;
  modified: string | null;
}

function failed(text: string, offset?: number): RgsError {
  return new RgsError({ code: "read_failed", text, offset });
}

export class UrlSource implements RangeSource {
  private constructor(
    private readonly url: string,
    private readonly options: UrlOptions,
    private readonly pin: Pin,
    /** Bytes of the first answer. */
    private readonly first: Uint8Array,
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
    return retried(options, signal, async (timed) => {
      const answer = await request(url, options, 0, kFirstBytes, timed.signal, null);
      if (answer.status === 416 && /^bytes \*\/0$/.test(answer.headers.get("content-range") ?? "")) {
        await answer.body?.cancel();
        return new MemorySource(new Uint8Array(0));
      }
      if (answer.status === 200) {
        const length = lengthOf(answer);
        const most = Math.min(kMostWhole, maxBytes);
        const bytes = await readBody(answer, length, most, timed, (soFar) => onProgress?.(soFar, length), kTooLarge);
        return new MemorySource(bytes);
      }
      const range = rangeOf(answer);
      if (range && range.begin !== 0) throw failed("the server answers with another range than was asked for");
      const expected = range && range.total !== undefined ? Math.min(kFirstBytes, range.total) : undefined;
      if (range && expected !== undefined && range.end !== expected) {
        throw failed("the server answers with another range than was asked for");
      }
      const first = await readBody(answer, expected, kFirstBytes, timed);
      // A short answer without a total is the whole file.
      const size = range?.total ?? (first.length < kFirstBytes ? first.length : undefined);
      const etag = answer.headers.get("etag");
      return new UrlSource(url, options, { size, etag, modified: answer.headers.get("last-modified") }, first);
    });
  }

  get size(): number | undefined {
    return this.pin.size;
  }

  async read(offset: number, bytes: number, signal?: AbortSignal): Promise<Uint8Array> {
    if (offset + bytes <= this.first.length) return this.first.slice(offset, offset + bytes);
    return retried(this.options, signal, async (timed) => {
      const answer = await request(this.url, this.options, offset, bytes, timed.signal, this.pin.etag);
      if (answer.status === 200) {
        await answer.body?.cancel();
        throw failed("the file has changed on the server, or the server no longer answers with ranges", offset);
      }
      this.check(answer, offset, bytes);
      return readBody(answer, bytes, bytes, timed);
    });
  }

  private check(answer: Response, offset: number, bytes: number): void {
    const range = rangeOf(answer);
    const etag = answer.headers.get("etag");
    const modified = answer.headers.get("last-modified");
    const { pin } = this;
    if (
      (range?.total !== undefined && pin.size !== undefined && range.total !== pin.size) ||
      (etag !== null && pin.etag !== null && etag !== pin.etag) ||
      (modified !== null && pin.modified !== null && modified !== pin.modified)
    ) {
      throw failed("the file has changed on the server while it was read: open it again", offset);
    }
    if (range && (range.begin !== offset || range.end !== offset + bytes)) {
      throw failed("the server answers with another range than was asked for", offset);
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

async function retried<T>(options: UrlOptions, signal: AbortSignal | undefined, attempt: (timed: Timed) => Promise<T>): Promise<T> {
  const { attempts = 3, silenceMs = 30_000, startTimer = started } = options;
  for (let i = 1; ; ++i) {
    signal?.throwIfAborted();
    const own = new AbortController();
    let silent = false;
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
      const text = silent ? `the server has sent nothing for ${silenceMs / 1000} s` : `the request failed: ${reason(error)}`;
      if (i >= attempts) throw new RgsError({ code: "read_failed", text }, { cause: error });
    } finally {
      stopTimer();
      signal?.removeEventListener("abort", abort);
      own.abort();  // drops the unread rest of the answer
    }
    await pause(200 * 2 ** (i - 1), signal);
  }
}

function reason(error: unknown): string {
  const { message, cause } = error as { message?: string; cause?: { message?: string } };
  return [message, cause?.message].filter((text) => text !== undefined && text !== "").join(": ");
}

function pause(ms: number, signal: AbortSignal | undefined): Promise<void> {
  return new Promise((resolve, reject) => {
    const abort = (): void => {
      clearTimeout(timer);
      reject(signal?.reason);
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener("abort", abort);
      resolve();
    }, ms);
    signal?.addEventListener("abort", abort, { once: true });
  });
}

const kTemporary = new Set([408, 425, 429, 500, 502, 503, 504]);

/** Resolves with an answer of 200 or 206, or of 416 to the first request. */
async function request(
  url: string,
  options: UrlOptions,
  offset: number,
  bytes: number,
  signal: AbortSignal,
  etag: string | null,
): Promise<Response> {
  const headers: Record<string, string> = { ...options.headers, range: `bytes=${offset}-${offset + bytes - 1}` };
  // Weak tags do not identify bytes. Not in browsers, where this header would need a CORS preflight.
  if (etag !== null && !etag.startsWith("W/") && typeof location === "undefined") headers["if-range"] = etag;
  const init: RequestInit = { headers, signal, redirect: "follow" };
  if (options.credentials !== undefined) init.credentials = options.credentials;
  const answer = await fetch(url, init);
  if (answer.status === 206 || answer.status === 200) {
    const coding = answer.headers.get("content-encoding");
    if (answer.status === 206 && coding !== null && coding !== "identity") {
      throw failed(`the server answers with the encoding ${coding}, which has no ranges of the file`, offset);
    }
    if (answer.headers.get("content-type")?.startsWith("multipart/") === true) {
      throw failed("the server answers with several ranges", offset);
    }
    return answer;
  }
  if (answer.status === 416 && offset === 0) return answer;
  await answer.body?.cancel();
  if (kTemporary.has(answer.status)) throw new Temporary(`HTTP ${answer.status}`);
  throw new RgsError({ code: offset === 0 ? "open_failed" : "read_failed", text: `the server answers with HTTP ${answer.status}` });
}

/** Content-Range, which CORS may hide; null if absent. */
function rangeOf(answer: Response): { begin: number; end: number; total: number | undefined } | null {
  const text = answer.headers.get("content-range");
  if (text === null) return null;
  const match = /^bytes (\d{1,15})-(\d{1,15})\/(\d{1,15}|\*)$/.exec(text);
  if (!match) throw failed("the server's Content-Range is not one range");
  return { begin: Number(match[1]), end: Number(match[2]) + 1, total: match[3] === "*" ? undefined : Number(match[3]) };
}

/** Length of the decoded body, undefined where it is not known. */
function lengthOf(answer: Response): number | undefined {
  const text = answer.headers.get("content-length");
  const coded = (answer.headers.get("content-encoding") ?? "identity") !== "identity";
  return !coded && text !== null && /^\d{1,15}$/.test(text) ? Number(text) : undefined;
}

/** The body: exactly `bytes` bytes if known, at most `most` otherwise. `tooLarge`: the error's text if `most` is a limit. */
async function readBody(
  answer: Response,
  bytes: number | undefined,
  most: number,
  timed: Timed,
  onProgress?: (soFar: Uint8Array) => void,
  tooLarge?: string,
): Promise<Uint8Array> {
  if (tooLarge !== undefined && bytes !== undefined && bytes > most) {
    await answer.body?.cancel();
    throw new RgsError({ code: "limit_exceeded", text: tooLarge });
  }
  if (!answer.body) return new Uint8Array(0);
  const reader = answer.body.getReader();
  let out = new Uint8Array(bytes ?? Math.min(most, 1 << 16));
  let done = 0;
  for (;;) {
    const next = await reader.read();
    timed.heard();
    if (next.done) break;
    if (done + next.value.length > out.length) {
      if (bytes !== undefined || done + next.value.length > most) {
        await reader.cancel();
        if (bytes === undefined && tooLarge !== undefined) throw new RgsError({ code: "limit_exceeded", text: tooLarge });
        throw failed("the server sends more than was asked for");
      }
      const larger = new Uint8Array(Math.min(most, Math.max(2 * out.length, done + next.value.length)));
      larger.set(out.subarray(0, done));
      out = larger;
    }
    out.set(next.value, done);
    done += next.value.length;
    onProgress?.(out.subarray(0, done));
  }
  if (bytes !== undefined && done < bytes) throw new Temporary(`the answer ends after ${done} of ${bytes} bytes`);
  return done === out.length ? out : out.slice(0, done);
}
