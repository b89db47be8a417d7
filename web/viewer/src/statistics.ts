// statistics.ts - the numbers over the picture.
// SPDX-License-Identifier: Apache-2.0
import { bytesText, countText } from "./messages.js";
import type { Page } from "./page.js";
import type { Stage } from "./stage.js";

/** Returns what is called before each frame. */
export function statisticsOf(page: Page): (stage: Stage) => void {
  const stream = page.element("stream", HTMLElement);
  const overlay = page.element("overlay", HTMLOutputElement);
  let speed = { at: 0, nFrames: 0, rate: 0 };
  return ({ frames: nFrames, api }) => {
    const { scenes, view, statistics, frame, isReferenceShown } = page.store.state;
    const pages = scenes.map((scene) => scene?.pages ?? { drawn: 0, wanted: 0 });
    const [drawn, wanted] = [pages.reduce((sum, each) => sum + each.drawn, 0), pages.reduce((sum, each) => sum + each.wanted, 0)];
    stream.hidden = wanted === 0;
    if (wanted > 0) stream.style.width = `${(100 * drawn) / (drawn + wanted)}%`;
    overlay.hidden = !statistics || !view;
    const now = performance.now();
    // Another renderer counts anew.
    if (now - speed.at > 500) speed = { at: now, nFrames, rate: (1000 * Math.max(0, nFrames - speed.nFrames)) / (now - speed.at) };
    if (overlay.hidden) return;
    const lines = scenes
      .filter((scene) => scene !== undefined)
      .map((scene) => {
        const { drawn, wanted } = scene.pages;
        const pages = scene.hasPages ? `, ${drawn} pages${wanted > 0 ? `, ${wanted} wanted` : ""}` : "";
        return `${countText(scene.nDrawn)} of ${countText(scene.nGaussians)} Gaussians, ${bytesText(scene.bytesRead)} of ${bytesText(scene.bytes)}${pages}`;
      });
    lines.push(`${speed.rate.toFixed(0)} frames a second by ${api}`);
    if (frame && isReferenceShown) {
      const { renderMs, totalMs, pagesMissing } = frame;
      lines.push(`reference picture: drawn in ${renderMs.toFixed(0)} ms, shown after ${totalMs.toFixed(0)} ms${pagesMissing > 0 ? `, ${pagesMissing} pages missing` : ""}`);
    }
    overlay.textContent = lines.join("\n");
  };
}
