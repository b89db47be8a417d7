// first-view.ts - the view from which a scene is seen first, where its file states none.
// SPDX-License-Identifier: Apache-2.0
import type { FirstView, Vector3 } from "@roofgs/reader";
import type { Seen } from "./chooser.js";
import { startChooser } from "./reader-worker.js";

/** Of all Gaussians of a scene, in any order, relative to their origin. Null if none is visible. `up`: floors and ground correct it. */
export async function firstView(parts: Iterable<Seen>, up: Vector3 = [0, -1, 0]): Promise<FirstView | null> {
  const answer = await fetch(new URL("../../../build/web/first-view.wasm", import.meta.url));
  const module = await WebAssembly.compile(await answer.arrayBuffer());
  const worker = startChooser();
  const ask = (message: object): Promise<FirstView | null> =>
    new Promise((resolve, reject) => {
      worker.onmessage = ({ data }: MessageEvent<FirstView | null>) => resolve(data);
      worker.onerror = ({ message }) => reject(new Error(message));
      worker.postMessage(message);
    });
  try {
    await ask({ module });
    for (const part of parts) {
      // The worker gets a copy, which needs no SH.
      await ask({ part: "geometry" in part ? { means: part.means, geometry: part.geometry, scaleExponent: part.scaleExponent } : part });
    }
    return await ask({ up });
  } finally {
    worker.terminate();
  }
}
