// messages.ts - errors as sentences that a person can act on. Names are a stranger's and are shown as text alone.
// SPDX-License-Identifier: Apache-2.0

interface CodedError {
  code?: string;
  text?: string;
  message?: string;
  offset?: number | null;
}

/** Codes that do not speak of the file's bytes: docs of @roofgs/reader. */
const kAdvice: Record<string, string> = {
  open_failed: "could not be fetched. Is the server still running, and may this page read from it? Then reload the page",
  read_failed: "stopped coming. Is the server still running? Start rgs-view again if not, then reload the page",
  bad_magic: "is no scene that this page knows. It opens .rgs, .ply, .spz and .sog; rgs-convert makes .rgs of others",
  unsupported_version: "was made by a newer program than this page knows. Take the page of that version",
  unsupported_feature: "holds what this page cannot draw",
  limit_exceeded: "asks for more than this page allows",
  unavailable: "could not be read, as the reader's worker does not run here. A stricter policy of the server, or an extension, may be why",
  host_out_of_memory: "does not fit into this browser's memory. Convert it with rgs-convert --lod: such files are read page by page",
  pages_missing: "has lost its end. What is there is drawn; copy the file again for the rest",
};

/** What the server of true pictures refuses; its codes are not of a file's bytes. */
export class ServerError extends Error {
  constructor(
    readonly code: string,
    message: string,
  ) {
    super(message);
  }
}

/** One sentence about what happened to `name`, with code and byte where the file is to blame. */
export function sentence(name: string, error: unknown): string {
  if (error instanceof ServerError) return `${name} could not be made: ${error.code}: ${error.message}.`;
  const { code, text, message, offset } = (error ?? {}) as CodedError;
  const where = offset === undefined || offset === null ? "" : ` at byte ${offset}`;
  if (code === undefined) return `${name} could not be opened: ${message ?? String(error)}.`;
  const advice = kAdvice[code];
  if (advice) return `${name} ${advice}. (${code}${where}: ${text ?? message ?? ""})`;
  return `${name} is damaged: ${text ?? message ?? ""} (${code}${where}). Copy the file again, or convert the scene again.`;
}

export const kNoGraphics =
  "This browser has no WebGL 2, which drawing needs. Update it, or switch on hardware acceleration in its settings.";
export const kNotAsDefined = "The picture is not quite what the files mean: this page does not know the shaders of its engine.";
export const kLost = "The graphics device was lost, for instance because its driver restarted. If the picture does not come back, reload the page.";

export function bytesText(bytes: number): string {
  return bytes < 1e6 ? `${(bytes / 1e3).toFixed(0)} kB` : bytes < 1e9 ? `${(bytes / 1e6).toFixed(1)} MB` : `${(bytes / 1e9).toFixed(2)} GB`;
}

export function countText(n: number): string {
  return n < 1e4 ? String(n) : n < 1e6 ? `${(n / 1e3).toFixed(0)}k` : `${(n / 1e6).toFixed(2)}M`;
}
