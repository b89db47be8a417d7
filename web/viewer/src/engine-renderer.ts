// engine-renderer.ts - the PlayCanvas engine by WebGL 2: two cameras in one place, each with a scene of its own.
// SPDX-License-Identifier: Apache-2.0
import { drawAsDefined, RgsResource, setPinhole } from "@roofgs/playcanvas";
import type { Gaussians, StoredGaussians } from "@roofgs/reader";
import type { Colour } from "@roofgs/webgpu";
import {
  AppBase,
  AppOptions,
  CameraComponentSystem,
  Color,
  createGraphicsDevice,
  Entity,
  GSplatComponentSystem,
  GSplatData,
  GSplatHandler,
  GSplatResource,
  type GraphicsDevice,
  type GSplatResourceBase,
  Layer,
  LAYERID_IMMEDIATE,
  PIXELFORMAT_RGBA8,
  RenderTarget,
  Texture,
  TextureHandler,
  Vec4,
  WORKBUFFER_UPDATE_ONCE,
} from "playcanvas";
import { add, pinholeOf, type ViewState } from "./cameras.js";
import type { Size } from "./picture-size.js";
import { edgesOf, kBoxColour, type Part, type Pixels, Renderer, type RendererEvents, type Shown, type Side, type Splats, splitOf } from "./renderer.js";

/** Sorts the Gaussians of one camera. */
interface Manager {
  /** In the next frame. */
  sortNeeded: boolean;
  cpuSorter?: { jobsInFlight: number } | null;
}

export class EngineRenderer extends Renderer {
  readonly api = "WebGL 2";
  readonly isAsDefined: boolean;
  readonly layers: readonly [number, number];
  private readonly cameras: readonly [Entity, Entity];
  private readonly splats = new Set<EngineSplats>();
  private shown: Shown | undefined;
  /** Frames to draw after this one. */
  private more = 0;
  /** Gaussians may be in the order of an earlier camera. */
  private isOrderOld = true;

