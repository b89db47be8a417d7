// picture.test.mjs - what the engine draws beside what this project's CPU renderer draws: axes, activations, quaternions, colours.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { copyFileSync, cpSync, existsSync, mkdirSync, mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { basename, join } from "node:path";
import test, { after } from "node:test";
import { fileURLToPath } from "node:url";
import { build } from "vite";
import { hasChromium, kDeviceNames, launch, newPage } from "../../reader/test/chromium.mjs";
import { golden, scenes } from "../../reader/test/dump.mjs";
import { hasNginx, skip, startNginx } from "../../reader/test/servers.mjs";
import { program, psnr, readCameras, renderAll } from "./pictures.mjs";

const kSize = [240, 180];
const kLeastDb = 35;
// Of a PLY the engine rounds SH otherwise, and reorders Gaussians, whose depths have ties.
const kLeastDbOfPly = 40;
// One shader in two languages: what is left are the roundings of two compilers.
const kLeastDbBetween = 60;
const bytes = (base64) => Buffer.from(base64, "base64");
/** By device: pictures of all scenes' views. */
const drawings = new Map(kDeviceNames.map((device) => [device, new Map()]));

let folder;
after(() => folder && rmSync(folder, { recursive: true }));
/** A house with levels, also as a streamed SOG in the folder `house` beside it, and its cameras. */
function house() {
  folder ??= mkdtempSync(join(tmpdir(), "rgs-web-house-"));
  const [ply, levels, cameras] = ["house.ply", "house.rgs", "house.json"].map((name) => join(folder, name));
  if (!existsSync(levels)) {
    execFileSync(program("rgs-make-scene"), ["--gaussians", "150k", "--cameras", cameras, ply, "--quiet"]);
    execFileSync(program("rgs-convert"), ["--lod", ply, levels, "--quiet"]);
    execFileSync(program("rgs-convert"), [levels, join(folder, "house", "lod-meta.json"), "--quiet"]);
  }
  return [levels, cameras];
}

