// compare.ts - compares two pictures: by a slider, by flicker, or by a difference map with its PSNR.
// SPDX-License-Identifier: Apache-2.0
import type { Captures } from "./captures.js";
import { difference, kHeat } from "./difference.js";
import { flip } from "./flip.js";
import type { Mode } from "./link.js";
import type { Page } from "./page.js";
import { rightOf } from "./state.js";
import type { Stage } from "./stage.js";

/** Milliseconds that each picture of flicker stays. */
const kFlickerMs = 500;
/** Largest width of a difference map. */
const kMapWidth = 1280;

export function showComparison(page: Page, stage: Stage, captures: Captures): void {
  const { store } = page;
  const slider = page.element("split", HTMLElement);
  const map = page.element("map", HTMLCanvasElement);
  const reference = page.element("reference-picture", HTMLCanvasElement);
  const [legend, working] = [page.element("legend", HTMLElement), page.element("working", HTMLElement)];
  const choices = page.all<HTMLInputElement>("#modes input");
  let isFlickered = false;
  let timer = 0;
  /** Counts difference maps, and what outdates them. */
  let run = 0;

  const showSides = (): void => {
    const { mode, split, isReferenceShown } = store.state;
    const isAlone = rightOf(store.state) === "none";
    const border = mode === "slider" ? split : isFlickered || (isReferenceShown && mode === "single") ? 0 : 1;
    stage.set({ show: isReferenceShown ? { only: 0 } : { split: isAlone ? 1 : border } });
    reference.hidden = !isReferenceShown || border === 1;
    reference.style.clipPath = `inset(0 0 0 ${100 * border}%)`;
    const isBoth = mode === "difference";
    page.element("left", HTMLElement).hidden = isAlone || (border === 0 && !isBoth);
    page.element("right", HTMLElement).hidden = isAlone || (border === 1 && !isBoth);
  };
  const hideMap = (): void => {
    run += 1;
    map.hidden = legend.hidden = working.hidden = true;
  };
  const drawMap = async (): Promise<void> => {
    const { mode, size } = store.state;
    if (mode !== "difference") return;
    const mine = (run += 1);
    const scale = Math.min(1, kMapWidth / size.width);
    const [width, height] = [Math.max(1, Math.round(size.width * scale)), Math.max(1, Math.round(size.height * scale))];
    const say = (text: string): void => void (page.element("working-text", HTMLElement).textContent = text);
    say("Comparing: the left picture");
    working.hidden = false;
    const left = await captures.picture(0, { width, height });
    if (mine !== run) return;
    say("Comparing: the right picture");
    const right = await captures.picture(1, { width, height });
    if (mine !== run) return;
    const { psnrDb, map: pixels, top } = difference(left, right);
    Object.assign(map, { width, height });
    map.getContext("2d")?.putImageData(new ImageData(pixels, width, height), 0, 0);
    page.element("psnr", HTMLElement).textContent = Number.isFinite(psnrDb) ? `${psnrDb.toFixed(1)} dB` : "equal";
    page.element("top", HTMLElement).textContent = `${top} of 255 levels`;
    const alike = page.element("flip", HTMLElement);
    alike.textContent = "";
    map.hidden = legend.hidden = false;
    const steps = flip(left, right, width, height);
    let step = steps.next();
    for (; !step.done; step = steps.next()) {
      say(`Computing FLIP: ${Math.round(100 * step.value)} %`);
      await new Promise((resolve) => setTimeout(resolve));
      if (mine !== run) return;
    }
    alike.textContent = `FLIP ${step.value.toFixed(3)}`;
    working.hidden = true;
  };
  const tryMap = (): void => void drawMap().catch((error: unknown) => {
    hideMap();
    page.fail("The difference", error);
  });

  connectHandle(page, slider);
  page.element("ramp", HTMLElement).style.background = `linear-gradient(to right, ${kHeat.map((rgb) => `rgb(${rgb.join()})`).join()})`;
  page.onClick("cancel-map", () => store.set({ mode: "slider" }));
  for (const choice of choices) choice.addEventListener("change", () => store.set({ mode: choice.value as Mode }));
  store.subscribe((state) => [state.mode, rightOf(state)], ([mode, right]) => {
    // Without a right picture there is nothing to compare with.
    if (right === "none" && mode !== "single") store.set({ mode: "single" });
  });
  store.subscribe(({ mode, split, scenes, isReferenceShown }) => [mode, split, scenes, isReferenceShown], ([mode, split]) => {
    page.element("compare", HTMLFieldSetElement).hidden = rightOf(store.state) === "none";
    slider.hidden = mode !== "slider";
    slider.style.left = `${100 * split}%`;
    slider.setAttribute("aria-valuenow", String(Math.round(1000 * split)));
    slider.setAttribute("aria-valuetext", `${Math.round(100 * split)} percent left`);
    for (const choice of choices) choice.checked = choice.value === mode;
    clearInterval(timer);
    isFlickered = false;
    if (mode === "flicker") {
      timer = window.setInterval(() => {
        isFlickered = !isFlickered;
        showSides();
      }, kFlickerMs);
    }
    showSides();
    hideMap();
    tryMap();
  });
  store.subscribe(({ view, size, background, nChanges }) => [view, size, background, nChanges], hideMap);
  store.subscribe(({ isAtRest }) => [isAtRest], ([isAtRest]) => isAtRest && map.hidden && tryMap());
  page.signal.addEventListener("abort", () => {
    clearInterval(timer);
    hideMap();
  });
}

/** The handle on the border of the two pictures moves by pointer, by arrow keys, ten times as far with Shift, and to both ends. */
function connectHandle({ store }: Page, handle: HTMLElement): void {
  const set = (split: number): void => store.set({ split: Math.min(1, Math.max(0, split)) });
  /** From the border to the pointer, px. */
  let grabbed = 0;
  const left = (): number => (handle.parentElement as HTMLElement).getBoundingClientRect().left;
  const width = (): number => (handle.parentElement as HTMLElement).clientWidth;
  handle.addEventListener("pointerdown", (event) => {
    handle.setPointerCapture(event.pointerId);
    grabbed = event.clientX - left() - store.state.split * width();
  });
  handle.addEventListener("pointermove", (event) => {
    if (handle.hasPointerCapture(event.pointerId)) set((event.clientX - grabbed - left()) / width());
  });
  handle.addEventListener("keydown", (event) => {
    const { key, shiftKey } = event;
    const by = { ArrowLeft: -0.01, ArrowDown: -0.01, ArrowRight: 0.01, ArrowUp: 0.01 }[key];
    if (by !== undefined) set(store.state.split + by * (shiftKey ? 10 : 1));
    else if (key === "Home" || key === "End") set(key === "Home" ? 0 : 1);
    else return;
    event.preventDefault();
  });
}
