// messages.ts - errors as sentences that a person can act on. File names are untrusted: they are shown as plain text.
// SPDX-License-Identifier: Apache-2.0

interface CodedError {
  code?: string;
  text?: string;
  message?: string;
  offset?: number | null;
}

/** For codes that do not mean a damaged file. */
const kAdvice: Record<string, string> = {
  open_failed: "could not be fetched. Check that the server is running and lets this page read from it, then reload the page",
  foreign_host: "is on another host, which does not let this page read it, or which this page's content security policy does not allow. Put the file beside the page, or open it from your disk",
  read_failed: "stopped loading. Reload the page; if rgs-view has ended, start it again and open its new address",
  bad_magic: "is not a scene that this page can open. It opens .rgs, .ply, .spz and .sog; rgs-convert makes .rgs of other formats",
  unsupported_version: "was made by a newer program than this page. Use the page of that version",
  unsupported_feature: "has something that this page cannot draw",
  limit_exceeded: "exceeds the limits of this page",
  unavailable: "could not be read: the worker for it does not start. The server's content security policy or a browser extension may block it",
  host_out_of_memory: "does not fit into this browser's memory. Convert it with rgs-convert --lod, so that it is read page by page",
  gaussians_damaged: "has damaged Gaussians, with NaN or infinity, which are left out",
  pages_missing: "is incomplete: its end is missing. What is there is drawn; copy the file again for the rest",
};

/** By the status of the server's answer. */
const kStatusAdvice: Record<string, string> = {
  403: "was refused. The address of rgs-view has a new token at every start: open the one that it printed last",
  404: "is not on the server. Check the file's name and folder in the address",
  409: "was written to after rgs-view had started. Start rgs-view again",
  410: "was removed after rgs-view had started. Start rgs-view again with the files that there are",
};

/** The server refused to draw a reference picture; its codes do not mean a damaged file. */
export class ServerError extends Error {
  constructor(
    readonly code: string,
    message: string,
  ) {
    super(message);
  }
}

/** One sentence about what happened to `name`, with the error's code and byte. */
export function sentence(name: string, error: unknown): string {
  if (error instanceof ServerError) return `${name} could not be made: ${error.code}: ${error.message}.`;
  const { code, text, message, offset } = (error ?? {}) as CodedError;
  const where = offset === undefined || offset === null ? "" : ` at byte ${offset}`;
  if (code === undefined) return `${name} could not be opened: ${message ?? String(error)}.`;
  const status = /HTTP (\d+)/.exec(text ?? message ?? "")?.[1] ?? "";
  const advice = (code === "open_failed" && kStatusAdvice[status]) || kAdvice[code];
  if (advice) return `${name} ${advice}. (${code}${where}: ${text ?? message ?? ""})`;
  return `${name} is damaged: ${text ?? message ?? ""} (${code}${where}). Copy the file again, or convert the scene again.`;
}

/** Of a file whose pages are read again after `error`. */
export function waitingSentence(name: string, error: unknown): string {
  const { code, text } = error as CodedError;
  return `${name} is incomplete: reading failed, and is tried again until it succeeds. If rgs-view has ended, start it again and open its new address. (${code}: ${text})`;
}

export const kNoGraphics = "This browser has neither WebGPU nor WebGL 2, of which this page needs one. Update it, or enable hardware acceleration in its settings.";
export const kNoRoom = "The graphics device has no room for this picture. Choose a coarser detail, a smaller budget or a smaller window, or the renderer webgl2: by &renderer=webgl2 in the page's address, or the element's attribute.";
export const kNotAsDefined = "This page does not know its engine's shaders, so the picture differs slightly from what the files define.";
export const kLost = "The graphics device was lost, perhaps because its driver restarted. If the picture does not come back, reload the page.";

export function bytesText(bytes: number): string {
  return bytes < 1e6 ? `${(bytes / 1e3).toFixed(0)} kB` : bytes < 1e9 ? `${(bytes / 1e6).toFixed(1)} MB` : `${(bytes / 1e9).toFixed(2)} GB`;
}

export function countText(n: number): string {
  return n < 1e4 ? String(n) : n < 1e6 ? `${(n / 1e3).toFixed(0)}k` : `${(n / 1e6).toFixed(2)}M`;
}
