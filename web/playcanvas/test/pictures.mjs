// pictures.mjs - pictures of rgs-render, and how far others are from them.
// SPDX-License-Identifier: Apache-2.0
import { execFileSync } from "node:child_process";
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";

export function program(name) {
  const folder = process.env.RGS_WEB_PROGRAMS;
  if (!folder) throw new Error("RGS_WEB_PROGRAMS is not set: sh scripts/test_web.sh");
  return join(folder, name);
}

/** Cameras of the project's own list or of 3DGS programs, as 3DGS programs write them. */
export function readCameras(path) {
  return JSON.parse(readFileSync(path, "utf8")).map((camera, id) => {
    if (camera.rotation) return camera;
    const rows = camera.world_to_camera;
    const rotation = [0, 1, 2].map((row) => [0, 1, 2].map((column) => rows[column][row]));
    const position = rotation.map((row) => -row.reduce((sum, value, k) => sum + value * rows[k][3], 0));
    const { width, height, fx, fy, cx = width / 2, cy = height / 2, name } = camera;
    return { id, img_name: name, width, height, position, rotation, fx, fy, cx, cy };
  });
}

/** PNGs of the CPU renderer, in order. */
export function renderAll(scene, path, views, [width, height], folder, more = []) {
  const cameras = join(folder, "views.json");
  const list = JSON.parse(readFileSync(path, "utf8"));
  mkdirSync(folder, { recursive: true });
  // Numbered, so that names are in order.
  writeFileSync(cameras, JSON.stringify(views.map((view, i) => ({ ...list[view], name: String(i).padStart(3, "0"), split: "test" }))));
  const out = join(folder, "views");
  const size = `${width}x${height}`;
  execFileSync(program("rgs-render"), [scene, "--cameras", cameras, "--backend", "cpu", "--size", size, "--out", out, "--quiet", "--overwrite", ...more]);
  return views.map((_, i) => join(out, `${String(i).padStart(3, "0")}.png`));
}

/** Of RGB of two RGBA pictures, dB. */
export function psnr(a, b) {
  if (a.length !== b.length) throw new Error(`pictures of ${a.length} and ${b.length} bytes`);
  let sum = 0;
  for (let i = 0; i < a.length; ++i) if (i % 4 !== 3) sum += (a[i] - b[i]) ** 2;
  return -10 * Math.log10(sum / ((a.length / 4) * 3) / 255 ** 2);
}
