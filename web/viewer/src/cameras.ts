// cameras.ts - reads camera files (docs/user/CAMERAS.md), and holds the page's view and the path through the cameras.
// SPDX-License-Identifier: Apache-2.0
import type { Pinhole } from "@roofgs/webgpu";

/** An entry of the cameras.json of 3DGS training programs. */
export interface CameraEntry extends Pinhole {
  id: number;
  img_name: string;
}

/** The view of the page, for a picture of any size. */
export interface ViewState {
  /** World. */
  readonly position: readonly number[];
  /** [3][3] camera to world, columns right, down, forward. */
  readonly rotation: readonly (readonly number[])[];
  /** Focal length as a share of the picture's width; vertical focal length as a share of the horizontal one. */
  readonly focal: number;
  readonly aspect: number;
  /** Principal point from the picture's centre, as a share of its width. */
  readonly offset: readonly [number, number];
  /** Centre of orbiting, world. */
  readonly pivot: readonly number[];
}

type Vector = readonly number[];
const at = (v: Vector, i: number): number => v[i] as number;
export const add = (a: Vector, b: Vector, scale = 1): number[] => [0, 1, 2].map((i) => at(a, i) + scale * at(b, i));
export const dot = (a: Vector, b: Vector): number => at(a, 0) * at(b, 0) + at(a, 1) * at(b, 1) + at(a, 2) * at(b, 2);
export const cross = (a: Vector, b: Vector): number[] => [
  at(a, 1) * at(b, 2) - at(a, 2) * at(b, 1),
  at(a, 2) * at(b, 0) - at(a, 0) * at(b, 2),
  at(a, 0) * at(b, 1) - at(a, 1) * at(b, 0),
];
export const length = (a: Vector): number => Math.hypot(at(a, 0), at(a, 1), at(a, 2));
export const normalised = (a: Vector): number[] => add([0, 0, 0], a, 1 / (length(a) || 1));
/** Column 0 right, 1 down, 2 forward. */
export const axisOf = (rotation: readonly Vector[], column: number): number[] => rotation.map((row) => at(row, column));
export const fromAxes = (right: Vector, down: Vector, forward: Vector): number[][] =>
  [0, 1, 2].map((row) => [at(right, row), at(down, row), at(forward, row)]);

/** `v` turned around a unit axis by an angle in radians (Rodrigues). */
export function turned(v: Vector, axis: Vector, angle: number): number[] {
  const c = Math.cos(angle);
  const along = add(add([0, 0, 0], v, c), cross(axis, v), Math.sin(angle));
  return add(along, axis, dot(axis, v) * (1 - c));
}

