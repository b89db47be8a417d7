// scene.ts - an opened scene: what it is, what of it is drawn. Files of others come through the engine's own parsers.
// SPDX-License-Identifier: Apache-2.0
import { type Colour, RgsResource } from "@roofgs/playcanvas";
import { open, type RgsFile, type StoredGaussians } from "@roofgs/reader";
import { Asset, Entity, type GSplatResourceBase, WORKBUFFER_UPDATE_ONCE } from "playcanvas";
import { chooseCut, type Cut, type CutView } from "./levels.js";
import { readInside, type SceneEntry } from "./manifest.js";
import { worker } from "./reader-worker.js";
import type { Stage } from "./stage.js";

export interface Box {
  min: readonly number[];
  max: readonly number[];
}

export type Tint = "none" | "level" | "error";

/** What is shown of how far loading is. `total` 0: nobody knows. */
export type OnProgress = (text: "read" | "decode", done: number, total: number) => void;

/** Requests at a time. */
const kPagesAtATime = 4;
/** Pages that are kept beyond those drawn, by Gaussians. */
const kKept = 2;
/** Milliseconds between two rebuilds of what is on the GPU. */
const kRebuildMs = 250;

const kLevelColours: readonly Colour[] = [
  [0.9, 0.2, 0.2],
  [0.95, 0.6, 0.1],
  [0.9, 0.9, 0.2],
  [0.3, 0.8, 0.3],
  [0.2, 0.7, 0.9],
  [0.3, 0.35, 0.95],
  [0.7, 0.3, 0.9],
];

export function extensionOf(name: string): string {
  return name.slice(name.lastIndexOf(".") + 1).toLowerCase();
}

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
  protected readonly entity: Entity;

  constructor(
    readonly name: string,
    readonly bytes: number,
    protected readonly stage: Stage,
    side: 0 | 1,
  ) {
    this.entity = new Entity(`scene ${side}`);
    this.entity.addComponent("gsplat", { layers: [stage.layers[side]] });
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
  setTint(_tint: Tint): void {}
  /** Before a frame; only scenes with pages care. */
  look(_view: CutView, _now: number): void {}

  /** `origin`: where the stage's coordinates begin in the world. */
  place(origin: readonly number[]): void {
    const [x, y, z] = this.origin.map((value, i) => value - (origin[i] as number)) as [number, number, number];
    this.entity.setLocalPosition(x, y, z);
  }

  destroy(): void {
    this.entity.destroy();
    this.stage.request();
  }

  protected local(point: readonly number[]): number[] {
    return point.map((value, i) => value - (this.origin[i] as number));
  }

  protected show(resource: GSplatResourceBase): void {
    const { gsplat } = this.entity;
    if (!gsplat) return;
    const before = gsplat.resource as GSplatResourceBase | null;
    gsplat.resource = resource;
    before?.destroy();
    this.stage.request();
  }

  protected refresh(): void {
    if (this.entity.gsplat) this.entity.gsplat.workBufferUpdate = WORKBUFFER_UPDATE_ONCE;
    this.stage.request();
  }
}

function upOf(file: RgsFile): readonly number[] | null {
  const { axes } = file.declarations;
  const i = axes.findIndex((axis) => axis === "up" || axis === "down");
  return i < 0 ? null : [0, 1, 2].map((k) => (k === i ? (axes[i] === "up" ? 1 : -1) : 0));
}

/** An .rgs file: all of it at once, or page by page from coarse to fine. */
class RgsScene extends Scene {
  readonly nGaussians: number;
  readonly shDegree: number;
  readonly box: Box;
  override readonly up: readonly number[] | null;
  override readonly origin: readonly number[];
  override readonly hasPages: boolean;
  private parts: StoredGaussians[] = [];
  private drawn: number[] = [];
  private resource: RgsResource | undefined;
  private shown = { shDegree: 3, tint: "none" as Tint };
  private readonly kept = new Map<number, StoredGaussians>();
  private readonly stop = new AbortController();
  private readonly loading = new Set<number>();
  private readonly damaged = new Set<number>();
  private wanted: number[] = [];
  private rebuilt = -Infinity;
  private read = 0;
  private reported = false;
  private view: CutView | undefined;

  constructor(
    entry: { name: string; bytes: number },
    private readonly file: RgsFile,
    stage: Stage,
    side: 0 | 1,
    private readonly onError: (error: unknown) => void,
  ) {
    super(entry.name, file.fileBytes, stage, side);
    const { robust, full, origin } = file.declarations;
    const box = robust.max.some((value, i) => value > (robust.min[i] as number)) ? robust : full;
    this.box = { min: box.min.map((v, i) => v + (origin[i] as number)), max: box.max.map((v, i) => v + (origin[i] as number)) };
    this.nGaussians = file.header.nGaussians;
    this.shDegree = file.header.shDegree;
    this.origin = origin;
    this.up = upOf(file);
    this.hasPages = file.levels !== null;
  }

