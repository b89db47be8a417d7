// picture-size.ts - the size of the picture in pixels.
// SPDX-License-Identifier: Apache-2.0

export interface Size {
  width: number;
  height: number;
}

/** Most pixels per CSS pixel; more are not visible. */
const kMostScale = 2;
/** Browsers stretch larger canvases. */
const kMostPixels = 7680 * 4320;

/** Size of the picture for an element in CSS pixels. `mostSide`: the largest texture of the device. */
export function pictureSize(element: Size, pixelRatio: number, mostSide: number): Size {
  const { width, height } = element;
  const scale = Math.min(pixelRatio, kMostScale, mostSide / Math.max(1, width, height), Math.sqrt(kMostPixels / Math.max(1, width * height)));
  return { width: Math.max(1, Math.floor(width * scale)), height: Math.max(1, Math.floor(height * scale)) };
}
