// opening.ts - opens scenes and cameras: what the page begins with, then what is dropped or chosen.
// SPDX-License-Identifier: Apache-2.0
import { parseCameras } from "./cameras.js";
import { fly } from "./flight.js";
import type { Mode } from "./link.js";
import { type Manifest, readInside, type SceneEntry, spzAxesOf } from "./manifest.js";
import { waitingSentence } from "./messages.js";
import { closeRead, openScene, type Read, readFile } from "./open-scene.js";
import { beginLoading, type Page, progressOf } from "./page.js";
import type { Trouble } from "./page-driver.js";
import type { Side } from "./renderer.js";
import type { Scene } from "./scene.js";
import { SplatScene } from "./splat-scene.js";
import { isTurned, kPlyAxes } from "./splats.js";
import { homeOf, type PageStore, type State } from "./state.js";
import type { Stage } from "./stage.js";

/** Calls `open` with what is chosen or dropped, from the first moment on. */
export function listenForFiles(page: Page, open: (files: readonly File[]) => void): void {
  const input = page.input("file");
  for (const id of ["open", "open-first"]) page.onClick(id, () => input.click());
  input.addEventListener("change", () => {
    open([...(input.files ?? [])]);
    input.value = "";
  });
  if (!page.isFull) return;
  const { dataset } = page.host;
  page.listen("dragover", (event) => {
    event.preventDefault();
    dataset["dragged"] = "";
  });
  page.listen("dragleave", () => delete dataset["dragged"]);
  page.listen("drop", (event) => {
    event.preventDefault();
    delete dataset["dragged"];
    open([...(event.dataTransfer?.files ?? [])]);
  });
}

export class Opening {
  /** Resolves when all that was requested so far is open; never rejects. */
  private last: Promise<void> = Promise.resolve();
  private readonly store: PageStore;
  /** Stops opening the scene that is being opened. */
  private cancel = (): void => undefined;

  constructor(
    private readonly page: Page,
    private readonly stage: Stage,
    private readonly manifest: Manifest,
  ) {
    this.store = page.store;
    page.onClick("cancel", () => this.cancel());
    page.signal.addEventListener("abort", () => this.cancel());
  }

  /** `reading`: scenes of the manifest, which are in flight already. `mode`: that of the link. */
  async begin(reading: readonly Promise<Read>[], mode: Mode | undefined): Promise<void> {
    const { cameras: url, scenes } = this.manifest;
    // Files that are dropped meanwhile come after these.
    if (url !== null) this.inTurn(() => this.openCameras("The camera file", async () => (url.startsWith("#") ? new Response(await readInside(url)) : fetch(url))));
    scenes.forEach(({ name }, i) => this.inTurn(() => this.open(name, reading[i] as Promise<Read>, mode, i, reading[i + 1])));
    if (scenes.length === 0) await this.offerSample();
    await this.last;
    const { state } = this.store;
    if (mode && !state.scenes[1] && state.mode === "single") this.store.set({ mode });
  }

  /** Where the whole page has nothing to show, and a scene lies beside it. */
  private async offerSample(): Promise<void> {
    const { page } = this;
    if (!page.isWhole || !page.isFull || location.protocol === "file:") return;
    const url = "sample.rgs";
    const answer = await fetch(url, { method: "HEAD" }).catch(() => null);
    // Some servers answer every address by their page.
    if (!answer?.ok || answer.headers.get("content-type")?.startsWith("text/html")) return;
    page.element("sample", HTMLButtonElement).hidden = false;
    page.onClick("sample", () => void this.openUrl({ name: url, url }));
  }

  /** Resolves when no scene is being opened any more, including those requested meanwhile. */
  async allOpened(): Promise<void> {
    for (let last: Promise<void> | undefined; last !== this.last; await last) last = this.last;
  }

  /** Opens one scene after the other, because each looks for a free side. */
  private inTurn(work: () => Promise<void>): void {
    this.last = this.last.then(work).catch((error: unknown) => this.page.fail("The page", error));
  }

  openFiles(files: readonly File[]): Promise<void> {
    for (const file of files) performance.mark(`open ${file.name}`);
    for (const file of files) this.inTurn(() => this.openFile(file));
    return this.last;
  }

  openUrl(entry: SceneEntry): Promise<void> {
    this.inTurn(() => this.open(entry.name, readFile({ entry, onProgress: progressOf(this.store) })));
    return this.last;
  }

  closeSecond(): Promise<void> {
    this.inTurn(async () => {
      const { scenes: [left, right] } = this.store.state;
      this.store.set({ scenes: [left, undefined] });
      right?.destroy();
    });
    return this.last;
  }

  private async openFile(file: File): Promise<void> {
    const { name } = file;
    beginLoading(this.store, name);
    const reading = readFile({ entry: { name, url: "" }, file, onProgress: progressOf(this.store) });
    const read = await reading.catch(() => undefined);
    if (read?.kind !== "cameras") return this.open(name, reading);
    await this.openCameras(name, () => read.answer());
    this.store.set({ loading: undefined });
  }