  /** The whole file, or of one with levels the coarsest page: what is drawn first. */
  async begin(onProgress: OnProgress): Promise<void> {
    const { signal } = this.stop;
    if (this.file.levels) {
      await this.fetchPage(0);
      this.rebuild([0]);
      if (this.file.nPresent < this.file.levels.nPages) {
        this.onError({ code: "pages_missing", text: `${this.file.nPresent} of ${this.file.levels.nPages} pages are there` });
      }
      return;
    }
    const stored = await this.file.readStored({ signal, onProgress: ({ phase, done, total }) => onProgress(phase, done, total ?? 0) });
    this.read = this.bytes;
    this.file.close();
    if (stored.n === 0) throw Object.assign(new Error("it holds no Gaussians"), { code: undefined });
    this.parts = [stored];
    this.drawn = [0];
    this.upload();
  }

  get nDrawn(): number {
    return this.parts.reduce((sum, { n }) => sum + n, 0);
  }

  override get bytesRead(): number {
    return this.read;
  }

  override get pages(): { drawn: number; wanted: number } {
    return { drawn: this.hasPages ? this.drawn.length : 0, wanted: this.wanted.length };
  }

  override boxes(): Box[] {
    const levels = this.file.levels;
    return levels ? this.drawn.map((index) => levels.page(index).core) : super.boxes();
  }

  centres(): Iterable<Float32Array> {
    return this.parts.map(({ means }) => means);
  }

  setShDegree(shDegree: number): void {
    this.shown = { ...this.shown, shDegree };
    this.setTable();
  }

  override setTint(tint: Tint): void {
    this.shown = { ...this.shown, tint };
    this.setTable();
  }

  override look(view: CutView, now: number): void {
    this.view = view;
    const cut = this.plan();
    if (!cut) return;
    const same = cut.draw.length === this.drawn.length && cut.draw.every((index, i) => index === this.drawn[i]);
    if (same || cut.draw.length === 0) return;
    if (now - this.rebuilt < kRebuildMs) {
      this.stage.request();
      return;
    }
    this.rebuilt = now;
    this.rebuild(cut.draw);
    this.forget(view.budget);
  }

  override destroy(): void {
    this.stop.abort();
    this.file.close();
    super.destroy();
    this.resource?.destroy();
  }

  /** What the view needs, of which some is asked for; more when it has come. */
  private plan(): Cut | undefined {
    const { file, view } = this;
    const { levels } = file;
    if (!levels || !view || this.stop.signal.aborted) return undefined;
    const cut = chooseCut((index) => levels.page(index), (index) => this.kept.has(index), view);
    this.wanted = cut.want.filter((index) => index < file.nPresent && !this.damaged.has(index));
    for (const index of this.wanted) {
      if (this.loading.size >= kPagesAtATime) break;
      if (this.loading.has(index)) continue;
      void this.fetchPage(index).catch((error: unknown) => {
        this.fail(error);
        // A server that is away has its slots for ever; what is damaged is not asked for again.
        if ((error as { code?: string }).code === "read_failed") return;
        this.loading.delete(index);
        this.damaged.add(index);
      });
    }
    return cut;
  }

  /** What cannot be read is said once; the page goes on with what it has. */
  private fail(error: unknown): void {
    if (this.stop.signal.aborted || this.reported) return;
    this.reported = true;
    this.onError(error);
  }

  private async fetchPage(index: number): Promise<void> {
    const { levels } = this.file;
    if (!levels) return;
    this.loading.add(index);
    const stored = await this.file.readPageStored(index, { signal: this.stop.signal });
    this.loading.delete(index);
    this.kept.set(index, stored);
    this.read += levels.page(index).storedBytes;
    this.plan();
    this.stage.request();
  }

  private rebuild(draw: number[]): void {
    this.drawn = draw;
    this.parts = draw.map((index) => this.kept.get(index) as StoredGaussians).filter(({ n }) => n > 0);
    if (this.parts.length > 0) this.upload();
  }

  /** Drops pages that were drawn longest ago. */
  private forget(budget: number): void {
    for (const index of this.drawn) {
      const stored = this.kept.get(index) as StoredGaussians;
      this.kept.delete(index);
      this.kept.set(index, stored);
    }
    let n = 0;
    for (const { n: count } of this.kept.values()) n += count;
    for (const [index, stored] of this.kept) {
      if (n <= kKept * budget || this.drawn.includes(index)) break;
      if (index !== 0) {
        this.kept.delete(index);
        n -= stored.n;
      }
    }
  }

  private upload(): void {
    this.resource = new RgsResource(this.stage.app.graphicsDevice, this.parts);
    this.setTable();
    this.show(this.resource);
  }

  private setTable(): void {
    const { shDegree, tint } = this.shown;
    this.resource?.setTable(shDegree, tint === "none" || !this.hasPages ? undefined : this.drawn.map((index) => this.colourOf(index, tint)));
    this.refresh();
  }

