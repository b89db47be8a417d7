// frames.ts - reference pictures, drawn by the server and shown: one request at a time, small ones while the view moves.
// SPDX-License-Identifier: Apache-2.0
import { type CameraEntry, pinholeOf } from "./cameras.js";
import { ServerError } from "./messages.js";
import type { Page } from "./page.js";
import type { Size } from "./picture-size.js";
import type { PageStore, State } from "./state.js";

export interface FrameRequest {
  scene: number;
  camera: CameraEntry;
  width: number;
  height: number;
  background: readonly number[];
  sh_degree: number;
  detail: number;
}

export interface Frame {
  bitmap: ImageBitmap;
  /** Milliseconds that drawing took, and from the request to the decoded picture. */
  renderMs: number;
  totalMs: number;
  pagesMissing: number;
}

/** Scale of the pictures that are drawn while the view moves. */
const kMovingScale = 0.25;
/** Tries while the server is busy, and the seconds between them where it does not say. */
const kTries = 10;
const kPauseSeconds = 1;
const kMostPauseSeconds = 10;

export class Frames {
  private waiting: { request: FrameRequest; moving: boolean } | undefined;
  private busy = false;

  constructor(
    private readonly url: string,
    private readonly on: { frame(frame: Frame): void; error(error: unknown): void },
  ) {}

  /** Requests a view as soon as the request in flight is over; a later call replaces it. */
  ask(request: FrameRequest, moving: boolean): void {
    this.waiting = { request, moving };
    if (!this.busy) void this.work();
  }

  stop(): void {
    this.waiting = undefined;
  }

  /** A PNG in full size, for comparison. */
  async exact(request: FrameRequest): Promise<ImageBitmap> {
    return (await this.fetch(request, "png")).bitmap;
  }

  private async work(): Promise<void> {
    this.busy = true;
    try {
      while (this.waiting) {
        const { request, moving } = this.waiting;
        this.waiting = undefined;
        const scale = moving ? kMovingScale : 1;
        const [width, height] = [Math.max(1, Math.round(request.width * scale)), Math.max(1, Math.round(request.height * scale))];
        this.on.frame(await this.fetch({ ...request, width, height }, moving ? "jpeg" : "png"));
      }
    } catch (error) {
      this.waiting = undefined;
      this.on.error(error);
    } finally {
      this.busy = false;
    }
  }

  private async fetch(request: FrameRequest, format: "png" | "jpeg"): Promise<Frame> {
    const began = performance.now();
    let answer = await this.post(request, format);
    for (let i = 1; answer.status === 503 && i < kTries; ++i) {
      const said = Number(answer.headers.get("Retry-After") ?? kPauseSeconds);
      const seconds = said >= 0 ? Math.min(said, kMostPauseSeconds) : kPauseSeconds;
      await new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
      answer = await this.post(request, format);
    }
    if (!answer.ok) {
      const said = (await answer.json().catch(() => ({}))) as { error?: { code?: string; message?: string } };
      throw new ServerError(said.error?.code ?? `HTTP ${answer.status}`, said.error?.message ?? answer.statusText);
    }
    const bitmap = await createImageBitmap(await answer.blob(), { colorSpaceConversion: "none" });
    return {
      bitmap,
      renderMs: Number(answer.headers.get("X-Render-Ms") ?? 0),
      totalMs: performance.now() - began,
      pagesMissing: Number(answer.headers.get("X-Pages-Missing") ?? 0),
    };
  }

  private post(request: FrameRequest, format: "png" | "jpeg"): Promise<Response> {
    const body = JSON.stringify({ ...request, format, quality: 85 });
    return fetch(this.url, { method: "POST", headers: { "Content-Type": "application/json" }, body }).catch((error: unknown) => {
      throw Object.assign(new Error(String(error)), { code: "read_failed" });
    });
  }
}

/** Undefined without a view. */
export function frameRequest({ referenceScene: scene, view, background, shDegree, detailPx }: State, { width, height }: Size): FrameRequest | undefined {
  return view && { scene, camera: pinholeOf(view, width, height), width, height, background, sh_degree: shDegree, detail: detailPx };
}

export function showReference(store: PageStore, isOn: boolean): void {
  const { hasReference, isReferenceShown, scenes, mode } = store.state;
  if (!hasReference || isOn === isReferenceShown) return;
  store.set({ isReferenceShown: isOn, mode: isOn ? mode : scenes[1] ? "slider" : "single" });
}

export function drawReference(page: Page, url: string): Frames {
  const { store } = page;
  const frames = new Frames(url, { frame: (frame) => store.set({ frame }), error: (error) => page.fail("The reference picture", error) });
  const ask = (isMoving: boolean): void => {
    const request = store.state.scenes[0] && frameRequest(store.state, store.state.size);
    if (request) frames.ask(request, isMoving);
  };
  page.element("reference-label", HTMLLabelElement).hidden = false;
  store.set({ hasReference: true });
  store.subscribe(({ isReferenceShown, isAtRest }) => [isReferenceShown, isAtRest], ([isShown, isAtRest], before) => {
    if (!isShown) frames.stop();
    else if (isAtRest || !before?.[0]) ask(false);
  });
  store.subscribe(({ view, size, scenes }) => [view, size, scenes], () => store.state.isReferenceShown && ask(true));
  store.subscribe(({ frame }) => [frame], ([frame]) => {
    if (!frame) return;
    const canvas = page.element("reference-picture", HTMLCanvasElement);
    const { bitmap } = frame;
    Object.assign(canvas, { width: bitmap.width, height: bitmap.height });
    canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
    bitmap.close();
  });
  return frames;
}
