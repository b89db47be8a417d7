// spz-resource.ts - the engine's resource for .spz, without its parser: that reads only version 4, and loads a script.
// SPDX-License-Identifier: Apache-2.0
import { readSpz as read, type Spz } from "@roofgs/reader";
import { type BoundingBox, type GraphicsDevice, type GSplatResourceBase, Vec3 } from "playcanvas";
import { GSplatSpzResource } from "playcanvas/scripts/esm/parsers/spz-parser.mjs";
import { worker } from "./reader-worker.js";
import { type Part, seenOfSpz } from "./seen.js";
import { axesOf, smallestThree, type SpzAxes } from "./spz.js";

/** SH coefficients beyond degree 0, per channel. */
const kRest = [0, 3, 8, 15];

/** The data that the engine's resource expects; it looks for the streams by their names. */
function dataOf({ n, fractionalBits, shDegree, antialiased, streams: others }: Spz, rotations: Uint8Array): object {
  const streams = { ...others, rotations };
  const getCenters = (): Float32Array => {
    const { positions } = streams;
    const centers = new Float32Array(3 * n);
    for (let i = 0; i < centers.length; ++i) {
      const code = (positions[3 * i] as number) | ((positions[3 * i + 1] as number) << 8) | ((positions[3 * i + 2] as number) << 16);
      centers[i] = ((code << 8) >> 8) / 2 ** fractionalBits;
    }
    return centers;
  };
  const calcAabb = (box: BoundingBox): void => {
    const min = [Infinity, Infinity, Infinity];
    const max = [-Infinity, -Infinity, -Infinity];
    getCenters().forEach((value, i) => {
      min[i % 3] = Math.min(min[i % 3] as number, value);
      max[i % 3] = Math.max(max[i % 3] as number, value);
    });
    box.setMinMax(new Vec3(min), new Vec3(max));
  };
  return { ...streams, numSplats: n, fractionalBits, shBands: shDegree, shDim: kRest[shDegree], antialiased, getCenters, calcAabb };
}

export interface SpzMade {
  resource: GSplatResourceBase;
  antialiased: boolean;
  /** Axes are right, up, backward. */
  isYUp: boolean;
  seen: Iterable<Part>;
}

/** `axes`: of a file that declares none. */
export async function readSpz(device: GraphicsDevice, contents: ArrayBuffer, axes: SpzAxes): Promise<SpzMade> {
  const spz = await read(new Uint8Array(contents), worker ? { worker } : {});
  if (spz.n === 0) throw new Error("it holds no Gaussians");
  const isYUp = (axesOf(spz) ?? axes) === "opengl";
  const rotations = spz.version === 2 ? smallestThree(spz.streams.rotations) : spz.streams.rotations;
  const resource = new GSplatSpzResource(device, dataOf(spz, rotations));
  return { resource, antialiased: spz.antialiased, isYUp, seen: seenOfSpz(spz, rotations, resource.centers as Float32Array, isYUp) };
}
