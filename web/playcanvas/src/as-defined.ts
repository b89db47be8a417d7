// as-defined.ts - makes the engine draw the image that docs/format/RENDERING.md defines.
// SPDX-License-Identifier: Apache-2.0
import { type AntiAliasing, antiAliasingOf } from "@roofgs/reader";
import {
  type AppBase,
  type CameraComponent,
  GAMMA_SRGB,
  GSPLAT_RENDERER_RASTER_CPU_SORT,
  GSPLATDATA_LARGE,
  SHADERLANGUAGE_GLSL,
  SHADERLANGUAGE_WGSL,
  type Scene,
  ShaderChunks,
  TONEMAP_NONE,
} from "playcanvas";

/** Of a scene that declares nothing. */
const kOriginal = antiAliasingOf({ aaMode: "undeclared" });

/** Replaces a text in a chunk of the engine's shaders. */
type Change = readonly [chunk: string, from: string, to: string];

// The engine's low-pass is 0.3 square half pixels. Here it is a uniform: square half pixels, and 1 if opacity is compensated.
const kUniform = "rgsLowPass";
// Yu et al. 2024, "Mip-Splatting", eq. 10.
const kLeastDetRatio = 0.000025;

// The definition clamps Gaussians beyond the picture's edge before it projects them; the engine does not.
const kFovClamp = 1.3;

// The engine does not draw Gaussians that are round on the picture or longest along its rows: their direction is 0 / 0.

// The engine cuts a Gaussian off at 2.83 standard deviations and subtracts the rest. The definition cuts it off where alpha is 1/255, at
// most 3.33 standard deviations away, and limits alpha to 0.99.
const kGlsl: readonly Change[] = [
  ["gsplatCenterVS", "centerView.z > 0.0", "centerView.z > -camera_params.z"],
  [
    "gsplatCornerVS",
    "vec3 vp = camera_params.w == 1.0 ? vec3(0.0, 0.0, 1.0) : v;",
    `vec3 vp = camera_params.w == 1.0 ? vec3(0.0, 0.0, 1.0) : v;
    vec2 edge = ${kFovClamp} / abs(vec2(center.projMat00, center.projMat11));
    vp.xy = clamp(vp.xy / vp.z, -edge, edge) * vp.z;`,
  ],
  ["gsplatCornerVS", "min(1024.0, min(viewport_size.x, viewport_size.y))", "65536.0"],
  ["gsplatCornerVS", "uniform float minPixelSize;", `uniform float minPixelSize; uniform vec2 ${kUniform};`],
  ["gsplatCornerVS", "diagonal1 = cov[0][0] + 0.3", `diagonal1 = cov[0][0] + ${kUniform}.x`],
  ["gsplatCornerVS", "diagonal2 = cov[1][1] + 0.3", `diagonal2 = cov[1][1] + ${kUniform}.x`],
  ["gsplatCornerVS", "(cov[0][0] + 0.3) * (cov[1][1] + 0.3)", `(cov[0][0] + ${kUniform}.x) * (cov[1][1] + ${kUniform}.x)`],
  ["gsplatCornerVS", "sqrt(max(detOrig / detBlur, 0.0))", `${kUniform}.y > 0.0 ? sqrt(max(detOrig / detBlur, ${kLeastDetRatio})) : 1.0`],
  [
    "gsplatCornerVS",
    "vec2 diagonalVector = normalize(vec2(offDiagonal, lambda1 - diagonal1));",
    `vec2 longest = vec2(offDiagonal, lambda1 - diagonal1);
    vec2 diagonalVector = longest == vec2(0.0) ? vec2(1.0, 0.0) : normalize(longest);`,
  ],
  ["gsplatCommonVS", "min(1.0, sqrt(", "min(1.2, sqrt("],
  ["gsplatPS", "if (A > 1.0)", "if (A > 1.44)"],
  ["gsplatPS", "(exp(x * -4.0) - EXP4) * INV_EXP4", "exp(x * -4.0)"],
  ["gsplatPS", "normExp(A) * gaussianColor.a", "min(0.99, normExp(A) * gaussianColor.a)"],
];
const kWgsl: readonly Change[] = [
  ["gsplatCenterVS", "centerView.z > 0.0", "centerView.z > -uniform.camera_params.z"],
  [
    "gsplatCornerVS",
    "let vp = select(center.view.xyz, vec3f(0.0, 0.0, 1.0), uniform.camera_params.w == 1.0);",
    `let seen = select(center.view.xyz, vec3f(0.0, 0.0, 1.0), uniform.camera_params.w == 1.0);
    let edge = ${kFovClamp} / abs(vec2f(center.projMat00, center.projMat11));
    let vp = vec3f(clamp(seen.xy / seen.z, -edge, edge) * seen.z, seen.z);`,
  ],
  ["gsplatCornerVS", "min(1024.0, min(uniform.viewport_size.x, uniform.viewport_size.y))", "65536.0"],
  ["gsplatCornerVS", "uniform minPixelSize: f32;", `uniform minPixelSize: f32; uniform ${kUniform}: vec2f;`],
  ["gsplatCornerVS", "diagonal1 = cov[0][0] + 0.3", `diagonal1 = cov[0][0] + uniform.${kUniform}.x`],
  ["gsplatCornerVS", "diagonal2 = cov[1][1] + 0.3", `diagonal2 = cov[1][1] + uniform.${kUniform}.x`],
  ["gsplatCornerVS", "(cov[0][0] + 0.3) * (cov[1][1] + 0.3)", `(cov[0][0] + uniform.${kUniform}.x) * (cov[1][1] + uniform.${kUniform}.x)`],
  [
    "gsplatCornerVS",
    "half(sqrt(max(detOrig / detBlur, 0.0)))",
    `half(select(1.0, sqrt(max(detOrig / detBlur, ${kLeastDetRatio})), uniform.${kUniform}.y > 0.0))`,
  ],
  [
    "gsplatCornerVS",
    "let diagonalVector = normalize(vec2f(offDiagonal, lambda1 - diagonal1));",
    `let longest = vec2f(offDiagonal, lambda1 - diagonal1);
    let diagonalVector = select(vec2f(1.0, 0.0), normalize(longest), any(longest != vec2f(0.0)));`,
  ],
  ["gsplatCommonVS", "min(half(1.0), sqrt(", "min(half(1.2), sqrt("],
  ["gsplatPS", "if (A > half(1.0))", "if (A > half(1.44))"],
  ["gsplatPS", "(exp(x * half(-4.0)) - EXP4) * INV_EXP4", "exp(x * half(-4.0))"],
  ["gsplatPS", "normExp(A) * gaussianColor.a", "min(half(0.99), normExp(A) * gaussianColor.a)"],
];

