// reader.ts - an opened file, and how one is opened.
// SPDX-License-Identifier: Apache-2.0
import { Client, type Port } from "./client.js";
import type { Gaussians, Groups, Limits, Range, StoredGaussians } from "./decoder.js";
import { RgsError } from "./errors.js";
import { type Declarations, type Head, type Header, Levels, parseHead, type Provenance, type Section } from "./head.js";
import { BlobSource, MemorySource, type RangeSource, UrlSource, type UrlOptions } from "./source.js";

export type Source = ArrayBuffer | ArrayBufferView | Blob | URL | string | RangeSource;

/** What has come so far. `total` is undefined while nobody knows. */
export interface Progress {
  phase: "read" | "decode";
  /** Bytes while reading, Gaussians while decoding. */
  done: number;
  total: number | undefined;
}

export interface ReadOptions {
  /** Stops the work; promises reject with its reason. */
  signal?: AbortSignal | undefined;
  onProgress?: ((progress: Progress) => void) | undefined;
}

export interface OpenOptions extends ReadOptions {
  limits?: Limits;
  /** Of a URL. */
  url?: UrlOptions;
  /** rgs.wasm, compiled, for who wants to load it himself; otherwise the worker fetches it from beside its script. */
  wasm?: WebAssembly.Module;
  /** In browsers: makes a worker that runs `@roofgs/reader/worker`, where none can be loaded from beside the script. */
  worker?: () => Worker;
}

/** docs/format/FORMAT.md, "Shape of the file". */
const kMagic = [0x89, 0x52, 0x47, 0x53, 0x0d, 0x0a, 0x1a, 0x0a];
const kFirstBytes = 1 << 16;
const kPieceBytes = 1 << 22;
/** Requests at a time. */
const kPieces = 3;
/** Sections that grow with the scene. */
const kLarge = new Set(["MEAN", "GEOM", "SHI8", "PERM"]);
/** Groups of a part, so that memory for parts is bounded. */
const kMostGroups = 16;

/** An opened file. A worker of its own decodes it until close(). */
export class RgsFile {
  /** What the file says of itself. */
  readonly header: Header;
  readonly declarations: Declarations;
  /** Null where the file states none, or where it lies behind pages and has not been read. */
  readonly provenance: Provenance | null;
  readonly sections: readonly Section[];
  /** Null of a file without levels of detail. */
  readonly levels: Levels | null;
  /** Bytes of the file as it is, which may be fewer than its header says. */
  readonly fileBytes: number;
  private last: Promise<unknown> = Promise.resolve();

  /** @internal */
  constructor(
    private readonly client: Client,
    private readonly source: RangeSource,
    head: Head,
    levels: Levels | null,
    fileBytes: number,
  ) {
    this.fileBytes = fileBytes < 0 ? head.header.fileBytes : fileBytes;
    this.header = head.header;
    this.declarations = head.declarations;
    this.provenance = head.provenance;
    this.sections = head.sections;
    this.levels = levels;
  }

  /**
   * All Gaussians, of a file with levels those of the finest. Reads the whole file and checks all of it first and last: every
   * checksum, every value. Peak memory is the file and the result.
   */
  async read(options: ReadOptions = {}): Promise<Gaussians> {
    return (await this.readAll(options)).gaussians;
  }

  /** The same with their positions in the source, FP64 [n], null where the file keeps none. */
  readAll(options: ReadOptions = {}): Promise<{ gaussians: Gaussians; sourceIndex: Float64Array | null }> {
    const { nGaussians: n, shDegree } = this.header;
    return this.whole(options, (call) => this.client.call("wholeGaussians", { n, shDegree }, call));
  }

  /** All Gaussians as a GPU reads them. Files with levels have them by page alone: bad_argument. */
  async readStored(options: ReadOptions = {}): Promise<StoredGaussians> {
    if (this.levels) {
      throw new RgsError({ code: "bad_argument", text: "a file with levels of detail is read as stored page by page" });
    }
    const { nGaussians: n, ...shape } = this.shape;
    return (await this.whole(options, (call) => this.client.call("wholeStored", { n, shape }, call))).gaussians;
  }

