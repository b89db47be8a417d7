// main.ts - the page: opens scenes, connects settings, keys and comparison.
// SPDX-License-Identifier: Apache-2.0
import "./style.css";
import { add, axisOf, type CameraEntry, defaultView, dot, kNear, length, looking, normalised, parseCameras, pathPosition, pinholeOf, type ViewState, viewOf } from "./cameras.js";
import { buildCameras } from "./cameras-panel.js";
import { Compare } from "./compare.js";
import { Controls, type World } from "./controls.js";
import { difference } from "./difference.js";
import { type Frame, type FrameRequest, Frames } from "./frames.js";
import { type Mode, type PageState, readLink, writeLink } from "./link.js";
import { type Manifest, readInside, readManifest, spzAxesOf } from "./manifest.js";
import { bytesText, countText, kLost, kNoGraphics, kNotAsDefined, sentence, waitingSentence } from "./messages.js";
import { element, hideLoading, say, showError, showLoading, showProgress, withdrawError } from "./page.js";
import { openScene, type Read, readFile } from "./open-scene.js";
import type { Trouble } from "./page-driver.js";
import type { Box, Scene, Tint } from "./scene.js";
import { type Side, Stage } from "./stage.js";

/** The view is at rest after so many milliseconds without a change. */
const kRestMs = 200;
/** Seconds from one camera to the next. */
const kPathSeconds = 2;

const kTitle = "RoofGS viewer";

const input = (id: string): HTMLInputElement => element(id, HTMLInputElement);

class Page {
  private readonly scenes: (Scene | undefined)[] = [undefined, undefined];
  private readonly compare: Compare;
  private readonly controls: Controls;
  private readonly canvas = element("picture", HTMLCanvasElement);
  private view: ViewState | undefined;
  private cameras: CameraEntry[] = [];
  private camera = -1;
  private photos = new Map<string, string>();
  private background: number[] = [0, 0, 0];
  private playing: number | undefined;
  private restTimer = 0;
  private frames: Frames | undefined;
  private frame: Frame | undefined;
  /** Changes of the scenes that notice() has seen. */
  private nChanges = 0;
  private speed: { at: number; frames: number; rate: number } = { at: 0, frames: 0, rate: 0 };
  /** Resolves when all scenes requested so far are open; never rejects. */
  private opening: Promise<void> = Promise.resolve();
  /** The left scene's number on the server that draws reference pictures. */
  private referenceScene = 0;
  /** Captures come one after the other. */
  private capturing: Promise<unknown> = Promise.resolve();

  constructor(
    private readonly stage: Stage,
    private readonly manifest: Manifest,
  ) {
    const page = this;
    this.compare = new Compare(
      stage,
      {
        get right() {
          return page.referenceShown ? "reference" : page.scenes[1] ? "scene" : "none";
        },
        capture: (side, width, height) => this.captureSide(side, width, height),
      },
      { changed: () => this.changed(), error: (error) => this.fail("The difference", error) },
    );
    this.controls = new Controls(this.canvas, {
      view: () => this.view,
      world: () => this.world,
      setView: (view) => this.setView(view),
      focus: (x, y) => this.focus(x, y),
    });
    const { frames } = manifest;
    if (frames) {
      this.frames = new Frames(frames.url, {
        frame: (frame) => this.showReference(frame),
        error: (error) => this.fail("The reference picture", error),
      });
      element("reference-label", HTMLLabelElement).hidden = false;
    }
    this.connect();
  }

  // Opening ------------------------------------------------------------------------------------------------------------

  /** `reading`: scenes of the manifest, which are in flight already. */
  async begin(reading: readonly Promise<Read>[]): Promise<void> {
    const { settings, photos, cameras, scenes } = this.manifest;
    this.photos = new Map(photos.map(({ camera, url }) => [camera, url]));
    if (settings?.background) this.setBackground(settings.background);
    if (settings?.sh_degree !== undefined) input("sh").value = String(settings.sh_degree);
    const link = readLink(location.hash);
    this.restore(link);
    // Files that are dropped meanwhile come after these.
    if (cameras !== null) void this.inTurn(() => this.fetchCameras(cameras));
    for (const [referenceScene, { name }] of scenes.entries()) {
      void this.inTurn(() => this.open({ name, reading: reading[referenceScene] as Promise<Read>, mode: link.mode ?? "slider", referenceScene }));
    }
    await this.opening;
    if (!this.scenes[1]) this.compare.setMode(this.compare.mode === "single" ? (link.mode ?? "single") : this.compare.mode);
  }

