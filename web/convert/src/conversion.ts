// conversion.ts - one conversion in one instance of rgs.wasm, in a worker.
// SPDX-License-Identifier: Apache-2.0
import type { RgsErrorCode, RgsErrorFields } from "@roofgs/reader";

export const kProfiles = ["packed", "direct", "archive:high", "archive:small", "archive:tiny"] as const;
export type Profile = (typeof kProfiles)[number];

/** What was found in the source and written. */
export interface Report {
  readonly sourceBytes: number;
  readonly bytes: number;
  /** Gaussians in the source, and of these in the output. */
  readonly nSource: number;
  readonly nWritten: number;
  readonly nRepaired: number;
  readonly sourceShDegree: number;
  readonly shDegree: number;
  /** 0 without levels of detail. */
  readonly nLevels: number;
  readonly nPages: number;
  /** Largest rounding of a coordinate, world units. */
  readonly positionRounding: number;
  /** Gaussians that have each kind of damage. */
  readonly defects: Readonly<Record<(typeof kDefects)[number], number>>;
}
const kDefects = ["mean", "scale", "rotation_nan", "rotation_zero", "opacity_nan", "sh"] as const;

export interface Progress {
  /** "read", then stages of rgs-convert: "scan", "sort", "encode", ... */
  readonly stage: string;
  readonly done: number;
  /** 0 if it is unknown. */
  readonly total: number;
  readonly unit: string;
}

export interface Job {
  source: Blob | Uint8Array | string;
  profile: Profile;
  levels: boolean;
  sourceName: string;
  tool: string | undefined;
  wasm: WebAssembly.Module | undefined;
}
export type Answer = { progress: Progress } | { blob: Blob; report: Report } | { error: RgsErrorFields };

/** An error of the closed list, for the other thread to throw. */
export class Failure extends Error {
  constructor(readonly fields: RgsErrorFields) {
    super(fields.text);
  }
}

interface Exports {
  memory: WebAssembly.Memory;
  _initialize(): void;
  rgs_start(): void;
  rgs_allocate(bytes: number): number;
  rgs_error(): void;
  rgs_numbers(): number;
  rgs_n_numbers(): number;
  rgs_text(): number;
  rgs_n_text(): number;
  rgs_convert(bytes: number, size: number, profile: number, levels: number, name: number, nName: number, tool: number, nTool: number): number;
  rgs_read_output(offset: number, to: number, bytes: number): void;
}

const kNone = 0xffffffffffffffffn;
const kPart = 2 ** 22;
/** What the C library allocates at once; the rest of 4 GiB is for the conversion. */
export const kMostSource = 2 ** 31 - 1;

function outOfMemory(): never {
  throw new Failure({ code: "host_out_of_memory", text: "this scene does not fit into the memory of a page; convert it with rgs-convert" });
}

