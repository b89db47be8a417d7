// spz.ts - decompresses the streams of Niantic's .spz. Layout: converter/formats/spz.cpp.
// SPDX-License-Identifier: Apache-2.0
import type { ZstdStream } from "@roofgs/reader";

const kMagic = 0x5053474e;
const kHeaderBytes = 16;
const kHeaderBytesV4 = 32;
const kFlagAntialiased = 1;
const kFlagExtensions = 2;
const kFlags = kFlagAntialiased | kFlagExtensions;
/** Types of extensions that say nothing of the Gaussians: a safe orbit for cameras, a georeference. */
const kHarmless = [0xadbe0002, 0x4e530001];
const kCoordinateSystem = 0xadbe0003;
const kMostExtensionBytes = 2 ** 24;
/** Largest ratio of decompressed to compressed bytes: the limit of rgs-convert. */
const kMostExpansion = 1032;
/** SH coefficients beyond degree 0, per channel. */
export const kRest = [0, 3, 8, 15] as const;

export interface Header {
  version: number;
  n: number;
  shDegree: 0 | 1 | 2 | 3;
  fractionalBits: number;
  antialiased: boolean;
  hasExtensions: boolean;
}

/** Right, down, forward as in PLY, or right, up, backward. */
export type SpzAxes = "ply" | "opengl";

export type Streams = Record<"positions" | "alphas" | "colors" | "scales" | "rotations" | "sh", Uint8Array>;

function refuse(code: string, text: string, offset: number): Error {
  return Object.assign(new Error(text), { code, text, offset });
}

/** Decompressed bytes of each stream, in the file's order. */
function sizesOf({ version, n, shDegree }: Header): number[] {
  return [9 * n, n, 3 * n, 3 * n, (version === 2 ? 3 : 4) * n, 3 * kRest[shDegree] * n];
}

const bytesOf = (header: Header): number => sizesOf(header).reduce((sum, size) => sum + size, 0);

function parseHeader(bytes: Uint8Array, fileBytes: number): Header {
  if (bytes.length < kHeaderBytes) throw refuse("truncated", "the file ends inside its header", bytes.length);
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (view.getUint32(0, true) !== kMagic) throw refuse("bad_magic", "it is not an SPZ file", 0);
  const [version, n, shDegree] = [view.getUint32(4, true), view.getUint32(8, true), view.getUint8(12)];
  const [fractionalBits, flags] = [view.getUint8(13), view.getUint8(14)];
  if (version < 2 || version > 4) throw refuse("unsupported_version", `SPZ of version ${version}; 2, 3 and 4 are known`, 4);
  if (shDegree > 3) throw refuse("unsupported_feature", "the SH degree is not 0 to 3", 12);
  if (fractionalBits > 24) throw refuse("bad_header", "more than 24 fractional bits", 13);
  if ((flags & ~kFlags) !== 0) throw refuse("reserved_bits", "an unknown flag is set", 14);
  const [antialiased, hasExtensions] = [(flags & kFlagAntialiased) !== 0, (flags & kFlagExtensions) !== 0];
  const header = { version, n, shDegree: shDegree as Header["shDegree"], fractionalBits, antialiased, hasExtensions };
  if (bytesOf(header) > kMostExpansion * fileBytes + 2 ** 20) throw refuse("limit_exceeded", "more Gaussians than so few bytes can hold", 8);
  return header;
}

/** The axes that the extensions declare, null if they declare none. `begin`: where they are. */
function declaredAxes(extensions: Uint8Array, begin: number): SpzAxes | null {
  const view = new DataView(extensions.buffer, extensions.byteOffset, extensions.byteLength);
  let axes: SpzAxes | null = null;
  for (let at = 0; at < extensions.length; ) {
    const rest = extensions.length - at;
    if (rest < 8) throw refuse("truncated", "the extensions end inside a record", begin + at);
    const [type, bytes] = [view.getUint32(at, true), view.getUint32(at + 4, true)];
    // The reference library's first builds wrote this record without its length.
    if (type === kHarmless[0] && rest === 16) break;
    if (type !== kCoordinateSystem && !kHarmless.includes(type)) throw refuse("unsupported_feature", "it has an unknown extension, which may change what it means", begin + at);
    if (bytes > rest - 8) throw refuse("truncated", "an extension is longer than the bytes left for extensions", begin + at + 4);
    if (type === kCoordinateSystem) {
      if (bytes !== 4) throw refuse("bad_header", "the coordinate system extension is not 4 bytes", begin + at + 4);
      const system = view.getUint32(at + 8, true);
      if (system > 16) throw refuse("bad_value", "no such coordinate system", begin + at + 8);
      if (system !== 0 && system !== 4 && system !== 6) throw refuse("unsupported_feature", "it has axes that only rgs-convert turns", begin + at + 8);
      if (system !== 0) axes = system === 4 ? "opengl" : "ply";
    }
    at += 8 + bytes;
  }
  return axes;
}

/** Decompresses a gzip stream, up to the number of bytes that `most` returns for its beginning. */
async function gunzip(bytes: Uint8Array<ArrayBuffer>, most: (begin: Uint8Array) => number): Promise<Uint8Array> {
  const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip")).getReader();
  const pieces: Uint8Array<ArrayBuffer>[] = [];
  const joined = async (): Promise<Uint8Array> => new Uint8Array(await new Blob(pieces).arrayBuffer());
  let limit = Infinity;
  for (let done = 0; ; ) {
    const next = await reader.read().catch(() => {
      throw refuse("corrupt_data", "its gzip stream is damaged", 0);
    });
    if (next.done) return joined();
    pieces.push(next.value);
    done += next.value.length;
    if (limit === Infinity && done >= kHeaderBytes) limit = most(await joined());
    if (done > limit) {
      await reader.cancel();
      throw refuse("trailing_bytes", "it decompresses to more bytes than its header says", limit);
    }
  }
}

