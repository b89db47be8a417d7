// pixels.js - what the pages of clients.test.mjs share.
// SPDX-License-Identifier: Apache-2.0

/** RGBA in base64. */
export function pixels(image) {
  const context = new OffscreenCanvas(image.width, image.height).getContext("2d");
  context.drawImage(image, 0, 0);
  const { data } = context.getImageData(0, 0, image.width, image.height);
  return btoa(Array.from(data, (byte) => String.fromCharCode(byte)).join(""));
}
window.decode = async (url) => pixels(await createImageBitmap(await (await fetch(url)).blob()));

export const newCanvas = ([width, height]) => document.body.appendChild(Object.assign(document.createElement("canvas"), { width, height }));
export const nextFrame = () => new Promise(requestAnimationFrame);
