// stage.ts - the picture: what it shows, and by what. WebGPU draws; the engine does where there is no WebGPU, and all from the first file
// on that it alone reads. What is shown and the scenes outlive a renderer.
// SPDX-License-Identifier: Apache-2.0
import type { ViewState } from "./cameras.js";
import type { EngineRenderer } from "./engine-renderer.js";
import { loadEngine } from "./load-engine.js";
import type { Pixels, Renderer, RendererEvents, Shown, Side, Splats } from "./renderer.js";
import { findAdapter, WebGpuRenderer } from "./webgpu-renderer.js";

export interface StageEvents extends Omit<RendererEvents, "failed"> {
  /** Another renderer draws, into another canvas. */
  replaced(): void;
  /** Nothing draws any more. */
  ended(error: unknown): void;
}

async function startEngine(canvas: HTMLCanvasElement, on: RendererEvents): Promise<EngineRenderer> {
  const { EngineRenderer } = await loadEngine();
  return EngineRenderer.start(canvas, on);
}

export class Stage {
  /** What another renderer draws anew. */
  readonly scenes = new Set<{ drawAnew(): void }>();
  private engine: EngineRenderer | undefined;
  /** Renderers take over one after the other. */
  private last: Promise<unknown> = Promise.resolve();
  private hasLost = false;
  private hasEnded = false;
  private shown: Shown = { view: undefined, origin: [0, 0, 0], show: { only: 0 }, background: [0, 0, 0], antiAliasing: [undefined, undefined] };
  private readonly events: RendererEvents;
  private renderer!: Renderer;

  private constructor(
    private readonly isAnyAdapter: boolean,
    private readonly on: StageEvents,
  ) {
    this.events = { ...on, failed: (renderer, error) => this.replace(renderer, error) };
  }

  /**
   * `asked`: "webgl2", or "webgpu" for one in software, too. Rejects where nothing can draw, or the engine cannot be fetched.
   */
  static async start(canvas: HTMLCanvasElement, asked: string | null, on: StageEvents): Promise<Stage> {
    const stage = new Stage(asked === "webgpu", on);
    const adapter = asked === "webgl2" ? undefined : await findAdapter(stage.isAnyAdapter);
    const first = adapter && (await WebGpuRenderer.start(adapter, canvas, stage.events).catch(() => undefined));
    stage.renderer = first || (stage.engine = await startEngine(canvas, stage.events));
    stage.renderer.begin();
    return stage;
  }

  end(): void {
    this.hasEnded = true;
    this.renderer.end();
  }

  get canvas(): HTMLCanvasElement {
    return this.renderer.canvas;
  }

  get api(): string {
    return this.renderer.api;
  }

  get isAsDefined(): boolean {
    return this.renderer.isAsDefined;
  }

  /** Frames drawn. */
  get frames(): number {
    return this.renderer.frames;
  }

  get isToDraw(): boolean {
    return this.renderer.isToDraw;
  }

  request(): void {
    this.renderer.request();
  }

  set(shown: Partial<Shown>): void {
    this.shown = { ...this.shown, ...shown };
    this.renderer.show(this.shown);
  }

  addSplats(side: Side, origin: readonly number[]): Splats {
    return this.renderer.addSplats(side, origin);
  }

  drawBox(min: readonly number[], max: readonly number[], origin: readonly number[]): void {
    this.renderer.drawBox(min, max, origin);
  }

  /** RGBA of one side, upper row first, in any size. Only one capture may run at a time. */
  async capture(side: Side, view: ViewState, width: number, height: number): Promise<Pixels> {
    for (;;) {
      await this.last;
      const { renderer } = this;
      try {
        return await renderer.capture(side, view, width, height);
      } catch (error) {
        await this.last;
        if (renderer === this.renderer) throw error;
      }
    }
  }

  /** Resolves when the scene that was added last has been drawn. */
  async drawn(): Promise<void> {
    const { renderer } = this;
    await renderer.drawn();
    if (renderer !== this.renderer) await this.drawn();
    if (this.hasEnded) await new Promise(() => undefined);
  }

  /** The engine draws from now on. */
  useEngine(): Promise<EngineRenderer> {
    return this.inTurn(() => this.toEngine());
  }

  private inTurn<T>(work: () => Promise<T>): Promise<T> {
    const done = this.last.then(work);
    this.last = done.catch(() => undefined);
    return done;
  }

  private async toEngine(): Promise<EngineRenderer> {
    return (this.engine ??= await this.change(startEngine));
  }

  /** After one loss WebGPU is tried again; after another one, and where the device has no room, the engine draws. */
  private replace(failed: Renderer, error: unknown): void {
    const isLost = !(error instanceof GPUError || error instanceof RangeError);
    const isTriedAgain = isLost && !this.hasLost;
    this.hasLost ||= isLost;
    if (isLost) this.on.lost();
    const work = async (): Promise<void> => {
      if (failed !== this.renderer) return;
      const adapter = isTriedAgain ? await findAdapter(this.isAnyAdapter) : undefined;
      const again = adapter && (await this.change((canvas, on) => WebGpuRenderer.start(adapter, canvas, on)).catch(() => undefined));
      if (!again) await this.toEngine();
    };
    this.inTurn(work).then(
      () => isLost && this.on.restored(),
      (why: unknown) => this.hasEnded || this.on.ended(why),
    );
  }

  private async change<T extends Renderer>(start: (canvas: HTMLCanvasElement, on: RendererEvents) => Promise<T>): Promise<T> {
    this.throwIfEnded();
    const { renderer: before } = this;
    // A canvas has one API for ever.
    const canvas = before.canvas.cloneNode() as HTMLCanvasElement;
    const next = await start(canvas, this.events);
    try {
      this.throwIfEnded();
      this.renderer = next;
      for (const scene of this.scenes) scene.drawAnew();
    } catch (error) {
      if (this.renderer === next) {
        this.renderer = before;
        for (const scene of this.scenes) scene.drawAnew();
      }
      next.end();
      throw error;
    }
    const isFocused = before.canvas.matches(":focus");
    before.canvas.replaceWith(canvas);
    before.end();
    next.begin();
    next.show(this.shown);
    if (isFocused) canvas.focus({ preventScroll: true });
    this.on.replaced();
    return next;
  }

  private throwIfEnded(): void {
    if (this.hasEnded) throw new DOMException("the viewer has ended", "AbortError");
  }
}