/** The rotation that looks along `forward` with `up` upwards. */
export function looking(forward: Vector, up: Vector): number[][] {
  const ahead = normalised(forward);
  let right = cross(ahead, up);
  if (length(right) < 1e-6) right = cross(ahead, Math.abs(at(ahead, 0)) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  right = normalised(right);
  return fromAxes(right, cross(ahead, right), ahead);
}

/** Nearest distance at which Gaussians are drawn: docs/format/RENDERING.md, "A Gaussian on the image". */
export const kNear = 0.2;
const kTanHalfView = Math.tan(Math.PI / 6);
const kElevation = Math.PI / 18;

/** A FirstView of the reader. */
export interface First {
  readonly position: Vector;
  readonly pivot: Vector;
  readonly up: Vector;
  readonly horizontalFov: number;
}

/** A first view of a scene with this origin, for a picture of this height over its width: in one wider than 16:9, as high as there. */
export function viewFromFirst({ position, pivot, up, horizontalFov }: First, origin: Vector, height: number): ViewState {
  const focal = (0.5 / Math.tan((horizontalFov * Math.PI) / 360)) * Math.min(1, (height * 16) / 9);
  return { position: add(position, origin), rotation: looking(add(pivot, position, -1), up), focal, aspect: 1, offset: [0, 0], pivot: add(pivot, origin) };
}

/** The first view of a scene that is not known any better, as rgs/camera.hpp has it. World. */
export function defaultView({ min, max }: { min: Vector; max: Vector }, up: Vector): First {
  const scaled = (v: Vector, scale: number): number[] => add([0, 0, 0], v, scale);
  const [middle, half] = [scaled(add(min, max), 0.5), scaled(add(max, min, -1), 0.5)];
  const front = add([0, 0, -1], up, at(up, 2));
  const level = length(front) > 1e-6 ? normalised(front) : [-1, 0, 0];
  const away = add(scaled(level, Math.cos(kElevation)), up, Math.sin(kElevation));
  const rotation = looking(scaled(away, -1), up);
  // How far the middle must be for an edge of the picture to pass the ellipsoid in the box.
  const far = (edge: Vector): number => length(add(away, edge).map((value, i) => value * at(half, i)));
  const edges = [1, -1].flatMap((side) => [scaled(axisOf(rotation, 0), side / kTanHalfView), scaled(axisOf(rotation, 1), ((side / kTanHalfView) * 16) / 9)]);
  const distance = Math.max(far([0, 0, 0]) + 2 * kNear, ...edges.map(far));
  return { position: add(middle, away, distance), pivot: middle, up, horizontalFov: 60 };
}

const isNumber = (value: unknown): value is number => typeof value === "number" && Number.isFinite(value);
const isSide = (value: unknown): value is number => isNumber(value) && Number.isInteger(value) && value >= 1 && value <= 65536;
const isVector = (value: unknown, n: number): value is number[] => Array.isArray(value) && value.length === n && value.every(isNumber);
const isMatrix = (value: unknown, n: number): value is number[][] =>
  Array.isArray(value) && value.length === n && value.every((row) => isVector(row, n));

/** Whether the columns are orthonormal, to 0.001, and not mirrored. */
function isRotation(value: unknown): value is number[][] {
  if (!isMatrix(value, 3)) return false;
  const axes: [Vector, Vector, Vector] = [axisOf(value, 0), axisOf(value, 1), axisOf(value, 2)];
  const isNear = axes.every((a, i) => axes.every((b, k) => Math.abs(dot(a, b) - (i === k ? 1 : 0)) <= 1e-3));
  return isNear && dot(cross(axes[0], axes[1]), axes[2]) > 0;
}

/** Position and rotation in the world, of a matrix from world to camera. */
function motionOf(world: unknown): { position?: unknown; rotation?: unknown } {
  if (!isMatrix(world, 4) || String(world[3]) !== "0,0,0,1") return {};
  const rotation = [0, 1, 2].map((row) => [0, 1, 2].map((column) => at(world[column] as Vector, row)));
  return { position: rotation.map((row) => -row.reduce((sum, value, k) => sum + value * at(world[k] as Vector, 3), 0)), rotation };
}

/** An entry of this project's list, or of one of 3DGS programs; undefined if a field is missing or wrong. */
function entryOf(entry: unknown, isOwn: boolean, index: number): CameraEntry | undefined {
  const fields = Object(entry) as Record<string, unknown>;
  const { width, height, fx, fy, split = "", id = index, cx = Number(width) / 2, cy = Number(height) / 2 } = fields;
  const { position, rotation } = isOwn ? motionOf(fields["world_to_camera"]) : fields;
  const name = fields[isOwn ? "name" : "img_name"] ?? String(index);
  if (!isSide(width) || !isSide(height) || !isNumber(fx) || !isNumber(fy) || !isNumber(cx) || !isNumber(cy)) return undefined;
  if (!isVector(position, 3) || !isRotation(rotation) || !(fx > 0 && fy > 0) || typeof name !== "string") return undefined;
  if (isOwn && !["", "train", "test"].includes(split as string)) return undefined;
  const bends = [fields["distortion"] ?? []].flat().some((k) => Number(k) !== 0);
  if ((fields["model"] ?? "pinhole") !== "pinhole" || bends) throw new Error(`camera ${index} is no pinhole; the page draws only those`);
  return { id: Number(id), img_name: name, width, height, fx, fy, cx, cy, position, rotation };
}

/** A camera list of this project or of 3DGS programs: docs/user/CAMERAS.md. */
export function parseCameras(text: string): CameraEntry[] {
  const found: unknown = JSON.parse(text);
  if (!Array.isArray(found)) throw new Error("the camera file is not a list of cameras");
  if (found.length === 0) throw new Error("the camera file holds no cameras");
  const isOwn = "world_to_camera" in Object(found[0]);
  return found.map((entry, index) => {
    const camera = entryOf(entry, isOwn, index);
    if (!camera) throw new Error(`camera ${index} of the camera file lacks a field or has a bad value`);
    return camera;
  });
}

export function viewOf(camera: Pinhole, pivot: Vector): ViewState {
  const { width, height, fx, fy, cx = width / 2, cy = height / 2, position, rotation } = camera;
  return { position, rotation, focal: fx / width, aspect: fy / fx, offset: [(cx - width / 2) / width, (cy - height / 2) / width], pivot };
}

/** The view from a camera; its pivot is straight ahead, as far away as the middle of the box. */
export function viewFrom(camera: CameraEntry, { min, max }: { min: Vector; max: Vector }): ViewState {
  const { position, rotation } = camera;
  const [middle, forward] = [add([0, 0, 0], add(min, max), 0.5), axisOf(rotation, 2)];
  return viewOf(camera, add(position, forward, Math.max(0.1, dot(add(middle, position, -1), forward))));
}

export function pinholeOf(view: ViewState, width: number, height: number): CameraEntry {
  const { position, rotation, focal, aspect, offset } = view;
  const fx = focal * width;
  const [cx, cy] = [width / 2 + offset[0] * width, height / 2 + offset[1] * width];
  return { id: 0, img_name: "view", width, height, fx, fy: fx * aspect, cx, cy, position, rotation };
}

/** Centripetal Catmull-Rom spline through positions, at `t` of 0 to 1; ends are doubled (docs/user/CAMERAS.md). */
export function pathPosition(points: readonly Vector[], t: number): { position: number[]; segment: number; share: number } {
  const last = points.length - 1;
  const segment = Math.min(last - 1, Math.max(0, Math.floor(t * last)));
  const share = Math.min(1, Math.max(0, t * last - segment));
  const point = (i: number): Vector => points[Math.min(last, Math.max(0, i))] as Vector;
  const p = [point(segment - 1), point(segment), point(segment + 1), point(segment + 2)] as const;
  const knots = [0, 0, 0, 0];
  for (let i = 1; i < 4; ++i) {
    knots[i] = at(knots, i - 1) + Math.max(1e-6, Math.sqrt(length(add(p[i] as Vector, p[i - 1] as Vector, -1))));
  }
  const k = at(knots, 1) + share * (at(knots, 2) - at(knots, 1));
  const mix = (a: Vector, b: Vector, from: number, to: number): number[] =>
    add(add([0, 0, 0], a, (to - k) / (to - from)), b, (k - from) / (to - from));
  const [k0, k1, k2, k3] = knots as [number, number, number, number];
  const a1 = mix(p[0], p[1], k0, k1);
  const a2 = mix(p[1], p[2], k1, k2);
  const a3 = mix(p[2], p[3], k2, k3);
  return { position: mix(mix(a1, a2, k0, k2), mix(a2, a3, k1, k3), k1, k2), segment, share };
}
