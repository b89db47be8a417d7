// as-defined.ts - what the engine must be told to draw the image that docs/RENDERING.md defines.
// SPDX-License-Identifier: Apache-2.0
import {
  type AppBase,
  type CameraComponent,
  GAMMA_SRGB,
  GSPLAT_RENDERER_RASTER_CPU_SORT,
  GSPLATDATA_LARGE,
  SHADERLANGUAGE_GLSL,
  SHADERLANGUAGE_WGSL,
  ShaderChunks,
  TONEMAP_NONE,
} from "playcanvas";

/** In a chunk of the engine's shaders one text instead of another. */
type Change = readonly [chunk: string, from: string, to: string];

// The engine's low pass is 0.3 square half pixels, that of the definition 0.3 square pixels.
const kLowPassPx2 = 0.3;

// The definition projects Gaussians beyond the picture's edge as if they stood there, the engine does not.
const kFovClamp = 1.3;

// The engine lets a Gaussian end at 2.83 standard deviations, moved down to reach 0 there. The definition lets it end where its
// alpha is 1/255, at most 3.33 standard deviations away, and alpha at 0.99.
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
  ["gsplatCornerVS", "diagonal1 = cov[0][0] + 0.3", `diagonal1 = cov[0][0] + ${4 * kLowPassPx2}`],
  ["gsplatCornerVS", "diagonal2 = cov[1][1] + 0.3", `diagonal2 = cov[1][1] + ${4 * kLowPassPx2}`],
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
  ["gsplatCornerVS", "diagonal1 = cov[0][0] + 0.3", `diagonal1 = cov[0][0] + ${4 * kLowPassPx2}`],
  ["gsplatCornerVS", "diagonal2 = cov[1][1] + 0.3", `diagonal2 = cov[1][1] + ${4 * kLowPassPx2}`],
  ["gsplatCommonVS", "min(half(1.0), sqrt(", "min(half(1.2), sqrt("],
  ["gsplatPS", "if (A > half(1.0))", "if (A > half(1.44))"],
  ["gsplatPS", "(exp(x * half(-4.0)) - EXP4) * INV_EXP4", "exp(x * half(-4.0))"],
  ["gsplatPS", "normExp(A) * gaussianColor.a", "min(half(0.99), normExp(A) * gaussianColor.a)"],
];

/** Chunks of devices whose shaders are changed already. */
const changedChunks = new WeakSet<object>();

/**
 * Before anything is drawn: tells engine and camera to show colours as they are in the file, Gaussians of any size, SH seen from
 * where the camera is, and Gaussians that fall off as they were trained. False if this engine's shaders are not those that this
 * package knows; then its own falloff stays, some dB away from the definition.
 */
export function drawAsDefined(app: AppBase, camera: CameraComponent): boolean {
  const { gsplat } = app.scene;
  // What sorts on the GPU projects by shaders that cannot be changed.
  gsplat.renderer = GSPLAT_RENDERER_RASTER_CPU_SORT;
  gsplat.dataFormat = GSPLATDATA_LARGE;
  gsplat.minPixelSize = 0;
  gsplat.minContribution = 0;
  gsplat.colorUpdateAngle = 0;
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
