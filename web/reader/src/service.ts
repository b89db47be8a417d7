// service.ts - the worker: answers the requests about one file, one after the other.
// SPDX-License-Identifier: Apache-2.0
import { buffersOf, Decoder, type Gaussians, type Groups, type Limits, type Range, type StoredGaussians } from "./decoder.js";
import { RgsError, type RgsErrorFields } from "./errors.js";
import { type Box, parseHead } from "./head.js";
import { type Spz, unpackSpz } from "./spz.js";

interface Shape {
  shDegree: number;
  chunkSize: number;
  scaleExponent: number;
}

/** Requests, with arguments and result. */
export interface Requests {
  start: [{ limits: Limits; wasm?: WebAssembly.Module | undefined }, void];
  part: [{ offset: number; bytes: Uint8Array }, void];
  needs: [{ fileBytes: number }, Range[]];
  /** `levels` and `subject`, of the pages that are known: null without levels of detail. */
  openParts: [{ fileBytes: number }, { head: { values: Float64Array; text: Uint8Array }; levels: Float64Array | null; subject: Box | null }];
  unreadTable: [{ below: number; most: number }, Range];
  /** For Levels. */
  extend: [{ below: number; offset: number; bytes: Uint8Array }, Float64Array];
  /** The compiled rgs.wasm. */
  module: [Record<string, never>, WebAssembly.Module];
  page: [{ page: number; bytes: Uint8Array; shDegree: number }, Gaussians];
  pageStored: [{ page: number; bytes: Uint8Array; shape: Shape }, StoredGaussians];
  /** Allocates memory for the whole file. */
  whole: [{ bytes: number }, void];
  wholePart: [{ offset: number; bytes: Uint8Array }, void];
  wholeGaussians: [{ n: number; shDegree: number }, { gaussians: Gaussians; sourceIndex: Float64Array | null }];
  wholeStored: [{ n: number; shape: Shape }, { gaussians: StoredGaussians; sourceIndex: Float64Array | null }];
  /** Null if the file cannot be decoded while it is read, for instance because it is damaged. */
  openEarly: [Record<string, never>, Groups | null];
  nextEarly: [{ firstChunk: number; nChunks: number; shape: Shape }, StoredGaussians];
  finishEarly: [Record<string, never>, void];
  /** After openEarly or wholeStored. */
  subjectBox: [Record<string, never>, Box];
  subjectBoxOf: [{ means: Float32Array; opacities: Float32Array }, Box];
  spz: [{ bytes: Uint8Array<ArrayBuffer> }, Spz];
  /** Releases the memory of the whole file. */
  endWhole: [Record<string, never>, void];
  /** Ends the request of that id with `cancelled`, if it waits or runs. */
  cancel: [{ id: number }, void];
}
export type Request = { [K in keyof Requests]: { id: number; name: K; args: Requests[K][0] } }[keyof Requests];
export type Answer =
  | { id: number; progress: number }
  | { id: number; result: unknown }
  | { id: number; error: RgsErrorFields };

export type Send = (answer: Answer, transfer: ArrayBuffer[]) => void;

/** Lets messages arrive. A timer would wait 4 ms in browsers. */
function turn(): Promise<void> {
  return new Promise((resolve) => {
    const { port1, port2 } = new MessageChannel();
    port2.onmessage = () => {
      port1.close();
      resolve();
    };
    port1.postMessage(0);
  });
}

/** Header, declarations and sections with their checksums. */
function identityOf(decoder: Decoder): string {
  const { values, text } = decoder.head();
  const { header, declarations, sections } = parseHead(values, text);
  return JSON.stringify([header, declarations, sections.map((section) => ({ ...section, xxh3: String(section.xxh3) }))]);
}

export class Service {
  private module: WebAssembly.Module | undefined;
  private limits: Limits = {};
  private decoder: Decoder | undefined;
  private whole: { decoder: Decoder; address: number; bytes: number } | undefined;
  private readonly cancelled = new Set<number>();  // ids of requests that wait or run
  private readonly open = new Set<number>();
  private last: Promise<void> = Promise.resolve();

  /** `load` is called if no request brings the module. Messages are let in every `turnMs` of work. */
  constructor(
    private readonly load: () => Promise<WebAssembly.Module>,
    private readonly send: Send,
    private readonly turnMs = 30,
  ) {}

  receive(request: Request): void {
    if (request.name === "cancel") {
      if (this.open.has(request.args.id)) this.cancelled.add(request.args.id);
      return;
    }
    this.open.add(request.id);
    this.last = this.last.then(() => this.answer(request));
  }

