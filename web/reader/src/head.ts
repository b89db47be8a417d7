// head.ts - header, declarations, sections and pages, from the numbers of rgs_head() and rgs_levels() in wasm/reader.cpp.
// SPDX-License-Identifier: Apache-2.0
import { allocate } from "./errors.js";

export const kAxes = ["undeclared", "right", "left", "up", "down", "forward", "backward"] as const;
const kColourSpaces = ["undeclared", "srgb_display", "linear_display"] as const;
const kShBases = ["undeclared", "real_3dgs"] as const;
const kKernels = ["undeclared", "gaussian_ewa"] as const;
const kAaModes = ["undeclared", "classic", "mip_splatting"] as const;
const kSortMetrics = ["undeclared", "z_depth"] as const;
const kDepthMappings = ["undeclared", "linear", "logarithmic"] as const;
const kDepthSources = ["undeclared", "cameras", "scene_extent", "by_hand"] as const;
const kOrders = ["undeclared", "input", "morton"] as const;
const kViewKinds = ["none", "outside", "inside"] as const;
const kCodecs = ["none", "planes", "archive_draco", "archive"] as const;

/** x, y, z. */
export type Vector3 = readonly [number, number, number];

/** World units, relative to the origin. */
export interface Box {
  readonly min: Vector3;
  readonly max: Vector3;
}

/** The header's counts: docs/format/FORMAT.md, "Header". */
export interface Header {
  /** Of the format. */
  readonly versionMajor: number;
  readonly versionMinor: number;
  /** Of the whole file, as it was written. */
  readonly fileBytes: number;
  /** Of the finest level; so are chunks and step sets. */
  readonly nGaussians: number;
  readonly nChunks: number;
  readonly nStepSets: number;
  /** Gaussians in a chunk; fewer in the last one. */
  readonly chunkSize: number;
  /** 0 to 3. */
  readonly shDegree: number;
  /** Stored scale = scale * 2^scaleExponent. */
  readonly scaleExponent: number;
}

/** docs/format/FORMAT.md, "Declarations: DECL". */
export interface Declarations {
  /** Where +x, +y and +z point. */
  readonly axes: readonly [Axis, Axis, Axis];
  readonly colourSpace: (typeof kColourSpaces)[number];
  readonly shBasis: (typeof kShBases)[number];
  readonly kernel: (typeof kKernels)[number];
  readonly aaMode: (typeof kAaModes)[number];
  readonly sortMetric: (typeof kSortMetrics)[number];
  readonly depthMapping: (typeof kDepthMappings)[number];
  readonly depthSource: (typeof kDepthSources)[number];
  readonly order: (typeof kOrders)[number];
  /** Depth range of the quantised sort key, world units. */
  readonly zNear: number;
  readonly zFar: number;
  /** 0: unknown. */
  readonly metresPerUnit: number;
  /** Extent of the kernel, standard deviations. */
  readonly cutoffSigma: number;
  /** Smaller alphas are not blended, larger ones than alphaMax are clamped. */
  readonly alphaThreshold: number;
  readonly alphaMax: number;
  /** Added to the diagonal of the screen-space covariance, square pixels. */
  readonly lowPassPx2: number;
  /** Blending ends below it. */
  readonly transmittanceMin: number;
  /** Of means within `robust`, on each axis. */
  readonly robustFraction: number;
  /** Of all means. */
  readonly full: Box;
  /** Of the means without the outermost on each axis. */
  readonly robust: Box;
  /** Gaussians of the source; of these the conversion dropped and repaired some. */
  readonly nSource: number;
  readonly nDropped: number;
  readonly nRepaired: number;
  readonly nScaleSubnormal: number;
  readonly nScaleZero: number;
  readonly nOpacityZero: number;
  readonly nOpacityOne: number;
  /** World position = origin + mean. */
  readonly origin: Vector3;
  /** Null: not stated. */
  readonly firstView: FirstView | null;
  /** Coordinate reference system of world positions; null: not stated. */
  readonly crs: Crs | null;
}

/** The view from which a scene is seen first, relative to the origin. */
export interface FirstView {
  /** `outside` of what it looks at, or `inside` of a scene that is all around. */
  readonly kind: "outside" | "inside";
  readonly position: Vector3;
  /** What it looks at, and what one turns around. */
  readonly pivot: Vector3;
  /** Unit direction. */
  readonly up: Vector3;
  /** Degrees, 1 to 179. */
  readonly horizontalFov: number;
}

/** A coordinate reference system. The text is untrusted: show it as plain text. */
export interface Crs {
  /** An authority's code, such as `EPSG:4978`, or WKT. */
  readonly text: string;
  /** Where its coordinates point, if not along x, y and z of positions: these are `undeclared` then. */
  readonly axes: readonly [Axis, Axis, Axis];
}

/** A direction, or `undeclared`. */
export type Axis = (typeof kAxes)[number];

