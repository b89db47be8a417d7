// read-splats.ts - reads a PLY or an SPZ in a worker.
// SPDX-License-Identifier: Apache-2.0
import { type AntiAliasing, antiAliasingOf, type Gaussians, readSpz } from "@roofgs/reader";
import { type Ask, withWorker } from "./ask.js";
import type { OnProgress } from "./open-scene.js";
import { startSplats, worker } from "./reader-worker.js";
import type { Axes, PlyHead, SpzContent } from "./splats.js";

/** Gaussians in a part. */
const kPart = 1 << 16;

export interface ReadSplats {
  /** Those that can be drawn; the file has `n`. */
  parts: Gaussians[];
  n: number;
  shDegree: number;
  origin: readonly number[];
  antiAliasing: AntiAliasing;
}

type Head = Pick<ReadSplats, "n" | "shDegree" | "origin" | "antiAliasing">;

async function openPly(ask: Ask, { body, headers }: Response, onProgress: OnProgress, wanted: Axes): Promise<Head> {
  const total = Number(headers.get("content-length") ?? 0);
  let done = 0;
  // What is encoded, has another length.
  const expected = headers.has("content-encoding") ? 0 : total;
  for (const reader = body?.getReader(); ; ) {
    const { value } = (await reader?.read()) ?? {};
    if (!value) break;
    done += value.length;
    await ask({ call: "append", args: [value, expected] }, [value.buffer]);
    onProgress(done, total);
  }
  const head = await ask<PlyHead>({ call: "openPly", args: [wanted] });
  return { ...head, antiAliasing: antiAliasingOf(head) };
}

/** `axes`: of a file that declares none. */
async function openSpz(ask: Ask, answer: Response, axes: Axes, wanted: Axes): Promise<Head> {
  const spz = await readSpz(new Uint8Array(await answer.arrayBuffer()), worker ? { worker } : {});
  const { version, n, shDegree, fractionalBits, streams, antialiased } = spz;
  const content: SpzContent = { version, n, shDegree, fractionalBits, streams };
  // Streams of one gzip stream have one buffer.
  await ask({ call: "openSpz", args: [content, spz.axes ?? axes, wanted] }, [...new Set(Object.values(streams).map(({ buffer }) => buffer as ArrayBuffer))]);
  return { n, shDegree, origin: [0, 0, 0], antiAliasing: antiAliasingOf({ aaMode: antialiased ? "mip_splatting" : "classic" }) };
}

/** Turned to `wanted`, if both are declared. `spzAxes`: of an SPZ that declares none. Rejects with RgsErrorFields, or the signal's reason. */
export function readSplats(kind: "ply" | "spz", answer: Response, spzAxes: Axes, wanted: Axes, onProgress: OnProgress, signal?: AbortSignal): Promise<ReadSplats> {
  return withWorker(startSplats, signal, async (ask) => {
    const wasm = await fetch(new URL("../../../build/web/splats.wasm", import.meta.url), signal ? { signal } : {});
    await ask({ module: await WebAssembly.compile(await wasm.arrayBuffer()) });
    const head = await (kind === "ply" ? openPly(ask, answer, onProgress, wanted) : openSpz(ask, answer, spzAxes, wanted));
    const parts: Gaussians[] = [];
    for (let first = 0; first < head.n; first += kPart) parts.push(await ask<Gaussians>({ call: "read", args: [first, Math.min(kPart, head.n - first)] }));
    return { ...head, parts };
  });
}
