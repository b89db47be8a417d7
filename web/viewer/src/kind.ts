// kind.ts - recognises files by their first bytes.
// SPDX-License-Identifier: Apache-2.0

/** Scenes that the engine loads. */
export type EngineKind = "compressed ply" | "sog";
export type Kind = "rgs" | "ply" | "spz" | EngineKind | "cameras";

/** Bytes that kindOf() and otherArchive() need: a PLY's header may hold a coordinate reference system of 16 KiB before its properties. */
export const kBeginningBytes = 1 << 15;

/** Zip archives that are no SOG, by the name of their first file. */
const kOtherArchives: [RegExp, string][] = [
  [/\.npy$/, "an .npz of NumPy arrays"],
  [/\.pkl$/, "a checkpoint of PyTorch"],
  [/\.usd[ac]?$/, "a .usdz"],
  [/^lod-meta\.json$|\/meta\.json$/, "an .ssog, a streamed SOG"],
];

/** The kind of a file by its first bytes, not by its name; null if this page does not know it. */
export function kindOf(beginning: Uint8Array): Kind | null {
  const begins = (...bytes: number[]): boolean => bytes.every((byte, i) => beginning[i] === byte);
  if (begins(0x89, 0x52, 0x47, 0x53)) return "rgs";
  if (begins(0x70, 0x6c, 0x79)) return /\bpacked_position\b/.test(new TextDecoder("latin1").decode(beginning)) ? "compressed ply" : "ply";
  if (begins(0x50, 0x4b, 0x03, 0x04)) return otherArchive(beginning) ? null : "sog";
  // Versions 2 and 3 are gzip streams, 4 is not.
  if (begins(0x1f, 0x8b) || begins(0x4e, 0x47, 0x53, 0x50)) return "spz";
  return /^\uFEFF?\s*[[{]/.test(new TextDecoder("utf-8", { ignoreBOM: true }).decode(beginning)) ? "cameras" : null;
}

/** What a zip archive is that kindOf() does not know. */
export function otherArchive(beginning: Uint8Array): string | null {
  const text = new TextDecoder("latin1").decode(beginning);
  const name = text.slice(30, 30 + (beginning[26] ?? 0));
  return text.startsWith("PK\x03\x04") ? (kOtherArchives.find(([pattern]) => pattern.test(name))?.[1] ?? null) : null;
}
