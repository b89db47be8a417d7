// spz.ts - unpacks Niantic's .spz; converter/formats/spz_header.cpp says where its streams are.
// SPDX-License-Identifier: Apache-2.0
import type { Decoder, SpzHeader } from "./decoder.js";
import { RgsError } from "./errors.js";

const kHeaderBytes = 16;
const kStreams = ["positions", "alphas", "colors", "scales", "rotations", "sh"] as const;

/** A .spz: its header, and its streams as the file packs them. */
export interface Spz extends SpzHeader {
  /** Decompressed. `rotations`: 3 bytes each in version 2, else 4. */
  streams: Record<(typeof kStreams)[number], Uint8Array>;
}

/** Decompresses a gzip stream, up to the number of bytes that `most` returns for its first 16. */
async function gunzip(bytes: Uint8Array<ArrayBuffer>, most: (beginning: Uint8Array) => number): Promise<Uint8Array> {
  const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip")).getReader();
  const pieces: Uint8Array<ArrayBuffer>[] = [];
  const joined = async (): Promise<Uint8Array> => new Uint8Array(await new Blob(pieces).arrayBuffer());
  let limit = Infinity;
  for (let done = 0; ; ) {
    const next = await reader.read().catch(() => {
      throw new RgsError({ code: "corrupt_data", text: "its gzip stream is damaged", offset: 0 });
    });
    if (next.done) return joined();
    pieces.push(next.value);
    done += next.value.length;
    if (limit === Infinity && done >= kHeaderBytes) limit = most((await joined()).subarray(0, kHeaderBytes));
    if (done > limit) {
      await reader.cancel();
      throw new RgsError({ code: "trailing_bytes", text: "it decompresses to more bytes than its header says", offset: limit });
    }
  }
}

/** Offsets of errors in versions 2 and 3 are those of the decompressed stream. */
export async function unpackSpz(decoder: Decoder, bytes: Uint8Array<ArrayBuffer>): Promise<Spz> {
  const inGzip = bytes[0] === 0x1f;
  const content = inGzip ? await gunzip(bytes, (beginning) => decoder.spzMost(beginning, bytes.length)) : bytes;
  const [header, places] = decoder.spz(content, bytes.length, inGzip);
  const streams = kStreams.map((_, i) => {
    const { offset, bytes: stored, size } = places[i] ?? { offset: 0, bytes: 0, size: 0 };
    const frames = content.subarray(offset, offset + stored);
    const stream = inGzip ? frames : size === 0 ? new Uint8Array(0) : decoder.decompress(frames, size);
    if (!stream) throw new RgsError({ code: "corrupt_data", text: "a stream is damaged, or has the wrong size", offset });
    return [kStreams[i], stream];
  });
  return { ...header, streams: Object.fromEntries(streams) };
}