  /**
   * The same part by part while the file is read, from the first Gaussian to the last: the first part has some ten thousand and
   * comes early, each other one doubles what has come. Parts have been checked, but the file as a whole is only when the last one
   * has come and the generator ends. No other read() begins before that.
   */
  async *storedParts({ signal, onProgress }: ReadOptions = {}): AsyncGenerator<StoredGaussians, void, undefined> {
    if (this.levels) {
      throw new RgsError({ code: "bad_argument", text: "a file with levels of detail is read as stored page by page" });
    }
    const { nGaussians: n, ...shape } = this.shape;
    const total = this.fileBytes;
    const all = [{ offset: 0, bytes: total }];
    const stop = new AbortController();
    const abort = (): void => stop.abort(signal?.reason);
    signal?.addEventListener("abort", abort, { once: true });
    const before = this.last;
    let end = (): void => undefined;
    const over = new Promise<void>((resolve) => (end = resolve));
    this.last = before.then(() => over);
    let hasBegun = false;
    const call = { signal: stop.signal };
    const unread = new Unread(total);
    let read = 0;
    let coming: Promise<void> = Promise.resolve();
    const load = (ranges: readonly Range[]): Promise<void> =>
      inLanes(ranges.flatMap((range) => unread.take(range)), async (range) => {
        await this.wholePart(range, stop.signal);
        read += range.bytes;
        onProgress?.({ phase: "read", done: read, total });
      });
    // What is wrong with a file is said as read() says it: of several defects the same.
    const asRead = async (error: unknown): Promise<never> => {
      if (stop.signal.aborted) throw error;
      await coming;
      await load(all);
      await this.client.call("wholeStored", { n, shape }, call);
      throw error;
    };
    try {
      await untilAborted(before, signal);
      signal?.throwIfAborted();
      hasBegun = true;
      await this.client.call("whole", { bytes: total }, call);
      await load(beforeGaussians(this.sections, total));
      const groups = await this.client.call("openEarly", {}, call);
      if (!groups) {
        await load(all);
        yield (await this.client.call("wholeStored", { n, shape }, call)).gaussians;
        return;
      }
      const parts = partsOf(groups);
      coming = load(parts[0]?.ranges ?? []);
      for (const [i, { ranges: _, ...chunks }] of parts.entries()) {
        await coming;
        // One part ahead of what is decoded.
        coming = load(parts[i + 1]?.ranges ?? all);
        coming.catch(() => undefined);
        yield await this.client.call("nextEarly", { ...chunks, shape }, call).catch(asRead);
      }
      await coming;
      await load(all);
      await this.client.call("finishEarly", {}, call).catch(asRead);
      onProgress?.({ phase: "decode", done: n, total: n });
    } finally {
      stop.abort(new RgsError({ code: "cancelled", text: "nobody reads on" }));
      signal?.removeEventListener("abort", abort);
      // Until then the memory is another's.
      if (hasBegun) await this.client.call("endWhole", {}).catch(() => undefined);
      end();
    }
  }