  private colourOf(index: number, tint: Tint): Colour {
    const page = this.file.levels?.page(index);
    if (!page) return [0, 0, 0];
    if (tint === "level") return kLevelColours[page.level % kLevelColours.length] as Colour;
    const { position, focalPx } = this.view ?? { position: [0, 0, 0], focalPx: 1 };
    const near = [0, 1, 2].map((i) => Math.max((page.core.min[i] as number) - (position[i] as number), 0, (position[i] as number) - (page.core.max[i] as number)));
    const errorPx = (page.error * focalPx) / Math.max(1e-9, Math.hypot(...near));
    const share = Math.min(1, errorPx / 4);
    return [share, 1 - share, 0.2];
  }
}

/** Assets of the engine so far. */
let nAssets = 0;

/** PLY, compressed PLY and SOG, by the engine. */
class EngineScene extends Scene {
  readonly nGaussians: number;
  readonly shDegree: number;
  readonly box: Box;

  constructor(
    entry: { name: string; bytes: number },
    private readonly asset: Asset,
    stage: Stage,
    side: 0 | 1,
  ) {
    super(entry.name, entry.bytes, stage, side);
    const resource = asset.resource as GSplatResourceBase;
    const { center, halfExtents } = resource.aabb;
    const [c, h] = [[center.x, center.y, center.z], [halfExtents.x, halfExtents.y, halfExtents.z]];
    this.box = robustBox(resource.centers) ?? { min: c.map((v, i) => v - (h[i] as number)), max: c.map((v, i) => v + (h[i] as number)) };
    this.nGaussians = resource.numSplats as number;
    this.shDegree = (resource as unknown as { shBands?: number }).shBands ?? (resource.gsplatData as { shBands?: number }).shBands ?? 0;
    this.show(resource);
  }
  get nDrawn(): number {
    return this.nGaussians;
  }
  *centres(): Iterable<Float32Array> {
    const centers = (this.entity.gsplat?.resource as GSplatResourceBase | null)?.centers;
    if (centers) yield centers;
  }
  /** The engine's own formats are drawn with all that they hold. */
  setShDegree(): void {}

  override destroy(): void {
    super.destroy();
    this.stage.app.assets.remove(this.asset);
    this.asset.unload();
  }
}

/** 2nd to 98th percentile of some thousand means. */
function robustBox(centers: Float32Array | null): Box | null {
  if (!centers || centers.length < 3) return null;
  const n = centers.length / 3;
  const step = Math.max(1, Math.floor(n / 20000));
  const sides = [0, 1, 2].map((c) => {
    const values: number[] = [];
    for (let i = 0; i < n; i += step) values.push(centers[3 * i + c] as number);
    values.sort((a, b) => a - b);
    const rank = (share: number): number => values[Math.round(share * (values.length - 1))] as number;
    return [rank(0.02), rank(0.98)] as const;
  });
  return { min: sides.map(([low]) => low), max: sides.map(([, high]) => high) };
}

export interface OpenScene {
  entry: SceneEntry;
  /** A file that was dropped or chosen. */
  file?: File;
  side: 0 | 1;
  onProgress: OnProgress;
  /** Of what comes later, page by page. */
  onError(error: unknown): void;
}

export async function openScene(stage: Stage, { entry, file, side, onProgress, onError }: OpenScene): Promise<Scene> {
  const blob = file ?? (entry.url.startsWith("#") ? await readInside(entry.url) : undefined);
  const extension = extensionOf(entry.name);
  const bytes = blob?.size ?? entry.bytes ?? 0;
  if (extension !== "ply" && extension !== "sog") {
    const source = blob ?? new URL(entry.url, document.baseURI);
    const rgs = await open(source, { ...(worker ? { worker } : {}), onProgress: ({ phase, done, total }) => onProgress(phase, done, total ?? 0) });
    const scene = new RgsScene({ name: entry.name, bytes }, rgs, stage, side, onError);
    try {
      await scene.begin(onProgress);
    } catch (error) {
      scene.destroy();
      throw error;
    }
    return scene;
  }
  const answer = blob ? new Response(blob, { headers: { "content-length": String(blob.size) } }) : await fetch(entry.url);
  if (!answer.ok) throw Object.assign(new Error(`HTTP ${answer.status}`), { code: "open_failed" });
  const contents = extension === "ply" ? answer : await answer.arrayBuffer();
  // The engine takes what has the same address for the same scene.
  const filename = `scene${(nAssets += 1)}.${extension}`;
  const asset = new Asset(entry.name, "gsplat", { url: filename, filename, contents } as object);
  try {
    await new Promise<void>((resolve, reject) => {
      asset.on("progress", (done: number, total: number) => onProgress("read", done, total));
      asset.on("load", () => resolve());
      asset.on("error", (error: unknown) => reject(error instanceof Error ? error : new Error(String(error))));
      stage.app.assets.add(asset);
      stage.app.assets.load(asset);
    });
  } catch (error) {
    stage.app.assets.remove(asset);
    throw error;
  }
  return new EngineScene({ name: entry.name, bytes }, asset, stage, side);
}
