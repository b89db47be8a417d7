// stage.ts - the engine: two cameras in one place, each with a scene of its own. Frames are drawn only after a change.
// SPDX-License-Identifier: Apache-2.0
import { type AntiAliasing, drawAsDefined, setPinhole } from "@roofgs/playcanvas";
import {
  AppBase,
  AppOptions,
  CameraComponentSystem,
  Color,
  createGraphicsDevice,
  Entity,
  GSplatComponentSystem,
  GSplatHandler,
  Layer,
  LAYERID_IMMEDIATE,
  PIXELFORMAT_RGBA8,
  RenderTarget,
  Texture,
  TextureHandler,
  Vec4,
} from "playcanvas";
import { pinholeOf, type ViewState } from "./cameras.js";
import { pictureSize, type Size } from "./picture-size.js";

export type Side = 0 | 1;

/** One side, or both with the border at `split` of the width. */
export type Show = { only: Side } | { split: number };

export class Stage {
  readonly layers: readonly [number, number];
  /** Frames drawn. */
  frames = 0;
  private readonly cameras: readonly [Entity, Entity];
  private view: ViewState | undefined;
  private origin: readonly number[] = [0, 0, 0];
  private show: Show = { only: 0 };
  /** A capture uses the cameras; the view and the sides are applied after it. */
  private isCapturing = false;
  /** Frames to draw after this one. */
  private more = 0;
  private isBusy = false;
  private readonly resizes = new ResizeObserver(() => this.resize());

  /** Whether the engine draws the image that RENDERING.md defines. */
  readonly isAsDefined: boolean;

  private constructor(
    readonly app: AppBase,
    private readonly canvas: HTMLCanvasElement,
    /** `frame` returns whether it waits for something that changes the picture. */
    private readonly on: { frame(seconds: number): boolean; resized(size: Size): void },
  ) {
    const layers = ["left", "right"].map((name) => {
      const layer = new Layer({ name });
      app.scene.layers.insert(layer, 0);
      return layer.id;
    });
    this.layers = layers as [number, number];
    this.cameras = this.layers.map((layer, side) => {
      const entity = new Entity(`camera ${side}`, app);
      entity.addComponent("camera", { layers: [layer, LAYERID_IMMEDIATE], priority: side, farClip: 1e5, clearColor: new Color(0, 0, 0, 1) });
      // Without this the engine ignores scissorRect.
      if (entity.camera) (entity.camera.camera as unknown as { _scissorRectClear: boolean })._scissorRectClear = true;
      app.root.addChild(entity);
      return entity;
    }) as unknown as [Entity, Entity];
    this.isAsDefined = this.cameras.map(({ camera }) => camera !== undefined && drawAsDefined(app, camera)).every((done) => done);
    app.scene.on("gsplat:sorted", () => {
      // One frame takes over the order, the next one shows it.
      this.more = 2;
      this.request();
    });
    app.systems.gsplat?.on("frame:request", () => (this.more = Math.max(this.more, 1)));
    app.on("update", (seconds: number) => {
      if (this.more > 0) {
        this.more -= 1;
        this.request();
      }
      const isWaiting = this.on.frame(seconds);
      this.setBusy(isWaiting || this.isToDraw || this.more > 0 || this.isCapturing || this.nSorts() > 0);
    });
    app.on("postrender", () => (this.frames += 1));
    app.autoRender = false;
    this.resizes.observe(canvas);
  }

  /** `deviceTypes` in order of preference. Rejects if there is none of them. */
  static async start(canvas: HTMLCanvasElement, deviceTypes: string[], on: { frame(seconds: number): boolean; resized(size: Size): void; lost(): void; restored(): void }): Promise<Stage> {
    const device = await createGraphicsDevice(canvas, { deviceTypes, antialias: false });
    const options = new AppOptions();
    options.graphicsDevice = device;
    options.componentSystems = [CameraComponentSystem, GSplatComponentSystem];
    options.resourceHandlers = [GSplatHandler, TextureHandler];
    const app = new AppBase(canvas);
    app.init(options);
    const stage = new Stage(app, canvas, on);
    device.on("devicelost", on.lost);
    device.on("devicerestored", () => {
      on.restored();
      stage.request();
    });
    app.start();
    stage.resize();
    return stage;
  }

  /** Gives the graphics device back. */
  end(): void {
    this.resizes.disconnect();
    this.app.destroy();
  }

  setAntiAliasing(side: Side, antiAliasing: AntiAliasing | undefined): void {
    const { camera } = this.cameras[side];
    if (camera) drawAsDefined(this.app, camera, antiAliasing);
    this.request();
  }

  /** Requests a frame. */
  request(): void {
    this.app.renderNextFrame = true;
    this.setBusy(true);
  }

  /** For screen readers, and for tests: while it is true, the picture is going to change by itself. */
  private setBusy(busy: boolean): void {
    if (busy === this.isBusy) return;
    this.isBusy = busy;
    this.canvas.setAttribute("aria-busy", String(busy));
  }

  /** Whether a frame is requested. */
  get isToDraw(): boolean {
    return this.app.renderNextFrame;
  }

  private get size(): Size {
    const { width, height } = this.canvas;
    return { width, height };
  }

  /** Origin of the engine's coordinates, world: cameras are FP64, and what the engine draws stays near 0. */
  setOrigin(origin: readonly number[]): void {
    this.origin = origin;
  }

