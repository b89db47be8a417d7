// viewer.ts - one viewer: its state, what shows it, and what it begins with.
// SPDX-License-Identifier: Apache-2.0
import { restore, showLink } from "./address.js";
import { showCameras } from "./cameras-panel.js";
import { Captures } from "./captures.js";
import { showComparison } from "./compare.js";
import { Controls } from "./controls.js";
import { drawState, step } from "./drawing.js";
import { watchFlights } from "./flight.js";
import { drawReference } from "./frames.js";
import { goHome, goTo } from "./home.js";
import { connectKeys } from "./keys.js";
import { readLink } from "./link.js";
import { nameOf, readManifest } from "./manifest.js";
import { kLost, kNoGraphics, kNoRoom, kNotAsDefined } from "./messages.js";
import { showNames } from "./names.js";
import { closeRead, readFile } from "./open-scene.js";
import { listenForFiles, Opening } from "./opening.js";
import { Page, progressOf, showLoading, showPoster } from "./page.js";
import { showPath } from "./path.js";
import { watchRest } from "./rest.js";
import { bindSaving } from "./save.js";
import { bindSettings } from "./settings.js";
import { Stage } from "./stage.js";
import { firstState } from "./state.js";
import { statisticsOf } from "./statistics.js";
import { Store } from "./store.js";

/** What there is once something draws. */
interface Parts {
  opening: Opening;
  captures: Captures;
}

export class Viewer {
  private readonly stop = new AbortController();
  private readonly page: Page;
  /** Undefined if there is no graphics device, or the viewer has ended. */
  private readonly parts: Promise<Parts | undefined>;

  constructor(host: HTMLElement, root: ShadowRoot) {
    this.page = new Page(new Store(firstState({ width: 300, height: 150 })), host, root, this.stop.signal);
    this.parts = this.start().catch((error: unknown) => {
      this.page.fail("The page", error);
      return undefined;
    });
    listenForFiles(this.page, (files) => void this.parts.then((parts) => parts?.opening.openFiles(files)));
  }

  end(): void {
    const { store } = this.page;
    const { scenes } = store.state;
    store.end();
    // What the renderer has of them goes before the renderer.
    for (const scene of scenes) scene?.destroy();
    this.stop.abort();
  }

  /** By the name of a camera, or the part of a link behind #. Resolves when it is there, with whether there is one. */
  async flyTo(camera: string): Promise<boolean> {
    const parts = await this.parts;
    await parts?.opening.allOpened();
    // A viewer that has ended flies nowhere.
    return !this.stop.signal.aborted && goTo(this.page, camera);
  }

  async screenshot(): Promise<Blob> {
    const parts = await this.parts;
    if (!parts) throw new Error(kNoGraphics);
    return parts.captures.shown();
  }

  async compare(scene?: string | File): Promise<void> {
    const opening = (await this.parts)?.opening;
    if (scene === undefined) await opening?.closeSecond();
    else if (typeof scene === "string") await opening?.openUrl({ name: nameOf(scene), url: scene });
    else await opening?.openFiles([scene]);
  }

  private async start(): Promise<Parts | undefined> {
    const { page } = this;
    const { store, signal, host } = page;
    const canvas = page.element("picture", HTMLCanvasElement);
    // What needs no picture does not wait for one.
    bindSettings(page);
    showLoading(page);
    showPoster(page);
    // Scenes are requested while the renderer starts.
    const manifest = readManifest(host, page.isWhole);
    const reading = manifest.then(({ scenes }) => scenes.map((entry) => readFile({ entry, onProgress: progressOf(store) })));
    void reading.then((all) => all.forEach((each) => each.catch(() => undefined))).catch(() => undefined);
    const leave = (): undefined => void reading.then((all) => all.forEach(closeRead)).catch(() => undefined);
    let frame = (_seconds: number): boolean => false;
    const asked = host.getAttribute("renderer") ?? new URLSearchParams(page.search).get("renderer");
    let replaced = (): void => undefined;
    const fail = (error: unknown): void => (typeof (error as { code?: unknown }).code === "string" ? page.fail("The PlayCanvas engine", error) : page.showError(kNoGraphics));
    const stage = await Stage.start(canvas, asked, {
      frame: (seconds) => frame(seconds),
      resized: (size) => store.set({ size }),
      fits: (isSo) => (isSo ? page.withdrawError(kNoRoom) : page.showError(kNoRoom)),
      lost: () => page.showError(kLost),
      restored: () => {
        page.withdrawError(kLost);
        page.say("The graphics device is back");
      },
      replaced: () => replaced(),
      ended: fail,
    }).catch(fail);
    if (!stage) return leave();
    if (signal.aborted) stage.end();
    else signal.addEventListener("abort", () => stage.end());
    const found = await manifest;
    if (signal.aborted) return leave();
    let controls: Controls;
    replaced = () => {
      page.withdrawError(kNoRoom);
      controls = new Controls(store, stage.canvas, () => page.isWhole || host.matches(":focus-within"));
      if (!stage.isAsDefined) page.showError(kNotAsDefined);
    };
    replaced();
    // Before what is done only at rest.
    watchRest(page, () => controls.active);
    drawState(store, stage);
    const opening = new Opening(page, stage, found);
    const frames = found.frames ? drawReference(page, found.frames.url) : undefined;
    const captures = new Captures(page, stage, frames, () => opening.allOpened());
    showComparison(page, stage, captures);
    bindSaving(page);
    showNames(page);
    showCameras(page, captures);
    watchFlights(store, signal);
    showPath(page);
    showLink(page);
    connectKeys(page);
    page.onClick("home", () => void goHome(page));
    page.onClick("screenshot", () => void captures.screenshot().catch((error: unknown) => page.fail("The screenshot", error)));
    const showStatistics = statisticsOf(page);
    frame = (seconds) => {
      const isWaiting = step(store, stage, controls, seconds);
      showStatistics(stage);
      return isWaiting;
    };
    const { background, sh_degree: shDegree } = found.settings ?? {};
    const photos = new Map(found.photos.map(({ camera, url }) => [camera, url]));
    store.set({ photos, ...(background ? { background } : {}), ...(shDegree !== undefined ? { shDegree } : {}) });
    const link = page.isWhole ? readLink(location.hash) : {};
    restore(store, link);
    void this.begin(opening, await reading, link.mode);
    return { opening, captures };
  }

  private async begin(opening: Opening, ...asked: [Parameters<Opening["begin"]>[0], Parameters<Opening["begin"]>[1]]): Promise<void> {
    const { page } = this;
    await opening.begin(...asked);
    const camera = page.host.getAttribute("camera");
    if (camera !== null) await goTo(page, camera, false);
    if (page.signal.aborted) return;
    page.store.set({ isReady: true });
    page.host.dataset["ready"] = "true";
    page.tell("ready", null);
  }
}