/** Versions 2 and 3: header and streams in one gzip stream. */
async function readGzip(bytes: Uint8Array<ArrayBuffer>): Promise<[Header, Uint8Array[], SpzAxes | null]> {
  const content = await gunzip(bytes, (begin) => {
    const header = parseHeader(begin, bytes.length);
    return kHeaderBytes + bytesOf(header) + (header.hasExtensions ? kMostExtensionBytes : 0);
  });
  const header = parseHeader(content, bytes.length);
  if (header.version > 3) throw refuse("unsupported_version", "a gzip stream holds versions 2 and 3", 4);
  if (content.length < kHeaderBytes + bytesOf(header)) throw refuse("truncated", "the file ends inside a stream", content.length);
  let at = kHeaderBytes;
  const streams = sizesOf(header).map((size) => content.subarray(at, (at += size)));
  return [header, streams, declaredAxes(content.subarray(at), at)];
}

/** `decompress` of @roofgs/reader. */
type Decompress = (streams: ZstdStream[]) => Promise<(Uint8Array | null)[]>;

/** Version 4: a table of streams of Zstandard frames; empty streams are left out. */
async function readStreams(bytes: Uint8Array<ArrayBuffer>, decompress: Decompress): Promise<[Header, Uint8Array[], SpzAxes | null]> {
  const header = parseHeader(bytes, bytes.length);
  if (header.version !== 4) throw refuse("unsupported_version", "versions 2 and 3 are gzip streams", 4);
  if (bytes.length < kHeaderBytesV4) throw refuse("truncated", "the file ends inside its header", bytes.length);
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const sizes = sizesOf(header);
  const nStreams = view.getUint8(15);
  const table = view.getUint32(16, true);
  if (nStreams !== sizes.length - (header.shDegree === 0 ? 1 : 0)) throw refuse("bad_header", "the number of streams is wrong", 15);
  if (table < kHeaderBytesV4 || table + 16 * nStreams > bytes.length) throw refuse("bad_header", "the table of streams is not in the file", 16);
  if (table !== kHeaderBytesV4 && !header.hasExtensions) throw refuse("section_gap", "there are bytes between the header and the table of streams", kHeaderBytesV4);
  const axes = declaredAxes(bytes.subarray(kHeaderBytesV4, table), kHeaderBytesV4);
  let at = table + 16 * nStreams;
  const begins: number[] = [];
  const stored = sizes.slice(0, nStreams).map((size, i) => {
    const entry = table + 16 * i;
    const n = Number(view.getBigUint64(entry, true));
    if (Number(view.getBigUint64(entry + 8, true)) !== size) throw refuse("size_mismatch", "a stream has the wrong size", entry + 8);
    if (n > bytes.length - at) throw refuse("truncated", "a stream reaches beyond the end of the file", entry);
    begins.push(at);
    at += n;
    return { frames: size === 0 ? new Uint8Array(0) : bytes.subarray(at - n, at), size };
  });
  if (at !== bytes.length) throw refuse("trailing_bytes", "there are bytes after the last stream", at);
  const streams = (await decompress(stored)).map((stream, i) => {
    if (!stream) throw refuse("corrupt_data", "a stream is damaged, or has the wrong size", begins[i] as number);
    return stream;
  });
  return [header, sizes.map((_, i) => streams[i] ?? new Uint8Array(0)), axes];
}

/** Converts rotations of version 2 (x, y, z of 8 bits) to smallest three of 9 bits and sign: 4 bytes. */
export function smallestThree(rotations: Uint8Array): Uint8Array {
  const n = rotations.length / 3;
  const out = new Uint32Array(n);
  for (let i = 0; i < n; ++i) {
    const q = [0, 1, 2].map((c) => (rotations[3 * i + c] as number) / 127.5 - 1);
    q.push(Math.sqrt(Math.max(0, 1 - q.reduce((sum, value) => sum + value * value, 0))));
    const length = Math.hypot(...q);
    const largest = q.reduce((best, value, c) => (Math.abs(value) > Math.abs(q[best] as number) ? c : best), 0);
    const sign = (q[largest] as number) < 0 ? -1 : 1;
    let word = largest;
    for (let c = 0; c < 4; ++c) {
      if (c === largest) continue;
      const value = (sign * (q[c] as number)) / length;
      word = ((word << 10) | (value < 0 ? 0x200 : 0) | Math.min(511, Math.round(Math.abs(value) * Math.SQRT2 * 511))) >>> 0;
    }
    out[i] = word;
  }
  return new Uint8Array(out.buffer);
}

/** Errors have `code`, `text` and `offset` like those of @roofgs/reader; offsets in versions 2 and 3 are of the decompressed stream. */
export async function decompressSpz(contents: ArrayBuffer, decompress: Decompress): Promise<{ header: Header; streams: Streams; axes: SpzAxes | null }> {
  const bytes = new Uint8Array(contents);
  const [header, streams, axes] = bytes[0] === 0x1f ? await readGzip(bytes) : await readStreams(bytes, decompress);
  const [positions, alphas, colors, scales, rotations, sh] = streams as [Uint8Array, Uint8Array, Uint8Array, Uint8Array, Uint8Array, Uint8Array];
  return { header, axes, streams: { positions, alphas, colors, scales, rotations: header.version === 2 ? smallestThree(rotations) : rotations, sh } };
}
