// open-scene.ts - what is in a file, by its first bytes, and the scene that it becomes.
// SPDX-License-Identifier: Apache-2.0
import { open } from "@roofgs/reader";
import { type EngineKind, EngineScene } from "./engine-scene.js";
import { kBeginningBytes, kindOf } from "./kind.js";
import { readInside, type SceneEntry } from "./manifest.js";
import { worker } from "./reader-worker.js";
import { beginFile, type OpenedFile, RgsScene } from "./rgs-scene.js";
import type { Scene } from "./scene.js";
import type { Side, Stage } from "./stage.js";

/** Bytes read; `total` 0: nobody knows. */
export type OnProgress = (done: number, total: number) => void;

/**
 * A file of which it is known what it is. Of an .rgs the beginning is on its way; others are asked for when they are read, as a server
 * need not wait for who takes nothing.
 */
export type Read = { kind: "rgs"; opened: OpenedFile } | { kind: EngineKind | "cameras"; answer(): Promise<Response> };

async function beginningOf(answer: Response): Promise<Uint8Array> {
  const reader = answer.body?.getReader();
  const { value } = (await reader?.read()) ?? {};
  await reader?.cancel();
  return value?.subarray(0, kBeginningBytes) ?? new Uint8Array(0);
}

/** A file of the page's server, of the page itself, or one that was dropped. Rejects if it is nothing that this page opens. */
export async function readFile({ entry, file, onProgress }: { entry: SceneEntry; file?: File | undefined; onProgress: OnProgress }): Promise<Read> {
  const blob = file ?? (entry.url.startsWith("#") ? await readInside(entry.url) : undefined);
  const ofOthers = async (): Promise<Read | null> => {
    const range = { range: `bytes=0-${kBeginningBytes - 1}` };
    const kind = kindOf(await beginningOf(blob ? new Response(blob.slice(0, kBeginningBytes)) : await fetch(entry.url, { headers: range })));
    if (kind === null || kind === "rgs") return null;
    const answer = async (): Promise<Response> => {
      if (blob) return new Response(blob, { headers: { "content-length": String(blob.size) } });
      const found = await fetch(entry.url);
      if (!found.ok) throw Object.assign(new Error(`HTTP ${found.status}`), { code: "open_failed" });
      return found;
    };
    return { kind, answer };
  };
  // A name says what to ask first, so that as a rule nothing is read twice, and no more.
  const isNamedRgs = /\.rgs$/i.test(entry.name);
  const other = isNamedRgs ? null : await ofOthers();
  if (other) return other;
  try {
    const rgs = await open(blob ?? new URL(entry.url, document.baseURI), {
      ...(worker ? { worker } : {}),
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
  side: Side;
  onProgress: OnProgress;
  /** Of what comes later, page by page. */
  onError(error: unknown): void;
}

/** The scene with what is there first; complete() brings the rest. */
export async function openScene(stage: Stage, { name, read, side, onProgress, onError }: OpenScene): Promise<Scene> {
  if (read.kind === "cameras") throw new Error("it is a list of cameras, not a scene");
  if (read.kind !== "rgs") return EngineScene.open(stage, { name, kind: read.kind, answer: await read.answer(), side, onProgress });
  const { opened } = read;
  try {
    const first = await opened.first;
    if (first.done || (first.value.n === 0 && opened.file.header.nGaussians === 0)) throw new Error("it holds no Gaussians");
    return new RgsScene(name, opened, first.value, stage, side, onError);
  } catch (error) {
    opened.file.close();
    throw error;
  }
}