  private restore(link: Partial<PageState>): void {
    if (link.background) this.setBackground(link.background);
    if (link.shDegree !== undefined) input("sh").value = String(link.shDegree);
    if (link.detailPx !== undefined) input("detail").value = String(link.detailPx);
    if (link.budget !== undefined) input("budget").value = String(Math.log10(link.budget));
    if (link.split !== undefined) this.compare.split = link.split;
    if (link.view) this.view = link.view;
    this.applySettings();
  }

  /** A link was put into the address bar. */
  private follow(link: Partial<PageState>): void {
    if (this.playing !== undefined) this.play();
    this.restore(link);
    this.compare.setMode(link.mode ?? this.compare.mode);
    this.refreshView();
  }

  /** Opens dropped or chosen files: cameras, and scenes on the first free side, or on the right. */
  async openFiles(files: readonly File[]): Promise<void> {
    for (const file of files) performance.mark(`open ${file.name}`);
    for (const file of files) void this.inTurn(() => this.openFile(file));
    await this.opening;
  }

  /** Opens one scene after the other, because each looks for a free side. */
  private inTurn(work: () => Promise<void>): Promise<void> {
    this.opening = this.opening.then(work).catch((error: unknown) => this.fail("The page", error));
    return this.opening;
  }

  /** Resolves when no scene is being opened any more, including those requested meanwhile. */
  private async allOpened(): Promise<void> {
    for (let last: Promise<void> | undefined; last !== this.opening; ) {
      last = this.opening;
      await last;
    }
  }

  private async openFile(file: File): Promise<void> {
    const { name } = file;
    showLoading(`Opening ${name}`);
    const reading = readFile({ entry: { name, url: "" }, file, onProgress: showProgress });
    const read = await reading.catch(() => undefined);
    if (read?.kind !== "cameras") return this.open({ name, reading, mode: "slider" });
    await read.answer().then((answer) => this.readCameras(answer)).catch((error: unknown) => this.fail(name, error));
    hideLoading();
  }

  /**
   * Opens a scene on the first free side, or on the right. If that fails, the side keeps what it had. `mode` for two scenes, unless the
   * user has chosen one. `referenceScene`: the scene's number on the server that draws reference pictures.
   */
  private async open({ name, reading, mode, referenceScene }: { name: string; reading: Promise<Read>; mode: Mode; referenceScene?: number }): Promise<void> {
    const side: Side = this.scenes[0] ? 1 : 0;
    this.showWelcome(false);
    showLoading(`Opening ${name}`);
    const before = this.scenes[side];
    const viewBefore = this.view;
    let scene: Scene | undefined;
    try {
      const read = await reading;
      scene = await openScene(this.stage, { name, read, spzAxes: spzAxesOf(location.search, this.manifest), side, onProgress: showProgress, on: this.trouble(name) });
      if (before) before.hidden = true;
      this.show(scene, side);
      if (side === 0) this.referenceScene = referenceScene ?? 0;
      this.compare.setMode(side === 1 && this.compare.mode === "single" ? mode : this.compare.mode);
      this.markPicture(name);
      await scene.complete();
      before?.destroy();
      if (side === 0 && !before) this.setCameras(this.cameras);
    } catch (error) {
      scene?.destroy();
      if (before) before.hidden = false;
      if (scene) this.show(before, side);
      if (!this.scenes.some((each) => each)) this.forgetView(viewBefore);
      this.fail(name, error);
      this.showWelcome();
      this.compare.setMode(this.compare.mode);
    } finally {
      hideLoading();
    }
  }

  /** Without a scene, the next one starts from its own first view. */
  private forgetView(view: ViewState | undefined): void {
    this.view = view;
    if (!view) history.replaceState(null, "", location.pathname + location.search);
  }

  /** Adds a measure to the browser's timeline: from the mark `open NAME`, or the page's start, to the first picture. */
  private markPicture(name: string): void {
    const begin = performance.getEntriesByName(`open ${name}`, "mark").at(-1)?.startTime ?? 0;
    void this.stage.drawn().then(() => performance.measure(`first picture of ${name}`, { start: begin }));
  }

