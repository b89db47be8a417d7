// camera.ts - what programs that draw share: a camera, and how its picture is anti-aliased.
// SPDX-License-Identifier: Apache-2.0
import type { Declarations } from "./head.js";

/** A pinhole camera, as in cameras.json (docs/user/CAMERAS.md); axes x right, y down, z forward. */
export interface Pinhole {
  /** Pixels, like all lengths of the image. */
  readonly width: number;
  readonly height: number;
  readonly fx: number;
  readonly fy: number;
  /** Principal point from the upper left corner; the image's centre if absent. */
  readonly cx?: number | undefined;
  readonly cy?: number | undefined;
  /** Centre of the camera, world. */
  readonly position: readonly number[];
  /** [3][3] camera to world, row by row: columns are the camera's axes. */
  readonly rotation: readonly (readonly number[])[];
}

/** How a picture is anti-aliased: docs/format/RENDERING.md, "Low-pass". */
export interface AntiAliasing {
  /** Added to the diagonal of the screen-space covariance, square pixels. */
  readonly lowPassPx2: number;
  /** Whether opacity is lowered in return, as in Mip-Splatting. */
  readonly compensated: boolean;
}

const kClassic: AntiAliasing = { lowPassPx2: 0.3, compensated: false };
const kMipSplatting: AntiAliasing = { lowPassPx2: 0.1, compensated: true };

/** Anti-aliasing as files declare it; the default low-pass is that of the mode. */
export interface DeclaredAntiAliasing {
  readonly aaMode: Declarations["aaMode"];
  readonly lowPassPx2?: number | undefined;
}

/** The anti-aliasing that a file declares. A low-pass applies only in its own mode. `coarser`: pages above level 0 are drawn. */
export function antiAliasingOf(declared: DeclaredAntiAliasing, coarser = false): AntiAliasing {
  const { aaMode, lowPassPx2 } = declared;
  const usual = coarser || aaMode === "mip_splatting" ? kMipSplatting : kClassic;
  return coarser || aaMode === "undeclared" || lowPassPx2 === undefined ? usual : { ...usual, lowPassPx2 };
}
