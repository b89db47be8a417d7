// frames.ts - reference pictures, drawn by the server: one request at a time, small ones while the view moves.
// SPDX-License-Identifier: Apache-2.0
import type { CameraEntry } from "./cameras.js";
import { ServerError } from "./messages.js";

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
  small: boolean;
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
        const camera = { ...request.camera };
        const frame = await this.fetch({ ...request, camera, width, height }, moving ? "jpeg" : "png");
        this.on.frame({ ...frame, small: moving });
      }
    } catch (error) {
      this.waiting = undefined;
      this.on.error(error);
    } finally {
      this.busy = false;
    }
  }

  private async fetch(request: FrameRequest, format: "png" | "jpeg"): Promise<Omit<Frame, "small">> {
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