  private show(scene: Scene | undefined, side: Side): void {
    this.scenes[side] = scene;
    const [left] = this.scenes;
    if (left) this.stage.setOrigin(left.origin);
    for (const each of this.scenes) each?.place(left?.origin ?? each.origin);
    if (scene) {
      scene.setShDegree(Number(input("sh").value));
      scene.setTint(this.tint);
      this.setAntiAliasing();
      this.setView(this.view ?? this.firstView(scene));
    }
    this.nameScenes();
  }

  private setAntiAliasing(): void {
    for (const [side, scene] of this.scenes.entries()) {
      if (scene) this.stage.setAntiAliasing(side as Side, scene.antiAliasing(Number(input("detail").value)));
    }
  }

  private showWelcome(shown = this.scenes[0] === undefined): void {
    element("welcome", HTMLElement).hidden = !shown;
  }

  private nameScenes(): void {
    const [left, right] = this.scenes;
    const names = [left?.name, this.referenceShown ? `${left?.name ?? ""}, reference picture` : right?.name].filter((name) => name !== undefined);
    element("title", HTMLElement).textContent = names.join(" | ") || kTitle;
    document.title = [...names, kTitle].join(" | ");
    element("left", HTMLElement).textContent = left?.name ?? "";
    element("right", HTMLElement).textContent = this.referenceShown ? (names.at(-1) ?? "") : (right?.name ?? "");
    const what = left ? `${left.name}, ${countText(left.nGaussians)} ${left.nGaussians === 1 ? "Gaussian" : "Gaussians"}${names[1] ? `, beside ${names[1]}` : ""}` : "No scene yet";
    this.canvas.setAttribute("aria-label", what);
    say(what);
    element("tint", HTMLSelectElement).disabled = !this.scenes.some((scene) => scene?.hasPages);
  }

  // Looking ------------------------------------------------------------------------------------------------------------

  private get world(): World {
    const up = this.cameras.length > 0 ? this.cameras.reduce((sum, { rotation }) => add(sum, axisOf(rotation, 1), -1), [0, 0, 0]) : null;
    const box = this.scenes[0]?.box;
    const size = box ? length(add(box.max, box.min, -1)) : 1;
    return { up: normalised(up && length(up) > 0.1 ? up : (this.scenes[0]?.up ?? [0, -1, 0])), speed: 0.15 * size };
  }

  private firstView({ box }: Scene): ViewState {
    const { width, height } = this.stage.size;
    return this.cameras[0] ? this.viewFrom(this.cameras[0], box) : defaultView(box, this.world.up, height / width);
  }

  /** Its pivot is straight ahead, as far away as the scene's middle. */
  private viewFrom(camera: CameraEntry, { min, max }: Box): ViewState {
    const { position, rotation } = camera;
    const [middle, forward] = [add([0, 0, 0], add(min, max), 0.5), axisOf(rotation, 2)];
    return viewOf(camera, add(position, forward, Math.max(0.1, dot(add(middle, position, -1), forward))));
  }

  private setView(view: ViewState): void {
    this.view = view;
    this.stage.setView(view);
    this.compare.outdate();
    this.changed();
    if (this.referenceShown) this.askReference(true);
  }

  /** Applies the view to a picture of another size. */
  refreshView(): void {
    if (this.view) this.setView(this.view);
  }

  private jump(index: number): void {
    const camera = this.cameras[index];
    const box = this.scenes[0]?.box;
    if (!camera || !box) return;
    this.camera = index;
    this.setView(this.viewFrom(camera, box));
    say(`Camera ${camera.img_name}`);
  }

