// project.ts - projects the Gaussians in view, in the order of the scene; one thread a Gaussian.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/projection.hpp, coverage.hpp, sh.hpp; docs/format/RENDERING.md "A Gaussian on the image"
// In/Out  chunks, bits of cull.ts and their sums, rows, SH -> splats, depth keys, tile counts [visible]
// Cost    76 B a Gaussian in view read, of arrays 236 B, 56 B written
// Order   deterministic: splats lie in the order of the scene, which the stable sort keeps for equal depths
import { kConstants, kCoverage, kSplatWgsl, kViewWgsl, type Layout, projectionOf } from "./math.js";

/** 32-bit words of SH codes of a Gaussian, by degree. */
export const kShWords = [1, 3, 7, 12] as const;

/** Real harmonics with the signs of 3DGS, as sh_basis(); by degree. */
const kBasis = [
  ["0.28209479177387814"],
  ["-0.4886025119029199 * d.y", "0.4886025119029199 * d.z", "-0.4886025119029199 * d.x"],
  [
    "1.0925484305920792 * d.x * d.y",
    "-1.0925484305920792 * d.y * d.z",
    "0.31539156525252005 * (2.0 * zz - xx - yy)",
    "-1.0925484305920792 * d.x * d.z",
    "0.5462742152960396 * (xx - yy)",
  ],
  [
    "-0.5900435899266435 * d.y * (3.0 * xx - yy)",
    "2.890611442640554 * d.x * d.y * d.z",
    "-0.4570457994644658 * d.y * (4.0 * zz - xx - yy)",
    "0.3731763325901154 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy)",
    "-0.4570457994644658 * d.x * (4.0 * zz - xx - yy)",
    "1.445305721320277 * d.z * (xx - yy)",
    "-0.5900435899266435 * d.x * (xx - 3.0 * yy)",
  ],
] as const;

/** sh_color() from codes: a degree's codes are summed before they are scaled. Straight code, so that no array is indexed. */
function shColorOfCodes(degree: number): string {
  const code = (i: number): string => `f32(extractBits(bitcast<i32>(w${i >> 2}), ${8 * (i & 3)}u, 8u))`;
  const band = (l: number): string => {
    const sum = kBasis[l as 0].map((y: string, m: number) => {
      const k = 3 * (l * l + m);
      return `(${y}) * vec3f(${code(k)}, ${code(k + 1)}, ${code(k + 2)})`;
    });
    const [a, b, c] = [0, 1, 2].map((channel) => 3 * l + channel).map((i) => `g.steps[${i >> 2}][${i & 3}]`);
    return `if (view.sh_degree >= ${l}u) { c += vec3f(${a}, ${b}, ${c}) * (${sum.join(" + ")}); }`;
  };
  const words = Array.from({ length: kShWords[degree] as number }, (_, i) => `let w${i} = sh[at + ${i}u];`);
  return `
fn sh_color(row: u32, g: Group, d: vec3f) -> vec3f {
  let at = ${kShWords[degree]}u * row;
  let xx = d.x * d.x; let yy = d.y * d.y; let zz = d.z * d.z;
  ${words.join(" ")}
  var c = vec3f();
  ${Array.from({ length: degree + 1 }, (_, l) => band(l)).join("\n  ")}
  return max(c + 0.5, vec3f());
}`;
}

/** sh_color() from FP32: degree 0 of all rows, then the other degrees of each. */
function shColor(degree: number): string {
  const band = (l: number): string => {
    const terms = kBasis[l as 0].map((y: string, m: number) => {
      const at = l === 0 ? "first" : `rest + ${3 * (l * l + m - 1)}u`;
      return `c += (${y}) * vec3f(coefficient(${at}), coefficient(${at} + 1u), coefficient(${at} + 2u));`;
    });
    return `if (view.sh_degree >= ${l}u) { ${terms.join(" ")} }`;
  };
  return `
fn coefficient(at: u32) -> f32 {
  return bitcast<f32>(sh[at]);
}
fn sh_color(row: u32, g: Group, d: vec3f) -> vec3f {
  let first = 3u * row;
  let rest = 3u * block.n_rows + ${3 * ((degree + 1) ** 2 - 1)}u * row;
  let xx = d.x * d.x; let yy = d.y * d.y; let zz = d.z * d.z;
  var c = vec3f();
  ${Array.from({ length: degree + 1 }, (_, l) => band(l)).join("\n  ")}
  return max(c + 0.5, vec3f());
}`;
}

/** Of Gaussians of an SH degree. */
export const projectOf = (layout: Layout, degree: number): string => /* wgsl */ `
${kViewWgsl}${kConstants}${kSplatWgsl}${kCoverage}
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> block: Block;
@group(0) @binding(2) var<storage, read> rows: array<u32>;
@group(0) @binding(3) var<storage, read> groups: array<Group>;
@group(0) @binding(4) var<storage, read> counts: array<u32>;
@group(0) @binding(5) var<storage, read> flags: array<u32>;
@group(0) @binding(6) var<storage, read> sh: array<u32>;
@group(0) @binding(7) var<storage, read_write> splats: array<array<vec4f, 3>>;
@group(0) @binding(8) var<storage, read_write> keys: array<u32>;
@group(0) @binding(9) var<storage, read_write> tiles: array<u32>;
${projectionOf(layout)}
${layout === "stored" ? shColorOfCodes(degree) : shColor(degree)}

@compute @workgroup_size(256)
fn project(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) thread: u32) {
  let index = group_index(workgroup);
  if (index >= block.n_groups) { return; }
  let g = groups[block.first_group + index];
  let word = thread / 32u;
  let bit = 1u << (thread % 32u);
  let own = flags[8u * g.order + word];
  if ((own & bit) == 0u) { return; }
  var at = counts[g.order] + countOneBits(own & (bit - 1u));
  for (var i = 0u; i < word; i++) { at += countOneBits(flags[8u * g.order + i]); }
  if (at >= view.capacity.x) { return; }
  let row = g.row + thread;
  let p = project_row(row, g.scale_unit);
  let color = sh_color(row, g, normalize(from_camera(load_mean(row))));
  let s = screen_splat(p, mix(color, g.tint.xyz, g.tint.w));
  let e = ellipse(s);
  let y = tile_rows(e, view.grid);
  var n = 0u;
  for (var r = y.x; r < y.y; r++) {
    let x = tiles_in_row(e, r, view.grid);
    n += x.y - x.x;
  }
  splats[at] = store_splat(s);
  keys[at] = bitcast<u32>(p.z);  // positive floats sort as their bits
  tiles[at] = n;
}
`;
