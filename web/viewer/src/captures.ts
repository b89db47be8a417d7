// captures.ts - pictures of complete scenes, to compare and to save.
// SPDX-License-Identifier: Apache-2.0
import type { ViewState } from "./cameras.js";
import { difference } from "./difference.js";
import { frameRequest, type Frames } from "./frames.js";
import { offer, type Page } from "./page.js";
import type { Size } from "./picture-size.js";
import type { Pixels, Side } from "./renderer.js";
import { rightOf } from "./state.js";
import type { Stage } from "./stage.js";

export class Captures {
  /** One comes after the other. */
  private last: Promise<unknown> = Promise.resolve();
  /** Rejects when the viewer ends: nothing is drawn any more. */
  private readonly gone: Promise<never>;

  constructor(
    private readonly page: Page,
    private readonly stage: Stage,
    private readonly frames: Frames | undefined,
    /** Resolves when no scene is being opened. */
    private readonly allOpened: () => Promise<void>,
  ) {
    this.gone = new Promise((_, reject) => page.signal.addEventListener("abort", () => reject(page.signal.reason)));
    this.gone.catch(() => undefined);
  }

  /** RGBA of what the stage draws. */
  capture(side: Side, view: ViewState, { width, height }: Size): Promise<Pixels> {
    const result = this.last.then(() => Promise.race([this.gone, this.stage.capture(side, view, width, height)]));
    this.last = result.catch(() => undefined);
    return result;
  }

  /** RGBA of one of the two pictures that are compared. */
  async picture(side: Side, size: Size): Promise<Pixels> {
    // Only complete scenes are compared or saved.
    await this.allOpened();
    const { state } = this.page.store;
    const request = frameRequest(state, size);
    if (!state.view || !request) throw new Error("there is no scene");
    if (side === 0 || !state.isReferenceShown) return this.capture(side, state.view, size);
    const bitmap = await (this.frames as Frames).exact(request);
    const context = contextOf(size);
    context.drawImage(bitmap, 0, 0);
    bitmap.close();
    return context.getImageData(0, 0, size.width, size.height).data;
  }

  /** Saves what is shown. */
  async screenshot(): Promise<void> {
    await this.allOpened();
    const { scenes: [left] } = this.page.store.state;
    if (!left) return this.page.showError("There is no picture to save yet. Open a scene first.");
    offer(await this.shown(), `${left.name}.png`);
  }

  /** A PNG of what is shown. */
  async shown(): Promise<Blob> {
    await this.allOpened();
    const { size, mode, split, isReferenceShown } = this.page.store.state;
    const { width, height } = size;
    const context = contextOf(size);
    if (mode === "difference") {
      const { map } = difference(await this.picture(0, size), await this.picture(1, size));
      context.putImageData(new ImageData(map, width, height), 0, 0);
    } else {
      const border = mode === "slider" && rightOf(this.page.store.state) !== "none" ? Math.round(split * width) : isReferenceShown && mode === "single" ? 0 : width;
      const put = async (side: Side, from: number, to: number): Promise<void> => {
        if (from === to) return;
        context.putImageData(new ImageData(await this.picture(side, size), width, height), 0, 0, from, 0, to - from, height);
      };
      await Promise.all([put(0, 0, border), put(1, border, width)]);
    }
    return context.canvas.convertToBlob({ type: "image/png" });
  }
}

function contextOf({ width, height }: Size): OffscreenCanvasRenderingContext2D {
  return new OffscreenCanvas(width, height).getContext("2d") as OffscreenCanvasRenderingContext2D;
}