  private constructor(
    readonly app: AppBase,
    canvas: HTMLCanvasElement,
    on: RendererEvents,
  ) {
    super(canvas, on);
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
      this.tick(seconds, () => this.more > 0 || this.nSorts() > 0 || this.sortAnew());
    });
    app.on("postrender", () => (this.frames += 1));
    app.autoRender = false;
  }

  /** Rejects where there is no WebGL 2. */
  static async start(canvas: HTMLCanvasElement, on: RendererEvents): Promise<EngineRenderer> {
    const device = await createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
    const options = new AppOptions();
    options.graphicsDevice = device;
    options.componentSystems = [CameraComponentSystem, GSplatComponentSystem];
    options.resourceHandlers = [GSplatHandler, TextureHandler];
    const app = new AppBase(canvas);
    app.init(options);
    const renderer = new EngineRenderer(app, canvas, on);
    device.on("devicelost", on.lost);
    device.on("devicerestored", () => {
      on.restored();
      renderer.request();
    });
    return renderer;
  }

  override begin(): void {
    this.app.start();
    super.begin();
  }

  override end(): void {
    super.end();
    this.app.destroy();
  }

  get isToDraw(): boolean {
    return this.app.renderNextFrame;
  }

  protected requestFrame(): void {
    this.app.renderNextFrame = true;
  }

  protected get mostSide(): number {
    return this.app.graphicsDevice.maxTextureSize;
  }

  protected setSize({ width, height }: Size): void {
    this.app.graphicsDevice.setResolution(width, height);
  }

  show(shown: Shown): void {
    const before = this.shown;
    this.shown = shown;
    // The engine does more than it needs to where nothing has changed.
    this.cameras.forEach(({ camera }, side) => {
      if (camera && shown.antiAliasing[side] !== before?.antiAliasing[side]) drawAsDefined(this.app, camera, shown.antiAliasing[side]);
    });
    if (shown.origin !== before?.origin) for (const splats of this.splats) splats.place(shown.origin);
    this.isOrderOld ||= shown.view !== before?.view || shown.origin !== before?.origin;
    if (this.isCapturing) return;
    const { view, origin, show, background } = shown;
    const { width, height } = this.canvas;
    const [r, g, b] = background as [number, number, number];
    const split = splitOf(show);
    this.cameras.forEach((entity, side) => {
      const { camera } = entity;
      if (!camera) return;
      if (view) setPinhole(entity, pinholeOf(view, width, height), origin);
      camera.clearColor = new Color(r, g, b, 1);
      camera.enabled = side === 0 ? split > 0 : split < 1;
      // The right side is drawn over the left one, so that rounding leaves no gap.
      const border = Math.round(split * width) / width;
      camera.scissorRect = side === 0 ? new Vec4(0, 0, 1, 1) : new Vec4(border, 0, 1, 1);
    });
    this.request();
  }

  addSplats(side: Side, origin: readonly number[]): EngineSplats {
    const splats = new EngineSplats(this, this.layers[side], origin, () => this.splats.delete(splats));
    this.splats.add(splats);
    splats.place(this.shown?.origin ?? origin);
    return splats;
  }

  drawBox(min: readonly number[], max: readonly number[], origin: readonly number[]): void {
    const shift = add(origin, this.shown?.origin ?? origin, -1);
    const ends = edgesOf(add(min, shift), add(max, shift));
    const colours = ends.flatMap(() => [...kBoxColour, 1]);
    this.app.drawLineArrays(ends.flat(), colours, false);
  }

  async capture(side: Side, view: ViewState, width: number, height: number): Promise<Pixels> {
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
      setPinhole(this.cameras[side], pinholeOf(view, width, height), this.shown?.origin);
      await this.settled();
      const read = await colorBuffer.read(0, 0, width, height, { renderTarget: target, immediate: true });
      const pixels = new Uint8ClampedArray(read as Uint8Array);
      flipRows(pixels, width);
      return pixels;
    } finally {
      camera.renderTarget = null as unknown as RenderTarget;
      target.destroy();
      colorBuffer.destroy();
      this.isCapturing = false;
      this.isOrderOld = true;
      if (this.shown) this.show(this.shown);
    }
  }

  async drawn(): Promise<void> {
    await new Promise<void>((resolve) => this.app.scene.once("gsplat:sorted", () => resolve()));
    for (let i = 0; i < 2; ++i) await new Promise<void>((resolve) => this.app.once("postrender", () => resolve()));
  }

  /** Resolves after a frame whose Gaussians are sorted for its camera. */
  private async settled(): Promise<void> {
    this.isOrderOld = true;
    for (let before = -1, i = 0; i < 20; ++i) {
      this.sortAnew();
      await this.nextFrame();
      const busy = this.nSorts();
      if (before === 0 && busy === 0) return;
      if (busy > 0) await new Promise<void>((resolve) => this.app.scene.once("gsplat:sorted", () => resolve()));
      before = busy;
    }
  }

  /**
   * The engine does not sort for a camera that moves without a turn, and forgets one that comes while it sorts. Once nothing else
   * is to come, this sorts for the camera that stays; returns whether it does.
   */
  private sortAnew(): boolean {
    if (!this.isOrderOld || this.nSorts() > 0) return false;
    this.isOrderOld = false;
    for (const manager of this.managers()) manager.sortNeeded = true;
    this.request();
    return true;
  }

  /** Sorts in flight. */
  private nSorts(): number {
    return this.managers().reduce((sum, { cpuSorter }) => sum + (cpuSorter?.jobsInFlight ?? 0), 0);
  }

  /** What sorts, by the engine's internals; nothing where it has none of these. */
  private managers(): Manager[] {
    interface Director {
      camerasMap?: Map<unknown, { layersMap: Map<unknown, { gsplatManager?: Manager | null }> }>;
    }
    const { gsplatDirector } = this.app.renderer as unknown as { gsplatDirector?: Director };
    const layers = [...(gsplatDirector?.camerasMap?.values() ?? [])].flatMap(({ layersMap }) => [...layersMap.values()]);
    return layers.flatMap(({ gsplatManager }) => gsplatManager ?? []);
  }

  private nextFrame(): Promise<void> {
    return new Promise((resolve) => {
      this.app.once("postrender", () => resolve());
      this.request();
    });
  }
}

/** A resource of the engine, its entity, and how many parts it has. */
interface Piece {
  resource: GSplatResourceBase;
  entity: Entity;
  nParts: number;
}

export class EngineSplats implements Splats {
  private readonly entity: Entity;
  private pieces: Piece[] = [];
  private parts: readonly Part[] = [];
  private shDegree = 3;

  constructor(
    private readonly renderer: EngineRenderer,
    private readonly layer: number,
    private readonly origin: readonly number[],
    private readonly gone: () => void,
  ) {
    this.entity = new Entity(undefined, renderer.app);
    renderer.app.root.addChild(this.entity);
  }

  /** `origin` of the engine's coordinates, world. */
  place(origin: readonly number[]): void {
    const [x, y, z] = add(this.origin, origin, -1) as [number, number, number];
    this.entity.setLocalPosition(x, y, z);
  }

  get isHidden(): boolean {
    return !this.entity.enabled;
  }

  set isHidden(isHidden: boolean) {
    this.entity.enabled = !isHidden;
    this.renderer.request();
  }

