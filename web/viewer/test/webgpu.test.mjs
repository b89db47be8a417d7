// webgpu.test.mjs - the page by WebGPU: beside the CPU renderer, and the engine, which takes over where WebGPU cannot draw.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import test from "node:test";
import { program, psnr, readCameras, renderAll } from "../../playcanvas/test/pictures.mjs";
import { hasChromium, launch } from "../../reader/test/chromium.mjs";
import { scenes } from "../../reader/test/dump.mjs";
import { skip } from "../../reader/test/servers.mjs";
import { newPage, startServer } from "./server.mjs";

const kSize = { width: 240, height: 180 };
const kLeastDb = 50;
/** The engine blends in 8 bits. */
const kLeastEngineDb = 35;
const kNames = ["packed.rgs", "levels.rgs", "wide.rgs", "scene.ply"];

test("by WebGPU", async (t) => {
  if (!hasChromium) return skip(t, "chromium is not installed");
  const cameras = join(scenes(), "cameras.json");
  const list = readCameras(cameras);
  const folder = mkdtempSync(join(tmpdir(), "rgs-web-webgpu-"));
  const browser = await launch("webgpu");
  t.after(async () => {
    await browser.close();
    rmSync(folder, { recursive: true });
  });

  /** A page with scenes by their names; `isAsked`: also by WebGPU in software. */
  const begin = async (t, names, { isAsked = true, allowed = [], more = {}, limits, before = () => undefined } = {}) => {
    const view = { version: 1, scenes: names.map((name) => ({ name, url: `scenes/0/${name}`, bytes: 1 })), cameras: "cameras.json", photos: [], frames: null };
    const files = { ...Object.fromEntries(kNames.map((name) => [`scenes/0/${name}`, join(scenes(), name)])), ...more, "cameras.json": cameras };
    const server = await startServer({ view, files });
    const page = await newPage(browser, { viewport: kSize });
    const problems = [];
    page.on("console", (message) => ["error", "warning"].includes(message.type()) && problems.push(message.text()));
    page.on("pageerror", (error) => problems.push(String(error)));
    t.after(async () => {
      await page.close();
      await server.end();
      assert.deepEqual(problems.filter((text) => !allowed.some((pattern) => pattern.test(text))), []);
    });
    await page.addInitScript((limits) => {
      window.devices = [];
      const { requestDevice } = GPUAdapter.prototype;
      GPUAdapter.prototype.requestDevice = async function (...asked) {
        window.devices.push(await requestDevice.apply(this, asked));
        const { createBuffer } = window.devices.at(-1);
        window.largest = 0;
        window.devices.at(-1).createBuffer = function (how) {
          window.largest = Math.max(window.largest, how.size);
          return createBuffer.call(this, how);
        };
        if (limits) Object.defineProperty(window.devices.at(-1), "limits", { value: limits });
        return window.devices.at(-1);
      };
    }, limits);
    await before(page);
    await page.goto(`${server.url}?chrome=none${isAsked ? "&renderer=webgpu" : ""}`);
    await page.waitForFunction(() => document.querySelector("rgs-view[data-ready]") || byId("errors")?.children.length > 0);
    return { page, server, hasEngine: () => server.requests.some((line) => /engine-/.test(line)) };
  };
  const apiOf = (page) => page.evaluate(() => (byId("picture").getContext("webgpu") ? "webgpu" : byId("picture").getContext("webgl2") ? "webgl2" : "none"));
  /** A control that may be hidden. */
  const choose = (page, id, value) =>
    page.evaluate(([id, value]) => {
      const control = byId(id);
      if (typeof value === "boolean") control.checked = value;
      else control.value = value;
      for (const name of ["input", "change"]) control.dispatchEvent(new Event(name));
    }, [id, value]);
  const rest = (page) => page.locator(`#picture[aria-busy="false"]`).waitFor();
  const fly = async (page, i) => {
    assert.ok(await page.evaluate((name) => document.querySelector("rgs-view").flyTo(name), list[i].img_name));
    await rest(page);
  };
  /** RGBA of a PNG in base64. */
  const decode = async (page, png) => Buffer.from(await page.evaluate(async (base64) => {
    const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))]));
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
    context.drawImage(bitmap, 0, 0);
    const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
    return btoa(Array.from(data, (byte) => String.fromCharCode(byte)).join(""));
  }, png), "base64");
  const shown = async (page) => {
    await rest(page);
    return decode(page, (await page.locator("#picture").screenshot()).toString("base64"));
  };
  const saved = async (page) => decode(page, await page.evaluate(async () => {
    const blob = await document.querySelector("rgs-view").screenshot();
    return btoa(Array.from(new Uint8Array(await blob.arrayBuffer()), (byte) => String.fromCharCode(byte)).join(""));
  }));
  const expected = async (page, name, i, ...more) => {
    const [path] = renderAll(name.includes("/") ? name : join(scenes(), name), cameras, [i], [kSize.width, kSize.height], folder, more);
    return decode(page, readFileSync(path).toString("base64"));
  };

  await t.test("the picture is that of the CPU renderer, without the engine", async (t) => {
    const { page, hasEngine } = await begin(t, ["packed.rgs"]);
    for (const i of [0, 3, 5]) {
      await fly(page, i);
      const [picture, screenshot] = [await shown(page), await saved(page)];
      assert.deepEqual(picture, screenshot, `view ${i}`);
      const db = psnr(picture, await expected(page, "packed.rgs", i));
      t.diagnostic(`view ${i}: ${db.toFixed(1)} dB`);
      assert.ok(db >= kLeastDb, `${db} dB`);
    }
    const before = await shown(page);
    await choose(page, "background", "#ffffff");
    await choose(page, "sh", "0");
    const db = psnr(await shown(page), await expected(page, "packed.rgs", 5, "--background", "1,1,1", "--sh-degree", "0"));
    assert.ok(db >= kLeastDb, `${db} dB`);
    assert.ok(psnr(await shown(page), before) < 40);
    assert.equal(await apiOf(page), "webgpu");
    assert.ok(!hasEngine());
  });

  await t.test("levels of detail, their colours and boxes", async (t) => {
    const { page } = await begin(t, ["levels.rgs"]);
    for (const detail of [8, 1]) {
      await choose(page, "detail", String(detail));
      await fly(page, 2);
      const db = psnr(await shown(page), await expected(page, "levels.rgs", 2, "--detail", String(detail)));
      t.diagnostic(`detail ${detail}: ${db.toFixed(1)} dB`);
      assert.ok(db >= kLeastDb, `${db} dB`);
    }
    const before = await shown(page);
    const yellow = (pixels) => {
      let n = 0;
      for (let i = 0; i < pixels.length; i += 4) n += pixels[i] > 230 && pixels[i + 1] > 180 && pixels[i + 2] < 60;
      return n;
    };
    await choose(page, "boxes", true);
    const boxes = yellow(await shown(page)) - yellow(before);
    assert.ok(boxes > 100, `${boxes} pixels`);
    await choose(page, "boxes", false);
    await choose(page, "tint", "level");
    assert.ok(psnr(await shown(page), before) < 25);
    await choose(page, "tint", "none");
    assert.deepEqual(await shown(page), before);
  });

  await t.test("two scenes, their difference, and a compressed PLY, for which the engine draws both", async (t) => {
    const compressed = join(folder, "c.compressed.ply");
    execFileSync(program("rgs-convert"), ["--quiet", join(scenes(), "scene.ply"), compressed]);
    const { page, hasEngine } = await begin(t, ["packed.rgs", "levels.rgs"], { more: { "c.compressed.ply": compressed } });
    await choose(page, "detail", "8");
    await fly(page, 1);
    const whole = [];
    for (const mode of ["split=1", "split=0"]) {
      await page.evaluate((mode) => (location.hash = location.hash.replace(/split=[^&]*/, mode)), mode);
      whole.push(await shown(page));
    }
    await page.evaluate(() => (location.hash = location.hash.replace(/split=[^&]*/, "split=0.25")));
    const both = await shown(page);
    const border = kSize.width / 4;
    // Apart from the handle.
    const differing = [0, 1].map((side) => {
      let n = 0;
      for (let y = 0; y < kSize.height / 4; ++y) {
        for (let x = side === 0 ? 0 : border; x < (side === 0 ? border : kSize.width); ++x) {
          const at = 4 * (y * kSize.width + x);
          if (Math.abs(x - border) >= 4) n += both.readInt32LE(at) !== whole[side].readInt32LE(at);
        }
      }
      return n;
    });
    assert.deepEqual(differing, [0, 0]);
    assert.ok(psnr(whole[0], whole[1]) < 40);
    await page.evaluate(() => byId("modes").querySelector("[value=difference]").click());
    await page.waitForFunction(() => !byId("map").hidden);
    const db = psnr(await expected(page, "packed.rgs", 1), await expected(page, "levels.rgs", 1, "--detail", "8"));
    assert.ok(Math.abs(parseFloat(await page.locator("#psnr").textContent()) - db) < 0.2, `${await page.locator("#psnr").textContent()}, not ${db} dB`);
    assert.ok(!hasEngine());
    await page.evaluate(() => document.querySelector("rgs-view").compare("c.compressed.ply"));
    assert.equal(await apiOf(page), "webgl2");
    assert.ok(hasEngine());
    await page.evaluate(() => byId("modes").querySelector("[value=single]").click());
    const left = psnr(await shown(page), await expected(page, "packed.rgs", 1));
    assert.ok(left > kLeastEngineDb, `${left} dB of the left scene`);
  });

  await t.test("a PLY and its .rgs are compared without the engine, and a broken one changes nothing", async (t) => {
    const broken = join(folder, "broken.ply");
    writeFileSync(broken, readFileSync(join(scenes(), "scene.ply")).subarray(0, -1));
    const { page, hasEngine } = await begin(t, ["scene.ply", "packed.rgs"], { more: { "broken.ply": broken } });
    // SH of 60k Gaussians of degree 3, and no room for more.
    assert.equal(await page.evaluate(() => window.largest), 60_000 * 4 * 48);
    await fly(page, 1);
    await page.evaluate(() => byId("modes").querySelector("[value=difference]").click());
    await page.waitForFunction(() => !byId("map").hidden);
    const db = psnr(await expected(page, "scene.ply", 1), await expected(page, "packed.rgs", 1));
    assert.ok(Math.abs(parseFloat(await page.locator("#psnr").textContent()) - db) < 0.2, `${await page.locator("#psnr").textContent()}, not ${db} dB`);
    await page.evaluate(() => byId("modes").querySelector("[value=single]").click());
    const before = await shown(page);
    const found = psnr(before, await expected(page, "scene.ply", 1));
    t.diagnostic(`${found.toFixed(1)} dB`);
    assert.ok(found >= kLeastDb, `${found} dB`);
    await choose(page, "sh", "0");
    assert.ok(psnr(await shown(page), await expected(page, "scene.ply", 1, "--sh-degree", "0")) >= kLeastDb);
    await choose(page, "sh", "3");
    await page.evaluate(() => document.querySelector("rgs-view").compare("broken.ply"));
    assert.match(await page.locator("#errors p").first().textContent(), /^broken\.ply is damaged: .*\(truncated/);
    await page.evaluate(() => byId("errors").replaceChildren());
    assert.equal(psnr(await shown(page), before), Infinity);
    assert.equal(await apiOf(page), "webgpu");
    assert.ok(!hasEngine());
  });

  await t.test("a PLY is drawn in the axes that it declares", async (t) => {
    const turned = join(folder, "turned.ply");
    execFileSync(program("rgs-convert"), ["--quiet", "--to-axes", "left,up,forward", join(scenes(), "scene.ply"), turned]);
    const kept = join(folder, "turned.rgs");
    execFileSync(program("rgs-convert"), ["--quiet", turned, kept]);
    const more = { "scenes/0/turned.rgs": kept, "scenes/0/turned.ply": turned };
    const { page } = await begin(t, ["turned.ply"], { more });
    await fly(page, 2);
    const db = psnr(await shown(page), await expected(page, turned, 2));
    t.diagnostic(`${db.toFixed(1)} dB`);
    assert.ok(db >= kLeastDb, `${db} dB`);
    assert.ok(psnr(await shown(page), await expected(page, "scene.ply", 2)) >= kLeastDb, "as it was before");
    await page.evaluate(() => document.querySelector("rgs-view").compare("scenes/0/turned.rgs"));
    assert.match(await page.locator("#errors p").textContent(), /turned\.rgs declares other axes than .* Open turned\.rgs first/);
    for (const names of [["turned.rgs", "turned.ply"], ["turned.ply", "turned.rgs"]]) {
      const { page } = await begin(t, names, { more });
      await page.evaluate(() => byId("modes").querySelector("[value=difference]").click());
      await page.waitForFunction(() => !byId("map").hidden);
      const equal = parseFloat(await page.locator("#psnr").textContent());
      assert.ok(equal > 40, `${names}: ${equal} dB`);
      assert.equal(await page.locator("#errors p").count(), 0);
    }
  });

  await t.test("without room for a picture the page says so, and draws the next one that has room", async (t) => {
    const limits = { maxStorageBufferBindingSize: 2 ** 22, maxBufferSize: 2 ** 22, maxTextureDimension2D: 8192 };
    const { page, hasEngine } = await begin(t, ["wide.rgs"], { limits });
    await choose(page, "detail", "16");
    await fly(page, 0);
    assert.equal(await page.locator("#errors p").count(), 0);
    await choose(page, "detail", "0.25");
    await page.locator("#errors p").waitFor({ state: "attached" });
    assert.match(await page.locator("#errors p").textContent(), /no room for this picture.*coarser detail/);
    assert.equal(await page.evaluate(() => document.querySelector("rgs-view").screenshot().catch(({ code }) => code)), "limit_exceeded");
    await choose(page, "detail", "16");
    await page.locator("#errors p").waitFor({ state: "detached" });
    assert.equal(await apiOf(page), "webgpu");
    assert.ok(!hasEngine());
  });

  await t.test("where the first picture has no room the engine draws it", async (t) => {
    const many = join(folder, "many.ply");
    execFileSync(program("rgs-make-scene"), ["--quiet", "--seed", "1", "--gaussians", "150k", "--degree", "0", many]);
    const limits = { maxStorageBufferBindingSize: 2 ** 20, maxBufferSize: 2 ** 20, maxTextureDimension2D: 8192 };
    const { page } = await begin(t, ["many.ply"], { limits, more: { "scenes/0/many.ply": many } });
    await page.waitForFunction(() => byId("picture").getContext("webgl2") !== null);
    await rest(page);
    assert.equal(await page.locator("#errors p").count(), 0);
  });

  await t.test("after a loss WebGPU draws again, after another one the engine", async (t) => {
    const { page } = await begin(t, ["packed.rgs"], { allowed: [/device|lost/i] });
    await fly(page, 4);
    const before = await shown(page);
    const lose = async () => {
      await page.evaluate(() => {
        byId("status").textContent = "";
        window.devices.at(-1).destroy();
      });
      await page.waitForFunction(() => byId("status").textContent === "The graphics device is back");
      assert.equal(await page.locator("#errors p").count(), 0);
    };
    await lose();
    assert.deepEqual(await shown(page), before);
    assert.equal(await apiOf(page), "webgpu");
    await lose();
    assert.equal(await apiOf(page), "webgl2");
    assert.ok(psnr(await shown(page), before) > kLeastEngineDb);
    await fly(page, 0);
    assert.ok(psnr(await shown(page), before) < 30, "another view");
  });

  await t.test("a viewer that ends while WebGPU is tried again starts no engine", async (t) => {
    const { page, server, hasEngine } = await begin(t, ["packed.rgs"], { allowed: [/device|lost|404/i] });
    await page.evaluate(async () => {
      let answer;
      const asked = new Promise((resolve) => {
        navigator.gpu.requestAdapter = () => {
          resolve();
          return new Promise((done) => (answer = done));
        };
      });
      window.devices.at(-1).destroy();
      await asked;
      document.querySelector("rgs-view").remove();
      answer(null);
    });
    await page.evaluate(() => fetch("last"));
    assert.ok(server.requests.some((line) => /last/.test(line)));
    assert.ok(!hasEngine());
  });

  await t.test("an engine that cannot be fetched is said to be what is missing", async (t) => {
    const { page } = await begin(t, ["packed.rgs"], { isAsked: false, allowed: [/Failed to load|ERR_FAILED/], before: (page) => page.route(/engine-/, (route) => route.abort()) });
    assert.match(await page.locator("#errors p").textContent(), /^The PlayCanvas engine could not be fetched/);
    const compressed = join(folder, "d.compressed.ply");
    execFileSync(program("rgs-convert"), ["--quiet", join(scenes(), "scene.ply"), compressed]);
    const other = await begin(t, ["d.compressed.ply"], { more: { "scenes/0/d.compressed.ply": compressed }, allowed: [/Failed to load|ERR_FAILED/], before: (page) => page.route(/engine-/, (route) => route.abort()) });
    assert.match(await other.page.locator("#errors p").textContent(), /could not be fetched.*\(open_failed: the PlayCanvas engine: /);
  });

  await t.test("where the device's memory ends the engine draws", async (t) => {
    const { page } = await begin(t, ["packed.rgs"], { allowed: [/size|buffer|WebGPU/i] });
    const before = await shown(page);
    await page.evaluate(() => {
      const [device] = window.devices;
      device.createBuffer({ size: 2 ** 50, usage: GPUBufferUsage.STORAGE });
      // The browser hands over what it was asked for.
      device.queue.submit([]);
    });
    await page.waitForFunction(() => byId("picture").getContext("webgl2") !== null);
    assert.ok(psnr(await shown(page), before) > kLeastEngineDb);
    assert.equal(await page.locator("#errors p").count(), 0);
  });

  await t.test("an adapter in software is not asked unless the address asks for it", async (t) => {
    const { page } = await begin(t, ["packed.rgs"], { isAsked: false });
    assert.equal(await apiOf(page), "webgl2");
  });
});
