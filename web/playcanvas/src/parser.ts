// parser.ts - loads .rgs files as gsplat assets of the engine.
// SPDX-License-Identifier: Apache-2.0
import { antiAliasingOf, open, type OpenOptions, RgsError, type Source } from "@roofgs/reader";
import type { AppBase, Asset } from "playcanvas";
import { RgsResource } from "./resource.js";
import { readStoredParts } from "./stored.js";

/** Options for every file: limits, headers, the compiled module. */
export type RgsParserOptions = Omit<OpenOptions, "signal" | "onProgress">;

// The engine's type is string or null, but it passes on any error.
type Callback = (error: any, resource?: RgsResource) => void;
type Contents = ArrayBuffer | Blob | Response | undefined;

/** Loads gsplat assets whose URL ends in .rgs, once it is added to the engine's handler of gsplat assets. */
export class RgsParser {
  /** `options` are those of open() of `@roofgs/reader`, for every file. */
  constructor(
    private readonly app: AppBase,
    private readonly options: RgsParserOptions = {},
  ) {}

  /** Called by the engine: whether the extension is rgs. */
  canParse(context: { ext: string }): boolean {
    return context.ext === "rgs";
  }

  /** Called by the engine: gives the callback an RgsResource of the finest level, or an error, an RgsError if the file is at fault. */
  load(
    url: string | { load: string; original: string },
    callback: Callback,
    asset?: Asset & { file?: { contents?: Contents | Promise<Contents> } },
  ): void {
    this.read(typeof url === "string" ? url : url.load, asset).then(
      (resource) => callback(null, resource),
      (error: unknown) => callback(error),
    );
  }

  /** Called by the engine: returns what load() gave. */
  open(_url: string, data: unknown): unknown {
    return data;
  }

  private async read(url: string, asset: Parameters<RgsParser["load"]>[2]): Promise<RgsResource> {
    const contents = await asset?.file?.contents;
    const source: Source = contents instanceof Response ? await contents.arrayBuffer() : (contents ?? new URL(url, document.baseURI));
    const file = await open(source, this.options);
    try {
      const parts = await readStoredParts(file, {
        onProgress: ({ done, total }) => asset?.fire("progress", done, total),
      });
      if (parts.length === 0) throw new RgsError({ code: "unsupported_feature", text: "the file holds no Gaussians" });
      const prepareCenters = (this.app.scene as { gsplatCentersEnabled?: boolean }).gsplatCentersEnabled !== false;
      return new RgsResource(this.app.graphicsDevice, parts, { prepareCenters, antiAliasing: antiAliasingOf(file.declarations) });
    } finally {
      file.close();
    }
  }
}