  set(parts: readonly Part[], shDegree: number, tints: readonly Colour[]): void {
    const before = this.parts;
    // Of arrays the engine draws all SH.
    const isAsBefore = shDegree === this.shDegree || parts.every((part) => "geometry" in part);
    this.shDegree = shDegree;
    // Parts that come later are resources of their own, so that those before stay as they are.
    const isMore = isAsBefore && before.length > 0 && before.every((part, i) => part === parts[i]);
    const more = isMore ? parts.slice(before.length) : parts;
    // The engine has no resource of nothing.
    if (more.some(({ n }) => n > 0)) this.draw(parts, more, isMore);
    this.setTables(tints);
  }

  private draw(parts: readonly Part[], more: readonly Part[], isMore: boolean): void {
    this.parts = parts;
    const { graphicsDevice } = this.renderer.app;
    const isStored = more.every((part) => "geometry" in part);
    const resource = isStored ? new RgsResource(graphicsDevice, more as StoredGaussians[]) : resourceOf(graphicsDevice, more as Gaussians[], this.shDegree);
    const [first, ...others] = this.pieces;
    if (!first || isMore) {
      this.add(resource, more.length);
    } else {
      for (const { entity } of others) entity.destroy();
      if (first.entity.gsplat) first.entity.gsplat.resource = resource;
      for (const piece of this.pieces) piece.resource.destroy();
      this.pieces = [{ ...first, resource, nParts: more.length }];
    }
  }

  /** Draws one more resource of the engine. */
  add(resource: GSplatResourceBase, nParts = 0): void {
    const entity = new Entity(undefined, this.renderer.app);
    entity.addComponent("gsplat", { layers: [this.layer], resource });
    this.entity.addChild(entity);
    this.pieces.push({ resource, entity, nParts });
    this.renderer.request();
  }

  destroy(): void {
    this.gone();
    this.entity.destroy();
    for (const { resource, nParts } of this.pieces) if (nParts > 0) resource.destroy();
    this.renderer.request();
  }

  private setTables(tints: readonly Colour[]): void {
    let at = 0;
    for (const { resource, entity, nParts } of this.pieces) {
      if (resource instanceof RgsResource) resource.setTable(this.shDegree, tints.length > 0 ? tints.slice(at, at + nParts) : undefined);
      if (entity.gsplat) entity.gsplat.workBufferUpdate = WORKBUFFER_UPDATE_ONCE;
      at += nParts;
    }
    this.renderer.request();
  }
}

function resourceOf(device: GraphicsDevice, parts: readonly Gaussians[], shDegree: number): GSplatResource {
  const data = dataOf(parts, shDegree);
  const resource = new GSplatResource(device, data);
  // Textures have the rest by now.
  const { numSplats, shBands } = data;
  resource.gsplatData = { numSplats, shBands } as GSplatData;
  return resource;
}

/** What the engine takes of a PLY. */
function dataOf(parts: readonly Gaussians[], shDegree: number): GSplatData {
  const count = parts.reduce((sum, { n }) => sum + n, 0);
  const nAll = ((parts[0]?.shDegree ?? 0) + 1) ** 2 - 1;
  const nRest = Math.min(nAll, (shDegree + 1) ** 2 - 1);
  const properties: { name: string; type: string; storage: Float32Array; byteSize: number }[] = [];
  /** Column `at` of `of` columns. */
  const add = (name: string, values: (part: Gaussians) => Float32Array, at: number, of: number): void => {
    const storage = new Float32Array(count);
    let next = 0;
    for (const part of parts) {
      const from = values(part);
      for (let i = at; i < from.length; i += of) storage[next++] = from[i] as number;
    }
    properties.push({ name, type: "float", storage, byteSize: 4 });
  };
  ["x", "y", "z"].forEach((name, i) => add(name, ({ means }) => means, i, 3));
  for (let i = 0; i < 3; ++i) add(`f_dc_${i}`, ({ sh0 }) => sh0, i, 3);
  for (let i = 0; i < 3 * nRest; ++i) add(`f_rest_${i}`, ({ shN }) => shN, 3 * (i % nRest) + Math.floor(i / nRest), 3 * nAll);
  add("opacity", ({ opacities }) => opacities, 0, 1);
  for (let i = 0; i < 3; ++i) add(`scale_${i}`, ({ scales }) => scales, i, 3);
  for (let i = 0; i < 4; ++i) add(`rot_${i}`, ({ rotations }) => rotations, i, 4);
  const data = new GSplatData([{ name: "vertex", count, properties }]);
  data.activated = true;
  return data;
}

function flipRows(pixels: Uint8ClampedArray, width: number): void {
  const rows = pixels.slice();
  const bytes = 4 * width;
  for (let at = 0; at < rows.length; at += bytes) pixels.set(rows.subarray(at, at + bytes), rows.length - bytes - at);
}