  /** Pages 0 .. nPresent - 1 lie within the file as it is. */
  get nPresent(): number {
    const { levels } = this;
    if (!levels) return 0;
    let low = 0;
    let high = levels.nPages;
    while (low < high) {
      const middle = (low + high) >>> 1;
      const page = levels.page(middle);
      if (page.offset + page.storedBytes <= this.fileBytes) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** Gaussians of a page, checksum and every value checked. */
  async readPage(page: number, options: ReadOptions = {}): Promise<Gaussians> {
    const bytes = await this.storedPage(page, options);
    const { shDegree } = this.header;
    return this.client.call("page", { page, bytes, shDegree }, { ...options, onProgress: undefined, transfer: [own(bytes)] });
  }

  async readPageStored(page: number, options: ReadOptions = {}): Promise<StoredGaussians> {
    const bytes = await this.storedPage(page, options);
    const { nGaussians: _, ...shape } = this.shape;
    shape.scaleExponent = (this.levels as Levels).page(page).scaleExponent;
    const call = { ...options, onProgress: undefined, transfer: [own(bytes)] };
    return this.client.call("pageStored", { page, bytes, shape }, call);
  }

  /** Ends the worker; what is at work rejects. */
  close(): void {
    this.client.end();
  }

  private get shape(): { nGaussians: number; shDegree: number; chunkSize: number; scaleExponent: number } {
    const { nGaussians, shDegree, chunkSize, scaleExponent } = this.header;
    return { nGaussians, shDegree, chunkSize, scaleExponent };
  }

  private async storedPage(page: number, options: ReadOptions): Promise<Uint8Array> {
    if (!this.levels) throw new RgsError({ code: "bad_argument", text: "the file has no levels of detail, and so no pages" });
    const { offset, storedBytes } = this.levels.page(page);
    if (offset + storedBytes > this.fileBytes) {
      throw new RgsError({
        code: "pages_missing",
        text: "the end of the file is missing, and with it this page",
        offset: this.fileBytes,
      });
    }
    return readExactly(this.source, { offset, bytes: storedBytes }, options.signal);
  }

  private async wholePart(range: Range, signal: AbortSignal): Promise<void> {
    const bytes = await readExactly(this.source, range, signal);
    await this.client.call("wholePart", { offset: range.offset, bytes }, { signal, transfer: [own(bytes)] });
  }

  /** One at a time: each takes memory for the whole file. */
  private whole<T>(...args: Parameters<typeof this.wholeNow<T>>): Promise<T> {
    const result = this.last.then(() => this.wholeNow(...args));
    this.last = result.catch(() => undefined);
    return untilAborted(result, args[0].signal);
  }

  private async wholeNow<T>(
    { signal, onProgress }: ReadOptions,
    decode: (call: { signal: AbortSignal | undefined; onProgress: (share: number) => void }) => Promise<T>,
  ): Promise<T> {
    const total = this.fileBytes;
    try {
      await this.client.call("whole", { bytes: total }, { signal });
      let read = 0;
      await inPieces(total, signal, async (range, stop) => {
        await this.wholePart(range, stop);
        read += range.bytes;
        onProgress?.({ phase: "read", done: read, total });
      });
      const n = this.header.nGaussians;
      const result = await decode({
        signal,
        onProgress: (share) => onProgress?.({ phase: "decode", done: Math.round(share * n), total: n }),
      });
      onProgress?.({ phase: "decode", done: n, total: n });
      return result;
    } finally {
      await this.client.call("endWhole", {}).catch(() => undefined);
    }
  }
}

/** The buffer of bytes that are ours alone, to be handed over. */
function own(bytes: Uint8Array): ArrayBuffer {
  return bytes.buffer as ArrayBuffer;
}

/** The same, but for the signal's reason as soon as it aborts: who waits for others' work need not. */
function untilAborted<T>(result: Promise<T>, signal: AbortSignal | undefined): Promise<T> {
  if (!signal) return result;
  return new Promise((resolve, reject) => {
    const abort = (): void => reject(signal.reason);
    if (signal.aborted) abort();
    signal.addEventListener("abort", abort, { once: true });
    result.then(resolve, reject).finally(() => signal.removeEventListener("abort", abort));
  });
}

/** What a source gives is checked: sources may be the caller's. The bytes are ours, to be handed over. */
async function readExactly(source: RangeSource, range: Range, signal: AbortSignal | undefined): Promise<Uint8Array> {
  signal?.throwIfAborted();
  const bytes = range.bytes === 0 ? new Uint8Array(0) : await source.read(range.offset, range.bytes, signal);
  signal?.throwIfAborted();
  if (bytes.length !== range.bytes) {
    throw new RgsError({
      code: "read_failed",
      text: "the source gives another number of bytes than was asked for",
      offset: range.offset,
      expected: BigInt(range.bytes),
      found: BigInt(bytes.length),
    });
  }
  return bytes;
}

/** Of a file's bytes those that nobody has asked for yet. */
class Unread {
  private gaps: Range[];
  constructor(bytes: number) {
    this.gaps = [{ offset: 0, bytes }];
  }

  /** Takes what a range has of them, in pieces. */
  take({ offset, bytes }: Range): Range[] {
    const end = offset + bytes;
    const taken: Range[] = [];
    const left: Range[] = [];
    for (const gap of this.gaps) {
      const gapEnd = gap.offset + gap.bytes;
      const [from, to] = [Math.max(gap.offset, offset), Math.min(gapEnd, end)];
      if (from >= to) {
        left.push(gap);
        continue;
      }
      for (let at = from; at < to; at += kPieceBytes) taken.push({ offset: at, bytes: Math.min(kPieceBytes, to - at) });
      if (gap.offset < from) left.push({ offset: gap.offset, bytes: from - gap.offset });
      if (to < gapEnd) left.push({ offset: to, bytes: gapEnd - to });
    }
    this.gaps = left;
    return taken;
  }
}

/** What openEarly needs: all but the large sections, and of these the beginning, which has their frame tables. */
function beforeGaussians(sections: readonly Section[], total: number): Range[] {
  const ranges: Range[] = [];
  let at = 0;
  for (const { type, offset, storedBytes } of [...sections].sort((a, b) => a.offset - b.offset)) {
    if (!kLarge.has(type)) continue;
    ranges.push({ offset: at, bytes: offset + Math.min(storedBytes, kFirstBytes) - at });
    at = offset + storedBytes;
  }
  return [...ranges, { offset: at, bytes: total - at }];
}

/** Groups together, so that there are few requests and few parts: each part as much as all before it, up to kMostGroups. */
function partsOf({ nChunks, ranges }: Groups): { firstChunk: number; nChunks: number; ranges: Range[] }[] {
  const parts = [];
  for (let first = 0; first < ranges.length; ) {
    const count = Math.min(Math.max(1, first), kMostGroups, ranges.length - first);
    const last = ranges[first + count - 1] as readonly Range[];
    // Groups lie one behind the other in each section.
    const together = (ranges[first] as readonly Range[]).map(({ offset }, i) => {
      const end = last[i] as Range;
      return { offset, bytes: end.offset + end.bytes - offset };
    });
    parts.push({ firstChunk: first * nChunks, nChunks: count * nChunks, ranges: together });
    first += count;
  }
  return parts;
}

/** Some at a time, in order. */
async function inLanes<T>(items: readonly T[], work: (item: T) => Promise<void>): Promise<void> {
  const queue = items.values();
  const lane = async (): Promise<void> => {
    for (const item of queue) await work(item);
  };
  await Promise.all(Array.from({ length: kPieces }, lane));
}

/** All of a file, some pieces at a time; the first failure stops the others. */
async function inPieces(
  total: number,
  signal: AbortSignal | undefined,
  piece: (range: Range, stop: AbortSignal) => Promise<void>,
): Promise<void> {
  const stop = new AbortController();
  const abort = (): void => stop.abort(signal?.reason);
  signal?.addEventListener("abort", abort, { once: true });
  let next = 0;
  const lane = async (): Promise<void> => {
    while (next < total) {
      const offset = next;
      const bytes = Math.min(kPieceBytes, total - offset);
      next += bytes;
      await piece({ offset, bytes }, stop.signal);
    }
  };
  try {
    await Promise.all(Array.from({ length: kPieces }, lane));
  } catch (error) {
    stop.abort(error);
    throw error;
  } finally {
    signal?.removeEventListener("abort", abort);
  }
}

/** What the worker would say of the file, before all of it has come from a server without ranges. */
function checkMagic(beginning: Uint8Array): void {
  const offset = kMagic.findIndex((byte, i) => i < beginning.length && beginning[i] !== byte);
  if (offset >= 0) throw new RgsError({ code: "bad_magic", text: "not an .rgs file (wrong magic bytes)", offset });
}

async function sourceOf(source: Source, options: OpenOptions): Promise<RangeSource> {
  if (source instanceof ArrayBuffer) return new MemorySource(new Uint8Array(source));
  if (ArrayBuffer.isView(source)) {
    return new MemorySource(new Uint8Array(source.buffer as ArrayBuffer, source.byteOffset, source.byteLength));
  }
  if (typeof Blob !== "undefined" && source instanceof Blob) return new BlobSource(source);
  if (typeof source === "string" || source instanceof URL) {
    const onProgress = (soFar: Uint8Array, total: number | undefined): void => {
      checkMagic(soFar);
      options.onProgress?.({ phase: "read", done: soFar.length, total });
    };
    return UrlSource.open(String(source), options.url ?? {}, options.signal, onProgress, options.limits?.maxFileBytes);
  }
  // What it gives may be part of something that it keeps, and buffers are handed over whole.
  const own = source as RangeSource;
  return {
    size: own.size,
    read: async (offset, bytes, signal) => new Uint8Array(await own.read(offset, bytes, signal)),
  };
}

/** Opens a file with a worker that `start` makes: see web.ts and node.ts. */
export async function openWith(start: () => Port, source: Source, options: OpenOptions): Promise<RgsFile> {
  const { signal } = options;
  signal?.throwIfAborted();
  const from = await sourceOf(source, options);
  const client = new Client(start());
  try {
    const limits = options.limits ?? {};
    await client.call("start", { limits, wasm: options.wasm }, { signal });
    const send = (offset: number, bytes: Uint8Array): Promise<void> =>
      client.call("part", { offset, bytes }, { signal, transfer: [own(bytes)] });
    const part = async (range: Range): Promise<void> => send(range.offset, await readExactly(from, range, signal));
    // A file of unknown size is taken to be as long as its header says, unless it ends before that can be seen.
    let size = from.size ?? Number.MAX_SAFE_INTEGER;
    const first = { offset: 0, bytes: Math.min(kFirstBytes, size) };
    if (from.size === undefined) {
      const beginning = await from.read(first.offset, first.bytes, signal);
      if (beginning.length < first.bytes) size = beginning.length;
      await send(0, beginning);
    } else {
      await part(first);
    }
    const fileBytes = size === Number.MAX_SAFE_INTEGER ? -1 : size;
    for (;;) {
      const missing = (await client.call("needs", { fileBytes }, { signal })).filter(
        ({ offset, bytes }) => offset + bytes <= size,
      );
      if (missing.length === 0) break;
      await Promise.all(missing.map(part));
    }
    const { head, unread: table } = await client.call("openParts", { fileBytes }, { signal });
    let unread = table;
    while (unread && unread.bytes > 0) {
      const bytes = Math.min(kPieceBytes, unread.bytes, Math.max(0, size - unread.offset));
      if (bytes === 0) {
        throw new RgsError({ code: "truncated", text: "the file ends before its first page", offset: size });
      }
      const range = { offset: unread.offset, bytes };
      const records = await readExactly(from, range, signal);
      const before: number = unread.bytes;
      unread = await client.call("extend", { offset: range.offset, bytes: records }, { signal, transfer: [own(records)] });
      if (unread.bytes === before) {
        throw new RgsError({ code: "truncated", text: "the file ends inside its table of pages", offset: size });
      }
    }
    const levels = unread ? new Levels(await client.call("levels", {}, { signal })) : null;
    return new RgsFile(client, from, parseHead(head.values, head.text), levels, fileBytes);
  } catch (error) {
    client.end();
    throw error;
  }
}
