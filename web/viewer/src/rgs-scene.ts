// rgs-scene.ts - an opened .rgs file, drawn part by part while it is read, or by pages from coarse to fine.
// SPDX-License-Identifier: Apache-2.0
import { type AntiAliasing, antiAliasingOf, type FirstView, type Look, type PageEvent, type PageScheduler, type Progress, type RgsFile, type StoredGaussians, type Vector3 } from "@roofgs/reader";
import type { Colour } from "@roofgs/webgpu";
import { isWorthShowing } from "./first-picture.js";
import { firstView } from "./first-view.js";
import { kSchedule, PageDriver, type Trouble } from "./page-driver.js";
import type { Side } from "./renderer.js";
import { type Box, Scene, type Tint } from "./scene.js";
import { type Axes, upOf } from "./splats.js";
import type { Stage } from "./stage.js";

/** Least time between two uploads to the GPU. */
const kRebuildMs = 250;

const kLevelColours: readonly Colour[] = [[0.9, 0.2, 0.2], [0.95, 0.6, 0.1], [0.9, 0.9, 0.2], [0.3, 0.8, 0.3], [0.2, 0.7, 0.9], [0.3, 0.35, 0.95], [0.7, 0.3, 0.9]];

/** An opened file whose first Gaussians are in flight. */
export interface OpenedFile {
  file: RgsFile;
  /** Only the root if the file has levels of detail. */
  parts: AsyncGenerator<StoredGaussians, void, undefined>;
  first: Promise<IteratorResult<StoredGaussians, void>>;
  /** Null without levels of detail. */
  scheduler: Promise<PageScheduler> | null;
  /** Only counted if the file has no levels of detail. */
  bytesRead: number;
}

/** Starts reading a file's Gaussians. `onProgress`: bytes read. */
export function beginFile(file: RgsFile, onProgress: (done: number, total: number) => void): OpenedFile {
  async function* root(): AsyncGenerator<StoredGaussians, void, undefined> {
    yield await file.readPageStored(0);
  }
  const progress = ({ phase, done, total }: Progress): void => {
    if (phase !== "read") return;
    opened.bytesRead = done;
    onProgress(done, total ?? 0);
  };
  const parts = file.levels ? root() : file.storedParts({ onProgress: progress });
  const opened = { file, parts, first: parts.next(), scheduler: file.levels && file.pageScheduler(kSchedule), bytesRead: 0 };
  // Whoever awaits them gets the error; until then it is not unhandled.
  for (const each of [opened.first, opened.scheduler]) each?.catch(() => undefined);
  return opened;
}

export class RgsScene extends Scene {
  readonly nGaussians: number;
  readonly box: Box;
  override readonly axes: Axes;
  override readonly up: Vector3 | null;
  override firstView: FirstView | null;
  override readonly hasPages: boolean;
  override readonly shDegree: number;
  private readonly file: RgsFile;
  private parts: StoredGaussians[] = [];
  private drawn: readonly number[] = [];
  private shown = { shDegree: 3, tint: "none" as Tint };
  private readonly stop = new AbortController();
  private readonly driver: PageDriver<StoredGaussians> | undefined;
  /** When the first view was looked at, ms. */
  private waitsSince: number | undefined;
  private rebuilt = -Infinity;
  private read = 0;
  private view: Look | undefined;
  /** The view that the colours by error were computed for. */
  private tinted: Look | undefined;

  constructor(
    name: string,
    private readonly opened: OpenedFile,
    first: StoredGaussians,
    scheduler: PageScheduler | null,
    stage: Stage,
    side: Side,
    on: Trouble,
  ) {
    const { file } = opened;
    const { origin } = file.declarations;
    super(name, file.fileBytes, stage, side, origin);
    this.file = file;
    const box = file.subjectBox as Box;
    this.box = { min: box.min.map((v, i) => v + (origin[i] as number)), max: box.max.map((v, i) => v + (origin[i] as number)) };
    this.nGaussians = file.header.nGaussians;
    this.axes = file.declarations.axes;
    this.up = upOf(this.axes);
    this.firstView = file.firstView;
    this.hasPages = file.levels !== null;
    this.shDegree = file.header.shDegree;
    const { levels } = file;
    if (levels && scheduler) {
      this.read = levels.page(0).storedBytes;
      const childrenOf = (index: number): number[] => {
        const { firstChild, nChildren } = levels.page(index);
        return Array.from({ length: nChildren }, (_, i) => firstChild + i);
      };
      const read = async (index: number): Promise<StoredGaussians> => {
        const stored = await file.readPageStored(index, { signal: this.stop.signal });
        this.read += levels.page(index).storedBytes;
        return stored;
      };
      const readTable = (group: number): Promise<PageEvent> => file.readTable(group, { signal: this.stop.signal });
      this.driver = new PageDriver(scheduler, { childrenOf, read, readTable }, first, { ...on, changed: () => this.stage.request() });
      const { fileBytes } = file.header;
      if (file.fileBytes < fileBytes) on.damaged({ code: "pages_missing", text: `the file has ${file.fileBytes} of its ${fileBytes} bytes` });
    } else {
      this.drawn = [0];
      this.parts = [first];
      this.begin();
    }
  }