  /** Makes the nearest Gaussian along the pointer's ray the pivot. */
  private focus(x: number, y: number): void {
    const { view, canvas } = this;
    const { mode, split } = this.compare;
    const isRight = mode === "slider" && this.scenes[1] !== undefined && x > split * canvas.clientWidth;
    const scene = this.scenes[isRight ? 1 : 0];
    if (!view || !scene) return;
    const { fx, fy, cx = 0, cy = 0 } = pinholeOf(view, canvas.clientWidth, canvas.clientHeight);
    const direction = [(x - cx) / fx, (y - cy) / fy, 1];
    const ray = normalised([0, 1, 2].map((row) => dot(view.rotation[row] as number[], direction)));
    const [rx, ry, rz] = ray as [number, number, number];
    const [ex, ey, ez] = add(view.position, scene.origin, -1) as [number, number, number];
    let best = Infinity;
    let depth = 0;
    // Called for millions of Gaussians, so it allocates nothing.
    for (const means of scene.centres()) {
      for (let i = 0; i < means.length; i += 3) {
        const tx = (means[i] as number) - ex;
        const ty = (means[i + 1] as number) - ey;
        const tz = (means[i + 2] as number) - ez;
        const along = tx * rx + ty * ry + tz * rz;
        if (along <= kNear) continue;
        const aside = Math.sqrt(Math.max(0, tx * tx + ty * ty + tz * tz - along * along)) / along;
        // Half a degree off the ray costs as much as a third of the distance.
        const cost = along * (1 + (aside / 0.009) ** 2 / 3);
        if (aside < 0.03 && cost < best) {
          best = cost;
          depth = along;
        }
      }
    }
    if (depth > 0) this.setView({ ...view, pivot: add(view.position, ray, depth), rotation: looking(ray, this.world.up) });
  }

  private play(): void {
    this.playing = this.playing === undefined && this.cameras.length > 1 ? 0 : undefined;
    element("play", HTMLButtonElement).setAttribute("aria-pressed", String(this.playing !== undefined));
    this.stage.request();
  }

  private async fetchCameras(url: string): Promise<void> {
    await (url.startsWith("#") ? readInside(url).then((blob) => new Response(blob)) : fetch(url))
      .then((answer) => this.readCameras(answer))
      .catch((error: unknown) => this.fail("The camera file", error));
  }

  private async readCameras(answer: Response): Promise<void> {
    if (!answer.ok) throw Object.assign(new Error(`HTTP ${answer.status}`), { code: "open_failed" });
    this.setCameras(parseCameras(await answer.text()));
  }

  private setCameras(cameras: CameraEntry[]): void {
    this.cameras = cameras;
    if (this.playing !== undefined && cameras.length < 2) this.play();
    buildCameras({
      list: cameras,
      photos: this.photos,
      jump: (index) => this.jump(index),
      draw: async (camera, width, height) => {
        if (!this.scenes[0]) throw new Error("there is no scene");
        return this.capture(0, viewOf(camera, camera.position), width, height);
      },
    });
  }

  // Before each frame --------------------------------------------------------------------------------------------------

  /** Returns whether pages are still to come, or the view is moving. */
  step(seconds: number): boolean {
    this.controls.step(seconds);
    const { view } = this;
    if (!view) return false;
    if (this.playing !== undefined) {
      this.playing = (this.playing + seconds / (kPathSeconds * (this.cameras.length - 1))) % 1;
      const { position, segment, share } = pathPosition(this.cameras.map((camera) => camera.position), this.playing);
      const [from, to] = [this.cameras[segment], this.cameras[segment + 1]] as [CameraEntry, CameraEntry];
      const forward = add(add([0, 0, 0], axisOf(from.rotation, 2), 1 - share), axisOf(to.rotation, 2), share);
      const up = add(add([0, 0, 0], axisOf(from.rotation, 1), share - 1), axisOf(to.rotation, 1), -share);
      const rotation = looking(forward, up);
      this.setView({ ...viewOf(from, view.pivot), position, rotation, pivot: add(position, normalised(forward), this.world.speed) });
    }
    const { width } = this.stage.size;
    const mostGaussians = this.budget;
    for (const scene of this.scenes) {
      if (!scene?.hasPages) continue;
      const position = add(view.position, scene.origin, -1);
      scene.look({ position, focalPx: Math.max(1, view.aspect) * view.focal * width, detailPx: Number(input("detail").value), mostGaussians }, performance.now());
    }
    this.notice();
    // Boxes last for one frame.
    if (input("boxes").checked && this.stage.isToDraw) this.drawBoxes();
    this.showNumbers();
    return this.controls.active || this.playing !== undefined || this.scenes.some((scene) => scene !== undefined && scene.pages.wanted > 0);
  }

