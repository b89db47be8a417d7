// resource.ts - keeps Gaussians on the GPU as the file stores them; the shader decodes them.
// SPDX-License-Identifier: Apache-2.0
import type { AntiAliasing, StoredGaussians } from "@roofgs/reader";
import {
  BoundingBox,
  GSplatFormat,
  GSplatResourceBase,
  type GraphicsDevice,
  PIXELFORMAT_R32U,
  PIXELFORMAT_RGBA32F,
  PIXELFORMAT_RGBA32U,
  Texture,
  Vec3,
} from "playcanvas";
import { kReadGlsl } from "./shader-glsl.js";
import { kReadWgsl } from "./shader-wgsl.js";
import { type Colour, kRowTexels, kShTextures, kTableColumns, pack, type Packed, shTextureWords } from "./stored.js";

/** Options of RgsResource. */
export interface RgsResourceOptions {
  /** Whether the engine sorts on the CPU, which needs the means there; true by default. */
  prepareCenters?: boolean;
  /** What the file declares, for drawAsDefined(). */
  antiAliasing?: AntiAliasing;
}

/** The data interface that the engine expects. */
class Data {
  readonly numSplats: number;
  readonly shBands: number;

  constructor(private readonly parts: readonly StoredGaussians[]) {
    this.numSplats = parts.reduce((sum, { n }) => sum + n, 0);
    this.shBands = parts[0]?.shDegree ?? 0;
  }

  getCenters(): Float32Array {
    const centers = new Float32Array(3 * this.numSplats);
    let at = 0;
    for (const { means } of this.parts) {
      centers.set(means, at);
      at += means.length;
    }
    return centers;
  }

  calcAabb(box: BoundingBox): void {
    const min = [Infinity, Infinity, Infinity];
    const max = [-Infinity, -Infinity, -Infinity];
    for (const { chunkBounds } of this.parts) {
      for (let at = 0; at < chunkBounds.length; at += 8) {
        for (let c = 0; c < 3; ++c) {
          min[c] = Math.min(min[c] as number, chunkBounds[at + c] as number);
          max[c] = Math.max(max[c] as number, chunkBounds[at + 4 + c] as number);
        }
      }
    }
    if (this.numSplats > 0) box.setMinMax(new Vec3(min), new Vec3(max));
  }
}

/**
 * A gsplat resource of files or pages of one SH degree, if you read them yourself. It takes 36, 48, 64 or 80 bytes per Gaussian at degree 0, 1, 2 or 3. Use it in
 * a gsplat component: `entity.addComponent("gsplat", { resource })`.
 */
export class RgsResource extends GSplatResourceBase {
  /** The option of that name. */
  readonly antiAliasing: AntiAliasing | undefined;
  private readonly packed: Packed;

  /** `parts`: what readStored(), storedParts() or readPageStored() gave; RangeError if there is none, or SH degrees differ. */
  constructor(device: GraphicsDevice, parts: readonly StoredGaussians[], options: RgsResourceOptions = {}) {
    super(device, new Data(parts), options);
    this.antiAliasing = options.antiAliasing;
    this.packed = pack(parts);
    const { n, shDegree, nRows } = this.packed;
    const shFormat = shTextureWords(shDegree) === 1 ? PIXELFORMAT_R32U : PIXELFORMAT_RGBA32U;
    const shNames = Array.from({ length: kShTextures[shDegree] as number }, (_, i) => `rgsSh${i}`);
    this._format = new GSplatFormat(
      device,
      [
        { name: "rgsMean", format: PIXELFORMAT_RGBA32U },
        { name: "rgsGeometry", format: PIXELFORMAT_RGBA32U },
        ...shNames.map((name) => ({ name, format: shFormat })),
        { name: "rgsTable", format: PIXELFORMAT_RGBA32F },
      ],
      { readGLSL: kReadGlsl, readWGSL: kReadWgsl },
    );
    this.streams.init(this._format, n);
    // The table has another size than the other textures.
    this.streams.textures.get("rgsTable")?.destroy();
    const rows = Math.max(1, Math.ceil(nRows / kTableColumns));
    const table = Texture.createDataTexture2D(device, "rgsTable", kTableColumns * kRowTexels, rows, PIXELFORMAT_RGBA32F);
    this.streams.textures.set("rgsTable", table);
    this.fill("rgsMean", (out) => this.packed.mean(out as Uint32Array));
    this.fill("rgsGeometry", (out) => this.packed.geometry(out as Uint32Array));
    shNames.forEach((name, i) => this.fill(name, (out) => this.packed.sh(i, out as Uint32Array)));
    this.setTable(shDegree);
  }

  /**
   * Limits the SH degree, 0 to 3, and tints parts in their order. To apply it, set `workBufferUpdate = WORKBUFFER_UPDATE_ONCE` on the
   * component.
   */
  setTable(shDegree: number, colours?: readonly Colour[]): void {
    this.fill("rgsTable", (out) => this.packed.table(out as Float32Array, shDegree, colours));
  }

  /** Called by the engine. */
  override configureMaterialDefines(defines: Map<string, string | number | boolean>): void {
    defines.set("SH_BANDS", this.packed.shDegree);
  }

  private fill(name: string, write: (out: ArrayBufferView) => void): void {
    const texture = this.streams.getTexture(name) as Texture;
    write(texture.lock() as unknown as ArrayBufferView);
    texture.unlock();
  }
}
