// settings.ts - the controls beside the picture: what is chosen there goes into the state, and they show what is there.
// SPDX-License-Identifier: Apache-2.0
import { showReference } from "./frames.js";
import { countText } from "./messages.js";
import { element, input, onClick } from "./page.js";
import type { Tint } from "./scene.js";
import type { PageStore, State } from "./state.js";

// A browser may have kept what the controls held before a reload, so each is read at first.

function bindRange(store: PageStore, id: string, get: (state: State) => number, choose: (value: number) => void, text = (): string => input(id).value): void {
  const control = input(id);
  const read = (): void => choose(Number(control.value));
  control.addEventListener("input", read);
  read();
  store.subscribe((state) => [get(state)], ([value]) => {
    control.value = String(value);
    // Its ends and its steps hold for links too.
    read();
    element(`${id}-value`, HTMLOutputElement).textContent = text();
  });
}

function bindCheck(store: PageStore, id: string, get: (state: State) => boolean, choose: (isOn: boolean) => void): void {
  const control = input(id);
  const read = (): void => choose(control.checked);
  control.addEventListener("change", read);
  read();
  store.subscribe((state) => [get(state)], ([isOn]) => (control.checked = isOn));
}

function bindTheme(store: PageStore): void {
  // The system's choice holds until the button is pressed.
  const system = matchMedia("(prefers-color-scheme: dark)");
  const isDark = (): boolean => (store.state.theme ?? (system.matches ? "dark" : "light")) === "dark";
  const show = (): void => element("theme", HTMLButtonElement).setAttribute("aria-pressed", String(isDark()));
  onClick("theme", () => store.set({ theme: isDark() ? "light" : "dark" }));
  system.addEventListener("change", show);
  store.subscribe(({ theme }) => [theme], ([theme]) => {
    if (theme) document.documentElement.dataset["theme"] = theme;
    show();
  });
}

export function bindSettings(store: PageStore): void {
  bindRange(store, "sh", ({ shDegree }) => shDegree, (shDegree) => store.set({ shDegree }));
  bindRange(store, "detail", ({ detailPx }) => detailPx, (detailPx) => store.set({ detailPx }));
  bindRange(store, "budget", ({ budget }) => Math.log10(budget), (log) => store.set({ budget: Math.round(10 ** log) }), () => countText(store.state.budget));
  bindCheck(store, "stats", ({ statistics }) => statistics, (statistics) => store.set({ statistics }));
  bindCheck(store, "boxes", ({ bounds }) => bounds, (bounds) => store.set({ bounds }));
  bindCheck(store, "reference", ({ isReferenceShown }) => isReferenceShown, (isOn) => showReference(store, isOn));
  bindTheme(store);
  const background = input("background");
  background.addEventListener("input", () => store.set({ background: [1, 3, 5].map((at) => parseInt(background.value.slice(at, at + 2), 16) / 255) }));
  store.subscribe((state) => [state.background], ([rgb]) => (background.value = `#${rgb.map((value) => Math.round(255 * value).toString(16).padStart(2, "0")).join("")}`));
  const tint = element("tint", HTMLSelectElement);
  const readTint = (): void => store.set({ tint: tint.value as Tint });
  tint.addEventListener("change", readTint);
  readTint();
  store.subscribe(({ scenes }) => [scenes], ([scenes]) => (tint.disabled = !scenes.some((scene) => scene?.hasPages)));
  onClick("menu", () => store.set({ isPanelShown: !store.state.isPanelShown }));
  store.subscribe(({ isPanelShown }) => [isPanelShown], ([isShown]) => {
    element("panel", HTMLElement).classList.toggle("shown", isShown);
    element("menu", HTMLButtonElement).setAttribute("aria-expanded", String(isShown));
  });
}
