// open-scene.ts - recognises a file by its first bytes and opens it as a scene.
// SPDX-License-Identifier: Apache-2.0
import { open } from "@roofgs/reader";
import { kBeginningBytes, type Kind, kindOf, otherArchive } from "./kind.js";
import { loadEngine } from "./load-engine.js";
import { readInside, type SceneEntry, type SpzAxes } from "./manifest.js";
import type { Trouble } from "./page-driver.js";
import { worker } from "./reader-worker.js";
import type { Side } from "./renderer.js";
import { beginFile, type OpenedFile, RgsScene } from "./rgs-scene.js";
import type { Scene } from "./scene.js";
import { SplatScene } from "./splat-scene.js";
import type { Axes } from "./splats.js";
import type { Stage } from "./stage.js";

/** Bytes read; `total` is 0 where it is not known. */
export type OnProgress = (done: number, total: number) => void;

/**
 * A file whose kind is known. The beginning of an .rgs is already in flight; other files are requested when they are read, because a
 * server need not keep a connection open that nobody reads from.
 */
export type Read = { kind: "rgs"; opened: OpenedFile } | { kind: Exclude<Kind, "rgs">; answer(signal?: AbortSignal): Promise<Response>; source: Blob | string | undefined };

async function beginningOf(answer: Response): Promise<Uint8Array> {
  const reader = answer.body?.getReader();
  const beginning = new Uint8Array(kBeginningBytes);
  let n = 0;
  while (n < kBeginningBytes) {
    const { value } = (await reader?.read()) ?? {};
    if (!value) break;
    beginning.set(value.subarray(0, kBeginningBytes - n), n);
    n += Math.min(value.length, kBeginningBytes - n);
  }
  await reader?.cancel();
  return beginning.subarray(0, n);
}

interface Asked {
  entry: SceneEntry;
  file?: File | undefined;
  onProgress: OnProgress;
}

/** A file from a server, from the page itself, or a dropped one. Rejects if this page cannot open it. */
export async function readFile(asked: Asked): Promise<Read> {
  try {
    return await recognise(asked);
  } catch (error) {
    // Browsers do not say why a request was not answered; a TypeError is one.
    const { code, text = String(error) } = error as { code?: string; text?: string };
    const isUnanswered = error instanceof TypeError || (code === "open_failed" && !/HTTP/.test(text));
    if (!isUnanswered || asked.file || asked.entry.url.startsWith("#")) throw error;
    const { host } = new URL(asked.entry.url, document.baseURI);
    throw Object.assign(new Error(), host === location.host ? { code: "open_failed", text } : { code: "foreign_host", text: `${host}: ${text}` });
  }
}

/** For who does not open it any more. */
export function closeRead(reading: Promise<Read>): void {
  void reading.then((read) => read.kind === "rgs" && read.opened.file.close(), () => undefined);
}

async function recognise({ entry, file, onProgress }: Asked): Promise<Read> {
  const blob = file ?? (entry.url.startsWith("#") ? await readInside(entry.url) : undefined);
  const ofOthers = async (): Promise<Read | null> => {
    const range = { range: `bytes=0-${kBeginningBytes - 1}` };
    const beginning = await beginningOf(blob ? new Response(blob.slice(0, kBeginningBytes)) : await fetch(entry.url, { headers: range }));
    const archive = otherArchive(beginning);
    if (archive) throw Object.assign(new Error(), { code: "bad_magic", text: `it is ${archive}` });
    const kind = kindOf(beginning);
    if (kind === null || kind === "rgs") return null;
    const answer = async (signal?: AbortSignal): Promise<Response> => {
      if (blob) return new Response(blob, { headers: { "content-length": String(blob.size) } });
      const found = await fetch(entry.url, signal ? { signal } : {});
      if (!found.ok) throw Object.assign(new Error(`HTTP ${found.status}`), { code: "open_failed" });
      return found;
    };
    // A file inside the page is not kept.
    const source = file ?? (entry.url.startsWith("#") ? undefined : new URL(entry.url, document.baseURI).href);
    return { kind, answer, source };
  };
  // The name only decides what is tried first, which saves a request.
  const isNamedRgs = /\.rgs$/i.test(entry.name);
  const other = isNamedRgs ? null : await ofOthers();
  if (other) return other;
  try {
    const rgs = await open(blob ?? new URL(entry.url, document.baseURI), {
      ...(worker ? { worker } : {}),
      table: "beginning",
      onProgress: ({ done, total }) => onProgress(done, total ?? 0),
    });
    return { kind: "rgs", opened: beginFile(rgs, onProgress) };
  } catch (error) {
    if (!isNamedRgs || (error as { code?: string }).code !== "bad_magic") throw error;
    const found = await ofOthers();
    if (!found) throw error;
    return found;
  }
}

export interface OpenScene {
  name: string;
  read: Read;
  /** Of an SPZ that declares none. */
  spzAxes: SpzAxes;
  /** To which others are turned that declare theirs. */
  axes: Axes;
  side: Side;
  /** That is drawn. */
  shDegree: number;
  onProgress: OnProgress;
  /** In pages that are read later, and of single Gaussians. */
  on: Trouble;
  signal: AbortSignal;
}

/** A file that is no .rgs. */
export interface OpenOther extends Omit<OpenScene, "read"> {
  answer: Response;
  source: Blob | string | undefined;
}

/** Resolves with the first part of the scene; complete() reads the rest. */
export async function openScene(stage: Stage, { read, ...options }: OpenScene): Promise<Scene> {
  if (read.kind === "cameras") throw new Error("it is a camera file, not a scene");
  if (read.kind !== "rgs") {
    const { kind, source } = read;
    const other = { ...options, answer: await read.answer(options.signal), source };
    if (kind === "ply" || kind === "spz") return SplatScene.open(stage, kind, other);
    return (await loadEngine()).EngineScene.open(stage, kind, other);
  }
  const { opened } = read;
  const { name, side, on } = options;
  try {
    const first = await opened.first;
    if (first.done || (first.value.n === 0 && opened.file.header.nGaussians === 0)) throw new Error("it holds no Gaussians");
    return new RgsScene(name, opened, first.value, await opened.scheduler, stage, side, on);
  } catch (error) {
    opened.file.close();
    throw error;
  }
}
