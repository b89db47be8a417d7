// rest.ts - tells when the picture has come to rest, for what is done only then.
// SPDX-License-Identifier: Apache-2.0
import type { Page } from "./page.js";

/** The view is at rest after so many milliseconds without a change. */
const kRestMs = 200;

/** `isActive`: whether the user is moving the view. */
export function watchRest({ store, signal }: Page, isActive: () => boolean): void {
  let timer = 0;
  const wait = (): void => {
    clearTimeout(timer);
    if (signal.aborted) return;
    timer = window.setTimeout(() => {
      const { playing, flight, isReady, scenes } = store.state;
      // The link that the page begins with stays in the address until there is a scene.
      if (isActive() || playing !== undefined || flight !== undefined || (!isReady && !scenes[0])) wait();
      else store.set({ isAtRest: true });
    }, kRestMs);
  };
  store.subscribe(
    ({ view, size, mode, split, background, shDegree, detailPx, budget, scenes, nChanges }) => [view, size, mode, split, background, shDegree, detailPx, budget, scenes, nChanges],
    () => {
      store.set({ isAtRest: false });
      wait();
    },
  );
  signal.addEventListener("abort", wait);
}
