// webgpu-renderer.ts - draws by @roofgs/webgpu: a renderer a scene, all of one device.
// SPDX-License-Identifier: Apache-2.0
import { type Colour, type Part as PartOnDevice, type RenderOptions, requestDevice, SplatRenderer } from "@roofgs/webgpu";
import { pinholeOf, type ViewState } from "./cameras.js";
import { Lines } from "./lines.js";
import { kNoRoom } from "./messages.js";
import type { Size } from "./picture-size.js";
import { edgesOf, type Part, type Pixels, Renderer, type RendererEvents, type Shown, type Side, type Splats, splitOf } from "./renderer.js";

/** Frames that the device may have before it, so that it is never idle, and what is shown is not old. */
const kMostInFlight = 2;
/** A longer pause between two frames counts as so much. */
const kMostSeconds = 0.1;

/** An adapter of hardware, or any. */
export async function findAdapter(isAny: boolean): Promise<GPUAdapter | undefined> {
  const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" }).catch(() => null);
  // Browsers had it on the adapter before.
  const isFallbackAdapter = adapter?.info?.isFallbackAdapter ?? (adapter as { isFallbackAdapter?: boolean } | null)?.isFallbackAdapter;
  return adapter && (isAny || !isFallbackAdapter) ? adapter : undefined;
}

export class WebGpuRenderer extends Renderer {
  readonly api = "WebGPU";
  readonly isAsDefined = true;
  isToDraw = false;
  private readonly context: GPUCanvasContext;
  private readonly lines: Lines;
  private readonly splats = new Set<WebGpuSplats>();
  private shown: Shown | undefined;
  private boxes: number[][] = [];
  private nInFlight = 0;
  private before = performance.now();
  private timer = 0;
  private hasPicture = false;
  private hasEnded = false;
  private waiting: { for: WebGpuSplats | undefined; resolve(): void }[] = [];

  private constructor(
    private readonly first: SplatRenderer,
    canvas: HTMLCanvasElement,
    on: RendererEvents,
  ) {
    super(canvas, on);
    const { device } = first;
    const format = navigator.gpu.getPreferredCanvasFormat();
    this.lines = new Lines(device, format);
    const context = canvas.getContext("webgpu");
    if (!context) throw new Error("the canvas has no context of WebGPU");
    context.configure({ device, format, alphaMode: "opaque" });
    this.context = context;
    device.addEventListener("uncapturederror", ({ error }) => this.fail(error));
    void device.lost.then((lost) => this.fail(lost));
  }

  static async start(adapter: GPUAdapter, canvas: HTMLCanvasElement, on: RendererEvents): Promise<WebGpuRenderer> {
    const device = await requestDevice(adapter);
    try {
      return new WebGpuRenderer(await SplatRenderer.create(device), canvas, on);
    } catch (error) {
      device.destroy();
      throw error;
    }
  }

  override begin(): void {
    super.begin();
    this.timer = requestAnimationFrame((now) => this.step(now));
  }

  override end(): void {
    super.end();
    this.hasEnded = true;
    cancelAnimationFrame(this.timer);
    for (const { resolve } of this.waiting) resolve();
    this.first.device.destroy();
  }

  protected requestFrame(): void {
    this.isToDraw = true;
  }

  protected get mostSide(): number {
    return this.first.device.limits.maxTextureDimension2D;
  }

  protected setSize(size: Size): void {
    Object.assign(this.canvas, size);
  }

  show(shown: Shown): void {
    this.shown = shown;
    this.request();
  }

  addSplats(side: Side, origin: readonly number[]): Splats {
    const splats: WebGpuSplats = new WebGpuSplats(this.first.another(), side, origin, {
      changed: () => this.request(),
      gone: () => this.splats.delete(splats),
    });
    this.splats.add(splats);
    return splats;
  }

  drawBox(min: readonly number[], max: readonly number[], origin: readonly number[]): void {
    this.boxes.push(...edgesOf(min, max).map((end) => end.map((value, axis) => value + (origin[axis] as number))));
  }

  /** One frame: Gaussians are sorted in it. */
  async capture(side: Side, view: ViewState, width: number, height: number): Promise<Pixels> {
    const splats = this.of(side);
    if (!splats) throw new Error("there is no scene");
    this.isCapturing = true;
    try {
      const pixels = new Uint8ClampedArray((await splats.capture(view, width, height, this.optionsOf(side))).buffer);
      for (let at = 3; at < pixels.length; at += 4) pixels[at] = 255;
      return pixels;
    } catch (error) {
      if (error instanceof RangeError) throw Object.assign(new Error(kNoRoom), { code: "limit_exceeded" });
      // A scene that goes meanwhile takes its buffers with it.
      if (this.splats.has(splats)) this.fail(error);
      throw error;
    } finally {
      this.isCapturing = false;
    }
  }

  drawn(): Promise<void> {
    return new Promise((resolve) => this.waiting.push({ for: [...this.splats].at(-1), resolve }));
  }

