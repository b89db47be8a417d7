// draw.test.mjs - draw.mjs: each client by its own defaults draws a scene about as rgs-render does with the client's low-pass.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { existsSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import test from "node:test";
import { program, psnr } from "../../playcanvas/test/pictures.mjs";
import { hasChromium, launch, newPage } from "../../reader/test/chromium.mjs";
import { scenes } from "../../reader/test/dump.mjs";
import { skip } from "../../reader/test/servers.mjs";
import { drawAll, kClients } from "../draw.mjs";

// Low-pass, px^2, as added to the covariance in pixels, halves or quarters of one; SH degree; least PSNR, under those that are seen.
const kExpected = {
  spark: [0.3, 3, 29],
  playcanvas: [0.3 / 4, 3, 33],
  gaussiansplats3d: [0.3, 0, 31],
  gsplatjs: [0.3 / 4, 0, 30.5],
  cesium: [0.3 / 16, 3, 31],
  babylon: [0.3 / 4, 3, 30],
  roofgs: [0.3, 3, 38],
};
const kCentred = ["gsplatjs", "cesium"];

test("pictures by web clients", async (t) => {
  if (!hasChromium) return skip(t, "chromium is not installed");
  const folder = mkdtempSync(join(tmpdir(), "rgs-web-draw-"));
  const browser = await launch();
  const page = await newPage(browser);
  t.after(async () => {
    await browser.close();
    rmSync(folder, { recursive: true });
  });
  const read = async (path) => {
    const rgba = await page.evaluate(async (png) => {
      const bitmap = await createImageBitmap(await (await fetch(`data:image/png;base64,${png}`)).blob());
      const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
      context.drawImage(bitmap, 0, 0);
      return new Uint8Array(context.getImageData(0, 0, bitmap.width, bitmap.height).data.buffer).toBase64();
    }, readFileSync(path, "base64"));
    return Buffer.from(rgba, "base64");
  };
  const scene = join(scenes(), "scene.ply");
  // One view as it is, one of other pixels and another middle.
  const [first, , third] = JSON.parse(readFileSync(join(scenes(), "cameras.json"), "utf8")).map((camera) => {
    const [scale, width, height] = [320 / camera.width, 320, 180];
    return { ...camera, width, height, fx: scale * camera.fx, fy: scale * camera.fy, cx: width / 2, cy: height / 2 };
  });
  const list = (name, cameras) => {
    writeFileSync(join(folder, name), JSON.stringify(cameras));
    return join(folder, name);
  };
  const centred = list("centred.json", [first, { ...third, fy: 1.2 * third.fy }]);
  const all = list("all.json", [first, { ...third, fy: 1.2 * third.fy, cx: 180, cy: 80 }]);
  const nothing = join(folder, "nothing.ply");
  writeFileSync(nothing, "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n");
  const failed = [];
  // --test-timeout alone ends what hangs.
  const draw = (key, jobs, more = {}) => drawAll(key, jobs, { seconds: 3600, say: (text) => failed.push(text), ...more });
  /** Of each view, dB. */
  const compare = async (cameras, out, [lowPass, degree]) => {
    const wanted = `${out}-wanted`;
    const more = ["--low-pass", `${lowPass}`, "--sh-degree", `${degree}`];
    execFileSync(program("rgs-render"), [scene, "--cameras", cameras, "--backend", "cpu", "--out", wanted, "--quiet", "--overwrite", ...more]);
    const found = [];
    for (const { name } of [first, third]) found.push(psnr(await read(join(out, `${name}.png`)), await read(join(wanted, `${name}.png`))));
    return found;
  };

  for (const [key, [client, , apis]] of Object.entries(kClients)) {
    for (const api of apis) {
      await t.test(`${client} by ${api}`, async (t) => {
        const out = join(folder, key, api);
        const cameras = kCentred.includes(key) ? centred : all;
        assert.equal(await draw(key, [{ scene, cameras, out }], { api }), 1, failed.join("\n"));
        const about = JSON.parse(readFileSync(join(out, "client.json"), "utf8"));
        assert.match(about.version, /^\d+\.\d+\.\d+$/);
        assert.match(about.browser, /Chrome/);
        assert.deepEqual([about.client, about.key, about.api, about.error], [client, key, api, undefined]);
        const found = await compare(cameras, out, kExpected[key]);
        t.diagnostic(`${about.version}: ${found.map((db) => db.toFixed(1)).join(" ")} dB`);
        assert.ok(Math.min(...found) >= kExpected[key][2], `${found} dB`);
      });
    }
  }

  await t.test("a scene that is refused has a reason instead of pictures, and the next one has pictures", async () => {
    const [none, out] = [join(folder, "none"), join(folder, "next")];
    const jobs = [{ scene: nothing, cameras: all, out: none }, { scene, cameras: all, out }];
    assert.equal(await draw("roofgs", jobs), 1);
    assert.match(JSON.parse(readFileSync(join(none, "client.json"), "utf8")).error, /not 3D Gaussian splats/);
    assert.match(failed.pop(), /^RoofGS: .*nothing\.ply: .*not 3D Gaussian splats/);
    assert.deepEqual([none, out].map((where) => existsSync(join(where, `${first.name}.png`))), [false, true]);
  });

  await t.test("our own page that is broken on purpose draws other pictures", async (t) => {
    const out = join(folder, "broken");
    await draw("roofgs", [{ scene, cameras: all, out }], { replace: [["4 * lowPassPx2", "0.3"]] });
    const found = await compare(all, out, kExpected.roofgs);
    t.diagnostic(`${found.map((db) => db.toFixed(1)).join(" ")} dB`);
    assert.ok(Math.max(...found) < kExpected.roofgs[2], `${found} dB`);
    await assert.rejects(draw("roofgs", [], { replace: [["no such text", ""]] }), /no such text/);
  });
});
