// pages.ts - decides the life of a file's pages: the scheduler of runtime/pages. docs/develop/PAGES.md.
// SPDX-License-Identifier: Apache-2.0
import type { Heap } from "./decoder.js";
import { outOfMemory } from "./errors.js";

/** What a scheduler may use: it shares nothing with others. */
export interface PageSchedule {
  /** Memory for pages beside the root; a page takes pageBytes and rowBytes for each Gaussian. */
  budget: number;
  pageBytes: number;
  rowBytes: number;
  /** Reads that may be in flight. */
  nReaders: number;
  /** Of one read, and of what it skips between groups. */
  mostBytes: number;
  gapBytes: number;
  /** Whether pages are read that a moving camera is about to see. */
  prefetches: boolean;
}

/** A camera, and what its picture asks for. */
export interface Look {
  /** Relative to the scene's origin. */
  position: readonly number[];
  /** The larger focal length. */
  focalPx: number;
  /** Declarations.zNear: nearer pages count as this near. */
  zNear: number;
  /** Projected error that is allowed, pixels; 0 draws leaves. */
  detailPx: number;
  /** Most Gaussians of the cut, in and out of view: a coarser detail is drawn where detailPx has more. */
  mostGaussians: number;
  /** Pages outside it are neither drawn nor wanted; without it the view sees everything. `rotation`: [9] world to camera. */
  picture?: { width: number; height: number; fx: number; fy: number; cx: number; cy: number; lowPassPx2: number; rotation: readonly number[] };
}

const kFaults = ["lost", "checksum", "damaged"] as const;

// In the order of WireEvent in runtime/pages/wire.hpp.
const kEvents = ["looks", "frame", "frameEnds", "idle", "done", "arrived", "failed", "probed", "take", "release", "tableGrew", "tableFailed"] as const;

/** What the caller tells the scheduler: a name and fields. A group is the children of one page, and has its number. */
export type PageEvent =
  | readonly ["looks", view: number, look: Look]
  /** Draw follows; its pages stay until the frame ends. */
  | readonly ["frame", view: number]
  /** The oldest frame of the view. */
  | readonly ["frameEnds", view: number]
  /** A reader has nothing to do. */
  | readonly ["idle"]
  /** A reader has ended what it was asked to do. */
  | readonly ["done"]
  | readonly ["arrived", group: number]
  /** Groups first .. first + n - 1 of a read. */
  | readonly ["failed", first: number, n: number, fault: (typeof kFaults)[number]]
  | readonly ["probed", isThere: boolean]
  /** Of the budget, for other things than pages: taken. */
  | readonly ["take", bytes: number]
  | readonly ["release", bytes: number]
  /** As RgsFile.readTable() returns it. */
  | readonly ["tableGrew", group: number, pages: Float64Array]
  | readonly ["tableFailed", fault: (typeof kFaults)[number]];

/** Of readTable: the first page of all that is not known. */
export const kAnyGroup = 0xffffffff;

/** What the caller carries out; pages of a group are the children of one page. */
export type PageAction =
  /** Read and decode groups first .. first + n - 1. */
  | { is: "read"; first: number; n: number }
  /** Read again what could be read before. */
  | { is: "probe" }
  | { is: "evict"; group: number }
  | { is: "draw"; view: number; pages: number[] }
  | { is: "taken"; isTaken: boolean }
  /** Idle readers should ask again at that time. */
  | { is: "wakeAt"; at: number }
  | { is: "wake" }
  /** RgsFile.readTable(group) */
  | { is: "readTable"; group: number };

interface Exports extends Heap {
  rgs_pages_new(setup: number, nSetup: number, pages: number, nPages: number): number;
  rgs_pages_add_view(wire: number): number;
  rgs_pages_step(wire: number, events: number, n: number, now: number): number;
  rgs_pages_actions(): number;
  rgs_pages_error_px(wire: number, view: number, page: number): number;
  rgs_pages_wanted(wire: number, view: number): number;
  rgs_pages_quarantined(wire: number): number;
}

const kMillisecond = 1e6;

function lookNumbers({ position, focalPx, zNear, detailPx, mostGaussians, picture }: Look): number[] {
  const numbers = [...position, focalPx, zNear, detailPx, mostGaussians];
  if (!picture) return [...numbers, 0];
  const { width, height, fx, fy, cx, cy, lowPassPx2, rotation } = picture;
  return [...numbers, width, height, fx, fy, cx, cy, lowPassPx2, ...rotation];
}