  private step(now: number): void {
    this.timer = requestAnimationFrame((next) => this.step(next));
    const seconds = Math.min(kMostSeconds, Math.max(0, now - this.before) / 1000);
    this.before = now;
    this.boxes = [];
    this.tick(seconds, () => this.nInFlight > 0);
    if (!this.isToDraw || this.isCapturing || this.nInFlight >= kMostInFlight) return;
    this.isToDraw = false;
    void this.draw();
  }

  /** The scene that is drawn on a side: one that is replaced stays until the next one is complete. */
  private of(side: Side): WebGpuSplats | undefined {
    return [...this.splats].filter((each) => each.side === side && !each.isHidden).at(-1);
  }

  private optionsOf(side: Side): RenderOptions {
    const { background = [0, 0, 0], antiAliasing } = this.shown ?? {};
    const declared = antiAliasing?.[side];
    return { background, ...(declared ? { antiAliasing: declared } : {}) };
  }

  private async draw(): Promise<void> {
    const { shown } = this;
    if (!shown) return;
    this.nInFlight += 1;
    try {
      const { device } = this.first;
      const target = this.context.getCurrentTexture();
      const { width, height } = target;
      const view = target.createView();
      const [r, g, b] = shown.background as [number, number, number];
      const clearing = device.createCommandEncoder();
      clearing.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store", clearValue: [r, g, b, 1] }] }).end();
      device.queue.submit([clearing.finish()]);
      // The right side is drawn over the left one.
      const border = Math.round(splitOf(shown.show) * width);
      const drawn = ([0, 1] as const).filter((side) => (side === 0 ? border > 0 : border < width)).flatMap((side) => this.of(side) ?? []);
      const frames = shown.view
        ? drawn.map((each) => each.render(shown.view as ViewState, target, { ...this.optionsOf(each.side), firstColumn: each.side === 0 ? 0 : border }))
        : [];
      if (shown.view && this.boxes.length > 0) this.lines.draw(view, this.boxes, pinholeOf(shown.view, width, height));
      const all = await Promise.all(frames);
      if (all.some(({ isComplete }) => !isComplete)) return this.request();
      this.frames += 1;
      this.hasPicture ||= drawn.some(({ nParts }) => nParts > 0);
      this.on.fits(true);
      const isDrawn = (splats: WebGpuSplats | undefined): boolean => !splats || (splats.nParts > 0 && drawn.includes(splats));
      for (const { resolve } of this.waiting.filter((each) => isDrawn(each.for))) resolve();
      this.waiting = this.waiting.filter((each) => !isDrawn(each.for));
    } catch (error) {
      if (error instanceof RangeError && this.hasPicture) this.on.fits(false);
      else this.fail(error);
    } finally {
      this.nInFlight -= 1;
    }
  }

  private fail(error: unknown): void {
    if (this.hasEnded) return;
    this.hasEnded = true;
    cancelAnimationFrame(this.timer);
    this.on.failed(this, error);
  }
}

class WebGpuSplats implements Splats {
  private parts = new Map<Part, PartOnDevice>();
  private shDegree = 3;
  private hidden = false;

  constructor(
    private readonly renderer: SplatRenderer,
    readonly side: Side,
    private readonly origin: readonly number[],
    private readonly on: { changed(): void; gone(): void },
  ) {}

  get nParts(): number {
    return this.parts.size;
  }

  get isHidden(): boolean {
    return this.hidden;
  }

  set isHidden(isHidden: boolean) {
    this.hidden = isHidden;
    this.on.changed();
  }

  set(parts: readonly Part[], shDegree: number, tints: readonly Colour[]): void {
    const { renderer } = this;
    const wanted = new Set(parts);
    // First, so that others have their room.
    for (const [part, onDevice] of this.parts) if (!wanted.has(part)) renderer.remove(onDevice);
    // Of arrays there are no more parts than these.
    let nRows = parts.reduce((sum, part) => sum + (this.parts.has(part) ? 0 : part.n), 0);
    const add = (part: Part): PartOnDevice => {
      const added = renderer.add(part, "geometry" in part ? undefined : nRows);
      nRows -= part.n;
      return added;
    };
    this.parts = new Map(parts.map((part) => [part, this.parts.get(part) ?? add(part)]));
    this.shDegree = shDegree;
    renderer.setParts([...this.parts.values()], tints);
    this.on.changed();
  }

  destroy(): void {
    this.on.gone();
    this.renderer.destroy();
    this.on.changed();
  }

  render(view: ViewState, target: GPUTexture, options: RenderOptions): ReturnType<SplatRenderer["render"]> {
    this.renderer.setView(pinholeOf(view, target.width, target.height), this.origin);
    return this.renderer.render(target, { ...options, shDegree: this.shDegree });
  }

  capture(view: ViewState, width: number, height: number, options: RenderOptions): ReturnType<SplatRenderer["capture"]> {
    this.renderer.setView(pinholeOf(view, width, height), this.origin);
    return this.renderer.capture(width, height, { ...options, shDegree: this.shDegree });
  }
}