  private drawBoxes(): void {
    for (const scene of this.scenes) {
      if (!scene) continue;
      const shift = add(scene.origin, this.scenes[0]?.origin ?? [0, 0, 0], -1);
      for (const { min, max } of scene.boxes()) this.stage.drawBox(add(min, shift), add(max, shift), [1, 0.8, 0.1]);
    }
  }

  /** Reacts to changes in what scenes draw, such as new pages. */
  private notice(): void {
    const changes = this.scenes.reduce((sum, scene) => sum + (scene?.nChanges ?? 0), 0);
    if (changes === this.nChanges) return;
    this.nChanges = changes;
    this.compare.outdate();
    this.changed();
  }

  private showNumbers(): void {
    const overlay = element("overlay", HTMLOutputElement);
    overlay.hidden = !input("stats").checked;
    const now = performance.now();
    if (now - this.speed.at > 500) {
      const { frames } = this.stage;
      this.speed = { at: now, frames, rate: (1000 * (frames - this.speed.frames)) / (now - this.speed.at) };
    }
    if (overlay.hidden) return;
    const lines = this.scenes
      .filter((scene) => scene !== undefined)
      .map((scene) => {
        const { drawn, wanted } = scene.pages;
        const pages = scene.hasPages ? `, ${drawn} pages${wanted > 0 ? `, ${wanted} wanted` : ""}` : "";
        return `${countText(scene.nDrawn)} of ${countText(scene.nGaussians)} Gaussians, ${bytesText(scene.bytesRead)} of ${bytesText(scene.bytes)}${pages}`;
      });
    lines.push(`${this.speed.rate.toFixed(0)} frames a second`);
    if (this.frame && this.referenceShown) {
      const { renderMs, totalMs, pagesMissing } = this.frame;
      lines.push(`reference picture: drawn in ${renderMs.toFixed(0)} ms, shown after ${totalMs.toFixed(0)} ms${pagesMissing > 0 ? `, ${pagesMissing} pages missing` : ""}`);
    }
    overlay.textContent = lines.join("\n");
  }

  // Settings -----------------------------------------------------------------------------------------------------------

  private get tint(): Tint {
    return element("tint", HTMLSelectElement).value as Tint;
  }

  private get budget(): number {
    return Math.round(10 ** Number(input("budget").value));
  }

  private setBackground(rgb: readonly number[]): void {
    this.background = [...rgb];
    const hex = rgb.map((value) => Math.round(255 * value).toString(16).padStart(2, "0")).join("");
    input("background").value = `#${hex}`;
    this.stage.setBackground(rgb);
  }

  private applySettings(): void {
    this.showValues();
    this.setAntiAliasing();
    for (const scene of this.scenes) scene?.setShDegree(Number(input("sh").value));
    this.stage.request();
  }

  private showValues(): void {
    element("sh-value", HTMLOutputElement).textContent = input("sh").value;
    element("detail-value", HTMLOutputElement).textContent = input("detail").value;
    element("budget-value", HTMLOutputElement).textContent = countText(this.budget);
  }

