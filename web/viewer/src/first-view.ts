// first-view.ts - the view from which a scene is seen first, where its file states none.
// SPDX-License-Identifier: Apache-2.0
import type { FirstView, Vector3 } from "@roofgs/reader";
import { moduleOf, withWorker } from "./ask.js";
import type { Seen } from "./chooser.js";
import { startChooser } from "./reader-worker.js";

/** Of all Gaussians of a scene, in any order, relative to their origin. Null if none is visible. `up`: floors and ground correct it. */
export function firstView(parts: Iterable<Seen> | AsyncIterable<Seen>, signal?: AbortSignal, up: Vector3 = [0, -1, 0]): Promise<FirstView | null> {
  return withWorker(startChooser, signal, async (ask) => {
    await ask({ module: await moduleOf(new URL("../../../build/web/first-view.wasm", import.meta.url), signal) });
    for await (const part of parts) {
      const { means } = part;
      // The worker gets a copy, which needs no SH.
      const shapes = "geometry" in part ? { geometry: part.geometry, scaleExponent: part.scaleExponent } : { rotations: part.rotations, scales: part.scales, opacities: part.opacities };
      await ask({ part: { means, ...shapes } });
    }
    return ask<FirstView | null>({ up });
  });
}
