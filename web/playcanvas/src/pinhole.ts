// pinhole.ts - sets the engine's camera from a camera of docs/user/CAMERAS.md.
// SPDX-License-Identifier: Apache-2.0
import type { Pinhole } from "@roofgs/reader";
import { ASPECT_MANUAL, type Entity, Mat4, Quat, Vec2 } from "playcanvas";

/** The same camera for a picture of another size; keeps the horizontal field of view, as rgs-render does. */
export function resizePinhole(pinhole: Pinhole, width: number, height: number): Pinhole {
  const scale = width / pinhole.width;
  const { cx = pinhole.width / 2, cy = pinhole.height / 2 } = pinhole;
  return {
    ...pinhole,
    width,
    height,
    fx: pinhole.fx * scale,
    fy: pinhole.fy * scale,
    cx: width / 2 + (cx - pinhole.width / 2) * scale,
    cy: height / 2 + (cy - pinhole.height / 2) * scale,
  };
}

/**
 * Gives an entity with a camera component the position and the projection of a pinhole camera. The file's `origin`
 * (Declarations.origin) is subtracted in FP64, because resources are relative to it. The picture fills the camera's render target.
 * TypeError without a camera component.
 */
export function setPinhole(entity: Entity, pinhole: Pinhole, origin: readonly number[] = [0, 0, 0]): void {
  const { width, height, fx, fy, cx = width / 2, cy = height / 2, position, rotation } = pinhole;
  const axis = (column: number, sign: number): number[] => [0, 1, 2].map((row) => sign * ((rotation[row] as number[])[column] as number));
  // Columns of the engine's axes: right, up, backward.
  const toWorld = new Mat4();
  toWorld.set([...axis(0, 1), 0, ...axis(1, -1), 0, ...axis(2, -1), 0, 0, 0, 0, 1]);
  const [x, y, z] = [0, 1, 2].map((c) => (position[c] as number) - (origin[c] ?? 0)) as [number, number, number];
  entity.setLocalPosition(x, y, z);
  entity.setLocalRotation(new Quat().setFromMat4(toWorld));
  const camera = entity.camera;
  if (!camera) throw new TypeError("the entity has no camera component");
  camera.horizontalFov = false;
  camera.fov = (2 * Math.atan(height / 2 / fy) * 180) / Math.PI;
  camera.aspectRatioMode = ASPECT_MANUAL;
  camera.aspectRatio = width / fx / (height / fy);
  camera.camera.projectionOffset = new Vec2(1 - (2 * cx) / width, (2 * cy) / height - 1);
}
