// engine-scene.ts - PLY, compressed PLY, SOG and SPZ, loaded by the engine.
// SPDX-License-Identifier: Apache-2.0
import { type AntiAliasing, antiAliasingOf, type FirstView, subjectBox } from "@roofgs/reader";
import { Asset, type GSplatData, type GSplatResourceBase } from "playcanvas";
import { antiAliasingOfComments, antiAliasingOfMeta } from "./declared.js";
import { firstView } from "./first-view.js";
import type { OpenScene } from "./open-scene.js";
import type { EngineRenderer, EngineSplats } from "./engine-renderer.js";
import type { EngineKind } from "./kind.js";
import { worker } from "./reader-worker.js";
import type { Side } from "./renderer.js";
import { type Box, Scene } from "./scene.js";
import { type Part, seenOf } from "./seen.js";
import { readSpz } from "./spz-resource.js";
import type { Stage } from "./stage.js";

export interface OpenEngineScene extends Omit<OpenScene, "read" | "on"> {
  kind: EngineKind;
  answer: Response;
  source: Blob | string | undefined;
}

/** A resource of the engine, and how to release it. */
interface Made {
  resource: GSplatResourceBase;
  end(): void;
  /** Turned. */
  seen: Iterable<Part>;
  /** Axes are right, up, backward; the scene is turned to right, down, forward. */
  isYUp?: boolean;
  antiAliasing: AntiAliasing;
}

/** Counts assets, for their names. */
let nAssets = 0;

async function makeSpz({ app }: EngineRenderer, { answer, spzAxes }: OpenEngineScene): Promise<Made> {
  const { antialiased, ...made } = await readSpz(app.graphicsDevice, await answer.arrayBuffer(), spzAxes);
  const antiAliasing = antiAliasingOf({ aaMode: antialiased ? "mip_splatting" : "classic" });
  return { ...made, end: () => made.resource.destroy(), antiAliasing };
}

async function makeAsset({ app }: EngineRenderer, { name, kind, answer, onProgress }: OpenEngineScene): Promise<Made> {
  const contents = kind === "ply" ? answer : await answer.arrayBuffer();
  // The engine takes assets of the same address for the same scene.
  const filename = `scene${(nAssets += 1)}.${kind}`;
  const asset = new Asset(name, "gsplat", { url: filename, filename, contents } as object);
  const { assets } = app;
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
    const antiAliasing = antiAliasingOf(meta ? antiAliasingOfMeta(meta) : antiAliasingOfComments(comments));
    return { resource, end, seen: await seenOf(resource.gsplatData as GSplatData), antiAliasing };
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

  static async open(stage: Stage, options: OpenEngineScene): Promise<Scene> {
    const bytes = Number(options.answer.headers.get("content-length") ?? 0);
    const engine = await stage.useEngine();
    const { seen, ...made } = await (options.kind === "spz" ? makeSpz(engine, options) : makeAsset(engine, options));
    if (!((made.resource.numSplats as number) > 0)) {
      made.end();
      throw new Error("it holds no Gaussians");
    }
    const { centers } = made.resource;
    const means = (made.isYUp ? centers?.map((value, i) => (i % 3 === 0 ? value : -value)) : centers) ?? new Float32Array();
    try {
      const opacities = new Float32Array(made.resource.numSplats as number);
      let n = 0;
      const parts = function* (): Generator<Part> {
        for (const part of seen) {
          opacities.set(part.opacities, n);
          n += part.opacities.length;
          yield part;
        }
      };
      const first = await firstView(parts());
      const box = await subjectBox(means, opacities, worker ? { worker } : {});
      // The converter takes no compressed PLY.
      const source = options.kind === "ply" && !(made.resource.gsplatData as GSplatData).isCompressed ? options.source : undefined;
      return new EngineScene(options.name, bytes, source, made, means, box, first, stage, options.side);
    } catch (error) {
      made.end();
      throw error;
    }
  }

  private constructor(
    name: string,
    bytes: number,
    override readonly source: Blob | string | undefined,
    private readonly made: Omit<Made, "seen">,
    /** [n, 3], turned. */
    private readonly means: Float32Array,
    readonly box: Box,
    override readonly firstView: FirstView | null,
    stage: Stage,
    side: Side,
  ) {
    super(name, bytes, stage, side, [0, 0, 0]);
    this.nGaussians = made.resource.numSplats as number;
    this.draw();
  }

  get nDrawn(): number {
    return this.nGaussians;
  }

  *centres(): Iterable<Float32Array> {
    yield this.means;
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

  protected draw(): void {
    // The engine stays.
    const splats = this.splats as EngineSplats;
    if (this.made.isYUp) splats.turnOver();
    splats.add(this.made.resource);
    this.hasChanged();
  }
}