for (const device of kDeviceNames) {
  test(`pictures by ${device}`, async (t) => {
    if (!hasChromium) return skip(t, "chromium is not installed");
    if (!hasNginx) return skip(t, "nginx is not installed");
    const server = await startNginx();
    const browser = await launch(device);
    t.after(async () => {
      await browser.close();
      await server.end();
    });
    await build({
      configFile: false,
      logLevel: "error",
      root: fileURLToPath(new URL(".", import.meta.url)),
      base: "./",
      build: { outDir: join(server.files, "page"), target: "es2022", rollupOptions: { input: fileURLToPath(new URL("page.html", import.meta.url)) } },
    });

    const problems = [];
    const open = async (scene, asDefined = true) => {
      const page = await newPage(browser);
      // The engine says on the console what it also gives to the callback.
      if (scene) page.on("console", (message) => ["error", "warning"].includes(message.type()) && problems.push(message.text()));
      page.on("pageerror", (error) => problems.push(String(error)));
      await page.goto(`${server.url}/page/page.html`);
      assert.equal(await page.evaluate(([type, asDefined]) => window.engine.start(type, asDefined), [device, asDefined]), device);
      if (scene) {
        const served = join(server.files, basename(scene));
        if (scene !== served) copyFileSync(scene, served);
        await page.evaluate((name) => window.engine.load(`/${name}`), basename(scene));
      }
      return page;
    };
    /** Least PSNR over some views. `page`: one that draws by itself. */
    const compare = async (t, scene, cameras, views, more = [], itself = undefined) => {
      const page = itself ?? (await open(scene));
      const list = readCameras(cameras);
      const pictures = join(server.files, "pictures");
      const paths = renderAll(scene, cameras, views, kSize, pictures, more);
      const found = [];
      for (const [i, path] of paths.entries()) {
        const drawn = bytes(await page.evaluate(([camera, [w, h]]) => window.engine.picture(camera, w, h), [list[views[i]], kSize]));
        if (!itself) drawings.get(device).set(`${basename(scene)} ${views[i]}`, drawn);
        const expected = await page.evaluate((url) => window.engine.decode(url), `/pictures/views/${basename(path)}`);
        found.push(psnr(drawn, bytes(expected)));
      }
      if (!itself) await page.close();
      t.diagnostic(`${[basename(scene), ...more].join(" ")}: ${found.map((db) => db.toFixed(1)).join(" ")} dB`);
      return Math.min(...found);
    };

    for (const name of ["packed.rgs", "direct.rgs", "levels.rgs"]) {
      await t.test(`a generated scene, ${name}`, async (t) => {
        // Of a file with levels of detail the asset holds the finest.
        const more = name === "levels.rgs" ? ["--detail", "0"] : [];
        const least = await compare(t, join(scenes(), name), join(scenes(), "cameras.json"), [0, 2, 5], more);
        assert.ok(least >= kLeastDb, `${least} dB`);
      });
    }
    // Wider and narrower than the usual one, and opacity for it.
    for (const [name, declared] of [["wide.rgs", ["--aa", "classic", "--low-pass", "1.5"]], ["mip.rgs", ["--aa", "mip"]]]) {
      await t.test(`what a file declares of its low-pass, ${name}`, async (t) => {
        const made = join(server.files, "made");
        mkdirSync(made, { recursive: true });
        execFileSync(program("rgs-convert"), [...declared, "--quiet", join(scenes(), "scene.ply"), join(made, name)]);
        const least = await compare(t, join(made, name), join(scenes(), "cameras.json"), [0, 2]);
        assert.ok(least >= kLeastDb, `${least} dB`);
      });
    }
    await t.test("12 views of a trained scene", async (t) => {
      const data = process.env.RGS_DATA_DIR;
      const scene = process.env.RGS_WEB_SOUTH;
      if (!scene) {
        if ((process.env.RGS_REQUIRE_DATA ?? "0") !== "0") throw new Error("RGS_REQUIRE_DATA is set, but there is no south");
        return t.skip("there is no south in RGS_DATA_DIR");
      }
      const views = Array.from({ length: 12 }, (_, i) => 10 * i);
      const least = await compare(t, scene, join(data, "south", "cameras.json"), views);
      assert.ok(least >= kLeastDb, `${least} dB`);
    });
    await t.test("by itself the engine draws a file as it draws its PLY", async (t) => {
      const [camera] = readCameras(join(scenes(), "cameras.json"));
      const sog = join(server.files, "scene.sog");
      execFileSync(program("rgs-convert"), [join(scenes(), "scene.ply"), sog, "--quiet"]);
      for (const file of [join(scenes(), "direct.rgs"), sog]) {
        const ply = join(server.files, "itself.ply");
        execFileSync(program("rgs-convert"), [file, ply, "--quiet", "--overwrite"]);
        const found = [];
        for (const scene of [ply, file]) {
          const page = await open(scene, false);
          found.push(bytes(await page.evaluate(([camera, [w, h]]) => window.engine.picture(camera, w, h), [camera, kSize])));
          await page.close();
        }
        const db = psnr(...found);
        assert.ok(new Set(new Uint32Array(found[0].buffer.slice(0))).size > 500, "a picture");
        t.diagnostic(`${basename(file)}: ${db.toFixed(1)} dB`);
        assert.ok(db >= kLeastDbOfPly, `${db} dB`);
      }
    });
    // Its low-pass is 0.3 square half pixels: with antiAlias near Mip-Splatting's 0.1 px^2, without it far from the 0.3 px^2 of 3DGS.
    await t.test("by itself the engine draws a streamed SOG as rgs-render with the engine's low-pass", async (t) => {
      const [levels, cameras] = house();
      cpSync(join(levels, "..", "house"), join(server.files, "house"), { recursive: true });
      const page = await open(undefined, false);
      await page.evaluate(() => window.engine.load("/house/lod-meta.json"));
      for (const [antiAlias, more] of [[false, ["--low-pass", "0.075"]], [true, ["--aa", "mip"]]]) {
        await page.evaluate((antiAlias) => window.engine.set({ antiAlias }), antiAlias);
        // The engine sorts where a camera has moved.
        const least = await compare(t, levels, cameras, antiAlias ? [2] : [0], ["--detail", "0", ...more], page);
        assert.ok(least >= kLeastDb, `${least} dB`);
      }
      await page.close();
    });
    await t.test("a damaged file is an error", async () => {
      const page = await open(undefined);
      copyFileSync(join(golden, "reject", "checksum_GEOM.rgs"), join(server.files, "damaged.rgs"));
      const found = await page.evaluate(() => window.engine.load("/damaged.rgs").then(String, ({ name, code, offset }) => ({ name, code, offset: typeof offset })));
      assert.deepEqual(found, { name: "RgsError", code: "checksum_mismatch", offset: "number" });
      await page.close();
    });
    await t.test("a device that was lost comes back with the scene", async () => {
      const page = await open(join(scenes(), "packed.rgs"));
      const cameras = readCameras(join(scenes(), "cameras.json"));
      const draw = (view) => page.evaluate(([camera, [w, h]]) => window.engine.picture(camera, w, h), [cameras[view], kSize]);
      const before = await draw(0);
      const nProblems = problems.length;
      await (await browser.newBrowserCDPSession()).send("Browser.crashGpuProcess");
      await page.evaluate(() => window.engine.restored());
      // The engine sorts where a camera has moved.
      await draw(2);
      assert.ok((await draw(0)) === before, "another picture");
      for (const problem of problems.splice(nProblems)) assert.match(problem, /CONTEXT_LOST|valid external Instance reference/);
      await page.close();
    });
    await t.test("the page has nothing to complain of", () => assert.deepEqual(problems, []));
  });
}

test("every device draws the same", (t) => {
  const [first, ...others] = kDeviceNames.map((device) => drawings.get(device));
  if ([first, ...others].some(({ size }) => size === 0)) return t.skip("not every device has drawn");
  for (const other of others) {
    assert.deepEqual([...other.keys()], [...first.keys()]);
    const found = [...other].map(([name, drawn]) => psnr(drawn, first.get(name)));
    t.diagnostic(`${found.map((db) => db.toFixed(1)).join(" ")} dB`);
    assert.ok(Math.min(...found) >= kLeastDbBetween, `${Math.min(...found)} dB`);
  }
});