/** Where a file comes from. The texts are untrusted: show them as plain text. */
export interface Provenance {
  /** Of the file that was converted. */
  readonly sourceBytes: number;
  readonly sourceXxh3: bigint;
  readonly sourceName: string;
  /** What wrote the file, with its version. */
  readonly tool: string;
}

/** An entry of the file's table of sections. */
export interface Section {
  /** Four characters, such as `MEAN`. */
  readonly type: string;
  readonly flags: number;
  /** A number if this reader does not know the codec. */
  readonly codec: Codec | number;
  /** Byte of the file. */
  readonly offset: number;
  readonly storedBytes: number;
  readonly decodedBytes: number;
  /** Checksum of the stored bytes. */
  readonly xxh3: bigint;
}

/** How a section's or a page's bytes are coded: docs/format/FORMAT.md, docs/format/ARCHIVE.md. */
export type Codec = (typeof kCodecs)[number];

export interface Head {
  readonly header: Header;
  readonly declarations: Declarations;
  readonly provenance: Provenance | null;
  readonly sections: readonly Section[];
}

/** A page of a file with levels of detail. Its Gaussians replace those of its descendants. */
export interface Page {
  /** 0 to nPages - 1. */
  readonly index: number;
  /** 0: the scene itself. */
  readonly level: number;
  /** Index of the parent, -1 for the root. */
  readonly parent: number;
  /** Its children are the pages firstChild .. firstChild + nChildren - 1. */
  readonly firstChild: number;
  readonly nChildren: number;
  /** Index of its first Gaussian, counted over all pages in order: once all are known. */
  readonly first: number;
  /** Gaussians in the page. */
  readonly count: number;
  /** The footprint of a pixel, world units, from which on the page may replace its descendants; 0 for level 0. */
  readonly error: number;
  /** Box of the page and its descendants, out to 3 standard deviations. */
  readonly bounds: Box;
  /** Box of most of what is visible; its nearest point gives the footprint. */
  readonly core: Box;
  /** Byte of the file. */
  readonly offset: number;
  readonly storedBytes: number;
  readonly nStepSets: number;
  readonly scaleExponent: number;
}

class Numbers {
  private at = 0;
  constructor(private readonly values: Float64Array) {}
  next(): number {
    const value = this.values[this.at++];
    if (value === undefined) throw new Error("rgs.wasm and the scripts of the reader are of different versions");
    return value;
  }
  hash(): bigint {
    const high = BigInt(this.next());
    return (high << 32n) | BigInt(this.next());
  }
  vector(): Vector3 {
    return [this.next(), this.next(), this.next()];
  }
  box(): Box {
    return { min: this.vector(), max: this.vector() };
  }
  firstView(): FirstView | null {
    const kind = this.of(kViewKinds);
    const view = { position: this.vector(), pivot: this.vector(), up: this.vector(), horizontalFov: this.next() };
    return kind === "none" ? null : { kind, ...view };
  }
  /** The name of a code, which the library has checked. */
  of<T extends string>(names: readonly T[]): T {
    const name = names[this.next()];
    if (name === undefined) throw new Error("rgs.wasm and the scripts of the reader are of different versions");
    return name;
  }
}

function fourCharacters(code: number): string {
  return String.fromCharCode(code & 0xff, (code >>> 8) & 0xff, (code >>> 16) & 0xff, code >>> 24);
}

/** `text` is rgs_text() of rgs_head(): CRS, source name and tool, UTF-8. */
export function parseHead(values: Float64Array, text: Uint8Array): Head {
  const in_ = new Numbers(values);
  const header: Header = {
    versionMajor: in_.next(),
    versionMinor: in_.next(),
    fileBytes: in_.next(),
    nGaussians: in_.next(),
    nChunks: in_.next(),
    nStepSets: in_.next(),
    chunkSize: in_.next(),
    shDegree: in_.next(),
    scaleExponent: in_.next(),
  };
  let declarations: Declarations = {
    axes: [in_.of(kAxes), in_.of(kAxes), in_.of(kAxes)],
    colourSpace: in_.of(kColourSpaces),
    shBasis: in_.of(kShBases),
    kernel: in_.of(kKernels),
    aaMode: in_.of(kAaModes),
    sortMetric: in_.of(kSortMetrics),
    depthMapping: in_.of(kDepthMappings),
    depthSource: in_.of(kDepthSources),
    order: in_.of(kOrders),
    zNear: in_.next(),
    zFar: in_.next(),
    metresPerUnit: in_.next(),
    cutoffSigma: in_.next(),
    alphaThreshold: in_.next(),
    alphaMax: in_.next(),
    lowPassPx2: in_.next(),
    transmittanceMin: in_.next(),
    robustFraction: in_.next(),
    full: in_.box(),
    robust: in_.box(),
    nSource: in_.next(),
    nDropped: in_.next(),
    nRepaired: in_.next(),
    nScaleSubnormal: in_.next(),
    nScaleZero: in_.next(),
    nOpacityZero: in_.next(),
    nOpacityOne: in_.next(),
    origin: in_.vector(),
    firstView: in_.firstView(),
    crs: null,
  };
  const utf8 = new TextDecoder(undefined, { ignoreBOM: true });
  const crsBytes = in_.next();
  const crsAxes: Crs["axes"] = [in_.of(kAxes), in_.of(kAxes), in_.of(kAxes)];
  if (crsBytes > 0) declarations = { ...declarations, crs: { text: utf8.decode(text.subarray(0, crsBytes)), axes: crsAxes } };
  let provenance: Provenance | null = null;
  if (in_.next() !== 0) {
    const sourceBytes = in_.next();
    const nameEnd = crsBytes + in_.next();
    provenance = {
      sourceBytes,
      sourceXxh3: in_.hash(),
      sourceName: utf8.decode(text.subarray(crsBytes, nameEnd)),
      tool: utf8.decode(text.subarray(nameEnd)),
    };
  }
  const sections: Section[] = [];
  for (let n = in_.next(); n > 0; --n) {
    const [type, flags, codec] = in_.vector();
    sections.push({
      type: fourCharacters(type),
      flags,
      codec: kCodecs[codec] ?? codec,
      offset: in_.next(),
      storedBytes: in_.next(),
      decodedBytes: in_.next(),
      xxh3: in_.hash(),
    });
  }
  return { header, declarations, provenance, sections };
}