/** Shader chunks that have been changed. */
const changedChunks = new WeakSet<object>();
/** Scenes whose cameras set the uniform before they draw. */
const watched = new WeakSet<Scene>();
const antiAliasings = new WeakMap<CameraComponent, AntiAliasing>();

function watch({ scene, graphicsDevice }: AppBase): void {
  if (watched.has(scene)) return;
  watched.add(scene);
  const uniform = graphicsDevice.scope.resolve(kUniform);
  scene.on("prerender:layer", (camera: CameraComponent | null) => {
    const { lowPassPx2, compensated } = (camera && antiAliasings.get(camera)) ?? kOriginal;
    uniform.setValue(new Float32Array([4 * lowPassPx2, compensated ? 1 : 0]));
  });
}

/**
 * Makes the engine draw the image that the format defines. Call it before anything is drawn. The engine and this camera then show colours as they are in the file, Gaussians of any size, SH
 * from the camera's position, and the falloff of 3DGS. `antiAliasing` applies to everything that this camera draws: files that declare
 * another one need a camera and a layer of their own. Call it again to change it. Returns false if this package does not know the
 * engine's shaders; the engine then draws its own falloff.
 */
export function drawAsDefined(app: AppBase, camera: CameraComponent, antiAliasing: AntiAliasing = kOriginal): boolean {
  const { gsplat } = app.scene;
  antiAliasings.set(camera, antiAliasing);
  watch(app);
  // The renderer that sorts on the GPU has shaders that cannot be changed.
  gsplat.renderer = GSPLAT_RENDERER_RASTER_CPU_SORT;
  gsplat.dataFormat = GSPLATDATA_LARGE;
  gsplat.minPixelSize = 0;
  gsplat.minContribution = 0;
  gsplat.colorUpdateAngle = 0;
  gsplat.antiAlias = true;
  camera.gammaCorrection = GAMMA_SRGB;
  camera.toneMapping = TONEMAP_NONE;
  camera.nearClip = 0.2;
  const webgpu = app.graphicsDevice.isWebGPU;
  const chunks = ShaderChunks.get(app.graphicsDevice, webgpu ? SHADERLANGUAGE_WGSL : SHADERLANGUAGE_GLSL);
  if (changedChunks.has(chunks)) return true;
  const changes = webgpu ? kWgsl : kGlsl;
  const changed = new Map<string, string>();
  for (const [chunk, from, to] of changes) {
    const code: string | undefined = changed.get(chunk) ?? chunks.get(chunk);
    if (code?.split(from).length !== 2) return false;
    changed.set(chunk, code.replace(from, to));
  }
  for (const [chunk, code] of changed) chunks.set(chunk, code);
  changedChunks.add(chunks);
  return true;
}
