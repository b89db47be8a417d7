// read-splats.ts - reads a PLY or an SPZ in a worker.
// SPDX-License-Identifier: Apache-2.0
import { type AntiAliasing, antiAliasingOf, type Gaussians, readSpz } from "@roofgs/reader";
import { type Ask, moduleOf, withWorker } from "./ask.js";
import type { OnProgress } from "./open-scene.js";
import { startSplats, worker } from "./reader-worker.js";
import type { Axes, PlyHead, SpzContent } from "./splats.js";

/** Gaussians in a part. */
const kPart = 1 << 16;
/** What the C++ library holds in one array. */
const kMostBytes = 2 ** 31 - 1;

export interface ReadSplats {
  /** Those that can be drawn; the file has `n`. */
  parts: Gaussians[];
  n: number;
  shDegree: number;
  origin: readonly number[];
  antiAliasing: AntiAliasing;
}

type Head = Pick<ReadSplats, "n" | "shDegree" | "origin" | "antiAliasing">;

function lost(error: unknown): never {
  if ((error as { name?: string }).name === "AbortError") throw error;
  throw Object.assign(new Error(), { code: "read_failed", text: String(error) });
}

async function openPly(ask: Ask, { body, headers }: Response, onProgress: OnProgress, wanted: Axes): Promise<Head> {
  const total = Number(headers.get("content-length") ?? 0);
  let done = 0;
  // What is encoded, has another length.
  const expected = headers.has("content-encoding") ? 0 : total;
  // Without a length the worker's memory would grow by copies of all.
  const kept: Uint8Array[] = [];
  const append = (value: Uint8Array, all: number): Promise<void> => ask({ call: "append", args: [value, all] }, [value.buffer as ArrayBuffer]);
  const reader = body?.getReader();
  try {
    for (;;) {
      if (Math.max(expected, done) > kMostBytes) throw Object.assign(new Error(), { code: "host_out_of_memory", text: "a PLY of 2 GiB or more" });
      const { value } = (await reader?.read().catch(lost)) ?? {};
      if (!value) break;
      done += value.length;
      if (expected > 0) await append(value, expected);
      else kept.push(value);
      onProgress(done, total);
    }
  } finally {
    void reader?.cancel().catch(() => undefined);
  }
  for (const value of kept) await append(value, done);
  const head = await ask<PlyHead>({ call: "openPly", args: [wanted] });
  return { ...head, antiAliasing: antiAliasingOf(head) };
}

/** `axes`: of a file that declares none. */
async function openSpz(ask: Ask, answer: Response, axes: Axes, wanted: Axes): Promise<Head> {
  const spz = await readSpz(new Uint8Array(await answer.arrayBuffer().catch(lost)), worker ? { worker } : {});
  const { version, n, shDegree, fractionalBits, streams, antialiased } = spz;
  const content: SpzContent = { version, n, shDegree, fractionalBits, streams };
  // Streams of one gzip stream have one buffer.
  await ask({ call: "openSpz", args: [content, spz.axes ?? axes, wanted] }, [...new Set(Object.values(streams).map(({ buffer }) => buffer as ArrayBuffer))]);
  return { n, shDegree, origin: [0, 0, 0], antiAliasing: antiAliasingOf({ aaMode: antialiased ? "mip_splatting" : "classic" }) };
}

/** Turned to `wanted`, if both are declared. `spzAxes`: of an SPZ that declares none. Rejects with RgsErrorFields, or the signal's reason. */
export function readSplats(kind: "ply" | "spz", answer: Response, spzAxes: Axes, wanted: Axes, onProgress: OnProgress, signal?: AbortSignal): Promise<ReadSplats> {
  return withWorker(startSplats, signal, async (ask) => {
    await ask({ module: await moduleOf(new URL("../../../build/web/splats.wasm", import.meta.url), signal) });
    const head = await (kind === "ply" ? openPly(ask, answer, onProgress, wanted) : openSpz(ask, answer, spzAxes, wanted));
    const parts: Gaussians[] = [];
    for (let first = 0; first < head.n; first += kPart) parts.push(await ask<Gaussians>({ call: "read", args: [first, Math.min(kPart, head.n - first)] }));
    return { ...head, parts };
  });
}
