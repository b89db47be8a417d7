// scene.ts - an opened scene: what it is, what of it is drawn.
// SPDX-License-Identifier: Apache-2.0
import type { AntiAliasing } from "@roofgs/playcanvas";
import { Entity, type GSplatResourceBase, WORKBUFFER_UPDATE_ONCE } from "playcanvas";
import type { CutView } from "./levels.js";
import type { Side, Stage } from "./stage.js";

export interface Box {
  min: readonly number[];
  max: readonly number[];
}

export type Tint = "none" | "level" | "error";

/** What is shown of how far loading is. `total` 0: nobody knows. */
export type OnProgress = (text: "read" | "decode", done: number, total: number) => void;

/** One scene on one side of the stage. */
export abstract class Scene {
  abstract readonly nGaussians: number;
  abstract readonly shDegree: number;
  /** Most of what shows, world. */
  abstract readonly box: Box;
  /** Where the world's up is, if the file says so. */
  readonly up: readonly number[] | null = null;
  readonly origin: readonly number[] = [0, 0, 0];
  readonly hasPages: boolean = false;
  /** How often something else has been drawn. */
  nChanges = 0;
  private readonly entity: Entity;
  /** What draws resources, a part of the scene each. */
  private readonly drawing: Entity[] = [];

  constructor(
    readonly name: string,
    readonly bytes: number,
    protected readonly stage: Stage,
    private readonly side: Side,
  ) {
    this.entity = new Entity(`scene ${side}`);
    stage.app.root.addChild(this.entity);
  }

  /** Gaussians on the GPU now. */
  abstract get nDrawn(): number;
  get bytesRead(): number {
    return this.bytes;
  }
  /** Pages drawn and wanted, of scenes that have some. */
  get pages(): { drawn: number; wanted: number } {
    return { drawn: 0, wanted: 0 };
  }
  /** Boxes that an overlay shows, in coordinates of the entity. */
  boxes(): Box[] {
    return [{ min: this.local(this.box.min), max: this.local(this.box.max) }];
  }
  /** Means for picking, [n, 3] relative to `origin`. */
  abstract centres(): Iterable<Float32Array>;
  abstract setShDegree(degree: number): void;
  /** What the file declares, `detailPx` being the error that may be drawn; undefined if nothing. */
  antiAliasing(_detailPx: number): AntiAliasing | undefined {
    return undefined;
  }
  setTint(_tint: Tint): void {}
  /** Before a frame; only scenes with pages care. */
  look(_view: CutView, _now: number): void {}

  /** `origin`: where the stage's coordinates begin in the world. */
  place(origin: readonly number[]): void {
    const [x, y, z] = this.origin.map((value, i) => value - (origin[i] as number)) as [number, number, number];
    this.entity.setLocalPosition(x, y, z);
  }

  /** What is still to come of a scene of which a part is drawn. Rejects if the file is not sound: then nothing of it may stay. */
  async complete(): Promise<void> {}

  /** Hidden it can come back. */
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

  /** By half a turn around the x axis. */
  protected turnOver(): void {
    this.entity.setLocalEulerAngles(180, 0, 0);
  }

  /** Draws a resource beside what is drawn. */
  protected add(resource: GSplatResourceBase): void {
    const entity = new Entity();
    entity.addComponent("gsplat", { layers: [this.stage.layers[this.side]], resource });
    this.entity.addChild(entity);
    this.drawing.push(entity);
    this.hasChanged();
  }

  /** Draws a resource in place of the one before. */
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

  /** Tables of resources have changed. */
  protected refresh(): void {
    for (const { gsplat } of this.drawing) if (gsplat) gsplat.workBufferUpdate = WORKBUFFER_UPDATE_ONCE;
    this.hasChanged();
  }

  private hasChanged(): void {
    this.nChanges += 1;
    this.stage.request();
  }
}
