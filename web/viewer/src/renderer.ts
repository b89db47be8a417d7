// renderer.ts - what draws the picture into a canvas, only after a change: webgpu-renderer.ts or engine-renderer.ts.
// SPDX-License-Identifier: Apache-2.0
import type { AntiAliasing, Gaussians, StoredGaussians } from "@roofgs/reader";
import type { Colour } from "@roofgs/webgpu";
import type { ViewState } from "./cameras.js";
import { pictureSize, type Size } from "./picture-size.js";

export type Side = 0 | 1;

/** One side, or both with the border at `split` of the width. */
export type Show = { only: Side } | { split: number };

/** What frames show. */
export interface Shown {
  readonly view: ViewState | undefined;
  /** Of the engine's coordinates, world: cameras are FP64, and what it draws stays near 0. */
  readonly origin: readonly number[];
  readonly show: Show;
  readonly background: readonly number[];
  /** By side. */
  readonly antiAliasing: readonly [AntiAliasing | undefined, AntiAliasing | undefined];
}

/** Share of the width in which the left side is drawn. */
export const splitOf = (show: Show): number => ("split" in show ? show.split : show.only === 0 ? 1 : 0);

export type Pixels = Uint8ClampedArray<ArrayBuffer>;

/** Gaussians as files store them, or as arrays. */
export type Part = StoredGaussians | Gaussians;

/** The Gaussians of one scene on the device. */
export interface Splats {
  isHidden: boolean;
  /** What is drawn, of one kind and SH degree; equal depths in this order. SH above `shDegree` are ignored. `tints`: of parts, or none. */
  set(parts: readonly Part[], shDegree: number, tints: readonly Colour[]): void;
  destroy(): void;
}

export interface RendererEvents {
  /** Before each frame; returns whether it waits for something that changes the picture. */
  frame(seconds: number): boolean;
  resized(size: Size): void;
  /** Whether the device has room for the picture; without, the one before stays. */
  fits(isSo: boolean): void;
  /** The device is gone, and comes back by itself or not. */
  lost(): void;
  restored(): void;
  /** This renderer draws no more. */
  failed(renderer: Renderer, error: unknown): void;
}

export abstract class Renderer {
  /** As people know it. */
  abstract readonly api: string;
  /** Whether it draws the image that RENDERING.md defines. */
  abstract readonly isAsDefined: boolean;
  /** Frames drawn. */
  frames = 0;
  /** A capture may use what frames use; what is set meanwhile is shown after it. */
  protected isCapturing = false;
  private isBusy: boolean | undefined;
  private readonly resizes = new ResizeObserver(() => this.resize());

  protected constructor(
    readonly canvas: HTMLCanvasElement,
    protected readonly on: RendererEvents,
  ) {}

  /** Whether a frame is requested. */
  abstract get isToDraw(): boolean;
  protected abstract readonly mostSide: number;
  abstract show(shown: Shown): void;
  abstract addSplats(side: Side, origin: readonly number[]): Splats;
  /** Draws a box for one frame, in the coordinates of a scene with this origin. */
  abstract drawBox(min: readonly number[], max: readonly number[], origin: readonly number[]): void;
  /** RGBA of one side, upper row first, in any size. Only one capture may run at a time. */
  abstract capture(side: Side, view: ViewState, width: number, height: number): Promise<Pixels>;
  /** Resolves when the scene that was added last has been drawn, or the renderer has ended. */
  abstract drawn(): Promise<void>;
  protected abstract setSize(size: Size): void;
  protected abstract requestFrame(): void;

  /** The canvas is in the page. */
  begin(): void {
    this.resizes.observe(this.canvas);
    this.resize();
    this.request();
  }

  /** Gives the device back. */
  end(): void {
    this.resizes.disconnect();
  }

  request(): void {
    this.requestFrame();
    this.setBusy(true);
  }

  /** Before each frame. `isDrawing`: what is drawn already changes the picture. */
  protected tick(seconds: number, isDrawing: () => boolean): void {
    const isWaiting = this.on.frame(seconds);
    this.setBusy(isWaiting || this.isToDraw || this.isCapturing || isDrawing());
  }

  /** For screen readers, and for tests: while it is true, the picture is going to change by itself. */
  private setBusy(busy: boolean): void {
    if (busy === this.isBusy) return;
    this.isBusy = busy;
    this.canvas.setAttribute("aria-busy", String(busy));
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.canvas;
    const size = pictureSize({ width: clientWidth, height: clientHeight }, devicePixelRatio, this.mostSide);
    if (size.width === this.canvas.width && size.height === this.canvas.height) return;
    this.setSize(size);
    this.on.resized(size);
    this.request();
  }
}

/** Ends of a box's edges: each joins corners whose numbers differ in one bit. */
export function edgesOf(min: readonly number[], max: readonly number[]): number[][] {
  const corner = (bits: number): number[] => [0, 1, 2].map((axis) => ((bits >> axis) & 1 ? max : min)[axis] as number);
  return [0, 1, 2, 3, 4, 5, 6, 7].flatMap((from) => [1, 2, 4].filter((bit) => (from & bit) === 0).flatMap((bit) => [corner(from), corner(from | bit)]));
}
/** RGB. */
export const kBoxColour = [1, 0.8, 0.1] as const;
