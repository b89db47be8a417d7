// cesium.test.mjs - CesiumJS draws tilesets and .spz.glb of rgs-convert as rgs-render draws the scene, and takes coarse tiles from afar.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { symlinkSync, writeFileSync } from "node:fs";
import { basename, dirname, join } from "node:path";
import test from "node:test";
import { fileURLToPath } from "node:url";
import { build } from "vite";
import { program, psnr, readCameras, renderAll } from "../../playcanvas/test/pictures.mjs";
import { hasChromium, launch, newPage } from "../../reader/test/chromium.mjs";
import { scenes } from "../../reader/test/dump.mjs";
import { hasNginx, skip, startNginx } from "../../reader/test/servers.mjs";

const kSize = [320, 180];
/** 32.5 to 34.6 dB are seen, 28.5 to 30.2 without harmonics above degree 0, 7 to 12 of a black picture. */
const kLeastDb = 31.5;
/** CesiumJS adds 0.3 square quarters of a pixel. */
const kLowPass = 0.3 / 16;
const kSplats = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"];

test("CesiumJS", async (t) => {
  if (!hasChromium) return skip(t, "chromium is not installed");
  if (!hasNginx) return skip(t, "nginx is not installed");
  const server = await startNginx();
  const browser = await launch("webgl2");
  t.after(async () => {
    await browser.close();
    await server.end();
  });
  const file = (name) => join(server.files, name);
  const input = fileURLToPath(new URL("cesium.js", import.meta.url));
  const rollupOptions = { input, output: { entryFileNames: "cesium.js" } };
  await build({ configFile: false, logLevel: "error", build: { outDir: server.files, target: "es2022", minify: false, rollupOptions } });
  // What it looks for beside its module.
  const engine = dirname(fileURLToPath(import.meta.resolve("@cesium/engine")));
  for (const folder of ["Build/Workers", "Source/Assets", "Source/ThirdParty"]) symlinkSync(join(engine, folder), file(basename(folder)));
  writeFileSync(file("page.html"), `<!doctype html><link rel="icon" href="data:,"><script type="module" src="cesium.js"></script>`);

  const page = await newPage(browser);
  const problems = [];
  page.on("console", (message) => ["error", "warning"].includes(message.type()) && problems.push(message.text()));
  page.on("pageerror", (error) => problems.push(String(error)));
  await page.goto(`${server.url}/page.html`);
  const list = join(scenes(), "cameras.json");
  const cameras = readCameras(list);
  const draw = (url, camera) => page.evaluate((words) => window.draw(...words), [url, camera, kSize]);
  const rgba = (base64) => Buffer.from(base64, "base64");
  const compare = async (t, url, views) => {
    const paths = renderAll(join(scenes(), "packed.rgs"), list, views, kSize, file("pictures"), ["--low-pass", `${kLowPass}`]);
    for (const [i, path] of paths.entries()) {
      const found = await draw(url, cameras[views[i]]);
      const wanted = await page.evaluate((url) => window.decode(url), `/pictures/views/${basename(path)}`);
      const db = psnr(rgba(found.rgba), rgba(wanted));
      t.diagnostic(`view ${views[i]}: ${found.gaussians} Gaussians of ${found.tiles.length} tiles, ${db.toFixed(1)} dB`);
      assert.ok(db >= kLeastDb, `${db} dB`);
      assert.equal(found.gaussians, 60000);
    }
  };

  execFileSync(program("rgs-convert"), ["--quiet", join(scenes(), "levels.rgs"), file("levels/tileset.json")]);
  await t.test("a tileset", (t) => compare(t, "/levels/tileset.json", [0, 5]));
  await t.test("an .spz.glb that a tileset names", async (t) => {
    execFileSync(program("rgs-convert"), ["--quiet", join(scenes(), "packed.rgs"), file("house.spz.glb")]);
    const content = { extensionsUsed: kSplats, extensionsRequired: kSplats };
    const root = { boundingVolume: { sphere: [0, 0, 0, 1000] }, geometricError: 0, refine: "ADD", content: { uri: "house.spz.glb" } };
    const extensions = { "3DTILES_content_gltf": content };
    writeFileSync(file("house.json"), JSON.stringify({ asset: { version: "1.1" }, extensionsUsed: Object.keys(extensions), extensions, geometricError: 1e6, root }));
    await compare(t, "/house.json", [2]);
  });
  await t.test("coarse tiles from afar", async (t) => {
    const [{ position, rotation, ...camera }] = cameras;
    const far = [];
    // The sky, whose errors are those of the tiles, is wide.
    for (const distance of [0, 2500, 10000]) {
      const { tiles, gaussians } = await draw("/levels/tileset.json", { ...camera, rotation, position: position.map((value, i) => value - distance * rotation[i][2]) });
      t.diagnostic(`from ${distance}: ${gaussians} Gaussians of ${tiles.join(" ")}`);
      far.push([tiles.map((tile) => tile[0]).join(""), gaussians]);
    }
    assert.deepEqual(far.map(([levels]) => levels), ["000000", "11", "2"]);
    for (const i of [1, 2]) assert.ok(far[i][1] < far[i - 1][1] / 2.5, `${far[i][1]} of ${far[i - 1][1]} Gaussians`);
  });
  await t.test("the page has nothing to complain of", () => assert.deepEqual(problems, []));
});
