// cameras-panel.ts - a button for each camera with its photograph, or with what is seen from there.
// SPDX-License-Identifier: Apache-2.0
import { viewFrom, viewOf, type ViewState } from "./cameras.js";
import type { Captures } from "./captures.js";
import { readInside } from "./manifest.js";
import type { Page } from "./page.js";

const kSize = { width: 96, height: 72 };

/** Returns the view of the camera, if there is one and a scene; `shows` it at once. */
export function jump(page: Page, index: number, shows = true): ViewState | undefined {
  const { store } = page;
  const { cameras, scenes } = store.state;
  const camera = cameras[index];
  if (!camera || !scenes[0]) return undefined;
  const view = viewFrom(camera, scenes[0].box);
  store.set({ camera: index, cameraView: view, ...(shows ? { view } : {}) });
  page.say(`Camera ${camera.img_name}`);
  return view;
}

export function showCameras(page: Page, captures: Captures): void {
  // Drawn again when all of the scene is there.
  page.store.subscribe(({ cameras, isComplete }) => [cameras, isComplete], () => build(page, captures));
  page.store.subscribe(({ cameras, isComplete, camera, cameraView, view }) => [cameras, isComplete, view === cameraView ? camera : -1], ([, , camera]) => {
    const buttons = [...page.element("cameras", HTMLElement).children];
    buttons.forEach((button, i) => button.setAttribute("aria-current", String(i === camera)));
  });
}

function build(page: Page, captures: Captures): void {
  const { store } = page;
  const { cameras, photos } = store.state;
  const box = page.element("cameras", HTMLElement);
  page.element("play", HTMLButtonElement).hidden = cameras.length < 2;
  box.replaceChildren();
  const draw = async (canvas: HTMLCanvasElement): Promise<void> => {
    const camera = cameras[Number(canvas.dataset["camera"])];
    if (!camera || !store.state.scenes[0]) return;
    // The picture itself is drawn between them.
    for (let i = 0; i < 2; ++i) await new Promise(requestAnimationFrame);
    const pixels = await captures.capture(0, viewOf(camera, camera.position), kSize);
    canvas.getContext("2d")?.putImageData(new ImageData(pixels, kSize.width, kSize.height), 0, 0);
  };
  let last = Promise.resolve();
  const observer = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (!isIntersecting) continue;
      observer.unobserve(target);
      // A picture that cannot be drawn stays grey.
      last = last.then(() => draw(target as HTMLCanvasElement)).catch(() => undefined);
    }
  });
  cameras.forEach((camera, index) => {
    const button = document.createElement("button");
    button.type = "button";
    button.title = camera.img_name;
    button.addEventListener("click", () => jump(page, index));
    const photo = photos.get(camera.img_name);
    if (photo !== undefined) {
      const image = document.createElement("img");
      Object.assign(image, { alt: "", loading: "lazy" });
      // In an exported page it is an element of the page.
      if (photo.startsWith("#")) void readInside(photo).then((blob) => (image.src = URL.createObjectURL(blob)), () => undefined);
      else image.src = photo;
      button.append(image);
    } else {
      const canvas = document.createElement("canvas");
      Object.assign(canvas, kSize);
      canvas.dataset["camera"] = String(index);
      observer.observe(canvas);
      button.append(canvas);
    }
    button.append(camera.img_name);
    box.append(button);
  });
}
