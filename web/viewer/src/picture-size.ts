// picture-size.ts - how many pixels are drawn.
// SPDX-License-Identifier: Apache-2.0

/** Of a device pixel as much as this: beyond it nobody sees more. */
const kMostScale = 2;
/** Browsers give a canvas no more, and the picture would be stretched. */
const kMostPixels = 7680 * 4320;

/** Pixels of the picture of an element of so many CSS pixels. `mostSide`: of the device's textures. */
export function pictureSize(element: { width: number; height: number }, pixelRatio: number, mostSide: number): { width: number; height: number } {
  const { width, height } = element;
  const scale = Math.min(pixelRatio, kMostScale, mostSide / Math.max(1, width, height), Math.sqrt(kMostPixels / Math.max(1, width * height)));
  return { width: Math.max(1, Math.floor(width * scale)), height: Math.max(1, Math.floor(height * scale)) };
}
