// settings.ts - the controls beside the picture: what is chosen there goes into the state, and they show what is there.
// SPDX-License-Identifier: Apache-2.0
import { showReference } from "./frames.js";
import { countText } from "./messages.js";
import type { Page } from "./page.js";
import type { Tint } from "./scene.js";
import { savable } from "./save.js";
import { kPanels, type Panel, type State } from "./state.js";

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

/** What is chosen once holds for the next visit, where the browser allows it. */
function remember(page: Page, name: string): { read(): string | null; write(value: string): void } {
  const key = `rgs-view ${name}`;
  const guarded = <T>(what: () => T): T | null => {
    try {
      return page.isWhole ? what() : null;
    } catch {
      return null;
    }
  };
  return { read: () => guarded(() => localStorage.getItem(key)), write: (value) => void guarded(() => localStorage.setItem(key, value)) };
}

function bindTheme(page: Page): void {
  const { store } = page;
  const memory = remember(page, "theme");
  const before = memory.read();
  if (before === "dark" || before === "light") store.set({ theme: before });
  // The system's choice holds until the button is pressed.
  const system = matchMedia("(prefers-color-scheme: dark)");
  const isDark = (): boolean => (store.state.theme ?? (system.matches ? "dark" : "light")) === "dark";
  const show = (): void => page.element("theme", HTMLButtonElement).setAttribute("aria-pressed", String(isDark()));
  page.onClick("theme", () => {
    const theme = isDark() ? "light" : "dark";
    memory.write(theme);
    store.set({ theme });
  });
  system.addEventListener("change", show, { signal: page.signal });
  store.subscribe(({ theme }) => [theme], ([theme]) => {
    if (theme) page.host.dataset["theme"] = theme;
    show();
  });
}

function bindPanel(page: Page): void {
  const { store } = page;
  const memory = remember(page, "panel");
  const before = kPanels.find((name) => name === memory.read());
  if (before && page.isFull) store.set({ panel: before });
  for (const name of kPanels) {
    page.onClick(name, () => store.set({ panel: store.state.panel === name ? undefined : name }));
  }
  store.subscribe(({ panel }) => [panel], ([panel], isChanged) => isChanged && memory.write(panel ?? ""));
  const isThere = ({ cameras, saving, scenes }: State, name: Panel): boolean =>
    name === "views" ? cameras.length > 0 : name !== "save" || saving !== undefined || savable(scenes).length > 0;
  store.subscribe((state) => [state.panel, ...kPanels.map((name) => isThere(state, name))] as const, ([panel, ...areThere]) => {
    const element = page.element("panel", HTMLElement);
    element.hidden = true;
    element.dataset["shows"] = panel ?? "";
    kPanels.forEach((name, i) => {
      const opener = page.element(name, HTMLButtonElement);
      opener.hidden = !areThere[i];
      opener.setAttribute("aria-expanded", String(panel === name));
      if (panel === name) element.hidden = opener.hidden;
    });
  });
}

/** What no scene has is not shown. */
function showWhatApplies(page: Page): void {
  page.store.subscribe(({ scenes }) => [scenes], ([scenes]) => {
    page.element("home", HTMLElement).hidden = !scenes.some((scene) => scene);
    (page.input("sh").parentElement as HTMLElement).hidden = !scenes.some((scene) => scene && scene.shDegree > 0);
    page.element("levels", HTMLElement).hidden = !scenes.some((scene) => scene?.hasPages);
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
  bindPanel(page);
  showWhatApplies(page);
  const full = page.element("full", HTMLButtonElement);
  full.hidden = !document.fullscreenEnabled;
  full.addEventListener("click", () => void (document.fullscreenElement ? document.exitFullscreen() : page.host.requestFullscreen()).catch(() => undefined));
}
