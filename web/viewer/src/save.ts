// save.ts - "Save as .rgs": the converter's worker makes an .rgs of a PLY, which the page offers as a download.
// SPDX-License-Identifier: Apache-2.0
import type { Profile, Progress, Report } from "@roofgs/convert";
import { loadConverter } from "./converter.js";
import { bytesText, countText } from "./messages.js";
import { offer, type Page } from "./page.js";
import type { Scene } from "./scene.js";

/** Those that this page can save. */
export function savable(scenes: readonly (Scene | undefined)[]): Scene[] {
  return loadConverter ? (scenes.filter((scene) => scene?.source !== undefined) as Scene[]) : [];
}

const outputOf = ({ name }: Scene): string => `${name.replace(/\.[^.]*$/, "")}.rgs`;

function progressOf({ stage, done, total }: Progress): { text: string; share: number | undefined } {
  const share = total > 0 ? done / total : undefined;
  return { text: `${stage[0]?.toUpperCase()}${stage.slice(1)}${share === undefined ? "" : ` ${Math.floor(100 * share)}%`}`, share };
}

function resultOf(output: string, { bytes, sourceBytes, nSource, nWritten, nRepaired }: Report): string {
  const parts = [`${output}: ${bytesText(bytes)} instead of ${bytesText(sourceBytes)}`];
  if (nWritten < nSource) parts.push(`${countText(nSource - nWritten)} of ${countText(nSource)} Gaussians were damaged and are left out`);
  if (nRepaired > 0) parts.push(`${countText(nRepaired)} were repaired`);
  return parts.join("; ");
}

async function save(page: Page, scene: Scene, signal: AbortSignal): Promise<void> {
  const { store } = page;
  const output = outputOf(scene);
  store.set({ saving: { text: "Load", share: undefined }, saved: "" });
  let what = "The converter";
  try {
    const { convert } = await (loadConverter as NonNullable<typeof loadConverter>)().catch((error: unknown) => {
      throw Object.assign(new Error(), { code: "open_failed", text: String(error) });
    });
    signal.throwIfAborted();
    what = scene.name;
    const { blob, report } = await convert(scene.source as Blob | string, {
      profile: page.element("profile", HTMLSelectElement).value as Profile,
      levels: page.input("save-levels").checked,
      sourceName: scene.name,
      signal,
      onProgress: (progress) => store.set({ saving: progressOf(progress) }),
    });
    offer(blob, output);
    store.set({ saved: resultOf(output, report) });
    page.say(store.state.saved);
  } catch (error) {
    page.fail(what, error);
  } finally {
    store.set({ saving: undefined });
  }
}

export function bindSaving(page: Page): void {
  let stop = new AbortController();
  page.onClick("cancel-save", () => stop.abort());
  page.signal.addEventListener("abort", () => stop.abort());
  page.store.subscribe(({ scenes }) => [scenes], ([scenes]) => {
    const buttons = savable(scenes).map((scene) => {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: `Save ${outputOf(scene)}` });
      button.addEventListener("click", () => {
        stop = new AbortController();
        void save(page, scene, stop.signal);
      });
      return button;
    });
    page.element("save-scenes", HTMLElement).replaceChildren(...buttons);
  });
  const bar = page.element("save-progress", HTMLProgressElement);
  page.store.subscribe(({ saving, saved }) => [saving, saved], ([saving, saved]) => {
    page.element("save-scenes", HTMLElement).hidden = saving !== undefined;
    page.element("saving", HTMLElement).hidden = saving === undefined;
    page.element("saved", HTMLOutputElement).textContent = saved;
    page.element("saving-text", HTMLElement).textContent = saving?.text ?? "";
    if (saving?.share === undefined) bar.removeAttribute("value");
    else bar.value = saving.share;
  });
}
