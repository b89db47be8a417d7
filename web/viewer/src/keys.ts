// keys.ts - what keys do, wherever the focus is.
// SPDX-License-Identifier: Apache-2.0
import { jump } from "./cameras-panel.js";
import type { Mode } from "./link.js";
import { input } from "./page.js";
import { play } from "./path.js";
import { showReference } from "./frames.js";
import type { PageStore } from "./state.js";

export function connectKeys(store: PageStore): void {
  const toggle = (mode: Mode): void => store.set({ mode: store.state.mode === mode ? "single" : mode });
  const go = (by: number): void => {
    const { camera, cameras } = store.state;
    jump(store, (camera + by + cameras.length) % cameras.length);
  };
  const actions: Record<string, () => void> = {
    KeyN: () => go(1),
    KeyB: () => go(-1),
    KeyP: () => play(store),
    KeyF: () => toggle("flicker"),
    KeyX: () => toggle("difference"),
    KeyC: () => toggle("slider"),
    KeyT: () => showReference(store, !store.state.isReferenceShown),
    KeyI: () => store.set({ statistics: !store.state.statistics }),
    KeyO: () => input("file").click(),
  };
  document.addEventListener("keydown", (event) => {
    const { target } = event;
    const typing = target instanceof HTMLSelectElement || (target instanceof HTMLInputElement && !["checkbox", "radio", "range"].includes(target.type));
    if (typing || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    actions[event.code]?.();
  });
}
