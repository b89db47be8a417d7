// devices.test.mjs - the page by WebGPU beside the page by WebGL 2, which page.test.mjs looks at.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import test from "node:test";
import { psnr } from "../../playcanvas/test/pictures.mjs";
import { hasChromium, kDeviceNames, launch } from "../../reader/test/chromium.mjs";
import { scenes } from "../../reader/test/dump.mjs";
import { skip } from "../../reader/test/servers.mjs";
import { newPage, startServer } from "./server.mjs";

const kLeastDb = 60;

const paths = { "scenes/0/packed.rgs": "packed.rgs", "scenes/1/levels.rgs": "levels.rgs", "cameras.json": "cameras.json" };
const files = () => Object.fromEntries(Object.entries(paths).map(([url, name]) => [url, join(scenes(), name)]));
const view = {
  version: 1,
  scenes: [
    { name: "packed.rgs", url: "scenes/0/packed.rgs", bytes: 1 },
    { name: "levels.rgs", url: "scenes/1/levels.rgs", bytes: 1 },
  ],
  cameras: "cameras.json",
  photos: [],
  frames: null,
};

/** RGBA of a PNG. */
async function decode(page, png) {
  const base64 = await page.evaluate(async (base64) => {
    const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))]));
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
    context.drawImage(bitmap, 0, 0);
    const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
    return btoa(Array.from(data, (byte) => String.fromCharCode(byte)).join(""));
  }, png.toString("base64"));
  return Buffer.from(base64, "base64");
}

/** What a page shows and saves that was opened by a device, as RGBA, and what its console complains of. */
async function look(device) {
  const server = await startServer({ view, files: files() });
  const browser = await launch(device);
  try {
    const page = await newPage(browser, { viewport: { width: 800, height: 360 } });
    const problems = [];
    page.on("console", (message) => ["error", "warning"].includes(message.type()) && problems.push(message.text()));
    page.on("pageerror", (error) => problems.push(String(error)));
    await page.addInitScript(() => localStorage.setItem("rgs-view panel", "menu"));
    await page.goto(`${server.url}?device=${device}`);
    await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
    const drawnBy = await page.evaluate(() => (byId("picture").getContext("webgl2") ? "webgl2" : "webgpu"));
    await page.locator("#stats").check();
    await page.locator("#detail").fill("0");
    await page.waitForFunction(() => /^60k of 60k Gaussians[^]*60k of 60k Gaussians/.test(byId("overlay").textContent));
    await page.locator("#stats").uncheck();
    await page.locator("#picture").focus();
    await page.keyboard.press("n");
    await page.locator(`#picture[aria-busy="false"]`).waitFor();
    const picture = await decode(page, await page.locator("#picture").screenshot());
    const [download] = await Promise.all([page.waitForEvent("download"), page.locator("#screenshot").click()]);
    const saved = await decode(page, readFileSync(await download.path()));
    await page.getByRole("radio", { name: "Difference" }).click();
    await page.locator("#map").waitFor();
    const difference = await page.locator("#psnr").textContent();
    return { drawnBy, picture, saved, difference, problems };
  } finally {
    await browser.close();
    await server.end();
  }
}

test("every device shows the same page", async (t) => {
  if (!hasChromium) return skip(t, "chromium is not installed");
  const [first, ...others] = await Promise.all(kDeviceNames.map(look));
  assert.equal(first.drawnBy, kDeviceNames[0]);
  assert.ok(new Set(new Uint32Array(first.saved.buffer.slice(0))).size > 500, "a picture");
  for (const [i, other] of others.entries()) {
    assert.equal(other.drawnBy, kDeviceNames[i + 1]);
    assert.deepEqual(other.problems, []);
    const [picture, saved] = [psnr(other.picture, first.picture), psnr(other.saved, first.saved)];
    t.diagnostic(`${picture.toFixed(1)} dB shown, ${saved.toFixed(1)} dB saved, differences ${first.difference} and ${other.difference}`);
    assert.ok(picture >= kLeastDb, `${picture} dB shown`);
    assert.ok(saved >= kLeastDb, `${saved} dB saved`);
    assert.equal(other.difference, first.difference);
  }
});
