// view.ts - a camera as the kernels need it: make_view() of rgs/math/camera.hpp and cull_planes() of common/cull_chunk.cuh.
// SPDX-License-Identifier: Apache-2.0
import type { AntiAliasing, Pinhole } from "@roofgs/reader";

export interface RenderOptions {
  /** The original's by default: 0.3, opacity as it is. */
  antiAliasing?: AntiAliasing;
  /** Red, green, blue, 0 to 1; black by default. */
  background?: readonly number[];
  /** Higher degrees are ignored. */
  shDegree?: number;
  /** Drawn are means with near < z <= far; 0.2 and no limit by default. */
  near?: number;
  far?: number;
  /** What is left of this column stays as it was in the texture. */
  firstColumn?: number;
}

export const kTileSize = 16;
export const kViewBytes = 464;
const kMost = 3.4e38;

/**
 * Bytes of `View` in shaders/math.ts, for a picture of `width` x `height` with the pinhole's horizontal field of view, as rgs-render
 * has it. `origin`: Declarations.origin, subtracted in FP64.
 */
export function viewBytes(pinhole: Pinhole, origin: readonly number[], width: number, height: number, options: RenderOptions, capacity: readonly number[]): ArrayBuffer {
  const { antiAliasing = { lowPassPx2: 0.3, compensated: false }, background = [0, 0, 0], shDegree = 3, near = 0.2, far = kMost } = options;
  const scale = width / pinhole.width;
  const [fx, fy] = [pinhole.fx * scale, pinhole.fy * scale];
  const cx = width / 2 + ((pinhole.cx ?? pinhole.width / 2) - pinhole.width / 2) * scale;
  const cy = height / 2 + ((pinhole.cy ?? pinhole.height / 2) - pinhole.height / 2) * scale;
  const w = [0, 1, 2].map((row) => [0, 1, 2].map((column) => pinhole.rotation[column]?.[row] as number)) as [number[], number[], number[]];
  const position = [0, 1, 2].map((i) => (pinhole.position[i] as number) - (origin[i] ?? 0));
  // 0.3 half images beyond the image's edges.
  const [marginX, marginY] = [(0.15 * width) / fx, (0.15 * height) / fy];
  const low = [-cx / fx - marginX, -cy / fy - marginY] as const;
  const high = [(width - cx) / fx + marginX, (height - cy) / fy + marginY] as const;

  // What is beyond x X + y Y + z Z > distance in camera coordinates.
  const plane = (x: number, y: number, z: number, distance: number, reach: number): number[] => {
    const normal = [0, 1, 2].map((axis) => x * (w[0][axis] as number) + y * (w[1][axis] as number) + z * (w[2][axis] as number));
    const size = Math.abs(x) + Math.abs(y) + Math.abs(z);
    return [...normal, -distance, ...normal.map((n) => 1.0001 * Math.abs(n)), reach / 3, 1e-5 * size, 0, 0, 0];
  };
  const [reachX, reachY] = [0, 1].map((i) => 3.34 * Math.hypot(1, Math.max(Math.abs(low[i] as number), Math.abs(high[i] as number)))) as [number, number];
  const margin = 3.34 * Math.sqrt(antiAliasing.lowPassPx2) + 1;
  const planes = [
    plane(0, 0, -1, -near, 0),
    plane(0, 0, 1, far, 0),
    plane(1, 0, -(width - cx + margin) / fx, 0, reachX),
    plane(-1, 0, -(cx + margin) / fx, 0, reachX),
    plane(0, 1, -(height - cy + margin) / fy, 0, reachY),
    plane(0, -1, -(cy + margin) / fy, 0, reachY),
  ];

  const bytes = new ArrayBuffer(kViewBytes);
  const floats = new Float32Array(bytes);
  const words = new Uint32Array(bytes);
  w.forEach((row, i) => floats.set(row, 4 * i));
  floats.set(position, 12);
  floats.set(position.map((p) => p - Math.fround(p)), 16);
  floats.set([fx, fy, cx, cy, ...low, ...high, near, far, antiAliasing.lowPassPx2], 20);
  words.set([Number(antiAliasing.compensated), width, height, ...tileGrid(width, height)], 31);
  floats.set(background.slice(0, 3), 36);
  words.set([shDegree, ...capacity], 39);
  floats.set(planes.flat(), 44);
  return bytes;
}

export function tileGrid(width: number, height: number): [number, number] {
  return [Math.ceil(width / kTileSize), Math.ceil(height / kTileSize)];
}
