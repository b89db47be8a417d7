// scene.ts - an opened scene on one side of the stage.
// SPDX-License-Identifier: Apache-2.0
import type { AntiAliasing, FirstView, Look } from "@roofgs/reader";
import type { Side, Splats } from "./renderer.js";
import { type Axes, kPlyAxes } from "./splats.js";
import type { Stage } from "./stage.js";

export interface Box {
  min: readonly number[];
  max: readonly number[];
}

export type Tint = "none" | "level" | "error";

export abstract class Scene {
  abstract readonly nGaussians: number;
  /** What it is about, world. */
  abstract readonly box: Box;
  /** From where it is seen first, relative to `origin` (docs/user/CAMERAS.md). Null: not known, or not yet; then the box counts. */
  readonly firstView: FirstView | null = null;
  readonly axes: Axes = kPlyAxes;
  /** The up direction that the file declares, or null. */
  readonly up: readonly number[] | null = null;
  readonly hasPages: boolean = false;
  /** What @roofgs/convert can convert: a file, or an address. */
  readonly source: Blob | string | undefined = undefined;
  /** 0 where setShDegree() changes nothing. */
  readonly shDegree: number = 0;
  /** Counts changes of what is drawn. */
  nChanges = 0;
  protected splats: Splats;

  constructor(
    readonly name: string,
    readonly bytes: number,
    protected readonly stage: Stage,
    private readonly side: Side,
    readonly origin: readonly number[],
  ) {
    this.splats = stage.addSplats(side, origin);
    stage.scenes.add(this);
  }

  /** Gaussians on the GPU now. */
  abstract get nDrawn(): number;
  get bytesRead(): number {
    return this.bytes;
  }
  /** Counts of pages drawn and wanted; 0 without levels of detail. */
  get pages(): { drawn: number; wanted: number } {
    return { drawn: 0, wanted: 0 };
  }
  /** Boxes for the overlay, relative to `origin`. */
  boxes(): Box[] {
    return [{ min: this.local(this.box.min), max: this.local(this.box.max) }];
  }
  /** Means for picking, [n, 3] relative to `origin`. */
  abstract centres(): Iterable<Float32Array>;
  abstract setShDegree(degree: number): void;
  /** What the file declares, for a view that allows an error of `detailPx`; undefined if it declares nothing. */
  antiAliasing(_detailPx: number): AntiAliasing | undefined {
    return undefined;
  }
  setTint(_tint: Tint): void {}
  /** Called before each frame; chooses the cut of scenes with levels of detail. */
  look(_view: Omit<Look, "zNear">, _now: number): void {}

  /** Reads the rest of a scene whose first part is drawn. Rejects if the file is damaged; the scene must then be destroyed. */
  async complete(): Promise<void> {}

  set hidden(hidden: boolean) {
    this.splats.isHidden = hidden;
  }

  /** By the stage's renderer, which is another one now. */
  drawAnew(): void {
    const { isHidden } = this.splats;
    this.splats.destroy();
    this.splats = this.stage.addSplats(this.side, this.origin);
    this.splats.isHidden = isHidden;
    this.draw();
  }

  destroy(): void {
    this.stage.scenes.delete(this);
    this.splats.destroy();
  }

  /** At the end of a constructor: what cannot be drawn is no scene of the stage. */
  protected begin(): void {
    try {
      this.draw();
    } catch (error) {
      this.destroy();
      throw error;
    }
  }

  /** Gives `splats` all that they draw. */
  protected abstract draw(): void;

  protected hasChanged(): void {
    this.nChanges += 1;
  }

  protected local(point: readonly number[]): number[] {
    return point.map((value, i) => value - (this.origin[i] as number));
  }
}
