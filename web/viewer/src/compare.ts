// compare.ts - compares two pictures: by a slider, by flicker, or by a difference map with its PSNR.
// SPDX-License-Identifier: Apache-2.0
import { difference } from "./difference.js";
import type { Mode } from "./link.js";
import { element } from "./page.js";
import type { Stage } from "./stage.js";

/** Milliseconds that each picture of flicker stays. */
const kFlickerMs = 500;
/** Largest width of a difference map. */
const kMapWidth = 1280;

export interface Pictures {
  /** On the right: another scene drawn by the engine, the reference picture, or nothing. */
  right: "scene" | "reference" | "none";
  /** RGBA of one side. */
  capture(side: "left" | "right", width: number, height: number): Promise<Uint8ClampedArray>;
}

export class Compare {
  mode: Mode = "single";
  split = 0.5;
  private flickered = false;
  private timer = 0;
  private run = 0;
  private readonly slider = element("split", HTMLInputElement);
  private readonly map = element("map", HTMLCanvasElement);
  private readonly reference = element("reference-picture", HTMLCanvasElement);
  private readonly psnr = element("psnr", HTMLOutputElement);

  constructor(
    private readonly stage: Stage,
    private readonly pictures: Pictures,
    private readonly on: { changed(): void; error(error: unknown): void },
  ) {
    this.slider.addEventListener("input", () => {
      this.split = Number(this.slider.value) / 1000;
      this.apply();
    });
    this.buildModes();
  }

  setMode(mode: Mode): void {
    this.mode = this.pictures.right === "none" ? "single" : mode;
    this.apply();
  }

  /** Brings the page in line with the mode. */
  apply(): void {
    const { mode, split, pictures } = this;
    clearInterval(this.timer);
    const two = pictures.right !== "none";
    element("compare", HTMLFieldSetElement).hidden = !two;
    this.slider.hidden = mode !== "slider";
    this.slider.value = String(Math.round(1000 * split));
    this.flickered = false;
    if (mode === "flicker") {
      this.timer = window.setInterval(() => {
        this.flickered = !this.flickered;
        this.showSides();
      }, kFlickerMs);
    }
    this.showSides();
    for (const choice of document.querySelectorAll<HTMLInputElement>("#modes input")) choice.checked = choice.value === mode;
    this.map.hidden = this.psnr.hidden = true;
    this.run += 1;
    if (mode === "difference") this.rest();
    this.on.changed();
  }

  /** Hides the difference map, because the pictures have changed. */
  outdate(): void {
    if (this.mode !== "difference") return;
    this.run += 1;
    this.map.hidden = this.psnr.hidden = true;
  }

  /** Draws the difference map again, because the view is at rest. */
  rest(): void {
    if (this.mode === "difference") void this.drawMap().catch((error: unknown) => this.on.error(error));
  }

  private showSides(): void {
    const { mode, split, pictures, flickered } = this;
    const isReference = pictures.right === "reference";
    const border = mode === "slider" ? split : flickered || (isReference && mode === "single") ? 0 : 1;
    this.stage.setShow(isReference ? { only: 0 } : { split: pictures.right === "none" ? 1 : border });
    this.reference.hidden = !isReference || border === 1;
    this.reference.style.clipPath = `inset(0 0 0 ${100 * border}%)`;
    element("left", HTMLElement).hidden = pictures.right === "none" || border === 0;
    element("right", HTMLElement).hidden = pictures.right === "none" || border === 1;
  }

  private async drawMap(): Promise<void> {
    const run = (this.run += 1);
    const { width: w, height: h } = this.stage.size;
    const scale = Math.min(1, kMapWidth / w);
    const [width, height] = [Math.max(1, Math.round(w * scale)), Math.max(1, Math.round(h * scale))];
    const left = await this.pictures.capture("left", width, height);
    if (run !== this.run) return;
    const right = await this.pictures.capture("right", width, height);
    if (run !== this.run) return;
    const { psnrDb, map } = difference(left, right);
    this.map.width = width;
    this.map.height = height;
    this.map.getContext("2d")?.putImageData(new ImageData(map, width, height), 0, 0);
    this.psnr.textContent = Number.isFinite(psnrDb) ? `${psnrDb.toFixed(1)} dB` : "equal";
    this.map.hidden = this.psnr.hidden = false;
  }

  private buildModes(): void {
    const names: [Mode, string][] = [
      ["single", "One"],
      ["slider", "Slider"],
      ["flicker", "Flicker"],
      ["difference", "Difference"],
    ];
    for (const [mode, text] of names) {
      const choice = document.createElement("input");
      Object.assign(choice, { type: "radio", name: "mode", value: mode });
      choice.addEventListener("change", () => this.setMode(mode));
      const label = document.createElement("label");
      label.append(choice, ` ${text}`);
      element("modes", HTMLElement).append(label);
    }
  }
}