  /**
   * Opens a scene on the first free side, or on the right. If that fails, the side keeps what it had. `mode` for two scenes, unless the
   * user has chosen one. `referenceScene`: the scene's number on the server that draws reference pictures. `next`: what is opened beside it.
   */
  private async open(name: string, reading: Promise<Read>, mode: Mode = "slider", referenceScene = 0, next?: Promise<Read>): Promise<void> {
    const { store, stage, page } = this;
    const { scenes: scenesBefore, view: viewBefore } = store.state;
    const side: Side = scenesBefore[0] ? 1 : 0;
    const before = scenesBefore[side];
    let scene: Scene | undefined;
    beginLoading(store, name);
    const stop = new AbortController();
    this.cancel = () => stop.abort();
    const cancelled = new Promise<never>((_, reject) => stop.signal.addEventListener("abort", () => reject(stop.signal.reason)));
    cancelled.catch(() => undefined);
    try {
      page.signal.throwIfAborted();
      const read = await Promise.race([reading, cancelled]);
      // An .rgs is drawn as it is, so others are turned to it, also those before it.
      const beside = read.kind === "rgs" ? undefined : await Promise.race([next?.catch(() => undefined), cancelled]);
      const axes = scenesBefore[0]?.axes ?? (beside?.kind === "rgs" ? beside.opened.file.declarations.axes : kPlyAxes);
      const how = { onProgress: progressOf(store), on: this.troubleOf(name), signal: stop.signal };
      const opened = openScene(stage, { name, read, spzAxes: spzAxesOf(page.search, this.manifest), axes, side, shDegree: store.state.shDegree, ...how });
      scene = await Promise.race([opened, cancelled]).catch((error: unknown) => {
        // One that comes too late goes again.
        void opened.then((late) => late.destroy(), () => undefined);
        throw error;
      });
      if (before) before.hidden = true;
      this.show(side === 0 ? { scenes: [scene, undefined], referenceScene } : { scenes: [scenesBefore[0], scene], mode: store.state.mode === "single" ? mode : store.state.mode });
      const [left, right] = store.state.scenes;
      if (read.kind === "rgs" && left instanceof SplatScene && right && isTurned(left.axes, right.axes)) {
        page.showError(`${name} declares other axes than those in which ${left.name} is drawn, so the two do not match. Open ${name} first, then ${left.name}, which is turned.`);
      }
      this.markPicture(name);
      const guess = scene.firstView || viewBefore || store.state.cameras.length > 0 ? undefined : store.state.view;
      await Promise.race([scene.complete(), cancelled]);
      before?.destroy();
      if (side === 0) store.set({ isComplete: true });
      const home = scene.firstView && homeOf(store.state);
      // What waits for `ready` waits for no flight.
      if (home && guess === store.state.view) void fly(store, home, performance.now(), store.state.isReady ? undefined : true);
    } catch (error) {
      scene?.destroy();
      if (!scene) closeRead(reading);
      if (before && page.signal.aborted) before.destroy();
      else if (before) before.hidden = false;
      // Without a scene, the next one starts from its own first view.
      store.set({ scenes: scenesBefore, ...(scenesBefore[0] ? {} : { view: viewBefore }) });
      page.fail(name, error);
    } finally {
      store.set({ loading: undefined });
    }
  }

  private show(patch: Partial<State>): void {
    const next = { ...this.store.state, ...patch };
    this.store.set({ ...patch, view: next.view ?? homeOf(next) });
  }

  /** Adds a measure to the browser's timeline: from the mark `open NAME`, or the page's start, to the first picture. */
  private markPicture(name: string): void {
    const begin = performance.getEntriesByName(`open ${name}`, "mark").at(-1)?.startTime ?? 0;
    void this.stage.drawn().then(() => {
      performance.measure(`first picture of ${name}`, { start: begin });
      this.store.set({ hasPicture: true });
    });
  }

  private async openCameras(name: string, read: () => Promise<Response>): Promise<void> {
    try {
      const answer = await read();
      if (!answer.ok) throw Object.assign(new Error(`HTTP ${answer.status}`), { code: "open_failed" });
      const cameras = parseCameras(await answer.text());
      this.store.set({ cameras, playing: cameras.length > 1 ? this.store.state.playing : undefined });
    } catch (error) {
      this.page.fail(name, error);
    }
  }

  /** What happens to a scene that is open. */
  private troubleOf(name: string): Trouble {
    const { page } = this;
    let said = "";
    const waiting = (error: unknown): void => (error === null ? page.withdrawError(said) : page.showError((said = waitingSentence(name, error))));
    return { waiting, damaged: (error) => page.fail(name, error) };
  }
}
