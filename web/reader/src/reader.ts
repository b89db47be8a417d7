// reader.ts - opens a file, and reads it whole, part by part, or by pages.
// SPDX-License-Identifier: Apache-2.0
import { Client, type Port } from "./client.js";
import type { Gaussians, Groups, Limits, Range, StoredGaussians } from "./decoder.js";
import { RgsError } from "./errors.js";
import {
  type Box,
  type Declarations,
  type FirstView,
  type Head,
  type Header,
  Levels,
  parseHead,
  type Provenance,
  type Section,
} from "./head.js";
import { kAnyGroup, type PageEvent, type PageSchedule, PageScheduler } from "./pages.js";
import type { Requests } from "./service.js";
import type { Spz } from "./spz.js";
import { BlobSource, MemorySource, type RangeSource, UrlSource, type UrlOptions } from "./source.js";

/** What open() reads: a URL (also as text), a Blob such as a File, a buffer or a view of one, or the caller's own ranges. */
export type Source = ArrayBuffer | ArrayBufferView | Blob | URL | string | RangeSource;

/** How far a call is. */
export interface Progress {
  phase: "read" | "decode";
  /** Bytes while reading, Gaussians while decoding. */
  done: number;
  /** Undefined while it is not known. */
  total: number | undefined;
}

/** Options of every call that reads. */
export interface ReadOptions {
  /** Stops the call, which rejects with the signal's reason. */
  signal?: AbortSignal | undefined;
  /** Called after each piece. */
  onProgress?: ((progress: Progress) => void) | undefined;
}

/** Options of open(). */
export interface OpenOptions extends ReadOptions {
  /** For files that are not trusted. */
  limits?: Limits;
  /** Of the table of pages, "beginning" reads what the first 64 KiB have; the rest is up to readTable(). */
  table?: "whole" | "beginning";
  /** For a URL. */
  url?: UrlOptions;
  /** The compiled rgs.wasm, for callers that load it themselves; otherwise the worker fetches it from beside its script. */
  wasm?: WebAssembly.Module;
  /** In browsers: starts a worker that runs `@roofgs/reader/worker`, if it cannot be loaded from beside the script. */
  worker?: () => Worker;
}

/** docs/format/FORMAT.md, "Shape of the file". */
const kMagic = [0x89, 0x52, 0x47, 0x53, 0x0d, 0x0a, 0x1a, 0x0a];
const kFirstBytes = 1 << 16;
const kPieceBytes = 1 << 22;
/** Of the table of pages where a view waits for it. */
const kTableBytes = 1 << 17;
/** Most requests in flight. */
const kPieces = 3;
/** Sections that grow with the scene. */
const kLarge = new Set(["MEAN", "GEOM", "SHI8", "PERM"]);
/** Most groups in a part, which bounds the memory for parts. */
const kMostGroups = 16;

/** An opened file; a worker of its own decodes it until close(). */
export class RgsFile {
  /** Counts, SH degree, version. */
  readonly header: Header;
  /** What the file states of its scene: axes, anti-aliasing, units, origin, boxes. */
  readonly declarations: Declarations;
  /** Where the file comes from: untrusted texts. Null if it has none, or if it lies behind pages and has not been read. */
  readonly provenance: Provenance | null;
  /** The table of sections, in its order. */
  readonly sections: readonly Section[];
  /** The tree of pages, coarse to fine. Null without levels of detail. */
  readonly levels: Levels | null;
  /** Actual bytes of the file; may be fewer than its header says. */
  readonly fileBytes: number;
  private last: Promise<unknown> = Promise.resolve();
  private subject: Box | null;

  /** @internal */
  constructor(
    private readonly client: Client,
    private readonly source: RangeSource,
    head: Head,
    levels: Levels | null,
    fileBytes: number,
    subject: Box | null,
  ) {
    this.subject = subject;
    this.fileBytes = fileBytes < 0 ? head.header.fileBytes : fileBytes;
    this.header = head.header;
    this.declarations = head.declarations;
    this.provenance = head.provenance;
    this.sections = head.sections;
    this.levels = levels;
  }

  /**
   * All Gaussians of the finest level, activated. Reads the whole file and checks every checksum and every value. Peak memory is the
   * file and the result.
   */
  async read(options: ReadOptions = {}): Promise<Gaussians> {
    return (await this.readAll(options)).gaussians;
  }

