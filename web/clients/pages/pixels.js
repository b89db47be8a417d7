// pixels.js - what the pages that draw.mjs and tests drive share. Each has window.draw(url, camera): Gaussians and the picture's RGBA.
// SPDX-License-Identifier: Apache-2.0

export const kFar = 1e5;
export const kApi = new URLSearchParams(location.search).get("api") ?? "webgl2";

/** RGBA over black, in base64. */
export function pixels(image) {
  const context = new OffscreenCanvas(image.width, image.height).getContext("2d", { alpha: false, willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const { data } = context.getImageData(0, 0, image.width, image.height);
  return new Uint8Array(data.buffer).toBase64();
}
window.decode = async (url) => pixels(await createImageBitmap(await (await fetch(url)).blob()));

export const newCanvas = ({ width, height }) => document.body.appendChild(Object.assign(document.createElement("canvas"), { width, height }));
export const nextFrame = () => new Promise(requestAnimationFrame);
