// clients.test.mjs - CesiumJS and Babylon.js draw glTF and 3D Tiles of rgs-convert as rgs-render draws the scene, Spark .rgs files;
// CesiumJS takes coarse tiles from afar.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { copyFileSync, writeFileSync } from "node:fs";
import { basename, join } from "node:path";
import test from "node:test";
import { resizePinhole } from "@roofgs/playcanvas";
import { program, psnr, readCameras, renderAll } from "../../playcanvas/test/pictures.mjs";
import { hasChromium, launch, newPage } from "../../reader/test/chromium.mjs";
import { scenes } from "../../reader/test/dump.mjs";
import { hasNginx, skip, startNginx } from "../../reader/test/servers.mjs";
import { buildPage } from "../draw.mjs";

const kSize = [320, 180];
const kSplats = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"];

test("pictures by other programs", async (t) => {
  if (!hasChromium) return skip(t, "chromium is not installed");
  if (!hasNginx) return skip(t, "nginx is not installed");
  const server = await startNginx();
  const browser = await launch("webgl2");
  t.after(async () => {
    await browser.close();
    await server.end();
  });
  const file = (name) => join(server.files, name);
  const scene = join(scenes(), "packed.rgs");
  const list = join(scenes(), "cameras.json");
  const cameras = readCameras(list);
  const convert = (from, name) => execFileSync(program("rgs-convert"), ["--quiet", from, file(name)]);
  convert(join(scenes(), "levels.rgs"), "levels/tileset.json");
  convert(scene, "house.spz.glb");
  convert(scene, "house.glb");

  /** `leastDb`: of the program's own low-pass. Calls `more` with what draws by a camera. */
  const client = (name, lowPass, leastDb, pictures, more) =>
    t.test(name, async (t) => {
      await buildPage(name, server.files);
      const page = await newPage(browser);
      const problems = [];
      page.on("console", (message) => ["error", "warning"].includes(message.type()) && problems.push(message.text()));
      page.on("pageerror", (error) => problems.push(String(error)));
      await page.goto(`${server.url}/${name}.html`);
      const draw = (url, camera) => page.evaluate((words) => window.draw(...words), [url, resizePinhole(camera, ...kSize)]);
      for (const [url, view] of pictures) {
        await t.test(`${url}, view ${view}`, async (t) => {
          const found = await draw(url, cameras[view]);
          const [path] = renderAll(scene, list, [view], kSize, file("pictures"), ["--low-pass", `${lowPass}`]);
          const wanted = await page.evaluate((url) => window.decode(url), `/pictures/views/${basename(path)}`);
          const db = psnr(Buffer.from(found.rgba, "base64"), Buffer.from(wanted, "base64"));
          t.diagnostic(`${db.toFixed(1)} dB`);
          assert.equal(found.gaussians, 60000);
          assert.ok(db >= leastDb, `${db} dB`);
        });
      }
      await more(t, draw);
      assert.deepEqual(problems, []);
      await page.close();
    });

  // 36.5 to 37.4 dB are seen, 28.8 to 33.9 without harmonics, 35.7 to 36.8 with those of Spark's own encoder.
  copyFileSync(scene, file("house.rgs"));
  await client("spark-rgs", 0.3, 36.2, [0, 2, 5].map((view) => ["/house.rgs", view]), () => {});

  // A tileset of one tile.
  const content = { extensionsUsed: kSplats, extensionsRequired: kSplats };
  const root = { boundingVolume: { sphere: [0, 0, 0, 1000] }, geometricError: 0, refine: "ADD", content: { uri: "house.spz.glb" } };
  const extensions = { "3DTILES_content_gltf": content };
  writeFileSync(file("house.json"), JSON.stringify({ asset: { version: "1.1" }, extensionsUsed: Object.keys(extensions), extensions, geometricError: 1e6, root }));
  // It adds 0.3 square quarters of a pixel. 32.5 to 34.6 dB are seen, 28.5 to 30.2 without harmonics, 7 to 12 of a black picture.
  const tiles = [["/levels/tileset.json", 0], ["/levels/tileset.json", 5], ["/house.json", 2]];
  await client("cesium", 0.3 / 16, 31.5, tiles, (t, draw) =>
    t.test("coarse tiles from afar", async (t) => {
      const [{ position, rotation, ...camera }] = cameras;
      const levels = [];
      let before = 60000;
      // The sky, whose errors are those of the tiles, is wide.
      for (const distance of [2500, 10000]) {
        const moved = position.map((value, i) => value - distance * rotation[i][2]);
        const { tiles, gaussians } = await draw("/levels/tileset.json", { ...camera, rotation, position: moved });
        t.diagnostic(`from ${distance}: ${gaussians} Gaussians of ${tiles.join(" ")}`);
        levels.push(tiles.map((tile) => tile[0]).join(""));
        assert.ok(gaussians < before / 2.5, `${gaussians} of ${before} Gaussians`);
        before = gaussians;
      }
      assert.deepEqual(levels, ["11", "2"]);
    }),
  );
  // It adds 0.3 square half pixels. 31.1 and 32.9 dB are seen.
  await client("babylon", 0.3 / 4, 30.5, [["/house.glb", 0], ["/house.glb", 2]], (t, draw) =>
    t.test("not an SPZ in glTF", () => assert.rejects(draw("/house.spz.glb", cameras[0]), /KHR_gaussian_splatting_compression_spz_2 is not available/)),
  );
});