/** `progress` is called at most every `pauseMs`, and when a stage begins. */
export async function convertJob(
  job: Job,
  load: () => Promise<WebAssembly.Module>,
  progress: (now: Progress) => void,
  pauseMs = 50,
): Promise<{ blob: Blob; report: Report }> {
  let now: Progress = { stage: "read", done: 0, total: 0, unit: "bytes" };
  let told = 0;
  const begin = (stage: string, total: number, unit: string): void => {
    now = { stage, done: 0, total, unit };
    told = performance.now();
    progress(now);
  };
  const advance = (units: number): void => {
    now = { ...now, done: now.done + units };
    if (performance.now() - told < pauseMs) return;
    told = performance.now();
    progress(now);
  };

  const bytes = (at: number, size: number): Uint8Array<ArrayBuffer> => new Uint8Array(wasm.memory.buffer as ArrayBuffer, at, size);
  const text = (at: number, size: number): string => new TextDecoder().decode(bytes(at, size));
  const textAt = (at: number): string => text(at, new Uint8Array(wasm.memory.buffer, at).indexOf(0));
  const instance = new WebAssembly.Instance(job.wasm ?? (await load()), {
    rgs: {
      out_of_memory: outOfMemory,
      begin: (stage: number, total: number, unit: number) => begin(textAt(stage), total, textAt(unit)),
      advance,
    },
    // Of the C++ library: the time that stages take, and messages before it aborts.
    wasi_snapshot_preview1: {
      clock_time_get: (_clock: number, _precision: bigint, to: number) => {
        new DataView(wasm.memory.buffer).setBigUint64(to, BigInt(Math.round(performance.now() * 1e6)), true);
        return 0;
      },
      fd_write: () => 8,
      fd_seek: () => 8,
    },
  });
  const wasm = instance.exports as unknown as Exports;
  const allocate = (size: number): number => wasm.rgs_allocate(size) >>> 0 || outOfMemory();
  const put = (value: Uint8Array): [number, number] => {
    const at = allocate(value.length);
    bytes(at, value.length).set(value);
    return [at, value.length];
  };
  wasm._initialize();
  wasm.rgs_start();
  const tool = job.tool ?? text(wasm.rgs_text() >>> 0, wasm.rgs_n_text());

  const source = typeof job.source === "string" ? await download(job.source) : job.source;
  const size = source instanceof Blob ? source.size : source.length;
  if (size > kMostSource) outOfMemory();
  begin("read", size, "bytes");
  const at = allocate(size);
  for (let first = 0; first < size; first += kPart) {
    const end = Math.min(size, first + kPart);
    bytes(at + first, end - first).set(source instanceof Blob ? await read(source, first, end) : source.subarray(first, end));
    advance(end - first);
  }
  const encoder = new TextEncoder();
  const failed = wasm.rgs_convert(
    at,
    size,
    kProfiles.indexOf(job.profile),
    job.levels ? 1 : 0,
    ...put(encoder.encode(job.sourceName)),
    ...put(encoder.encode(tool)),
  );
  const numbers = (): number[] => [...new Float64Array(wasm.memory.buffer, wasm.rgs_numbers() >>> 0, wasm.rgs_n_numbers())];
  if (failed !== 0) {
    wasm.rgs_error();
    const [code, what] = text(wasm.rgs_text() >>> 0, wasm.rgs_n_text()).split("\n") as [RgsErrorCode, string];
    const values = numbers();
    const value = (i: number): bigint | undefined => {
      const whole = (BigInt(values[2 * i] as number) << 32n) | BigInt(values[2 * i + 1] as number);
      return whole === kNone ? undefined : whole;
    };
    const offset = value(0);
    throw new Failure({ code, text: what, offset: offset === undefined ? undefined : Number(offset), expected: value(1), found: value(2) });
  }
  const values = numbers();
  let next = 0;
  const take = (): number => values[next++] as number;
  const report: Report = {
    sourceBytes: take(),
    bytes: take(),
    nSource: take(),
    nWritten: take(),
    nRepaired: take(),
    sourceShDegree: take(),
    shDegree: take(),
    nLevels: take(),
    nPages: take(),
    positionRounding: take(),
    defects: Object.fromEntries(kDefects.map((name) => [name, take()])) as Report["defects"],
  };
  const parts: Blob[] = [];
  const part = allocate(kPart);
  for (let first = 0; first < report.bytes; first += kPart) {
    const n = Math.min(kPart, report.bytes - first);
    wasm.rgs_read_output(first, part, n);
    parts.push(new Blob([bytes(part, n)]));
  }
  return { blob: new Blob(parts, { type: "application/octet-stream" }), report };
}

async function read(source: Blob, first: number, end: number): Promise<Uint8Array> {
  try {
    return new Uint8Array(await source.slice(first, end).arrayBuffer());
  } catch (error) {
    throw new Failure({ code: "read_failed", text: `the file cannot be read: ${String(error)}`, offset: first });
  }
}

async function download(url: string): Promise<Blob> {
  try {
    const answer = await fetch(url);
    if (!answer.ok) throw new Error(`HTTP ${answer.status}`);
    return await answer.blob();
  } catch (error) {
    throw new Failure({ code: "open_failed", text: `the source cannot be loaded: ${String(error)}` });
  }
}

/** Answers the one job that a worker gets. */
export async function answer(job: Job, load: () => Promise<WebAssembly.Module>, send: (answer: Answer) => void): Promise<void> {
  try {
    send(await convertJob(job, load, (progress) => send({ progress })));
  } catch (error) {
    send({ error: error instanceof Failure ? error.fields : { code: "internal", text: `the worker failed: ${String(error)}` } });
  }
}