  private async answer(request: Request): Promise<void> {
    try {
      if (this.cancelled.has(request.id)) throw new RgsError({ code: "cancelled", text: "stopped by the caller" });
      const result = await this.perform(request);
      const buffers = result !== null && typeof result === "object" ? buffersOf(result) : [];
      const nested = result as { gaussians?: object; streams?: object };
      for (const each of [nested?.gaussians, nested?.streams]) if (each) buffers.push(...buffersOf(each));
      this.send({ id: request.id, result }, [...new Set(buffers)]);
    } catch (error) {
      const fields =
        error instanceof RgsError ? error.fields : { code: "internal" as const, text: `the worker failed: ${String(error)}` };
      this.send({ id: request.id, error: fields }, []);
    } finally {
      this.open.delete(request.id);
      this.cancelled.delete(request.id);
    }
  }

  private async perform(request: Request): Promise<unknown> {
    switch (request.name) {
      case "start":
        this.module = request.args.wasm ?? (await this.load());
        this.limits = request.args.limits;
        this.decoder = new Decoder(this.module, this.limits);
        return undefined;
      case "part":
        return this.opened.addPart(request.args.offset, request.args.bytes);
      case "needs":
        return this.opened.needs(request.args.fileBytes);
      case "openParts": {
        const hasLevels = this.opened.openParts(request.args.fileBytes);
        const levels = hasLevels ? this.opened.levels() : null;
        return { head: this.opened.head(), levels, subject: hasLevels ? this.opened.subjectBox() : null };
      }
      case "unreadTable":
        return this.opened.unreadTable(request.args.below, request.args.most);
      case "extend":
        return this.opened.extend(request.args.below, request.args.offset, request.args.bytes);
      case "module":
        return this.module;
      case "page":
        return this.opened.readPage(request.args.page, request.args.bytes, request.args.shDegree);
      case "pageStored":
        return this.opened.readPageStored(request.args.page, request.args.bytes, request.args.shape);
      case "whole": {
        // A separate instance, because WebAssembly memory never shrinks.
        const decoder = new Decoder(this.module as WebAssembly.Module, this.limits);
        const { bytes } = request.args;
        this.whole = { decoder, address: decoder.allocateWhole(bytes), bytes };
        return undefined;
      }
      case "wholePart": {
        const { decoder, address } = this.wholeFile;
        return decoder.putWhole(address, request.args.offset, request.args.bytes);
      }
      case "wholeGaussians": {
        const decoder = this.openWhole();
        const gaussians = await this.finish(request.id, decoder.gaussians(request.args.n, request.args.shDegree));
        return { gaussians, sourceIndex: decoder.sourceIndex() };
      }
      case "wholeStored": {
        const decoder = this.openWhole();
        const gaussians = await this.finish(request.id, decoder.storedGaussians(request.args.n, request.args.shape));
        return { gaussians, sourceIndex: decoder.sourceIndex() };
      }
      case "openEarly": {
        const { decoder, address, bytes } = this.wholeFile;
        try {
          const groups = decoder.openEarly(address, bytes);
          return identityOf(decoder) === identityOf(this.opened) ? groups : null;
        } catch (error) {
          if (error instanceof RgsError) return null;
          throw error;
        }
      }
      case "nextEarly": {
        const { firstChunk, nChunks, shape } = request.args;
        return this.wholeFile.decoder.nextEarly(firstChunk, nChunks, shape);
      }
      case "finishEarly":
        return this.wholeFile.decoder.finishEarly();
      case "subjectBox":
        return this.wholeFile.decoder.subjectBox();
      case "subjectBoxOf":
        return this.opened.subjectBoxOf(request.args.means, request.args.opacities);
      case "spz":
        return unpackSpz(this.opened, request.args.bytes);
      case "endWhole":
        this.whole = undefined;
        return undefined;
      case "cancel":
        return undefined;
    }
  }

  /** Opens the whole file; fails if it was replaced after the caller read its head. */
  private openWhole(): Decoder {
    const { decoder, address, bytes } = this.wholeFile;
    decoder.openWhole(address, bytes);
    if (identityOf(decoder) !== identityOf(this.opened)) {
      throw new RgsError({ code: "read_failed", text: "the file has changed since it was opened: open it again" });
    }
    return decoder;
  }

  /** Runs work to its end and lets messages in meanwhile. */
  private async finish<T>(id: number, work: Generator<number, T>): Promise<T> {
    for (let began = performance.now(); ; ) {
      const step = work.next();
      if (step.done === true) return step.value;
      if (performance.now() - began < this.turnMs) continue;
      this.send({ id, progress: step.value }, []);
      await turn();
      if (this.cancelled.has(id)) throw new RgsError({ code: "cancelled", text: "stopped by the caller" });
      began = performance.now();
    }
  }

  private get opened(): Decoder {
    if (!this.decoder) throw new Error("no start");
    return this.decoder;
  }
  private get wholeFile(): { decoder: Decoder; address: number; bytes: number } {
    if (!this.whole) throw new Error("no whole file");
    return this.whole;
  }
}
