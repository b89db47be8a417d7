// keys.ts - what keys do, wherever the focus is.
// SPDX-License-Identifier: Apache-2.0
import { jump } from "./cameras-panel.js";
import { goHome } from "./home.js";
import type { Mode } from "./link.js";
import type { Page } from "./page.js";
import { play } from "./path.js";
import { showReference } from "./frames.js";

export function connectKeys(page: Page): void {
  const { store } = page;
  const toggle = (mode: Mode): void => store.set({ mode: store.state.mode === mode ? "single" : mode });
  const go = (by: number): void => {
    const { camera, cameras } = store.state;
    jump(page, (camera + by + cameras.length) % cameras.length);
  };
  const actions: Record<string, () => unknown> = {
    KeyN: () => go(1),
    KeyB: () => go(-1),
    KeyP: () => play(store),
    KeyH: () => goHome(page),
    Home: () => goHome(page),
    KeyF: () => toggle("flicker"),
    KeyX: () => toggle("difference"),
    KeyC: () => toggle("slider"),
    KeyT: () => showReference(store, !store.state.isReferenceShown),
    KeyI: () => store.set({ statistics: !store.state.statistics }),
    Escape: () => store.set({ panel: undefined }),
    KeyO: () => page.isFull && page.input("file").click(),
  };
  page.listen("keydown", (event) => {
    // The event's target is the element that the shadow root belongs to.
    const [target] = event.composedPath();
    const typing = target instanceof HTMLSelectElement || (target instanceof HTMLInputElement && (event.code === "Home" || !["checkbox", "radio", "range"].includes(target.type)));
    if (typing || event.defaultPrevented || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    actions[event.code]?.();
  });
}
