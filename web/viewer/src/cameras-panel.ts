// cameras-panel.ts - a button for each camera with its photograph, or with what the engine draws from there.
// SPDX-License-Identifier: Apache-2.0
import type { CameraEntry } from "./cameras.js";
import { element } from "./page.js";

const kWidth = 96;
const kHeight = 72;

export interface CamerasPanel {
  list: readonly CameraEntry[];
  photos: ReadonlyMap<string, string>;
  jump(index: number): void;
  /** RGBA; called one at a time, when a button scrolls into view. */
  draw(camera: CameraEntry, width: number, height: number): Promise<Uint8ClampedArray<ArrayBuffer>>;
}

export function buildCameras({ list, photos, jump, draw }: CamerasPanel): void {
  const box = element("cameras", HTMLElement);
  element("camera-set", HTMLFieldSetElement).hidden = list.length === 0;
  box.replaceChildren();
  const queue: (() => Promise<void>)[] = [];
  let busy = false;
  const work = async (): Promise<void> => {
    if (busy) return;
    busy = true;
    // A picture that cannot be drawn stays grey.
    for (let next = queue.shift(); next; next = queue.shift()) await next().catch(() => undefined);
    busy = false;
  };
  const observer = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (!isIntersecting) continue;
      observer.unobserve(target);
      const canvas = target as HTMLCanvasElement;
      queue.push(async () => {
        const pixels = await draw(list[Number(canvas.dataset["camera"])] as CameraEntry, kWidth, kHeight);
        canvas.getContext("2d")?.putImageData(new ImageData(pixels, kWidth, kHeight), 0, 0);
      });
    }
    void work();
  });
  list.forEach((camera, index) => {
    const button = document.createElement("button");
    button.type = "button";
    button.title = camera.img_name;
    button.addEventListener("click", () => jump(index));
    const photo = photos.get(camera.img_name);
    if (photo !== undefined) {
      const image = document.createElement("img");
      Object.assign(image, { src: photo, alt: "", loading: "lazy" });
      button.append(image);
    } else {
      const canvas = document.createElement("canvas");
      Object.assign(canvas, { width: kWidth, height: kHeight });
      canvas.dataset["camera"] = String(index);
      observer.observe(canvas);
      button.append(canvas);
    }
    button.append(camera.img_name);
    box.append(button);
  });
}
