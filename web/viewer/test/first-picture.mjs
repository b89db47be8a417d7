// first-picture.mjs - measures: node first-picture.mjs FILE... prints the milliseconds until something of each file is seen, from the
// beginning of the page, and from choosing the file in a page that is there; then until all of it is. Chromium in software.
// SPDX-License-Identifier: Apache-2.0
import { statSync } from "node:fs";
import { basename } from "node:path";
import { launch } from "../../reader/test/chromium.mjs";
import { newPage, startServer } from "./server.mjs";

const kRuns = 3;
const kSize = { width: 320, height: 240 };

/** When the picture is on the device, not only asked for: reading a pixel waits for it. */
function watch() {
  window.pictures = {};
  new PerformanceObserver((list) => {
    for (const { name, startTime } of list.getEntries()) {
      const gl = byId("picture").getContext("webgl2");
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      window.pictures[name] = performance.now() - startTime;
    }
  }).observe({ type: "measure" });
}

async function measure(browser, path, chosen) {
  const name = basename(path);
  const view = chosen ? null : { version: 1, scenes: [{ name, url: `scenes/0/${name}`, bytes: statSync(path).size }], cameras: null, photos: [], frames: null };
  const server = await startServer({ view, files: { [`scenes/0/${name}`]: path } });
  const page = await newPage(browser, { viewport: kSize });
  try {
    await page.addInitScript(watch);
    await page.goto(server.url);
    if (chosen) {
      await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
      await page.setInputFiles("#file", path);
    }
    const what = `first picture of ${name}`;
    await page.waitForFunction((what) => what in window.pictures, what, { timeout: 300_000 });
    const first = await page.evaluate((what) => window.pictures[what], what);
    await page.waitForFunction(() => byId("loading").hidden, undefined, { timeout: 300_000 });
    const begin = chosen ? await page.evaluate((name) => performance.getEntriesByName(`open ${name}`)[0].startTime, name) : 0;
    const all = (await page.evaluate(() => performance.now())) - begin;
    return { first, all };
  } finally {
    await page.close();
    await server.end();
  }
}

for (const path of process.argv.slice(2)) {
  for (const chosen of [false, true]) {
    const found = [];
    for (let i = 0; i < kRuns; ++i) {
      const browser = await launch("webgl2");
      found.push(await measure(browser, path, chosen));
      await browser.close();
    }
    const text = (of) => found.map((each) => Math.round(each[of])).sort((a, b) => a - b).join(" ");
    console.log(`${basename(path)}, ${chosen ? "chosen in a page that is there" : "with the page"}: first picture ${text("first")} ms, all of it ${text("all")} ms`);
  }
}