  setView(view: ViewState): void {
    this.view = view;
    if (this.isCapturing) return;
    for (const entity of this.cameras) setPinhole(entity, pinholeOf(view, this.size.width, this.size.height), this.origin);
    this.request();
  }

  setShow(show: Show): void {
    this.show = show;
    if (this.isCapturing) return;
    const split = "split" in show ? show.split : show.only === 0 ? 1 : 0;
    this.cameras.forEach(({ camera }, side) => {
      if (!camera) return;
      camera.enabled = side === 0 ? split > 0 : split < 1;
      // The right side is drawn over the left one, so that rounding leaves no gap.
      const border = Math.round(split * this.size.width) / this.size.width;
      camera.scissorRect = side === 0 ? new Vec4(0, 0, 1, 1) : new Vec4(border, 0, 1, 1);
    });
    this.request();
  }

  setBackground(rgb: readonly number[]): void {
    const [r, g, b] = rgb as [number, number, number];
    for (const { camera } of this.cameras) if (camera) camera.clearColor = new Color(r, g, b, 1);
    this.request();
  }

  /** Draws a box for one frame, in the engine's coordinates. */
  drawBox(min: readonly number[], max: readonly number[], colour: readonly number[]): void {
    // Each edge joins corners whose numbers differ in one bit.
    const corner = (bits: number): number[] => [0, 1, 2].map((axis) => ((bits >> axis) & 1 ? max : min)[axis] as number);
    const ends = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((from) => [1, 2, 4].filter((bit) => (from & bit) === 0).flatMap((bit) => [...corner(from), ...corner(from | bit)]));
    const colours = Array.from({ length: ends.length / 3 }, () => [...colour, 1]).flat();
    this.app.drawLineArrays(ends, colours, false);
  }

  /** RGBA of one side, upper row first, in any size. Only one capture may run at a time. */
  async capture(side: Side, view: ViewState, width: number, height: number): Promise<Uint8ClampedArray<ArrayBuffer>> {
    const { camera } = this.cameras[side];
    if (!camera) throw new Error("no camera");
    const colorBuffer = new Texture(this.app.graphicsDevice, { width, height, format: PIXELFORMAT_RGBA8, mipmaps: false });
    const target = new RenderTarget({ colorBuffer, depth: true });
    this.isCapturing = true;
    try {
      const other = this.cameras[side === 0 ? 1 : 0].camera;
      if (other) other.enabled = false;
      camera.enabled = true;
      camera.scissorRect = new Vec4(0, 0, 1, 1);
      camera.renderTarget = target;
      setPinhole(this.cameras[side], pinholeOf(view, width, height), this.origin);
      await this.settled();
      const read = await colorBuffer.read(0, 0, width, height, { renderTarget: target, immediate: true });
      const pixels = new Uint8ClampedArray(read as Uint8Array);
      if (this.app.graphicsDevice.isWebGL2) flipRows(pixels, width);
      return pixels;
    } finally {
      camera.renderTarget = null as unknown as RenderTarget;
      target.destroy();
      colorBuffer.destroy();
      this.isCapturing = false;
      if (this.view) this.setView(this.view);
      this.setShow(this.show);
    }
  }

  /** Resolves when the scene that was added last has been drawn. */
  async drawn(): Promise<void> {
    await new Promise<void>((resolve) => this.app.scene.once("gsplat:sorted", () => resolve()));
    for (let i = 0; i < 2; ++i) await new Promise<void>((resolve) => this.app.once("postrender", () => resolve()));
  }

  /** Resolves after a frame whose Gaussians are sorted for its camera. */
  async settled(): Promise<void> {
    for (let before = -1, i = 0; i < 20; ++i) {
      await this.nextFrame();
      const busy = this.nSorts();
      if (before === 0 && busy === 0) return;
      if (busy > 0) await new Promise<void>((resolve) => this.app.scene.once("gsplat:sorted", () => resolve()));
      before = busy;
    }
  }

  /** Sorts in flight, by the engine's internals; 0 where it has none of these. */
  private nSorts(): number {
    interface Managers {
      camerasMap?: Map<unknown, { layersMap: Map<unknown, { gsplatManager?: { cpuSorter?: { jobsInFlight: number; pendingSorted: unknown } } }> }>;
    }
    const { gsplatDirector } = this.app.renderer as unknown as { gsplatDirector?: Managers };
    let jobs = 0;
    for (const { layersMap } of gsplatDirector?.camerasMap?.values() ?? []) {
      for (const { gsplatManager } of layersMap.values()) jobs += gsplatManager?.cpuSorter?.jobsInFlight ?? 0;
    }
    return jobs;
  }

  private nextFrame(): Promise<void> {
    return new Promise((resolve) => {
      this.app.once("postrender", () => resolve());
      this.request();
    });
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.canvas;
    const { width, height } = pictureSize({ width: clientWidth, height: clientHeight }, devicePixelRatio, this.app.graphicsDevice.maxTextureSize);
    if (width === this.size.width && height === this.size.height) return;
    this.app.graphicsDevice.setResolution(width, height);
    this.on.resized({ width, height });
    this.request();
  }
}

function flipRows(pixels: Uint8ClampedArray, width: number): void {
  const rows = pixels.slice();
  const bytes = 4 * width;
  for (let at = 0; at < rows.length; at += bytes) pixels.set(rows.subarray(at, at + bytes), rows.length - bytes - at);
}
