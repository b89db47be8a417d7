// math.ts - rgs/math in WGSL: constants, camera, covariance, coverage. Names are those of kernels/math.
// SPDX-License-Identifier: Apache-2.0

/** A view: `View` in WGSL, written by view.ts. */
export const kViewWgsl = /* wgsl */ `
struct Plane {
  normal: vec3f, offset: f32,
  extent: vec3f, reach: f32,
  rounding: vec4f,
}
struct View {
  rotation: array<vec4f, 3>,  // rows of world to camera
  position: vec4f,            // of the camera, relative to the scene's origin
  position_low: vec4f,        // rounding error of position
  focal: vec2f,
  center: vec2f,              // principal point, px from the left and upper edge
  slope_low: vec2f,           // range of x/z and y/z in which the projection is linearised
  slope_high: vec2f,
  near_plane: f32,
  far_plane: f32,
  low_pass: f32,
  compensated: u32,           // 1: mip_splatting
  size: vec2u,
  grid: vec2u,                // tiles
  background: vec3f,
  sh_degree: u32,
  capacity: vec2u,            // of splats and of entries
  planes: array<Plane, 6>,
}
`;

/** docs/format/RENDERING.md; constants.hpp has the reasons. */
export const kConstants = /* wgsl */ `
const kTileSize = 16u;
const kAlphaMin = 1.0 / 255.0;
const kAlphaMax = 0.99;
const kTransmittanceMin = 1e-4;
const kMipRatioMin = 0.000025;
`;

export const kSplatWgsl = /* wgsl */ `
// A Gaussian on the image.
struct ScreenSplat {
  mean: vec2f,     // px, pixel centres at the integers
  conic: vec3f,    // a dx^2 + 2 b dx dy + c dy^2
  opacity: f32,
  color: vec3f,
  level: f32,      // of the ellipse
  variance: vec2f, // diagonal of the covariance
}
fn load_splat(v: array<vec4f, 3>) -> ScreenSplat {
  return ScreenSplat(v[0].xy, vec3f(v[0].zw, v[1].x), v[1].y, vec3f(v[1].zw, v[2].x), v[2].y, v[2].zw);
}
fn store_splat(s: ScreenSplat) -> array<vec4f, 3> {
  return array(vec4f(s.mean, s.conic.xy), vec4f(s.conic.z, s.opacity, s.color.xy), vec4f(s.color.z, s.level, s.variance));
}
`;

/** coverage.hpp: an ellipse is made of what ScreenSplat keeps, the same in every kernel. */
export const kCoverage = /* wgsl */ `
struct Ellipse {
  mean: vec2f,
  level: f32,
  half: vec2f,        // half width and height
  slope: f32,         // x of the chord's middle per y
  shear: f32,         // y at which x is largest, relative to the mean
  variance_x_y: f32,  // of x at a given y
  inverse_yy: f32,
}
fn ellipse(s: ScreenSplat) -> Ellipse {
  let half = sqrt(s.level * s.variance);
  // det = 1 / (a c - b^2): cov.xy / cov.yy = -b / a, cov.xy / cov.xx = -b / c, det / cov.yy = 1 / a
  return Ellipse(s.mean, s.level, half, -s.conic.y / s.conic.x, -s.conic.y / s.conic.z * half.x, 1.0 / s.conic.x, 1.0 / s.variance.y);
}

// Tiles with a pixel centre in [low, high] along one axis: first, last + 1.
fn tiles_between(low: f32, high: f32, limit: u32) -> vec2u {
  let end = f32(limit);
  let first = u32(ceil(clamp((low - 15.0) / 16.0, 0.0, end)));
  let last = select(u32(clamp(high / 16.0 + 1.0, 0.0, end)), 0u, high < 0.0);
  return vec2u(first, max(first, last));
}
fn tile_rows(e: Ellipse, grid: vec2u) -> vec2u {
  return tiles_between(e.mean.y - e.half.y, e.mean.y + e.half.y, grid.y);
}
fn tile_columns(e: Ellipse, grid: vec2u) -> vec2u {
  return tiles_between(e.mean.x - e.half.x, e.mean.x + e.half.x, grid.x);
}

// Range of x of the ellipse within y_low <= y <= y_high, relative to the mean. The right boundary is concave with its top at shear,
// so its maximum over a range is at the clamped top; the left boundary is its point reflection.
fn chord(e: Ellipse, y_low: f32, y_high: f32) -> vec2f {
  let y_right = clamp(e.shear, y_low, y_high);
  let y_left = clamp(-e.shear, y_low, y_high);
  let right = e.level - y_right * y_right * e.inverse_yy;
  let left = e.level - y_left * y_left * e.inverse_yy;
  return vec2f(e.slope * y_left - sqrt(max(left * e.variance_x_y, 0.0)), e.slope * y_right + sqrt(max(right * e.variance_x_y, 0.0)));
}

// Tiles of a row of tile_rows().
fn tiles_in_row(e: Ellipse, row: u32, grid: vec2u) -> vec2u {
  let y = f32(row * kTileSize) - e.mean.y;
  let c = chord(e, max(y, -e.half.y), min(y + 15.0, e.half.y));
  let slack = 1e-3 + 1e-6 * e.half.x;  // for rounding of the chord's ends, px
  return tiles_between(e.mean.x + c.x - slack, e.mean.x + c.y + slack, grid.x);
}
`;

/** How rows lie in buffers: as in files, or as FP32 arrays one after the other. */
export type Layout = "stored" | "arrays";