  override async complete(): Promise<void> {
    try {
      for await (const part of this.opened.parts) this.addPart(part);
    } catch (error) {
      if (!this.stop.signal.aborted) throw error;
    }
    if (this.hasPages) return;
    this.file.close();
    if (this.stop.signal.aborted) return;
    // A scene whose view cannot be chosen is seen as its box tells.
    this.firstView ??= await firstView(this.parts, this.stop.signal, this.up ?? undefined).catch(() => null);
  }

  get nDrawn(): number {
    return this.parts.reduce((sum, { n }) => sum + n, 0);
  }

  override get bytesRead(): number {
    return this.hasPages ? this.read : this.opened.bytesRead;
  }

  override get pages(): { drawn: number; wanted: number } {
    return { drawn: this.hasPages ? this.drawn.length : 0, wanted: this.driver?.nWanted ?? 0 };
  }

  override boxes(): Box[] {
    const levels = this.file.levels;
    return levels ? this.drawn.map((index) => levels.page(index).core) : super.boxes();
  }

  centres(): Iterable<Float32Array> {
    return this.parts.map(({ means }) => means);
  }

  setShDegree(shDegree: number): void {
    if (shDegree === this.shown.shDegree) return;
    this.shown = { ...this.shown, shDegree };
    this.draw();
  }

  override setTint(tint: Tint): void {
    if (tint === this.shown.tint) return;
    this.shown = { ...this.shown, tint };
    this.draw();
  }

  override antiAliasing(detailPx: number): AntiAliasing {
    return antiAliasingOf(this.file.declarations, this.hasPages && detailPx > 0);
  }

  override look(looking: Omit<Look, "zNear">, now: number): void {
    const view = { ...looking, zNear: this.file.declarations.zNear };
    this.view = view;
    const { driver } = this;
    if (!driver) return;
    driver.look(view, (draw) => {
      this.tintAnew(view, now);
      if (draw.length === this.drawn.length && draw.every((index, i) => index === this.drawn[i])) return;
      this.waitsSince ??= now;
      const errorPx = Math.max(...draw.map((index) => driver.errorPx(index)));
      const isFirst = this.nDrawn === 0;
      if (isFirst ? !isWorthShowing(errorPx, driver.nWanted, now - this.waitsSince) : now - this.rebuilt < kRebuildMs) {
        this.stage.request();
        return;
      }
      this.rebuilt = now;
      this.rebuild(driver, draw);
    });
  }

  /** Projected errors, and so the colours by error, depend on the view. */
  private tintAnew(view: Look, now: number): void {
    const { tinted } = this;
    if (this.shown.tint !== "error") return;
    if (tinted && tinted.focalPx === view.focalPx && tinted.position.every((value, i) => value === view.position[i])) return;
    if (now - this.rebuilt < kRebuildMs) {
      this.stage.request();
      return;
    }
    this.tinted = view;
    this.rebuilt = now;
    this.draw();
  }

  override destroy(): void {
    this.driver?.end();
    this.stop.abort();
    this.file.close();
    super.destroy();
  }

  protected draw(): void {
    const { shDegree, tint } = this.shown;
    this.splats.set(this.parts, shDegree, tint === "none" || !this.hasPages ? [] : this.drawn.map((index) => this.colourOf(index, tint)));
    this.hasChanged();
  }

  private addPart(part: StoredGaussians): void {
    if (this.stop.signal.aborted) return;
    this.parts = [...this.parts, part];
    this.draw();
  }

  private rebuild(driver: PageDriver<StoredGaussians>, draw: readonly number[]): void {
    this.drawn = draw;
    this.parts = draw.map((index) => driver.page(index));
    this.draw();
  }

  private colourOf(index: number, tint: Tint): Colour {
    const page = this.file.levels?.page(index);
    if (!page) return [0, 0, 0];
    if (tint === "level") return kLevelColours[page.level % kLevelColours.length] as Colour;
    const share = this.driver && this.view ? Math.min(1, this.driver.errorPx(index) / 4) : 0;
    return [share, 1 - share, 0.2];
  }
}

