// splat-scene.ts - a PLY or an SPZ, all of it in memory as arrays.
// SPDX-License-Identifier: Apache-2.0
import { type AntiAliasing, type FirstView, subjectBox, type Vector3 } from "@roofgs/reader";
import { add } from "./cameras.js";
import { firstView } from "./first-view.js";
import type { OpenOther } from "./open-scene.js";
import { type ReadSplats, readSplats } from "./read-splats.js";
import { worker } from "./reader-worker.js";
import { type Box, Scene } from "./scene.js";
import { type Axes, kOpenGlAxes, kPlyAxes, upOf } from "./splats.js";
import type { Stage } from "./stage.js";

function joined(arrays: readonly Float32Array[]): Float32Array {
  const all = new Float32Array(arrays.reduce((sum, { length }) => sum + length, 0));
  let at = 0;
  for (const each of arrays) {
    all.set(each, at);
    at += each.length;
  }
  return all;
}

export class SplatScene extends Scene {
  readonly nGaussians: number;
  readonly box: Box;
  override readonly shDegree: number;
  override readonly up: Vector3 | null;

  static async open(stage: Stage, kind: "ply" | "spz", options: OpenOther): Promise<Scene> {
    const { answer, spzAxes, axes, onProgress, signal, on, name } = options;
    const read = await readSplats(kind, answer, spzAxes === "opengl" ? kOpenGlAxes : kPlyAxes, axes, onProgress, signal);
    const nDrawn = read.parts.reduce((sum, { n }) => sum + n, 0);
    if (nDrawn === 0) throw new Error(read.n > 0 ? "all of its Gaussians are damaged" : "it holds no Gaussians");
    // A scene whose view cannot be chosen is seen as its box tells.
    const first = await firstView(read.parts, signal, upOf(axes) ?? undefined).catch(() => null);
    signal.throwIfAborted();
    const box = await subjectBox(joined(read.parts.map(({ means }) => means)), joined(read.parts.map(({ opacities }) => opacities)), worker ? { worker } : {});
    signal.throwIfAborted();
    if (nDrawn < read.n) on.damaged({ code: "gaussians_damaged", text: `${read.n - nDrawn} of ${read.n}` });
    const source = kind === "ply" ? options.source : undefined;
    return new SplatScene(name, Number(answer.headers.get("content-length") ?? 0), source, read, axes, box, first, stage, options.side, options.shDegree);
  }

  private constructor(
    name: string,
    bytes: number,
    override readonly source: Blob | string | undefined,
    private readonly read: ReadSplats,
    override readonly axes: Axes,
    box: Box,
    override readonly firstView: FirstView | null,
    stage: Stage,
    side: OpenOther["side"],
    private shown: number,
  ) {
    super(name, bytes, stage, side, read.origin);
    this.box = { min: add(box.min, read.origin), max: add(box.max, read.origin) };
    this.nGaussians = read.n;
    this.shDegree = read.shDegree;
    this.up = upOf(axes);
    this.begin();
  }

  get nDrawn(): number {
    return this.read.parts.reduce((sum, { n }) => sum + n, 0);
  }

  centres(): Iterable<Float32Array> {
    return this.read.parts.map(({ means }) => means);
  }

  setShDegree(shDegree: number): void {
    if (shDegree === this.shown) return;
    this.shown = shDegree;
    this.draw();
  }

  override antiAliasing(): AntiAliasing {
    return this.read.antiAliasing;
  }

  protected draw(): void {
    this.splats.set(this.read.parts, this.shown, []);
    this.hasChanged();
  }
}