const kLoad: Readonly<Record<Layout, string>> = {
  stored: `
  let at = 3u * block.n_rows + 4u * row;
  let scale_xy = unpack2x16float(rows[at + 2u]);
  let scale_z_opacity = unpack2x16float(rows[at + 3u]);
  let rotation = vec4f(unpack2x16float(rows[at]), unpack2x16float(rows[at + 1u]));
  return Shape(rotation, vec3f(scale_xy, scale_z_opacity.x) * scale_unit, scale_z_opacity.y);`,
  arrays: `
  let q = 3u * block.n_rows + 4u * row;
  let s = 7u * block.n_rows + 3u * row;
  let rotation = vec4f(load(q), load(q + 1u), load(q + 2u), load(q + 3u));
  return Shape(rotation, vec3f(load(s), load(s + 1u), load(s + 2u)), load(10u * block.n_rows + row));`,
};

/** camera.hpp, covariance.hpp and projection.hpp. Needs `view`, `rows` and `block`. */
export const projectionOf = (layout: Layout): string => /* wgsl */ `
// Chunks in the order that is drawn.
struct Group {
  row: u32,
  count: u32,
  order: u32,
  scale_unit: f32,
  steps: array<vec4f, 3>,  // by degree and channel
  low: vec3f,              // box of the means
  radius: f32,             // three standard deviations of its largest Gaussian
  high: vec3f,
  opacity: f32,
  tint: vec4f,             // a colour, and its share
}
struct Block {
  first_group: u32,
  n_groups: u32,
  n_rows: u32,
}
// Of a grid of two dimensions.
fn group_index(workgroup: vec3u) -> u32 {
  return workgroup.x + (workgroup.y << 15u);
}

// Comparisons may be compiled as if there were neither infinities nor NaN.
fn is_finite(x: f32) -> bool {
  return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

fn from_camera(p: vec3f) -> vec3f {
  return (p - view.position.xyz) - view.position_low.xyz;
}
fn to_camera(d: vec3f) -> vec3f {
  return vec3f(dot(view.rotation[0].xyz, d), dot(view.rotation[1].xyz, d), dot(view.rotation[2].xyz, d));
}

struct Projected {
  mean: vec2f,
  z: f32,
  cov: vec3f,  // xx, xy, yy, low-pass included
  conic: vec3f,
  opacity: f32,
  valid: bool,
}

fn load(at: u32) -> f32 {
  return bitcast<f32>(rows[at]);
}
fn load_mean(row: u32) -> vec3f {
  let at = 3u * row;
  return vec3f(load(at), load(at + 1u), load(at + 2u));
}
struct Shape {
  rotation: vec4f,  // w, x, y, z
  scale: vec3f,
  opacity: f32,
}
fn load_shape(row: u32, scale_unit: f32) -> Shape {${kLoad[layout]}
}

// EWA (Zwicker et al. 2001, eq. 31) as M M^T with M = J W R S, which stays positive semi-definite under rounding.
fn project_covariance(p: vec3f, q: vec4f, s: vec3f) -> vec3f {
  let w = view.rotation;
  let inverse_z = 1.0 / p.z;
  let slope = clamp(p.xy * inverse_z, view.slope_low, view.slope_high);
  let j = view.focal * inverse_z;
  let du = j.x * (w[0].xyz - slope.x * w[2].xyz);
  let dv = j.y * (w[1].xyz - slope.y * w[2].xyz);
  let axis_x = vec3f(1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z));
  let axis_y = vec3f(2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y));
  let axis_z = vec3f(2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  let mu = vec3f(dot(du, axis_x), dot(du, axis_y), dot(du, axis_z)) * s;
  let mv = vec3f(dot(dv, axis_x), dot(dv, axis_y), dot(dv, axis_z)) * s;
  return vec3f(dot(mu, mu), dot(mu, mv), dot(mv, mv));
}

fn determinant_of(cov: vec3f) -> f32 {
  return cov.x * cov.z - cov.y * cov.y;
}

fn project_row(row: u32, scale_unit: f32) -> Projected {
  var result: Projected;
  let p = to_camera(from_camera(load_mean(row)));
  if (!(p.z > view.near_plane && p.z <= view.far_plane)) { return result; }
  let shape = load_shape(row, scale_unit);
  let norm2 = dot(shape.rotation, shape.rotation);
  let q = select(vec4f(1.0, 0.0, 0.0, 0.0), shape.rotation / sqrt(norm2), norm2 > 0.0);
  let before = project_covariance(p, q, shape.scale);
  let cov = before + vec3f(view.low_pass, 0.0, view.low_pass);
  let det = determinant_of(cov);
  result.opacity = shape.opacity;
  if (view.compensated != 0u) { result.opacity *= sqrt(max(kMipRatioMin, determinant_of(before) / det)); }
  let inverse_det = 1.0 / det;
  result.conic = vec3f(cov.z * inverse_det, -cov.y * inverse_det, cov.x * inverse_det);
  result.mean = view.focal * p.xy / p.z + view.center - 0.5;
  result.z = p.z;
  result.cov = cov;
  result.valid = det > 0.0 && is_finite(det) && is_finite(result.conic.x) && is_finite(result.conic.z);
  return result;
}

// Level of the ellipse in which alpha reaches 1/255, raised by the largest rounding error in a pixel; negative: there is none.
fn ellipse_level(p: Projected) -> f32 {
  let cutoff = -log(p.opacity / kAlphaMin);
  if (!(p.opacity >= kAlphaMin)) { return -1.0; }
  let rounding = 8.0 * 6e-8 * (p.cov.x * p.conic.x);
  return -2.0 * cutoff * (1.0 + rounding) + 1e-4;
}
fn screen_splat(p: Projected, color: vec3f) -> ScreenSplat {
  return ScreenSplat(p.mean, p.conic, p.opacity, color, ellipse_level(p), p.cov.xz);
}
`;
