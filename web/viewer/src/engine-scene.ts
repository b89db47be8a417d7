// engine-scene.ts - PLY, compressed PLY, SOG and SPZ, loaded by the engine.
// SPDX-License-Identifier: Apache-2.0
import { type AntiAliasing, antiAliasingOf } from "@roofgs/playcanvas";
import { Asset, type GSplatResourceBase } from "playcanvas";
import { antiAliasingOfComments, antiAliasingOfMeta } from "./declared.js";
import { type Box, Scene } from "./scene.js";
import type { SpzAxes } from "./spz.js";
import { readSpz } from "./spz-resource.js";
import type { Side, Stage } from "./stage.js";

export type EngineKind = "ply" | "sog" | "spz";

export interface OpenEngineScene {
  name: string;
  kind: EngineKind;
  answer: Response;
  /** Of an SPZ that declares none. */
  spzAxes: SpzAxes;
  side: Side;
  onProgress(done: number, total: number): void;
}

/** A resource of the engine, and how to release it. */
interface Made {
  resource: GSplatResourceBase;
  end(): void;
  /** Axes are right, up, backward; the scene is turned to right, down, forward. */
  isYUp?: boolean;
  antiAliasing: AntiAliasing;
}

/** Counts assets, for their names. */
let nAssets = 0;

async function makeSpz({ app }: Stage, { answer, spzAxes }: OpenEngineScene): Promise<Made> {
  const { resource, antialiased, axes } = await readSpz(app.graphicsDevice, await answer.arrayBuffer());
  const antiAliasing = antiAliasingOf({ aaMode: antialiased ? "mip_splatting" : "classic" });
  return { resource, end: () => resource.destroy(), isYUp: (axes ?? spzAxes) === "opengl", antiAliasing };
}

async function makeAsset(stage: Stage, { name, kind, answer, onProgress }: OpenEngineScene): Promise<Made> {
  const contents = kind === "ply" ? answer : await answer.arrayBuffer();
  // The engine takes assets of the same address for the same scene.
  const filename = `scene${(nAssets += 1)}.${kind}`;
  const asset = new Asset(name, "gsplat", { url: filename, filename, contents } as object);
  const { assets } = stage.app;
  // Without this the engine would request images that a SOG lacks from the page's server.
  const images: Asset[] = [];
  const missing: string[] = [];
  const withhold = (added: Asset): void => {
    if (added.type !== "texture") return;
    images.push(added);
    const file = added.file as { contents?: ArrayBuffer };
    if (file.contents) return;
    missing.push(added.name);
    file.contents = new ArrayBuffer(0);
  };
  const end = (): void => {
    assets.remove(asset);
    asset.unload();
  };
  assets.on("add", withhold);
  try {
    await new Promise<void>((resolve, reject) => {
      asset.on("progress", onProgress);
      asset.on("load", () => resolve());
      asset.on("error", (error: unknown) => reject(asSentence(kind, error)));
      assets.add(asset);
      assets.load(asset);
    });
    if (missing.length > 0) throw lacking(missing);
  } catch (error) {
    end();
    // Images of a scene that was loaded are removed with it.
    for (const image of images) assets.remove(image);
    throw missing.length > 0 ? lacking(missing) : error;
  } finally {
    assets.off("add", withhold);
  }
  const resource = asset.resource as GSplatResourceBase;
  const { comments = [], meta } = resource.gsplatData as { comments?: string[]; meta?: object };
  try {
    return { resource, end, antiAliasing: antiAliasingOf(meta ? antiAliasingOfMeta(meta) : antiAliasingOfComments(comments)) };
  } catch (error) {
    end();
    throw error;
  }
}

/** With the code that rgs-convert reports. */
function lacking(images: readonly string[]): Error {
  return Object.assign(new Error(), { code: "missing_section", text: `the zip archive lacks ${images.join(", ")}, which its meta.json names` });
}

/** Replaces errors that the engine throws at damaged files by sentences. */
function asSentence(kind: EngineKind, error: unknown): Error {
  if (error instanceof TypeError || error instanceof RangeError) {
    const parts = kind === "sog" ? "the zip archive or its meta.json" : "the file";
    return Object.assign(new Error(), { code: "bad_header", text: `${parts} lacks what ${kind.toUpperCase()} must have` });
  }
  const text = String((error as { message?: string } | null)?.message ?? error).replace(/^Error: /, "");
  // The engine says so wherever a PLY ends too early.
  if (/^Stream finished before end of header/.test(text)) return Object.assign(new Error(), { code: "truncated", text: "the file ends before the last Gaussian that its header counts" });
  return error instanceof Error ? error : new Error(text);
}

export class EngineScene extends Scene {
  readonly nGaussians: number;
  readonly shDegree: number;
  readonly box: Box;
  /** [n, 3], turned. */
  private readonly means: Float32Array | null;

  static async open(stage: Stage, options: OpenEngineScene): Promise<Scene> {
    const bytes = Number(options.answer.headers.get("content-length") ?? 0);
    const made = await (options.kind === "spz" ? makeSpz(stage, options) : makeAsset(stage, options));
    if (!((made.resource.numSplats as number) > 0)) {
      made.end();
      throw new Error("it holds no Gaussians");
    }
    return new EngineScene(options.name, bytes, made, stage, options.side);
  }

  private constructor(
    name: string,
    bytes: number,
    private readonly made: Made,
    stage: Stage,
    side: Side,
  ) {
    super(name, bytes, stage, side);
    const { resource, isYUp = false } = made;
    const { center, halfExtents } = resource.aabb;
    const sign = isYUp ? -1 : 1;
    const [c, h] = [[center.x, sign * center.y, sign * center.z], [halfExtents.x, halfExtents.y, halfExtents.z]];
    this.means = isYUp ? (resource.centers?.map((value, i) => (i % 3 === 0 ? value : -value)) ?? null) : resource.centers;
    this.box = robustBox(this.means) ?? { min: c.map((v, i) => v - (h[i] as number)), max: c.map((v, i) => v + (h[i] as number)) };
    this.nGaussians = resource.numSplats as number;
    this.shDegree = (resource as unknown as { shBands?: number }).shBands ?? (resource.gsplatData as { shBands?: number }).shBands ?? 0;
    if (isYUp) this.turnOver();
    this.add(resource);
  }

  get nDrawn(): number {
    return this.nGaussians;
  }

  *centres(): Iterable<Float32Array> {
    if (this.means) yield this.means;
  }

  /** The engine draws its own formats with all their SH. */
  setShDegree(): void {}

  override antiAliasing(): AntiAliasing {
    return this.made.antiAliasing;
  }

  override destroy(): void {
    super.destroy();
    this.made.end();
  }
}

/** 2nd to 98th percentile of a sample of the means. */
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
