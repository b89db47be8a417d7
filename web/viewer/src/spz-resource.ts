// spz-resource.ts - the engine's resource for .spz, without its parser: that reads only version 4, and loads a script.
// SPDX-License-Identifier: Apache-2.0
import { decompress } from "@roofgs/reader";
import { type BoundingBox, type GraphicsDevice, type GSplatResourceBase, Vec3 } from "playcanvas";
import { GSplatSpzResource } from "playcanvas/scripts/esm/parsers/spz-parser.mjs";
import { worker } from "./reader-worker.js";
import { type Header, kRest, type SpzAxes, type Streams, decompressSpz } from "./spz.js";

/** The data interface that the engine's resource expects. */
class Data {
  readonly numSplats: number;
  readonly fractionalBits: number;
  readonly shBands: number;
  readonly shDim: number;
  readonly antialiased: boolean;

  constructor(
    header: Header,
    private readonly streams: Streams,
  ) {
    this.numSplats = header.n;
    this.fractionalBits = header.fractionalBits;
    this.shBands = header.shDegree;
    this.shDim = kRest[header.shDegree];
    this.antialiased = header.antialiased;
    // The resource looks for the streams by these names.
    Object.assign(this, streams);
  }

  getCenters(): Float32Array {
    const { positions } = this.streams;
    const centers = new Float32Array(3 * this.numSplats);
    for (let i = 0; i < centers.length; ++i) {
      const code = (positions[3 * i] as number) | ((positions[3 * i + 1] as number) << 8) | ((positions[3 * i + 2] as number) << 16);
      centers[i] = ((code << 8) >> 8) / 2 ** this.fractionalBits;
    }
    return centers;
  }

  calcAabb(box: BoundingBox): void {
    const min = [Infinity, Infinity, Infinity];
    const max = [-Infinity, -Infinity, -Infinity];
    const centers = this.getCenters();
    for (let i = 0; i < centers.length; ++i) {
      min[i % 3] = Math.min(min[i % 3] as number, centers[i] as number);
      max[i % 3] = Math.max(max[i % 3] as number, centers[i] as number);
    }
    box.setMinMax(new Vec3(min), new Vec3(max));
  }
}

export async function readSpz(device: GraphicsDevice, contents: ArrayBuffer): Promise<{ resource: GSplatResourceBase; antialiased: boolean; axes: SpzAxes | null; opacities: Float32Array }> {
  const { header, streams, axes } = await decompressSpz(contents, (streams) => decompress(streams, worker ? { worker } : {}));
  if (header.n === 0) throw new Error("it holds no Gaussians");
  return { resource: new GSplatSpzResource(device, new Data(header, streams)), antialiased: header.antialiased, axes, opacities: Float32Array.from(streams.alphas, (code) => code / 255) };
}
