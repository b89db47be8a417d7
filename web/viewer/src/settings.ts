// settings.ts - the controls beside the picture: what is chosen there goes into the state, and they show what is there.
// SPDX-License-Identifier: Apache-2.0
import { showReference } from "./frames.js";
import { countText } from "./messages.js";
import type { Page } from "./page.js";
import type { Tint } from "./scene.js";
import type { State } from "./state.js";

// A browser may have kept what the controls held before a reload, so each is read at first.

function bindRange(page: Page, id: string, get: (state: State) => number, choose: (value: number) => void, text = (): string => page.input(id).value): void {
  const { store } = page;
  const control = page.input(id);
  const read = (): void => choose(Number(control.value));
  control.addEventListener("input", read);
  read();
  store.subscribe((state) => [get(state)], ([value]) => {
    control.value = String(value);
    // Its ends and its steps hold for links too.
    read();
    page.element(`${id}-value`, HTMLOutputElement).textContent = text();
  });
}

function bindCheck(page: Page, id: string, get: (state: State) => boolean, choose: (isOn: boolean) => void): void {
  const { store } = page;
  const control = page.input(id);
  const read = (): void => choose(control.checked);
  control.addEventListener("change", read);
  read();
  store.subscribe((state) => [get(state)], ([isOn]) => (control.checked = isOn));
}

function bindTheme(page: Page): void {
  const { store } = page;
  // The system's choice holds until the button is pressed.
  const system = matchMedia("(prefers-color-scheme: dark)");
  const isDark = (): boolean => (store.state.theme ?? (system.matches ? "dark" : "light")) === "dark";
  const show = (): void => page.element("theme", HTMLButtonElement).setAttribute("aria-pressed", String(isDark()));
  page.onClick("theme", () => store.set({ theme: isDark() ? "light" : "dark" }));
  system.addEventListener("change", show, { signal: page.signal });
  store.subscribe(({ theme }) => [theme], ([theme]) => {
    if (theme) page.host.dataset["theme"] = theme;
    show();
  });
}

export function bindSettings(page: Page): void {
  const { store } = page;
  bindRange(page, "sh", ({ shDegree }) => shDegree, (shDegree) => store.set({ shDegree }));
  bindRange(page, "detail", ({ detailPx }) => detailPx, (detailPx) => store.set({ detailPx }));
  bindRange(page, "budget", ({ budget }) => Math.log10(budget), (log) => store.set({ budget: Math.round(10 ** log) }), () => countText(store.state.budget));
  bindCheck(page, "stats", ({ statistics }) => statistics, (statistics) => store.set({ statistics }));
  bindCheck(page, "boxes", ({ bounds }) => bounds, (bounds) => store.set({ bounds }));
  bindCheck(page, "reference", ({ isReferenceShown }) => isReferenceShown, (isOn) => showReference(store, isOn));
  bindTheme(page);
  const background = page.input("background");
  background.addEventListener("input", () => store.set({ background: [1, 3, 5].map((at) => parseInt(background.value.slice(at, at + 2), 16) / 255) }));
  store.subscribe((state) => [state.background], ([rgb]) => (background.value = `#${rgb.map((value) => Math.round(255 * value).toString(16).padStart(2, "0")).join("")}`));
  const tint = page.element("tint", HTMLSelectElement);
  const readTint = (): void => store.set({ tint: tint.value as Tint });
  tint.addEventListener("change", readTint);
  readTint();
  store.subscribe(({ scenes }) => [scenes], ([scenes]) => (tint.disabled = !scenes.some((scene) => scene?.hasPages)));
  page.onClick("menu", () => store.set({ isPanelShown: !store.state.isPanelShown }));
  store.subscribe(({ isPanelShown }) => [isPanelShown], ([isShown]) => {
    page.element("panel", HTMLElement).classList.toggle("shown", isShown);
    page.element("menu", HTMLButtonElement).setAttribute("aria-expanded", String(isShown));
  });
}