  /** What read() gives, and positions in the source, FP64 [n] from 0; null if the file keeps none. */
  readAll(options: ReadOptions = {}): Promise<{ gaussians: Gaussians; sourceIndex: Float64Array | null }> {
    const { nGaussians: n, shDegree } = this.header;
    return this.whole(options, (call) => this.client.call("wholeGaussians", { n, shDegree }, call));
  }

  /**
   * All Gaussians as a GPU reads them: FP16 geometry, SH codes with their steps; not with levels of detail. There pages have step sets
   * and a scale exponent of their own: bad_argument, use storedParts().
   */
  async readStored(options: ReadOptions = {}): Promise<StoredGaussians> {
    if (this.levels) {
      throw new RgsError({ code: "bad_argument", text: "a file with levels of detail is read by storedParts() or by page" });
    }
    const { nGaussians: n, ...shape } = this.shape;
    return (await this.whole(options, (call) => this.client.call("wholeStored", { n, shape }, call))).gaussians;
  }

  /**
   * The same of any file in parts, for `for await`, while the file is read; with levels of detail they are the leaves, in order. Else
   * the first part has some ten thousand Gaussians, and each further one doubles the count. Parts are checked when they are given;
   * without levels the file as a whole is checked when the generator ends, and other read() calls wait until then.
   */
  async *storedParts(options: ReadOptions = {}): AsyncGenerator<StoredGaussians, void, undefined> {
    if (this.levels) return yield* this.storedLeaves(this.levels, options);
    const { signal, onProgress } = options;
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
    let inFlight: Promise<void> = Promise.resolve();
    const load = (ranges: readonly Range[]): Promise<void> =>
      inLanes(ranges.flatMap((range) => unread.take(range)), async (range) => {
        await this.wholePart(range, stop.signal);
        read += range.bytes;
        onProgress?.({ phase: "read", done: read, total });
      });
    // Reports the same defect as read(), if there are several.
    const asRead = async (error: unknown): Promise<never> => {
      if (stop.signal.aborted) throw error;
      await inFlight;
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
        const { gaussians } = await this.client.call("wholeStored", { n, shape }, call);
        this.subject = await this.client.call("subjectBox", {}, call);
        yield gaussians;
        return;
      }
      this.subject = await this.client.call("subjectBox", {}, call);
      const parts = partsOf(groups);
      inFlight = load(parts[0]?.ranges ?? []);
      for (const [i, { ranges: _, ...chunks }] of parts.entries()) {
        await inFlight;
        // Read one part ahead of decoding.
        inFlight = load(parts[i + 1]?.ranges ?? all);
        inFlight.catch(() => undefined);
        yield await this.client.call("nextEarly", { ...chunks, shape }, call).catch(asRead);
      }
      await inFlight;
      await load(all);
      await this.client.call("finishEarly", {}, call).catch(asRead);
      onProgress?.({ phase: "decode", done: n, total: n });
    } finally {
      stop.abort(new RgsError({ code: "cancelled", text: "the caller stopped reading" }));
      signal?.removeEventListener("abort", abort);
      // Before that the memory belongs to another read.
      if (hasBegun) await this.client.call("endWhole", {}).catch(() => undefined);
      end();
    }
  }

  /**
   * What a view without cameras looks at (docs/user/CAMERAS.md), relative to the origin. Null without levels of detail, until the first
   * of storedParts().
   */
  get subjectBox(): Box | null {
    return this.subject;
  }

  /** The view from which the file states that its scene is seen first. Null: none. */
  get firstView(): FirstView | null {
    return this.declarations.firstView;
  }

  /** Pages 0 .. nPresent - 1 lie within the actual file, which may be cut off: then known pages alone may count. */
  get nPresent(): number {
    const { levels } = this;
    let low = 0;
    let high = levels?.nPages ?? 0;
    if (this.fileBytes >= this.header.fileBytes) return high;
    while (low < high) {
      const middle = (low + high) >>> 1;
      if (this.isPresent(middle)) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /**
   * Reads more of the table of pages: from the first unknown child of page `group` on, or from the first unknown page of all. Returns
   * what to tell the scheduler, whose readTable asks for it. One at a time, of about `most` bytes.
   * Errors: those of open() for the table; bad_argument without levels; RangeError.
   */
  async readTable(group = kAnyGroup, options: ReadOptions = {}, most = kTableBytes): Promise<PageEvent> {
    const { signal } = options;
    const { tree } = this;
    if (group !== kAnyGroup) tree.page(group);
    const range = await this.client.call("unreadTable", { below: group, most: Math.max(112, Math.min(most, kPieceBytes)) }, { signal });
    const bytes = await readExactly(this.source, range, signal);
    // To its end, so that both sides know the same.
    const values = await this.client.call("extend", { below: group, offset: range.offset, bytes }, { transfer: [own(bytes)] });
    return ["tableGrew", group, tree.extend(values)];
  }

  /** Gaussians of a page, by one request; checks its checksum and every value. pages_missing beyond nPresent. */
  async readPage(page: number, options: ReadOptions = {}): Promise<Gaussians> {
    const bytes = await this.storedPage(page, options);
    const { shDegree } = this.header;
    return this.client.call("page", { page, bytes, shDegree }, { ...options, onProgress: undefined, transfer: [own(bytes)] });
  }

  /** Gaussians of a page as a GPU reads them, by one request; checks its checksum and every value. pages_missing beyond nPresent. */
  async readPageStored(page: number, options: ReadOptions = {}): Promise<StoredGaussians> {
    const bytes = await this.storedPage(page, options);
    const { nGaussians: _, ...shape } = this.shape;
    shape.scaleExponent = this.tree.page(page).scaleExponent;
    const call = { ...options, onProgress: undefined, transfer: [own(bytes)] };
    return this.client.call("pageStored", { page, bytes, shape }, call);
  }

  /**
   * Decides which pages a view draws, and which are read, kept and evicted; your code carries that out. It runs on the caller's thread,
   * so a busy worker does not hold it up.
   */
  async pageScheduler(schedule: PageSchedule): Promise<PageScheduler> {
    const { pageNumbers } = this.tree;
    return PageScheduler.start(await this.client.call("module", {}), pageNumbers, schedule);
  }

  /** Ends the worker; calls in progress reject. */
  close(): void {
    this.client.end();
  }

  private get shape(): { nGaussians: number; shDegree: number; chunkSize: number; scaleExponent: number } {
    const { nGaussians, shDegree, chunkSize, scaleExponent } = this.header;
    return { nGaussians, shDegree, chunkSize, scaleExponent };
  }

  /** bad_argument without levels of detail. */
  private get tree(): Levels {
    if (this.levels) return this.levels;
    throw new RgsError({ code: "bad_argument", text: "the file has no levels of detail, so it has no pages" });
  }

  /** Reads one leaf ahead of what is taken. */
  private async *storedLeaves(levels: Levels, { signal, onProgress }: ReadOptions): AsyncGenerator<StoredGaussians, void, undefined> {
    while (!levels.isComplete) await this.readTable(kAnyGroup, { signal }, kPieceBytes);
    const leaves = levels.ofLevel(0).map(({ index }) => index);
    const read = (page: number | undefined): Promise<StoredGaussians> | undefined => {
      const part = page === undefined ? undefined : this.readPageStored(page, { signal });
      part?.catch(() => undefined); // reported when it is taken
      return part;
    };
    let done = 0;
    let next = read(leaves[0]);
    for (let i = 1; next; ++i) {
      const part = await next;
      next = read(leaves[i]);
      done += part.n;
      onProgress?.({ phase: "decode", done, total: this.header.nGaussians });
      yield part;
    }
  }

  private isPresent(index: number): boolean {
    const { levels } = this;
    if (!levels?.isKnown(index)) return false;
    const { offset, storedBytes } = levels.page(index);
    return offset + storedBytes <= this.fileBytes;
  }

  private async storedPage(page: number, options: ReadOptions): Promise<Uint8Array> {
    const { offset, storedBytes } = this.tree.page(page);
    if (!this.isPresent(page)) {
      throw new RgsError({
        code: "pages_missing",
        text: "the end of the file is missing, including this page",
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

/** The buffer of bytes that nobody else uses, to be transferred. */
function own(bytes: Uint8Array): ArrayBuffer {
  return bytes.buffer as ArrayBuffer;
}

/** `result`, or a rejection with the signal's reason as soon as it aborts. */
function untilAborted<T>(result: Promise<T>, signal: AbortSignal | undefined): Promise<T> {
  if (!signal) return result;
  return new Promise((resolve, reject) => {
    const abort = (): void => reject(signal.reason);
    if (signal.aborted) abort();
    signal.addEventListener("abort", abort, { once: true });
    result.then(resolve, reject).finally(() => signal.removeEventListener("abort", abort));
  });
}

/** Checks the number of bytes, because the source may be the caller's. */
async function readExactly(source: RangeSource, range: Range, signal: AbortSignal | undefined): Promise<Uint8Array> {
  signal?.throwIfAborted();
  const bytes = range.bytes === 0 ? new Uint8Array(0) : await source.read(range.offset, range.bytes, signal);
  signal?.throwIfAborted();
  if (bytes.length !== range.bytes) {
    throw new RgsError({
      code: "read_failed",
      text: "the source returned the wrong number of bytes",
      offset: range.offset,
      expected: BigInt(range.bytes),
      found: BigInt(bytes.length),
    });
  }
  return bytes;
}

/** The bytes of a file that have not been requested yet. */
class Unread {
  private gaps: Range[];
  constructor(bytes: number) {
    this.gaps = [{ offset: 0, bytes }];
  }

  /** Takes those within a range, in pieces. */
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

/** The ranges that openEarly needs: everything but the large sections, and their beginnings, which hold the frame tables. */
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

/** Joins groups into parts, each as large as all before it together, up to kMostGroups. */
function partsOf({ nChunks, ranges }: Groups): { firstChunk: number; nChunks: number; ranges: Range[] }[] {
  const parts = [];
  for (let first = 0; first < ranges.length; ) {
    const count = Math.min(Math.max(1, first), kMostGroups, ranges.length - first);
    const last = ranges[first + count - 1] as readonly Range[];
    // Groups are contiguous in each section.
    const together = (ranges[first] as readonly Range[]).map(({ offset }, i) => {
      const end = last[i] as Range;
      return { offset, bytes: end.offset + end.bytes - offset };
    });
    parts.push({ firstChunk: first * nChunks, nChunks: count * nChunks, ranges: together });
    first += count;
  }
  return parts;
}

/** Starts the work in order, kPieces at a time. */
async function inLanes<T>(items: readonly T[], work: (item: T) => Promise<void>): Promise<void> {
  const queue = items.values();
  const lane = async (): Promise<void> => {
    for (const item of queue) await work(item);
  };
  await Promise.all(Array.from({ length: kPieces }, lane));
}

/** A whole file, kPieces at a time; the first failure stops the others. */
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

/** Checks the magic as the worker would, before a server without ranges has sent the whole file. */
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
  // A copy, because buffers are transferred whole and the caller may keep its own.
  const own = source as RangeSource;
  return {
    size: own.size,
    read: async (offset, bytes, signal) => new Uint8Array(await own.read(offset, bytes, signal)),
  };
}

/** `start` starts the worker: see web.ts and node.ts. */
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
    // If the size is unknown, the header's is used, unless the first bytes show the end of the file.
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
    const { head, levels, subject } = await client.call("openParts", { fileBytes }, { signal });
    const file = new RgsFile(client, from, parseHead(head.values, head.text), levels && new Levels(levels), fileBytes, subject);
    if (options.table !== "beginning") {
      while (file.levels?.isComplete === false) await file.readTable(kAnyGroup, options, kPieceBytes);
    }
    return file;
  } catch (error) {
    client.end();
    throw error;
  }
}

/** One request to a worker of its own. */
async function askWorker<K extends keyof Requests>(start: () => Port, name: K, args: Requests[K][0], { wasm }: Pick<OpenOptions, "wasm">): Promise<Requests[K][1]> {
  const client = new Client(start());
  try {
    await client.call("start", { limits: {}, wasm });
    return await client.call(name, args);
  } finally {
    client.end();
  }
}

export function subjectBoxWith(start: () => Port, means: Float32Array, opacities: Float32Array, options: Pick<OpenOptions, "wasm">): Promise<Box> {
  return askWorker(start, "subjectBoxOf", { means, opacities }, options);
}

export function readSpzWith(start: () => Port, bytes: Uint8Array<ArrayBuffer>, options: Pick<OpenOptions, "wasm">): Promise<Spz> {
  return askWorker(start, "spz", { bytes }, options);
}
