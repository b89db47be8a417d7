// compare.ts - compares two pictures: by a slider, by flicker, or by a difference map with its PSNR.
// SPDX-License-Identifier: Apache-2.0
import type { Captures } from "./captures.js";
import { difference } from "./difference.js";
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
  const slider = page.element("split", HTMLInputElement);
  const map = page.element("map", HTMLCanvasElement);
  const reference = page.element("reference-picture", HTMLCanvasElement);
  const psnr = page.element("psnr", HTMLOutputElement);
  const choices = page.all<HTMLInputElement>("#modes input");
  let isFlickered = false;
  let timer = 0;
  /** Counts difference maps, and what outdates them. */
  let run = 0;

  const showSides = (): void => {
    const { mode, split, isReferenceShown } = store.state;
    const isAlone = rightOf(store.state) === "none";
    const border = mode === "slider" ? split : isFlickered || (isReferenceShown && mode === "single") ? 0 : 1;
    stage.setShow(isReferenceShown ? { only: 0 } : { split: isAlone ? 1 : border });
    reference.hidden = !isReferenceShown || border === 1;
    reference.style.clipPath = `inset(0 0 0 ${100 * border}%)`;
    page.element("left", HTMLElement).hidden = isAlone || border === 0;
    page.element("right", HTMLElement).hidden = isAlone || border === 1;
  };
  const hideMap = (): void => {
    run += 1;
    map.hidden = psnr.hidden = true;
  };
  const drawMap = async (): Promise<void> => {
    const { mode, size } = store.state;
    if (mode !== "difference") return;
    const mine = (run += 1);
    const scale = Math.min(1, kMapWidth / size.width);
    const [width, height] = [Math.max(1, Math.round(size.width * scale)), Math.max(1, Math.round(size.height * scale))];
    const left = await captures.picture(0, { width, height });
    if (mine !== run) return;
    const right = await captures.picture(1, { width, height });
    if (mine !== run) return;
    const { psnrDb, map: pixels } = difference(left, right);
    Object.assign(map, { width, height });
    map.getContext("2d")?.putImageData(new ImageData(pixels, width, height), 0, 0);
    psnr.textContent = Number.isFinite(psnrDb) ? `${psnrDb.toFixed(1)} dB` : "equal";
    map.hidden = psnr.hidden = false;
  };
  const tryMap = (): void => void drawMap().catch((error: unknown) => page.fail("The difference", error));

  slider.addEventListener("input", () => store.set({ split: Number(slider.value) / 1000 }));
  for (const choice of choices) choice.addEventListener("change", () => store.set({ mode: choice.value as Mode }));
  store.subscribe((state) => [state.mode, rightOf(state)], ([mode, right]) => {
    // Without a right picture there is nothing to compare with.
    if (right === "none" && mode !== "single") store.set({ mode: "single" });
  });
  store.subscribe(({ mode, split, scenes, isReferenceShown }) => [mode, split, scenes, isReferenceShown], ([mode, split]) => {
    page.element("compare", HTMLFieldSetElement).hidden = rightOf(store.state) === "none";
    slider.hidden = mode !== "slider";
    slider.value = String(Math.round(1000 * split));
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
  page.signal.addEventListener("abort", () => clearInterval(timer));
}