function eventNumbers([name, ...fields]: PageEvent): number[] {
  const numbersOf = (field: (typeof fields)[number]): Iterable<number> => {
    if (typeof field !== "object") return [typeof field === "string" ? kFaults.indexOf(field) : Number(field)];
    return field instanceof Float64Array ? field : lookNumbers(field);
  };
  return [kEvents.indexOf(name), ...fields.flatMap((field) => [...numbersOf(field)])];
}

/** Codes as in WireAction in runtime/pages/wire.hpp. */
function* actionsOf(numbers: Float64Array): Generator<PageAction> {
  let at = 0;
  const next = (): number => numbers[at++] as number;
  while (at < numbers.length) {
    switch (next()) {
      case 0:
        yield { is: "read", first: next(), n: next() };
        break;
      case 1:
        yield { is: "probe" };
        break;
      case 2:
        yield { is: "evict", group: next() };
        break;
      case 3: {
        const view = next();
        const n = next();
        yield { is: "draw", view, pages: [...numbers.subarray(at, at + n)] };
        at += n;
        break;
      }
      case 4:
        yield { is: "taken", isTaken: next() === 1 };
        break;
      case 5:
        yield { is: "wakeAt", at: next() / kMillisecond };
        break;
      case 6:
        yield { is: "wake" };
        break;
      default:
        yield { is: "readTable", group: next() };
    }
  }
}

/** Decides which pages a view draws, and which are read, kept and evicted: events go in, actions come out. */
export class PageScheduler {
  private readonly wire: number;

  private constructor(
    private readonly wasm: Exports,
    pages: Float64Array,
    setup: readonly number[],
  ) {
    wasm._initialize();
    wasm.rgs_start();
    this.wire = this.with(setup, (at) => this.with(pages, (of) => wasm.rgs_pages_new(at, setup.length, of, pages.length)));
  }

  /** @internal */
  static async start(module: WebAssembly.Module, pages: Float64Array, schedule: PageSchedule): Promise<PageScheduler> {
    const { budget, pageBytes, rowBytes, nReaders, mostBytes, gapBytes, prefetches } = schedule;
    return PageScheduler.startNumbers(module, pages, [budget, pageBytes, rowBytes, nReaders, mostBytes, gapBytes, Number(prefetches)]);
  }

  /** @internal */
  static async startNumbers(module: WebAssembly.Module, pages: Float64Array, setup: readonly number[]): Promise<PageScheduler> {
    const unwind = (): never => {
      throw outOfMemory();
    };
    const { exports } = await WebAssembly.instantiate(module, { rgs: { out_of_memory: unwind } });
    return new PageScheduler(exports as unknown as Exports, pages, setup);
  }

  /** Returns the number of a new view: a picture that is drawn again and again. */
  addView(): number {
    return this.wasm.rgs_pages_add_view(this.wire);
  }

  /** Takes what has happened, in order, and returns what to do, in order. `now`: milliseconds, never less than before. */
  step(events: readonly PageEvent[], now: number): PageAction[] {
    return [...actionsOf(this.stepNumbers(events.flatMap(eventNumbers), Math.round(now * kMillisecond)))];
  }

  /** Events and actions as runtime/pages/wire.hpp has them; `now` in nanoseconds. @internal */
  stepNumbers(events: readonly number[], now: number): Float64Array {
    const n = this.with(events, (at) => this.wasm.rgs_pages_step(this.wire, at, events.length, now));
    return new Float64Array(this.wasm.memory.buffer, this.wasm.rgs_pages_actions() >>> 0, n).slice();
  }

  /** Projected error of a page for the camera that the view had last, pixels. */
  errorPx(view: number, page: number): number {
    return this.wasm.rgs_pages_error_px(this.wire, view, page);
  }

  /** Groups that the view's last frame wanted and that are in flight or can be requested, now or after a pause. */
  nWanted(view: number): number {
    return this.wasm.rgs_pages_wanted(this.wire, view);
  }

  /** Groups that are too damaged to be read again; a table of pages that is counts as one. */
  get nQuarantined(): number {
    return this.wasm.rgs_pages_quarantined(this.wire);
  }

  private with<T>(values: Float64Array | readonly number[], f: (address: number) => T): T {
    const address = this.wasm.rgs_allocate(8 * values.length) >>> 0;
    if (address === 0) throw outOfMemory();
    new Float64Array(this.wasm.memory.buffer, address, values.length).set(values);
    const result = f(address);
    this.wasm.rgs_free(address);
    return result;
  }
}
