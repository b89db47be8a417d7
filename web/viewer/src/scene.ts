// scene.ts - an opened scene on one side of the stage.
// SPDX-License-Identifier: Apache-2.0
import type { AntiAliasing } from "@roofgs/playcanvas";
import type { FirstView, Look } from "@roofgs/reader";
import { Entity, type GSplatResourceBase, WORKBUFFER_UPDATE_ONCE } from "playcanvas";
import type { Side, Stage } from "./stage.js";

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
  /** The up direction that the file declares, or null. */
  readonly up: readonly number[] | null = null;
  readonly origin: readonly number[] = [0, 0, 0];
  readonly hasPages: boolean = false;
  /** What @roofgs/converter can convert: a file, or an address. */
  readonly source: Blob | string | undefined = undefined;
  /** 0 where setShDegree() changes nothing. */
  readonly shDegree: number = 0;
  /** Counts changes of what is drawn. */
  nChanges = 0;
  private readonly entity: Entity;
  /** One entity for each resource: a part of the scene. */
  private readonly drawing: Entity[] = [];

  constructor(
    readonly name: string,
    readonly bytes: number,
    protected readonly stage: Stage,
    private readonly side: Side,
  ) {
    this.entity = new Entity(`scene ${side}`, stage.app);
    stage.app.root.addChild(this.entity);
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
  /** Boxes for the overlay, in the entity's coordinates. */
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

  /** `origin` of the stage's coordinates, world. */
  place(origin: readonly number[]): void {
    const [x, y, z] = this.origin.map((value, i) => value - (origin[i] as number)) as [number, number, number];
    this.entity.setLocalPosition(x, y, z);
  }

  /** Reads the rest of a scene whose first part is drawn. Rejects if the file is damaged; the scene must then be destroyed. */
  async complete(): Promise<void> {}

  set hidden(hidden: boolean) {
    this.entity.enabled = !hidden;
    this.stage.request();
  }

  destroy(): void {
    this.entity.destroy();
    this.stage.request();
  }

  protected local(point: readonly number[]): number[] {
    return point.map((value, i) => value - (this.origin[i] as number));
  }

  /** Half a turn around the x axis. */
  protected turnOver(): void {
    this.entity.setLocalEulerAngles(180, 0, 0);
  }

  /** Draws one more resource. */
  protected add(resource: GSplatResourceBase): void {
    const entity = new Entity(undefined, this.stage.app);
    entity.addComponent("gsplat", { layers: [this.stage.layers[this.side]], resource });
    this.entity.addChild(entity);
    this.drawing.push(entity);
    this.hasChanged();
  }

  /** Draws a resource instead of the one before. */
  protected replace(resource: GSplatResourceBase): void {
    const gsplat = this.drawing[0]?.gsplat;
    if (!gsplat) {
      this.add(resource);
      return;
    }
    const before = gsplat.resource as GSplatResourceBase | null;
    gsplat.resource = resource;
    before?.destroy();
    this.hasChanged();
  }

  /** Applies changes of the resources' tables. */
  protected refresh(): void {
    for (const { gsplat } of this.drawing) if (gsplat) gsplat.workBufferUpdate = WORKBUFFER_UPDATE_ONCE;
    this.hasChanged();
  }

  private hasChanged(): void {
    this.nChanges += 1;
    this.stage.request();
  }
}