  private connect(): void {
    const click = (id: string, action: () => void): void => element(id, HTMLButtonElement).addEventListener("click", action);
    click("open", () => input("file").click());
    click("screenshot", () => void this.screenshot().catch((error: unknown) => this.fail("The screenshot", error)));
    click("link", () => void this.copyLink());
    click("play", () => this.play());
    click("menu", () => {
      const shown = element("panel", HTMLElement).classList.toggle("shown");
      element("menu", HTMLButtonElement).setAttribute("aria-expanded", String(shown));
    });
    // The system's choice holds until the button is pressed.
    const system = matchMedia("(prefers-color-scheme: dark)");
    const root = document.documentElement;
    const isDark = (): boolean => (root.dataset["theme"] ?? (system.matches ? "dark" : "light")) === "dark";
    const showTheme = (): void => element("theme", HTMLButtonElement).setAttribute("aria-pressed", String(isDark()));
    click("theme", () => {
      root.dataset["theme"] = isDark() ? "light" : "dark";
      showTheme();
    });
    system.addEventListener("change", showTheme);
    showTheme();
    input("file").addEventListener("change", () => {
      void this.openFiles([...(input("file").files ?? [])]);
      input("file").value = "";
    });
    input("background").addEventListener("input", () => {
      this.setBackground([1, 3, 5].map((at) => parseInt(input("background").value.slice(at, at + 2), 16) / 255));
      this.compare.outdate();
      this.changed();
    });
    for (const id of ["sh", "detail", "budget"]) {
      input(id).addEventListener("input", () => {
        this.applySettings();
        this.changed();
      });
    }
    window.addEventListener("hashchange", () => this.follow(readLink(location.hash)));
    for (const id of ["stats", "boxes"]) input(id).addEventListener("change", () => this.stage.request());
    element("tint", HTMLSelectElement).addEventListener("change", () => {
      for (const scene of this.scenes) scene?.setTint(this.tint);
    });
    input("reference").addEventListener("change", () => {
      this.nameScenes();
      if (!this.referenceShown) this.frames?.stop();
      else this.askReference(false);
      this.compare.setMode(this.referenceShown ? this.compare.mode : this.scenes[1] ? "slider" : "single");
    });
    document.addEventListener("keydown", (event) => this.key(event));
    document.addEventListener("dragover", (event) => event.preventDefault());
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      void this.openFiles([...(event.dataTransfer?.files ?? [])]);
    });
  }

  private key(event: KeyboardEvent): void {
    const { target } = event;
    const typing = target instanceof HTMLSelectElement || (target instanceof HTMLInputElement && !["checkbox", "radio", "range"].includes(target.type));
    if (typing || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    const toggle = (id: string): void => input(id).click();
    const mode = (name: "flicker" | "difference" | "slider"): void => this.compare.setMode(this.compare.mode === name ? "single" : name);
    const n = this.cameras.length;
    const actions: Record<string, () => void> = {
      KeyN: () => this.jump((this.camera + 1) % n),
      KeyB: () => this.jump((this.camera - 1 + n) % n),
      KeyP: () => this.play(),
      KeyF: () => mode("flicker"),
      KeyX: () => mode("difference"),
      KeyC: () => mode("slider"),
      KeyT: () => this.frames && toggle("reference"),
      KeyI: () => toggle("stats"),
      KeyO: () => input("file").click(),
    };
    actions[event.code]?.();
  }

  /** Called after a change of anything that a link restores. */
  private changed(): void {
    clearTimeout(this.restTimer);
    this.restTimer = window.setTimeout(() => {
      if (this.controls.active || this.playing !== undefined) {
        this.changed();
        return;
      }
      const hash = this.link;
      if (hash) history.replaceState(null, "", `#${hash}`);
      if (this.referenceShown) this.askReference(false);
      if (this.compare.mode === "difference" && element("map", HTMLCanvasElement).hidden) this.compare.rest();
    }, kRestMs);
    if (this.controls.active) this.stage.request();
  }

  private get link(): string | null {
    if (!this.view) return null;
    const { mode, split } = this.compare;
    const { view, background, budget } = this;
    return writeLink({ view, mode, split, background, shDegree: Number(input("sh").value), detailPx: Number(input("detail").value), budget });
  }

  private async copyLink(): Promise<void> {
    const hash = this.link;
    if (hash) history.replaceState(null, "", `#${hash}`);
    try {
      await navigator.clipboard.writeText(location.href);
      say("Link copied");
    } catch {
      showError("The browser does not let this page copy. The link is in the address bar.");
    }
  }

  // Pictures -----------------------------------------------------------------------------------------------------------

  private get referenceShown(): boolean {
    return this.frames !== undefined && input("reference").checked;
  }

  private frameRequest(width: number, height: number): FrameRequest | undefined {
    if (!this.view) return undefined;
    const detail = Number(input("detail").value);
    return { scene: this.referenceScene, camera: pinholeOf(this.view, width, height), width, height, background: this.background, sh_degree: Number(input("sh").value), detail };
  }

  private askReference(moving: boolean): void {
    const { width, height } = this.stage.size;
    const request = this.frameRequest(width, height);
    if (request && this.scenes[0]) this.frames?.ask(request, moving);
  }

  private showReference(frame: Frame): void {
    this.frame = frame;
    const canvas = element("reference-picture", HTMLCanvasElement);
    canvas.width = frame.bitmap.width;
    canvas.height = frame.bitmap.height;
    canvas.getContext("2d")?.drawImage(frame.bitmap, 0, 0);
    frame.bitmap.close();
    this.stage.request();
  }

  private capture(side: Side, view: ViewState, width: number, height: number): Promise<Uint8ClampedArray<ArrayBuffer>> {
    const result = this.capturing.then(() => this.stage.capture(side, view, width, height));
    this.capturing = result.catch(() => undefined);
    return result;
  }

  private async captureSide(side: "left" | "right", width: number, height: number): Promise<Uint8ClampedArray<ArrayBuffer>> {
    // Only complete scenes are compared or saved.
    await this.allOpened();
    const request = this.frameRequest(width, height);
    if (!this.view || !request) throw new Error("there is no scene");
    if (side === "left" || !this.referenceShown) return this.capture(side === "left" ? 0 : 1, this.view, width, height);
    const bitmap = await (this.frames as Frames).exact(request);
    const context = new OffscreenCanvas(width, height).getContext("2d") as OffscreenCanvasRenderingContext2D;
    context.drawImage(bitmap, 0, 0);
    bitmap.close();
    return context.getImageData(0, 0, width, height).data;
  }

  private async screenshot(): Promise<void> {
    await this.allOpened();
    const { width, height } = this.stage.size;
    const { mode, split } = this.compare;
    const two = this.referenceShown || this.scenes[1] !== undefined;
    const border = mode === "slider" && two ? Math.round(split * width) : this.referenceShown && mode === "single" ? 0 : width;
    if (!this.scenes[0]) {
      showError("There is no picture to save yet. Open a scene first.");
      return;
    }
    const canvas = new OffscreenCanvas(width, height);
    const context = canvas.getContext("2d") as OffscreenCanvasRenderingContext2D;
    if (mode === "difference") {
      const { map } = difference(await this.captureSide("left", width, height), await this.captureSide("right", width, height));
      context.putImageData(new ImageData(map, width, height), 0, 0);
    } else {
      const put = async (side: "left" | "right", from: number, to: number): Promise<void> => {
        if (from === to) return;
        const pixels = new ImageData(await this.captureSide(side, width, height), width, height);
        context.putImageData(pixels, 0, 0, from, 0, to - from, height);
      };
      await Promise.all([put("left", 0, border), put("right", border, width)]);
    }
    const link = document.createElement("a");
    link.href = URL.createObjectURL(await canvas.convertToBlob({ type: "image/png" }));
    link.download = `${this.scenes[0].name}.png`;
    link.click();
    URL.revokeObjectURL(link.href);
  }

  private trouble(name: string): Trouble {
    let said = "";
    const waiting = (error: unknown): void => (error === null ? withdrawError(said) : showError((said = waitingSentence(name, error))));
    return { waiting, damaged: (error) => this.fail(name, error) };
  }

  private fail(name: string, error: unknown): void {
    if ((error as { name?: string } | null)?.name === "AbortError") return;
    showError(sentence(name, error));
  }
}

async function main(): Promise<void> {
  let page: Page | undefined;
  let stage: Stage;
  // Scenes are requested while the engine starts.
  const manifest = readManifest();
  const reading = manifest.then(({ scenes }) => scenes.map((entry) => readFile({ entry, onProgress: showProgress })));
  void reading.then((all) => all.forEach((each) => each.catch(() => undefined))).catch(() => undefined);
  try {
    const device = new URLSearchParams(location.search).get("device");
    // WebGPU only on request: not every browser that has it can draw with it.
    stage = await Stage.start(element("picture", HTMLCanvasElement), device === "webgpu" ? ["webgpu", "webgl2"] : ["webgl2"], {
      frame: (seconds) => page?.step(seconds) ?? false,
      resized: () => page?.refreshView(),
      lost: () => showError(kLost),
      restored: () => {
        withdrawError(kLost);
        say("The graphics device is back");
      },
    });
  } catch {
    showError(kNoGraphics);
    return;
  }
  try {
    if (!stage.isAsDefined) showError(kNotAsDefined);
    page = new Page(stage, await manifest);
    await page.begin(await reading);
    document.documentElement.dataset["ready"] = "true";
  } catch (error) {
    showError(sentence("The page", error));
  }
}

void main();