const kLevelsNumbers = 6;
const kPageNumbers = 23;
const kParent = 1;
const kFirst = 4;
const kCount = 5;

/** The tree of pages, coarse to fine: page 0 is the root. */
export class Levels {
  /** Pages of all levels, known or not. */
  readonly nPages: number;
  /** Level nLevels - 1 is the root. */
  readonly nLevels: number;
  /** Gaussians of all pages. */
  readonly nStored: number;
  /** Most chunks in a page. */
  readonly pageChunks: number;
  /** The PSNR that Page.error stands for: a page's picture against that of its descendants, dB; 0: not stated. */
  readonly qualityDb: number;
  /** Of all pages. */
  readonly codec: Codec;
  /** Whether all pages are known. */
  isComplete = false;
  /** Of all pages, [nPages, kPageNumbers]; unknown ones have no parent. @internal */
  readonly pageNumbers: Float64Array;

  /** `values` of rgs_levels(). @internal */
  constructor(values: Float64Array) {
    const in_ = new Numbers(values);
    this.nPages = in_.next();
    this.nLevels = in_.next();
    this.nStored = in_.next();
    this.pageChunks = in_.next();
    this.qualityDb = in_.next();
    this.codec = in_.of(kCodecs);
    this.pageNumbers = allocate(() => new Float64Array(kPageNumbers * this.nPages));
    for (let at = kParent; at < this.pageNumbers.length; at += kPageNumbers) this.pageNumbers[at] = -1;
    this.extend(values);
  }

  /** Takes the pages of rgs_levels() or rgs_extend(); returns what the scheduler is told of them. @internal */
  extend(values: Float64Array): Float64Array {
    const told = values.subarray(kLevelsNumbers);
    this.isComplete = told[0] === 1;
    const { pageNumbers } = this;
    pageNumbers.set(told.subarray(3), kPageNumbers * (told[1] as number));
    let first = 0;
    for (let at = 0; this.isComplete && at < pageNumbers.length; at += kPageNumbers) {
      pageNumbers[at + kFirst] = first;
      first += pageNumbers[at + kCount] as number;
    }
    return told;
  }

  /** Whether page(index) is there yet: with `table: "beginning"` of OpenOptions, not before its record of the table is read. */
  isKnown(index: number): boolean {
    return index === 0 || (Number.isInteger(index) && (this.pageNumbers[kPageNumbers * index + kParent] ?? -1) >= 0);
  }

  /** A known page. RangeError: no such page, or not known yet. */
  page(index: number): Page {
    if (!this.isKnown(index)) throw new RangeError(`page ${index} is not there, or not known yet`);
    const in_ = new Numbers(this.pageNumbers.subarray(kPageNumbers * index, kPageNumbers * (index + 1)));
    return {
      index,
      level: in_.next(),
      parent: in_.next(),
      firstChild: in_.next(),
      nChildren: in_.next(),
      first: in_.next(),
      count: in_.next(),
      error: in_.next(),
      bounds: in_.box(),
      core: in_.box(),
      offset: in_.next(),
      storedBytes: in_.next(),
      nStepSets: in_.next(),
      scaleExponent: in_.next(),
    };
  }

  /** All known pages of one level, in order. */
  ofLevel(level: number): Page[] {
    const pages: Page[] = [];
    for (let i = 0; i < this.nPages; ++i) {
      // The level is a page's first number.
      if (this.isKnown(i) && this.pageNumbers[kPageNumbers * i] === level) pages.push(this.page(i));
    }
    return pages;
  }
}
