// record.mjs - the recording of the project's README: node record.mjs LEFT RIGHT CAMERAS OUT.webp. Orbits two files of a scene, moves the
// border between them and shows their difference; ten seconds, by screenshots of Chromium and img2webp of Debian's package webp.
// Files: rgs-make-scene --town --gaussians 100k --blocks 2 --degree 1 --cameras cameras.json town.ply; rgs-convert town.ply packed.rgs;
// rgs-convert --profile archive:small town.ply archive.rgs
// SPDX-License-Identifier: Apache-2.0
import { execFileSync } from "node:child_process";
import { mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { basename, join } from "node:path";
import { launch } from "../../reader/test/chromium.mjs";
import { newPage, startServer } from "./server.mjs";

const kSize = { width: 760, height: 428 };
const kFrameMs = 190;
const kQuality = "45";

const [left, right, cameras, out] = process.argv.slice(2);
const folder = mkdtempSync(join(tmpdir(), "rgs-record-"));
const scene = (side, path) => ({ name: basename(path), url: `scenes/${side}/${basename(path)}` });
const view = { version: 1, scenes: [scene(0, left), scene(1, right)], cameras: "cameras.json", photos: [], frames: null };
const files = { [view.scenes[0].url]: left, [view.scenes[1].url]: right, "cameras.json": cameras };
const server = await startServer({ view, files });
const browser = await launch("webgl2");
try {
  const page = await newPage(browser, { viewport: kSize, colorScheme: "dark" });
  await page.goto(server.url);
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  const shots = [];
  /** The page when it no longer changes, for so many frames. */
  const shoot = async (frames = 1) => {
    let last = "";
    let shot = await page.screenshot();
    for (let i = 0; i < 20 && shot.toString("base64") !== last; ++i) {
      last = shot.toString("base64");
      shot = await page.screenshot();
    }
    const path = join(folder, `${String(shots.length).padStart(3, "0")}.png`);
    writeFileSync(path, shot);
    shots.push("-d", String(frames * kFrameMs), path);
  };
  const slide = async (split) => {
    const [handle, stage] = [await page.locator("#split").boundingBox(), await page.locator("#stage").boundingBox()];
    await page.mouse.move(handle.x + handle.width / 2, handle.y + handle.height / 2);
    await page.mouse.down();
    await page.mouse.move(stage.x + (split / 1000) * stage.width, handle.y + handle.height / 2);
    await page.mouse.up();
  };
  // From above the roofs.
  await page.locator("#picture").focus();
  await page.keyboard.press("b");
  const box = await page.locator("#picture").boundingBox();
  // Beside the handle.
  const [x, y] = [box.x + 0.44 * box.width, box.y + box.height / 2];
  await page.mouse.dblclick(x, y);
  for (let i = 0; i < 4; ++i) await page.keyboard.press("+");
  await page.mouse.move(x, y);
  await page.mouse.down();
  for (let i = 0; i < 20; ++i) {
    await page.mouse.move(x + 70 * Math.sin((2 * Math.PI * i) / 20), y);
    await shoot();
  }
  await page.mouse.up();
  for (let i = 0; i <= 14; ++i) {
    await slide(500 + Math.round(380 * Math.sin((2 * Math.PI * i) / 14)));
    await shoot();
  }
  await page.getByRole("radio", { name: "Difference" }).click();
  await page.locator("#map").waitFor();
  await shoot(12);
  await page.getByRole("radio", { name: "Slider" }).click();
  await shoot(6);
  execFileSync("img2webp", ["-loop", "0", "-lossy", "-q", kQuality, "-m", "6", ...shots, "-o", out], { stdio: "inherit" });
} finally {
  await browser.close();
  await server.end();
  rmSync(folder, { recursive: true });
}
