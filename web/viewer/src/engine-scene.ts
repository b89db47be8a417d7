// engine-scene.ts - compressed PLY and SOG, loaded by the engine.
// SPDX-License-Identifier: Apache-2.0
import { type AntiAliasing, antiAliasingOf, type FirstView, subjectBox } from "@roofgs/reader";
import { Asset, type GSplatData, type GSplatResourceBase } from "playcanvas";
import { antiAliasingOfComments, antiAliasingOfMeta } from "./declared.js";
import { firstView } from "./first-view.js";
import type { OpenOther } from "./open-scene.js";
import type { EngineRenderer, EngineSplats } from "./engine-renderer.js";
import type { EngineKind } from "./kind.js";
import { worker } from "./reader-worker.js";
import { type Box, Scene } from "./scene.js";
import { type Part, seenOf } from "./seen.js";
import type { Stage } from "./stage.js";

/** A resource of the engine, and how to release it. */
interface Made {
  resource: GSplatResourceBase;
  end(): void;
  antiAliasing: AntiAliasing;
}

/** Counts assets, for their names. */
let nAssets = 0;

async function makeAsset({ app }: EngineRenderer, kind: EngineKind, { name, answer, onProgress }: OpenOther): Promise<Made> {
  const contents = kind !== "sog" ? answer : await answer.arrayBuffer();
  // The engine takes assets of the same address for the same scene.
  const filename = `scene${(nAssets += 1)}.${kind === "sog" ? kind : "ply"}`;
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
    return { resource, end, antiAliasing };
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
    const text = kind === "sog" ? "the zip archive or its meta.json lacks what a SOG must have" : "the file lacks what a compressed PLY must have";
    return Object.assign(new Error(), { code: "bad_header", text });
  }
  const text = String((error as { message?: string } | null)?.message ?? error).replace(/^Error: /, "");
  // The engine says so wherever a PLY ends too early.
  if (/^Stream finished before end of header/.test(text)) return Object.assign(new Error(), { code: "truncated", text: "the file ends before the last Gaussian that its header counts" });
  return error instanceof Error ? error : new Error(text);
}

export class EngineScene extends Scene {
  readonly nGaussians: number;

  static async open(stage: Stage, kind: EngineKind, options: OpenOther): Promise<Scene> {
    const bytes = Number(options.answer.headers.get("content-length") ?? 0);
    // Images of a SOG are textures of the engine from the first on.
    const made = await makeAsset(await stage.useEngine(), kind, options);
    if (!((made.resource.numSplats as number) > 0)) {
      made.end();
      throw new Error("it holds no Gaussians");
    }
    const means = made.resource.centers ?? new Float32Array();
    try {
      const opacities = new Float32Array(made.resource.numSplats as number);
      let n = 0;
      const parts = async function* (): AsyncGenerator<Part> {
        for await (const part of seenOf(made.resource.gsplatData as GSplatData)) {
          opacities.set(part.opacities, n);
          n += part.opacities.length;
          yield part;
        }
      };
      const first = await firstView(parts(), options.signal);
      const box = await subjectBox(means, opacities, worker ? { worker } : {});
      return new EngineScene(options.name, bytes, made, means, box, first, stage, options.side);
    } catch (error) {
      made.end();
      throw error;
    }
  }

  private constructor(
    name: string,
    bytes: number,
    private readonly made: Made,
    /** [n, 3] */
    private readonly means: Float32Array,
    readonly box: Box,
    override readonly firstView: FirstView | null,
    stage: Stage,
    side: OpenOther["side"],
  ) {
    super(name, bytes, stage, side, [0, 0, 0]);
    this.nGaussians = made.resource.numSplats as number;
    this.begin();
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
    (this.splats as EngineSplats).add(this.made.resource);
    this.hasChanged();
  }
}
