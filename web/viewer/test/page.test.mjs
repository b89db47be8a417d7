// page.test.mjs - the page in a real browser, by what a person sees and does.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { existsSync, mkdirSync, mkdtempSync, readdirSync, readFileSync, rmSync, statSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { basename, dirname, join } from "node:path";
import test, { after, before } from "node:test";
import { fileURLToPath, pathToFileURL } from "node:url";
import { open } from "@roofgs/reader";
import { byProgramOf } from "../../convert/test/same.mjs";
import { program, readCameras } from "../../playcanvas/test/pictures.mjs";
import { hasChromium, launch } from "../../reader/test/chromium.mjs";
import { golden, scenes } from "../../reader/test/dump.mjs";
import { skip } from "../../reader/test/servers.mjs";
import { dist, newPage, startServer } from "./server.mjs";

const kSize = { width: 800, height: 360 };

let browser;
let folder;
before(async () => {
  if (!hasChromium) return;
  folder = mkdtempSync(join(tmpdir(), "rgs-web-viewer-"));
  browser = await launch("webgl2");
});
after(async () => {
  await browser?.close();
  if (folder) rmSync(folder, { recursive: true });
});

const scene = (name) => ({ name, url: `scenes/0/${name}`, bytes: 1 });

/** One test with a page of its own; `problems` are what the console complains of. `panel`: open since the last visit. */
function inBrowser(name, { view = null, files = {}, frame = null, hold, ranges = true, size = kSize, hasTouch = false, address = "", allowed = [], waits = true, panel = "menu" }, body) {
  test(name, async (t) => {
    if (!browser) return skip(t, "chromium is not installed");
    if (!existsSync(dist)) throw new Error("web/viewer is not built: sh scripts/test_web.sh");
    const server = await startServer({ view, files, frame, hold, ranges });
    const context = await browser.newContext({ viewport: size, hasTouch, acceptDownloads: true });
    await context.addInitScript((panel) => localStorage.getItem("rgs-view panel") ?? localStorage.setItem("rgs-view panel", panel), panel);
    const page = await newPage(context);
    const problems = [];
    page.on("console", (message) => message.type() === "error" && problems.push(message.text()));
    page.on("pageerror", (error) => problems.push(String(error)));
    t.after(async () => {
      await context.close();
      await server.end();
    });
    await page.goto(`${server.url}${address}`);
    if (waits) await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
    await body({ t, page, server, context });
    const bad = problems.filter((text) => !allowed.some((pattern) => pattern.test(text)));
    assert.deepEqual(bad, []);
  });
}

const k404 = /Failed to load resource.*404/;
const two = {
  view: { version: 1, scenes: [scene("packed.rgs"), { ...scene("low.rgs"), url: "scenes/1/low.rgs" }], cameras: "cameras.json", photos: [], frames: null },
  files: () => ({ "scenes/0/packed.rgs": join(scenes(), "packed.rgs"), "scenes/1/low.rgs": join(scenes(), "low.rgs"), "cameras.json": join(scenes(), "cameras.json") }),
};
const one = {
  view: { ...two.view, scenes: [scene("packed.rgs")] },
  files: two.files,
};

/** Until the picture no longer changes by itself. */
const settled = (page) => page.locator(`#picture[aria-busy="false"]`).waitFor();
/** The picture at rest, as PNG in base64. */
async function still(page, selector = "#picture") {
  await settled(page);
  return (await page.locator(selector).screenshot()).toString("base64");
}
const text = (page, selector) => page.locator(selector).textContent();
/** The address as the page has it: the browser tells later. */
const address = (page) => page.evaluate(() => location.href);
const hashOf = async (page) => new URL(await address(page)).hash;
const errors = (page) => page.locator("#errors p").allTextContents();
/** Until the picture is not one colour; a part of a scene may have few. */
async function untilDrawn(page, least = 500) {
  const colours = async () => {
    const shot = (await page.locator("#stage").screenshot()).toString("base64");
    return page.evaluate(async (base64) => {
      const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))]));
      const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
      context.drawImage(bitmap, 0, 0);
      const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
      const found = new Set();
      for (let i = 0; i < data.length; i += 4) found.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2]);
      return found.size;
    }, shot);
  };
  while ((await colours()) < least);
}

// So high that cameras are in sight before there is a scene.
inBrowser("a scene with its cameras", { ...one, files: one.files(), size: { width: 800, height: 1000 } }, async ({ t, page, server }) => {
  assert.equal(await text(page, "#title"), "packed.rgs");
  assert.match(await page.getAttribute("#picture", "aria-label"), /packed\.rgs, 60k Gaussians/);
  await untilDrawn(page);
  await page.locator("#stats").check();
  const size = `${(statSync(join(scenes(), "packed.rgs")).size / 1e6).toFixed(1)} MB`;
  await page.waitForFunction((all) => byId("overlay").textContent.includes(all), `60k of 60k Gaussians, ${size} of ${size}`);
  // Nothing but what it was given.
  const beyond = server.requests.filter((line) => !/^GET (|assets\/[\w-]+\.(js|css|wasm)|view\.json|cameras\.json|scenes\/0\/packed\.rgs)$/.test(line));
  assert.deepEqual(beyond, []);
  assert.ok(server.bytes["scenes/0/packed.rgs"] < 1.1 * readFileSync(join(scenes(), "packed.rgs")).length, "read once");
  assert.equal(await page.locator("#cameras button").count(), 8);
  await page.locator("#views").click();
  await page.waitForFunction(() => {
    const canvas = byId("cameras").querySelector("canvas");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return new Set(new Uint32Array(data.buffer)).size > 100;
  });
  t.diagnostic(await text(page, "#overlay"));
});

/** Drags the handle on the border to a share of the picture's width. */
async function slide(page, share) {
  const [handle, stage] = [await page.locator("#split").boundingBox(), await page.locator("#stage").boundingBox()];
  const [middle, y] = [handle.x + handle.width / 2, handle.y + handle.height / 2];
  // At both ends half of the handle is outside the picture.
  const x = Math.min(stage.x + stage.width - 2, Math.max(stage.x + 2, middle));
  await page.mouse.move(x, y);
  await page.mouse.down();
  await page.mouse.move(x + stage.x + share * stage.width - middle, y);
  await page.mouse.up();
}

inBrowser("the slider moves by keys and pointer", { ...two, files: two.files(), panel: "" }, async ({ page }) => {
  assert.equal(await text(page, "#title"), "packed.rgs | low.rgs");
  const split = page.getByRole("slider", { name: "Divider between the two pictures" });
  await split.waitFor();
  const value = async () => Number(await split.getAttribute("aria-valuenow"));
  assert.equal(await value(), 500);
  await split.focus();
  for (const key of ["ArrowRight", "ArrowRight", "Shift+ArrowLeft"]) await page.keyboard.press(key);
  assert.equal(await value(), 420);
  await page.keyboard.press("End");
  assert.equal(await value(), 1000);
  assert.ok(await page.locator("#right").isHidden());
  await page.keyboard.press("Home");
  assert.ok(await page.locator("#left").isHidden());
  await page.keyboard.press("Shift+ArrowRight");
  const box = await page.locator("#stage").boundingBox();
  await slide(page, 0.25);
  assert.ok(Math.abs((await value()) - 250) < 3, `${await value()}`);
  // The handle is where the border is, in the picture's middle.
  const handle = await split.boundingBox();
  assert.ok(Math.abs(handle.x + handle.width / 2 - box.x - box.width / 4) < 2, `${handle.x}`);
  await page.waitForFunction(() => /mode=slider&split=0\.2/.test(location.hash));
});

const leftAndLevels = { view: { ...two.view, scenes: [scene("packed.rgs"), { name: "levels.rgs", url: "scenes/1/levels.rgs", bytes: 1 }] } };
inBrowser("the slider has one scene on its left and the other on its right", { ...leftAndLevels, files: { ...two.files(), "scenes/1/levels.rgs": join(scenes(), "levels.rgs") } }, async ({ page }) => {
  // The right one alone has pages, and so colours of them.
  await page.locator("#tint").selectOption("level");
  const at = async (split) => {
    await slide(page, split);
    return still(page);
  };
  const [left, right, both] = [await at(1), await at(0), await at(0.4)];
  // Apart from the handle and what else lies over the picture.
  const differing = await page.evaluate(async (all) => {
    const [left, right, both] = await Promise.all(
      all.map(async (base64) => {
        const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))]));
        const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
        context.drawImage(bitmap, 0, 0);
        const [y, rows] = [Math.round(0.2 * bitmap.height), Math.round(0.2 * bitmap.height)];
        return { width: bitmap.width, rows, pixels: new Uint32Array(context.getImageData(0, y, bitmap.width, rows).data.buffer) };
      }),
    );
    const { width, rows } = both;
    const border = 0.4 * width;
    const n = { left: 0, right: 0, scenes: 0 };
    for (let x = 0; x < width; ++x) {
      for (let y = 0; y < rows; ++y) {
        const i = y * width + x;
        // The line itself, and those at both ends.
        if (Math.abs(x - border) < 4 || x < 4 || x > width - 4) continue;
        n.scenes += left.pixels[i] !== right.pixels[i];
        if (x < border) n.left += both.pixels[i] !== left.pixels[i];
        if (x > border) n.right += both.pixels[i] !== right.pixels[i];
      }
    }
    return { left: n.left, right: n.right, share: n.scenes / (width * rows) };
  }, [left, right, both]);
  assert.ok(differing.share > 0.9, `${differing.share}`);
  assert.deepEqual([differing.left, differing.right], [0, 0]);
});

inBrowser("the difference says how many dB", { ...two, files: two.files() }, async ({ page }) => {
  await page.getByRole("radio", { name: "Difference" }).click();
  await page.locator("#map").waitFor();
  const db = Number(/^([\d.]+) dB$/.exec(await text(page, "#psnr"))?.[1]);
  assert.ok(db > 25 && db < 60, await text(page, "#psnr"));
  // Of another view it is another map.
  await page.locator("#picture").focus();
  await page.keyboard.press("x");
  await page.locator("#map").waitFor({ state: "hidden" });
});

inBrowser("the difference is of what the settings say, and is what a screenshot saves", { ...two, files: two.files() }, async ({ page }) => {
  await page.getByRole("radio", { name: "Difference" }).click();
  await page.locator("#map").waitFor();
  for (const [id, value] of [["sh", "0"], ["background", "#ffffff"]]) {
    await page.evaluate(() => (byId("psnr").textContent = "of before"));
    await page.locator(`#${id}`).fill(value);
    await page.waitForFunction(() => !byId("map").hidden && /dB$/.test(byId("psnr").textContent));
  }
  // Where both are equal, black: most of it.
  const [download] = await Promise.all([page.waitForEvent("download"), page.locator("#screenshot").click()]);
  const png = readFileSync(await download.path()).toString("base64");
  const same = await page.evaluate(async (base64) => {
    const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))]));
    const map = byId("map");
    const pixels = [bitmap, map].map((image) => {
      const context = new OffscreenCanvas(map.width, map.height).getContext("2d");
      context.drawImage(image, 0, 0);
      return new Uint32Array(context.getImageData(0, 0, map.width, map.height).data.buffer);
    });
    return pixels[0].every((value, i) => value === pixels[1][i]);
  }, png);
  assert.ok(same);
});

inBrowser("the difference has both names, a legend and FLIP", { ...two, files: two.files(), panel: "" }, async ({ page }) => {
  await page.getByRole("radio", { name: "Difference" }).click();
  await page.waitForFunction(() => /^FLIP 0\.\d{3}$/.test(byId("flip").textContent));
  assert.match(await text(page, "#top"), /^(1|2|5|10|20|50|100|200|255) of 255 levels$/);
  assert.deepEqual([await page.locator("#left").isVisible(), await page.locator("#right").isVisible()], [true, true]);
  assert.ok(await page.locator("#working").isHidden());
  await page.getByRole("radio", { name: "One" }).click();
  assert.ok(await page.locator("#legend").isHidden());
});

inBrowser("what no scene has is not shown", { allowed: [k404] }, async ({ page }) => {
  const shown = async () => {
    const all = {};
    for (const id of ["levels", "sh", "compare", "views", "save"]) all[id] = await page.locator(`#${id}`).isVisible();
    return all;
  };
  const flat = join(folder, "degree0.rgs");
  execFileSync(program("rgs-convert"), ["--quiet", "--overwrite", "--sh-degree", "0", join(scenes(), "scene.ply"), flat]);
  await drop(page, "a.rgs", readFileSync(flat));
  await page.waitForFunction(() => byId("title").textContent === "a.rgs" && byId("loading").hidden);
  assert.deepEqual(await shown(), { levels: false, sh: false, compare: false, views: false, save: false });
  await drop(page, "b.rgs", readFileSync(join(golden, "levels_packed.rgs")));
  await page.waitForFunction(() => byId("title").textContent === "a.rgs | b.rgs" && byId("loading").hidden);
  await drop(page, "cameras.json", readFileSync(join(scenes(), "cameras.json")));
  await page.locator("#views").waitFor();
  assert.deepEqual(await shown(), { levels: true, sh: true, compare: true, views: true, save: false });
  // A compressed PLY is none that the converter takes.
  const ply = join(scenes(), "scene.ply");
  const compressed = join(folder, "c.compressed.ply");
  execFileSync(program("rgs-convert"), ["--quiet", ply, compressed]);
  for (const [path, isShown] of [[ply, true], [compressed, false]]) {
    await drop(page, basename(path), readFileSync(path));
    await page.waitForFunction((title) => byId("title").textContent === title && byId("loading").hidden, `a.rgs | ${basename(path)}`);
    assert.equal((await shown()).save, isShown);
  }
});

inBrowser("a panel is open as it was at the last visit", { ...one, files: one.files(), panel: "" }, async ({ page }) => {
  assert.ok(await page.locator("#panel").isHidden());
  await page.getByRole("button", { name: "Keys and gestures" }).click();
  assert.ok(await page.locator("#keys").isVisible());
  await page.reload();
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  assert.ok(await page.locator("#keys").isVisible());
  await page.locator("#picture").focus();
  await page.keyboard.press("Escape");
  assert.ok(await page.locator("#panel").isHidden());
});

inBrowser("a scene of another host is said to be that", { address: "?scene=http://127.0.0.1:9/a.rgs", allowed: [/Content Security Policy|Failed to load|ERR_/] }, async ({ page }) => {
  assert.match((await errors(page)).join(), /^a\.rgs is on another host, .*\(foreign_host: 127\.0\.0\.1:9: /);
});

inBrowser("without a scene there is a place to drop one, and a button", { allowed: [k404], panel: "", hasTouch: true }, async ({ page }) => {
  assert.ok(await page.locator("#home").isHidden());
  const [chooser] = await Promise.all([page.waitForEvent("filechooser"), page.getByRole("button", { name: "Open a scene…" }).click()]);
  assert.ok(chooser.isMultiple());
  for (const id of ["open", "menu", "theme"]) assert.ok((await page.locator(`#${id}`).boundingBox()).width >= 44, id);
});

inBrowser("without a sample beside the page none is offered, after one request", { allowed: [k404] }, async ({ page, server }) => {
  assert.ok(await page.locator("#sample").isHidden());
  assert.deepEqual(server.requests.filter((request) => request.includes("sample")), ["HEAD sample.rgs"]);
});

inBrowser("the page of a server that answers every address by it is no sample", { allowed: [k404] }, async ({ page }) => {
  await page.route("**/sample.rgs", (route) => route.fulfill({ contentType: "text/html; charset=utf-8", body: "" }));
  await page.reload();
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  assert.ok(await page.locator("#sample").isHidden());
});

inBrowser("a sample beside the page is offered where there is no scene", { files: { "sample.rgs": join(golden, "first_view.rgs") }, allowed: [k404] }, async ({ page, server }) => {
  await page.getByRole("button", { name: "Look at a sample" }).click();
  await page.waitForFunction(() => byId("title").textContent === "sample.rgs");
  await untilDrawn(page, 30);
  assert.ok(await page.locator("#welcome").isHidden());
  // With a scene there is nothing to offer.
  const before = server.requests.length;
  await page.goto(`${server.url}?scene=sample.rgs`);
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  assert.ok(!server.requests.slice(before).includes("HEAD sample.rgs"));
});

inBrowser("the page's address chooses how much is around the picture", { ...one, files: one.files(), address: "?chrome=none" }, async ({ page }) => {
  assert.ok(await page.locator("header").isHidden());
  assert.ok(await page.locator("#panel").isHidden());
  assert.ok(await page.locator("#picture").isVisible());
});

inBrowser("a comparison is chosen by arrow keys, and letters in a list are the list's", { ...two, files: { ...two.files(), "scenes/1/low.rgs": join(scenes(), "levels.rgs") } }, async ({ page }) => {
  await page.getByRole("radio", { name: "One" }).focus();
  await page.keyboard.press("ArrowDown");
  assert.ok(await page.getByRole("radio", { name: "Slider" }).isChecked());
  await page.locator("#split").waitFor();
  await page.locator("#tint").focus();
  for (const key of ["f", "x", "n"]) await page.keyboard.press(key);
  assert.ok(await page.getByRole("radio", { name: "Slider" }).isChecked());
  // Held down a key is pressed once.
  await page.locator("#picture").focus();
  for (let i = 0; i < 3; ++i) await page.keyboard.down("i");
  assert.ok(await page.locator("#stats").isChecked());
});

inBrowser("flicker shows one after the other", { ...two, files: two.files() }, async ({ page }) => {
  await page.locator("#picture").focus();
  await page.keyboard.press("f");
  const shown = () => page.locator("#left").isVisible();
  const first = await shown();
  await page.waitForFunction((was) => byId("left").hidden === was, first);
  await page.waitForFunction((was) => byId("left").hidden !== was, first);
  await page.keyboard.press("f");
  assert.ok(await page.getByRole("radio", { name: "One" }).isChecked());
});

inBrowser("a link restores the view", { ...one, files: one.files() }, async ({ page, server, context }) => {
  await page.locator("#picture").focus();
  await page.keyboard.press("n");
  await page.keyboard.press("n");
  await page.locator("#sh").fill("1");
  await page.locator("#background").fill("#336699");
  await page.waitForFunction(() => /sh=1/.test(location.hash) && /background=0\.2/.test(location.hash));
  const hash = await hashOf(page);
  const [, camera] = readCameras(join(scenes(), "cameras.json"));
  const at = new URLSearchParams(hash.slice(1)).get("at").split(",").map(Number);
  camera.position.forEach((value, i) => assert.ok(Math.abs(value - at[i]) < 1e-5, `${at}`));
  await context.grantPermissions(["clipboard-read", "clipboard-write"]);
  const other = await newPage(context);
  await other.goto(`${server.url}${hash}`);
  await other.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  assert.equal(await other.locator("#sh").inputValue(), "1");
  assert.equal(await other.locator("#background").inputValue(), "#336699");
  // What is behind # is the address's own until the page writes it anew.
  await other.evaluate(() => history.replaceState(null, "", location.pathname));
  await other.locator("#link").click();
  assert.equal(await hashOf(other), hash);
  await other.waitForFunction(() => byId("status").textContent === "Link copied");
  assert.equal(await other.evaluate(() => navigator.clipboard.readText()), await address(other));
  // In a page that is there already, too.
  await other.locator("#picture").focus();
  await other.keyboard.press("n");
  await other.locator("#sh").fill("3");
  await other.waitForFunction((was) => location.hash !== was && /sh=3/.test(location.hash), hash);
  await other.evaluate((hash) => (location.hash = hash), hash);
  await other.waitForFunction(() => byId("sh").value === "1");
  await other.evaluate(() => history.replaceState(null, "", location.pathname));
  await other.locator("#link").click();
  assert.equal(await hashOf(other), hash);
});

/** `window.nDrawn` counts what is drawn from now on. */
const countDrawn = (page) =>
  page.evaluate(() => {
    window.nDrawn = 0;
    const { prototype } = WebGL2RenderingContext;
    const { clear } = prototype;
    prototype.clear = function (...mask) {
      window.nDrawn += 1;
      return clear.apply(this, mask);
    };
  });

/** At rest nothing is drawn. */
async function assertAtRest(page) {
  await settled(page);
  const drawn = await page.evaluate(async () => {
    const before = window.nDrawn;
    for (let i = 0; i < 30; ++i) await new Promise(requestAnimationFrame);
    return window.nDrawn - before;
  });
  assert.equal(drawn, 0);
}

inBrowser("keys and pointer move the view, and only then is drawn", { ...one, files: one.files() }, async ({ page }) => {
  await page.waitForFunction(() => location.hash !== "");
  const before = await address(page);
  const changed = async (action) => {
    const was = await address(page);
    await action();
    await page.waitForFunction((url) => location.href !== url, was);
  };
  /** Until the key has had some frames. */
  const hold = async (key) => {
    await page.keyboard.down(key);
    await page.evaluate(async () => {
      for (let i = 0; i < 3; ++i) await new Promise(requestAnimationFrame);
    });
    await page.keyboard.up(key);
  };
  await countDrawn(page);
  await assertAtRest(page);
  await page.locator("#picture").focus();
  await changed(() => hold("ArrowLeft"));
  assert.ok((await page.evaluate(() => window.nDrawn)) > 0);
  // Bounds are drawn with the picture, and with nothing else.
  await page.locator("#boxes").check();
  await assertAtRest(page);
  await page.locator("#picture").focus();
  await changed(() => hold("w"));
  await changed(() => page.keyboard.press("+"));
  await changed(async () => {
    await page.mouse.move(150, 200);
    await page.mouse.down();
    await page.mouse.move(190, 220, { steps: 3 });
    await page.mouse.up();
  });
  await changed(() => page.mouse.wheel(0, 100));
  await changed(() => page.mouse.dblclick(150, 250));
  assert.notEqual(await address(page), before);
  // Turned all the way the camera is still upright: right is across the world's up.
  const axes = new URLSearchParams((await hashOf(page)).slice(1)).get("axes").split(",").map(Number);
  for (const value of axes) assert.ok(Number.isFinite(value));
});

/** Drops bytes as a file. */
const drop = (page, name, bytes) =>
  page.evaluate(
    ([name, base64]) => {
      const data = new DataTransfer();
      data.items.add(new File([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))], name));
      document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
    },
    [name, Buffer.from(bytes).toString("base64")],
  );

inBrowser("what is in a file counts, not its name", { allowed: [k404] }, async ({ page }) => {
  await drop(page, "a.rgs", firstOf(join(scenes(), "scene.ply"), 1000));
  await page.waitForFunction(() => byId("title").textContent === "a.rgs");
  await drop(page, "b.ply", readFileSync(join(golden, "degree3.rgs")));
  await page.waitForFunction(() => byId("title").textContent === "a.rgs | b.ply");
  await drop(page, "c.sog", readFileSync(join(scenes(), "cameras.json")));
  await page.waitForFunction(() => byId("cameras").children.length === 8);
  assert.deepEqual(await errors(page), []);
  await drop(page, "d.rgs", "nothing of that");
  await page.waitForFunction(() => byId("errors").children.length > 0);
  assert.match((await errors(page))[0], /^d\.rgs is not a scene that this page can open\..*bad_magic at byte 0/);
  await drop(page, "e.sog", readFileSync(join(golden, "../fuzz/corpus/npz/float32_degree1.npz")));
  await page.waitForFunction(() => byId("errors").children.length > 1);
  assert.match((await errors(page))[1], /^e\.sog is not a scene that this page can open\..*bad_magic: it is an \.npz/);
});

for (const [version, axes] of [[2, "ply"], [3, "ply"], [4, "ply"], [3, "opengl"]]) {
  inBrowser(`an SPZ of version ${version} in the axes ${axes} shows what the PLY shows`, { allowed: [k404], address: `?spz-axes=${axes}` }, async ({ t, page }) => {
    const path = join(folder, `v${version}${axes}.spz`);
    const ply = join(scenes(), "scene.ply");
    execFileSync(program("rgs-convert"), ["--quiet", "--spz-version", String(version), "--spz-axes", axes, ply, path]);
    const same = join(folder, `v${version}${axes}.rgs`);
    execFileSync(program("rgs-convert"), ["--quiet", ply, same]);
    await drop(page, "a.spz", readFileSync(path));
    await page.waitForFunction(() => byId("title").textContent === "a.spz");
    assert.match(await page.getAttribute("#picture", "aria-label"), /60k Gaussians/);
    await drop(page, "b.rgs", readFileSync(same));
    await page.waitForFunction(() => byId("title").textContent === "a.spz | b.rgs");
    await page.getByRole("radio", { name: "Difference" }).click();
    await page.locator("#map").waitFor();
    const db = Number(/^([\d.]+) dB$/.exec(await text(page, "#psnr"))?.[1]);
    t.diagnostic(`${db} dB`);
    assert.ok(db > 35, `${db} dB`);
  });
}

inBrowser("a gamepad flies", { ...one, files: one.files() }, async ({ page }) => {
  await page.waitForFunction(() => location.hash !== "");
  const number = async (field, i) => Number(new URLSearchParams((await hashOf(page)).slice(1)).get(field).split(",")[i]);
  const at = () => Promise.all([0, 1, 2].map((i) => number("at", i)));
  const press = async (...axes) => {
    const was = await page.evaluate(() => location.hash);
    const pad = (axes) =>
      page.evaluate((axes) => {
        navigator.getGamepads = () => [null, { connected: true, mapping: "standard", axes, buttons: [] }];
      }, axes);
    await pad(axes);
    await page.evaluate(async () => {
      for (let i = 0; i < 5; ++i) await new Promise((resolve) => requestAnimationFrame(resolve));
    });
    // At rest, as sticks are.
    await pad([0.1, -0.1, 0.05, 0]);
    await page.waitForFunction((was) => location.hash !== was, was);
  };
  const before = await at();
  const forward = await Promise.all([2, 5, 8].map((i) => number("axes", i)));
  await press(0, -1, 0, 0);
  const ahead = (await at()).map((value, i) => value - before[i]);
  const along = ahead.reduce((sum, value, i) => sum + value * forward[i], 0);
  assert.ok(along > 0 && Math.abs(along - Math.hypot(...ahead)) < 1e-3 * along, `${ahead} along ${forward}`);
  // Looking around does not move.
  const stood = await at();
  await press(0, 0, 1, 0);
  (await at()).forEach((value, i) => assert.ok(Math.abs(value - stood[i]) < 1e-4 * Math.hypot(...stood), `${value}`));
  // A stick at rest does nothing, nor one that a driver knows nothing of.
  const hash = await hashOf(page);
  await page.evaluate(() => {
    navigator.getGamepads = () => [{ connected: true, mapping: "standard", axes: [NaN, NaN, NaN, NaN], buttons: [] }];
  });
  const frames = () => page.evaluate(() => new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(() => resolve(location.hash)))));
  assert.equal(await frames(), hash);
  await page.locator("#picture").focus();
  await page.keyboard.press("+");
  await page.waitForFunction((hash) => location.hash !== hash, hash);
  assert.ok(!/NaN/.test(await hashOf(page)), await address(page));
});

/** Holds a file's end back until `open()` is called. */
function holdEnd(name, share) {
  let release;
  const opened = new Promise((resolve) => (release = resolve));
  let asked = 0;
  const most = share * statSync(join(scenes(), "packed.rgs")).size;
  return { open: release, hold: async (url, begin, bytes) => url.endsWith(name) && (asked += bytes) > most && opened };
}
const second = holdEnd("second.rgs", 0.6);
const beside = {
  view: { ...two.view, scenes: [scene("packed.rgs"), { name: "second.rgs", url: "scenes/1/second.rgs", bytes: 1 }] },
  files: { ...two.files(), "scenes/1/second.rgs": join(scenes(), "packed.rgs") },
  hold: second.hold,
  waits: false,
};

inBrowser("a second scene is beside the first as soon as a part of it is there", beside, async ({ page }) => {
  await page.waitForFunction(() => byId("title").textContent === "packed.rgs | second.rgs");
  await page.locator("#split").waitFor();
  assert.ok(await page.locator("#loading").isVisible());
  // What is compared is all of it.
  const save = async () => {
    const saved = page.waitForEvent("download").then((download) => download.path());
    await page.locator("#screenshot").click();
    return { saved };
  };
  /** So long that it would be done if it did not wait. */
  const frames = () =>
    page.evaluate(async () => {
      for (let i = 0; i < 60; ++i) await new Promise(requestAnimationFrame);
    });
  const early = await save();
  let isSaved = false;
  void early.saved.then(() => (isSaved = true));
  await frames();
  assert.ok(!isSaved);
  await page.getByRole("radio", { name: "Difference" }).click();
  await frames();
  assert.ok(await page.locator("#map").isHidden());
  second.open();
  await page.locator("#map").waitFor();
  assert.equal(await text(page, "#psnr"), "equal");
  assert.ok(await page.getByRole("radio", { name: "Difference" }).isChecked());
  // So is what is saved.
  const late = await save();
  assert.ok(readFileSync(await early.saved).equals(readFileSync(await late.saved)));
});

const later = holdEnd("second.rgs", 0.6);
inBrowser("a difference that is waited for can be cancelled", { ...beside, hold: later.hold, panel: "" }, async ({ page }) => {
  await page.waitForFunction(() => byId("title").textContent === "packed.rgs | second.rgs");
  await page.getByRole("radio", { name: "Difference" }).click();
  await page.locator("#working").waitFor();
  assert.match(await text(page, "#working-text"), /^Comparing/);
  await page.locator("#cancel-map").click();
  assert.ok(await page.getByRole("radio", { name: "Slider" }).isChecked());
  assert.ok(await page.locator("#working").isHidden());
  later.open();
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  assert.ok(await page.locator("#map").isHidden());
});

for (const share of [0, 0.6]) {
  const never = holdEnd("second.rgs", share);
  inBrowser(`opening is cancelled, with ${share} of the file there`, { ...beside, hold: never.hold }, async ({ page }) => {
    await page.waitForFunction((title) => byId("title").textContent === title && /second|MB/.test(byId("progress-text").textContent), share ? "packed.rgs | second.rgs" : "packed.rgs");
    if (!share) await page.waitForFunction(() => byId("progress-text").textContent === "Opening second.rgs");
    await page.locator("#cancel").click();
    await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
    assert.equal(await text(page, "#title"), "packed.rgs");
    assert.ok(await page.locator("#loading").isHidden());
    assert.deepEqual(await errors(page), []);
    await drop(page, "b.rgs", readFileSync(join(golden, "degree3.rgs")));
    await page.waitForFunction(() => byId("title").textContent === "packed.rgs | b.rgs");
    never.open();
  });
}

const untouched = holdEnd("packed.rgs", 0.6);
let isReleased = false;
const plyAsked = [];
const plyLater = {
  view: { ...two.view, scenes: [scene("packed.rgs"), { name: "scene.ply", url: "scenes/1/scene.ply", bytes: 1 }] },
  files: () => ({ ...two.files(), "scenes/1/scene.ply": join(scenes(), "scene.ply") }),
  hold: async (url, begin, bytes) => {
    if (url.endsWith("scene.ply")) plyAsked.push({ bytes, isReleased });
    await untouched.hold(url, begin, bytes);
  },
  waits: false,
};

// rgs-view hangs up on who takes nothing for 30 s.
inBrowser("a second scene that is a PLY is asked for when it is read", { ...plyLater, files: plyLater.files() }, async ({ page }) => {
  await page.waitForFunction(() => byId("title").textContent === "packed.rgs");
  assert.ok(await page.locator("#loading").isVisible());
  isReleased = true;
  untouched.open();
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  assert.equal(await text(page, "#title"), "packed.rgs | scene.ply");
  assert.deepEqual(plyAsked, [{ bytes: 1 << 15, isReleased: false }, { bytes: statSync(join(scenes(), "scene.ply")).size, isReleased: true }]);
});

let dropIsDone;
const dropped = new Promise((resolve) => (dropIsDone = resolve));
const slowCameras = { ...one, hold: async (url) => url === "cameras.json" && dropped, waits: false };

inBrowser("what is dropped while the page begins comes after what it begins with", { ...slowCameras, files: one.files() }, async ({ page, server }) => {
  await page.waitForFunction(() => window.performance.getEntriesByType("resource").length > 0);
  while (!server.requests.includes("GET cameras.json")) await page.evaluate(() => new Promise(requestAnimationFrame));
  await drop(page, "b.rgs", readFileSync(join(golden, "degree3.rgs")));
  dropIsDone();
  await page.waitForFunction(() => byId("title").textContent === "packed.rgs | b.rgs" && byId("loading").hidden);
});

const withoutRanges = { view: { ...one.view, scenes: [scene("scene.ply")] }, ranges: false };
inBrowser("a server without ranges is asked for a PLY no more often than one with them", { ...withoutRanges, files: { ...one.files(), "scenes/0/scene.ply": join(scenes(), "scene.ply") } }, async ({ page, server }) => {
  assert.equal(await text(page, "#title"), "scene.ply");
  assert.equal(server.requests.filter((line) => line === "GET scenes/0/scene.ply").length, 2);
});

inBrowser("a worker that does not start is an error, and a PLY is opened without the one that chooses its view", { allowed: [k404, /ERR_FAILED/] }, async ({ page }) => {
  const ply = firstOf(join(scenes(), "scene.ply"), 1000);
  const saidOf = async (name) => {
    await page.evaluate(() => byId("errors").replaceChildren());
    await drop(page, name, ply);
    await page.waitForFunction(() => byId("errors").children.length > 0);
    return (await errors(page))[0];
  };
  await page.route(/splats-worker/, (route) => route.abort());
  assert.match(await saidOf("a.ply"), /^a\.ply could not be read: the worker.*\(unavailable: the worker does not start/);
  await page.unroute(/splats-worker/);
  await page.route(/splats-[^/]*\.wasm/, (route) => route.fulfill({ status: 404 }));
  assert.match(await saidOf("b.ply"), /^b\.ply could not be read.*\(unavailable: its WebAssembly: HTTP 404\)/);
  await page.unroute(/splats-[^/]*\.wasm/);
  await page.route(/chooser-worker/, (route) => route.abort());
  await page.evaluate(() => byId("errors").replaceChildren());
  await drop(page, "c.ply", ply);
  await page.waitForFunction(() => byId("title").textContent === "c.ply" && byId("loading").hidden);
  assert.deepEqual(await errors(page), []);
});

inBrowser("a PLY without a length is opened, and one that is too large or ends early is given back", { allowed: [k404] }, async ({ page }) => {
  const ply = firstOf(join(scenes(), "scene.ply"), 1000).toString("base64");
  const given = (how) => page.evaluate(async ([how, base64]) => {
    const { fetch } = window;
    const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
    let isCancelled = false;
    window.fetch = async (url, options) => {
      if (!String(url).includes(".ply")) return fetch(url, options);
      if (options.headers?.range) return new Response(bytes.slice(0, 4096));
      let at = 0;
      const pull = (controller) => {
        if (at > 0 && how === "broken") controller.error(new TypeError("the line"));
        else if (at < bytes.length) controller.enqueue(bytes.slice(at, (at += 100_000)));
        else controller.close();
      };
      return new Response(new ReadableStream({ pull, cancel: () => void (isCancelled = true) }), { headers: how === "large" ? { "content-length": String(2 ** 31) } : {} });
    };
    byId("errors").replaceChildren();
    await document.querySelector("rgs-view").compare(`${how}.ply`);
    window.fetch = fetch;
    return { isCancelled, said: byId("errors").textContent, title: byId("title").textContent };
  }, [how, ply]);
  const large = await given("large");
  assert.ok(large.isCancelled);
  assert.match(large.said, /^large\.ply does not fit .*rgs-convert.*\(host_out_of_memory: a PLY of 2 GiB or more\)/);
  assert.match((await given("broken")).said, /^broken\.ply stopped loading.*\(read_failed: TypeError: the line\)/);
  assert.deepEqual(await given("whole"), { isCancelled: false, said: "", title: "whole.ply" });
});

const misnamed = { view: { ...one.view, scenes: [scene("a.rgs")] }, ranges: false };
inBrowser("a PLY with the name of an .rgs is opened from a server without ranges", { ...misnamed, files: { "scenes/0/a.rgs": join(scenes(), "scene.ply"), "cameras.json": join(scenes(), "cameras.json") } }, async ({ page }) => {
  assert.equal(await text(page, "#title"), "a.rgs");
  assert.match(await page.getAttribute("#picture", "aria-label"), /60k Gaussians/);
  assert.deepEqual(await errors(page), []);
});

let asked;
const secondOfTwo = { view: { ...two.view, scenes: [{ ...scene("missing.rgs") }, { ...scene("packed.rgs"), url: "scenes/1/packed.rgs" }], frames: { url: "frame", backend: "cpu" } } };
const refusesAndTells = async ({ scene }) => {
  asked = scene;
  return { status: 500, error: { code: "internal", message: "no" } };
};
inBrowser("where the first scene fails the second one is on the left", { ...secondOfTwo, files: { ...one.files(), "scenes/1/packed.rgs": join(scenes(), "packed.rgs") }, frame: refusesAndTells, allowed: [k404, /500/] }, async ({ page }) => {
  assert.match((await errors(page))[0], /^missing\.rgs is not on the server/);
  assert.equal(await text(page, "#title"), "packed.rgs");
  assert.ok(await page.locator("#welcome").isHidden());
  assert.match(await page.getAttribute("#picture", "aria-label"), /packed\.rgs, 60k Gaussians/);
  // The server knows it as the second still.
  await page.locator("#picture").focus();
  await page.keyboard.press("t");
  await page.waitForFunction(() => byId("errors").children.length > 1);
  assert.equal(asked, 1);
});

const whole = holdEnd("second.rgs", 0);
const chosen = { view: { ...beside.view, frames: { url: "frame", backend: "cpu" } }, files: beside.files, hold: whole.hold, waits: false };
inBrowser("a mode that is chosen while a scene is opened stays", { ...chosen, frame: refusesAndTells, allowed: [/500/] }, async ({ page }) => {
  await page.waitForFunction(() => byId("title").textContent === "packed.rgs" && byId("progress-text").textContent === "Opening second.rgs");
  await page.locator("#picture").focus();
  await page.keyboard.press("t");
  await page.keyboard.press("f");
  whole.open();
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  assert.ok(await page.getByRole("radio", { name: "Flicker" }).isChecked());
});

/** The file with damage that is found only after a part of it is drawn, and the offset of the damaged section. */
async function damagedAtEnd(sound) {
  const damaged = Buffer.from(sound);
  const file = await open(sound);
  const { offset, storedBytes } = file.sections.find(({ type }) => type === "SHI8");
  file.close();
  damaged[offset + storedBytes - 1] ^= 1;
  return { damaged, offset };
}

inBrowser("what turns out damaged goes again, and what was there stays", { allowed: [k404] }, async ({ page }) => {
  const sound = readFileSync(join(scenes(), "packed.rgs"));
  const { damaged, offset } = await damagedAtEnd(sound);
  await drop(page, "bad.rgs", damaged);
  await page.waitForFunction(() => byId("errors").children.length > 0);
  assert.match((await errors(page))[0], new RegExp(`^bad\\.rgs is damaged: .*checksum_mismatch at byte ${offset}\\)`));
  assert.equal(await text(page, "#title"), "RoofGS viewer");
  assert.ok(await page.locator("#welcome").isVisible());
  await drop(page, "a.rgs", sound);
  await page.waitForFunction(() => byId("title").textContent === "a.rgs");
  await drop(page, "b.rgs", sound);
  await page.waitForFunction(() => byId("title").textContent === "a.rgs | b.rgs" && byId("loading").hidden);
  await page.evaluate(() => byId("errors").replaceChildren());
  await drop(page, "bad.rgs", damaged);
  await page.waitForFunction(() => byId("errors").children.length > 0);
  assert.equal(await text(page, "#title"), "a.rgs | b.rgs");
  // It is drawn again: both sides are of one file.
  await page.getByRole("radio", { name: "Difference" }).click();
  await page.locator("#map").waitFor();
  assert.equal(await text(page, "#psnr"), "equal");
});

inBrowser("files that are dropped at once are opened one after the other", { allowed: [k404] }, async ({ page }) => {
  const sound = readFileSync(join(scenes(), "packed.rgs"));
  const damaged = Buffer.from(sound);
  damaged[sound.length >> 1] ^= 1;
  await Promise.all([drop(page, "a.rgs", sound), drop(page, "b.rgs", sound)]);
  await page.waitForFunction(() => byId("title").textContent === "a.rgs | b.rgs" && byId("loading").hidden);
  await Promise.all([drop(page, "bad.rgs", damaged), drop(page, "c.rgs", sound)]);
  await page.waitForFunction(() => byId("title").textContent === "a.rgs | c.rgs" && byId("loading").hidden);
  assert.match((await errors(page))[0], /^bad\.rgs is damaged/);
  await page.getByRole("radio", { name: "Difference" }).click();
  await page.locator("#map").waitFor();
  assert.equal(await text(page, "#psnr"), "equal");
});

inBrowser("a damaged scene leaves no view behind", { allowed: [k404] }, async ({ page }) => {
  // A file that states its first view: the view of another changes when it is chosen.
  const path = join(folder, "small.rgs");
  writeFileSync(join(folder, "small.ply"), firstOf(join(scenes(), "scene.ply"), 500));
  execFileSync(program("rgs-convert"), ["--quiet", "--overwrite", join(folder, "small.ply"), path]);
  const small = readFileSync(path);
  await drop(page, "small.rgs", small);
  await page.waitForFunction(() => location.hash !== "");
  const expected = await hashOf(page);
  await page.reload();
  await page.evaluate(() => history.replaceState(null, "", location.pathname));
  await page.reload();
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  const { damaged } = await damagedAtEnd(readFileSync(join(scenes(), "packed.rgs")));
  await drop(page, "bad.rgs", damaged);
  await page.waitForFunction(() => byId("errors").children.length > 0);
  await drop(page, "small.rgs", small);
  await page.waitForFunction((expected) => location.hash === expected, expected);
});

/** The first `n` Gaussians of a PLY. */
function firstOf(path, n) {
  const ply = readFileSync(path);
  const begin = ply.indexOf("end_header\n") + "end_header\n".length;
  const header = ply.toString("latin1", 0, begin);
  const nAll = Number(/element vertex (\d+)/.exec(header)[1]);
  const rows = ply.subarray(begin, begin + ((ply.length - begin) / nAll) * n);
  return Buffer.concat([Buffer.from(header.replace(`vertex ${nAll}`, `vertex ${n}`)), rows]);
}

/** Applies a link to a page that is there already. */
const follow = (page, link) =>
  page.evaluate((link) => {
    const done = new Promise((resolve) => addEventListener("hashchange", resolve, { once: true }));
    location.hash = link;
    return done;
  }, new URLSearchParams(link).toString());

inBrowser("a PLY that declares Mip-Splatting is drawn as the .rgs made of it", { allowed: [k404] }, async ({ t, page }) => {
  const db = async (comment) => {
    const path = join(folder, "declares.ply");
    const rgs = join(folder, "declares.rgs");
    writeFileSync(path, Buffer.from(readFileSync(join(scenes(), "scene.ply")).toString("latin1").replace("\nelement", `\n${comment}element`), "latin1"));
    execFileSync(program("rgs-convert"), ["--quiet", "--overwrite", path, rgs]);
    await page.reload();
    await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
    await drop(page, "a.ply", readFileSync(path));
    await drop(page, "b.rgs", readFileSync(rgs));
    await page.waitForFunction(() => byId("title").textContent === "a.ply | b.rgs" && byId("loading").hidden);
    // From far away, where anti-aliasing shows and quantisation does not.
    await follow(page, { at: [-1, -2, -39], axes: [1, 0, 0, 0, 1, 0, 0, 0, 1], lens: [0.866, 1, 0, 0], pivot: [-1, -2, -1] });
    await page.getByRole("radio", { name: "Difference" }).click();
    await page.locator("#map").waitFor();
    return Number(/^([\d.]+) dB$/.exec(await text(page, "#psnr"))?.[1]);
  };
  const found = [await db(""), await db("comment SplatRenderMode: mip\n"), await db("comment rgs_low_pass_px2: 1\n")];
  t.diagnostic(`${found.join(", ")} dB`);
  for (const each of found) assert.ok(each > 48, `${found}`);
});

/** A link: from 38 units before the scene, or behind it, or a multiple of that. */
const far = (way, times = 1) => ({ at: [-1, -2, -1 - 38 * way * times], axes: [way, 0, 0, 0, 1, 0, 0, 0, way], lens: [0.866, 1, 0, 0], pivot: [-1, -2, -1] });
const twice = { view: two.view, files: { ...two.files(), "scenes/1/low.rgs": join(scenes(), "packed.rgs") } };

inBrowser("a link is followed, although the page writes its own address before it reads the link", twice, async ({ page, context }) => {
  await context.grantPermissions(["clipboard-write"]);
  await page.evaluate((link) => {
    const read = new Promise((resolve) => addEventListener("hashchange", resolve, { once: true }));
    const { hash } = location;
    location.hash = link;
    history.replaceState(null, "", hash);
    return read;
  }, new URLSearchParams(far(1)).toString());
  // Writes the address of the view that there is.
  await page.locator("#link").click();
  assert.equal(new URLSearchParams((await hashOf(page)).slice(1)).get("at"), "-1,-2,-39");
});

inBrowser("a camera that moves while the Gaussians are sorted gets an order of its own", twice, async ({ page }) => {
  await page.addInitScript(() => {
    const { postMessage } = Worker.prototype;
    window.sorts = { isHeld: false, held: [] };
    Worker.prototype.postMessage = function (...asked) {
      if (sorts.isHeld && asked[0]?.command === "sort") sorts.held.push(() => postMessage.apply(this, asked));
      else postMessage.apply(this, asked);
    };
  });
  await page.reload();
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  await follow(page, far(1));
  const expected = await still(page);
  /** Away and back, while the order of there is not made. */
  const away = async (meanwhile) => {
    await settled(page);
    await page.evaluate(() => (sorts.isHeld = true));
    await follow(page, far(-1));
    await page.waitForFunction(() => sorts.held.length > 0);
    await follow(page, far(1));
    await meanwhile();
    // A frame after the one that is requested already.
    await page.evaluate(() => new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve))));
    assert.equal(await page.getAttribute("#picture", "aria-busy"), "true");
    await page.evaluate(() => {
      sorts.isHeld = false;
      for (const post of sorts.held.splice(0)) post();
    });
  };
  await away(async () => {});
  assert.ok((await still(page)) === expected, "the picture is that of the camera");
  await away(() => page.getByRole("radio", { name: "Difference" }).click());
  await page.locator("#map").waitFor();
  assert.equal(await text(page, "#psnr"), "equal");
});

inBrowser("pictures are compared as they are, wherever the camera came from", twice, async ({ page }) => {
  await follow(page, far(1));
  await settled(page);
  // Nearer, without a turn, for which the engine would sort.
  await follow(page, far(1, 0.2));
  await page.getByRole("radio", { name: "Difference" }).click();
  await page.locator("#map").waitFor();
  assert.equal(await text(page, "#psnr"), "equal");
});

/** A zip of one file that is stored as it is. */
function zipOf(name, contents) {
  const entry = (signature, bytes, at) => {
    const head = Buffer.alloc(bytes);
    head.writeUInt32LE(signature);
    for (const offset of [at, at + 4]) head.writeUInt32LE(contents.length, offset);
    head.writeUInt16LE(name.length, at + 8);
    return Buffer.concat([head, Buffer.from(name)]);
  };
  const local = Buffer.concat([entry(0x04034b50, 30, 18), Buffer.from(contents)]);
  const central = entry(0x02014b50, 46, 20);
  const end = Buffer.alloc(22);
  end.writeUInt32LE(0x06054b50);
  for (const at of [8, 10]) end.writeUInt16LE(1, at);
  end.writeUInt32LE(central.length, 12);
  end.writeUInt32LE(local.length, 16);
  return Buffer.concat([local, central, end]);
}

inBrowser("a zip that is no SOG, and an empty list of cameras, are said in sentences", { allowed: [k404, /scene\d+\.sog-gsplat/] }, async ({ page }) => {
  const refused = async (name, bytes) => {
    await drop(page, name, bytes);
    await page.waitForFunction((name) => [...byId("errors").children].some((p) => p.textContent.startsWith(name)), name);
    return (await errors(page)).at(-1);
  };
  assert.match(await refused("a.sog", zipOf("meta.json", "{}")), /^a\.sog is damaged: .*meta\.json lacks what a SOG must have \(bad_header\)/);
  assert.match(await refused("b.sog", zipOf("meta.json", "{}").subarray(0, 60)), /^b\.sog (is damaged|could not be opened): [^T]/);
  assert.match(await refused("c.json", "[]"), /^c\.json could not be opened: the camera file holds no cameras\./);
});

inBrowser("images that a SOG lacks are named, and asked for nowhere", { allowed: [k404, /scene\d+\.sog-gsplat|\.webp-texture|createImageBitmap/] }, async ({ page, server }) => {
  const images = { means: ["means_l.webp", "../means_u.webp"], scales: ["scales.webp"], quats: ["quats.webp"], sh0: ["sh0.webp"] };
  const meta = { version: 2, count: 1, ...Object.fromEntries(Object.entries(images).map(([name, files]) => [name, { files }])) };
  const before = server.requests.length;
  await drop(page, "a.sog", zipOf("meta.json", JSON.stringify(meta)));
  await page.waitForFunction(() => byId("errors").children.length > 0);
  assert.match((await errors(page))[0], /^a\.sog is damaged: the zip archive lacks means_l\.webp, \.\.\/means_u\.webp, scales\.webp, quats\.webp, sh0\.webp, which its meta\.json names \(missing_section\)/);
  assert.deepEqual(server.requests.slice(before), []);
});

/** A PLY of Gaussians of one size, [x, y, z] each. */
function plyOf(means, scale) {
  const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
  const header = ["ply", "format binary_little_endian 1.0", `element vertex ${means.length}`, ...names.map((name) => `property float ${name}`), "end_header", ""];
  const rows = new Float32Array(means.flatMap((mean) => [...mean, 1, 0.5, -0.5, 3, ...Array(3).fill(Math.log(scale)), 1, 0, 0, 0]));
  return Buffer.concat([Buffer.from(header.join("\n")), Buffer.from(rows.buffer)]);
}

inBrowser("a single Gaussian is seen, and a scene smaller than what is too near to be drawn", { allowed: [k404] }, async ({ page }) => {
  const open = async (name, bytes) => {
    await page.reload();
    await page.evaluate(() => history.replaceState(null, "", location.pathname));
    await page.reload();
    await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
    await drop(page, name, bytes);
    await page.waitForFunction((name) => byId("title").textContent === name, name);
    await untilDrawn(page, 30);
  };
  const asRgs = (ply) => {
    const [from, to] = ["few.ply", "few.rgs"].map((name) => join(folder, name));
    writeFileSync(from, ply);
    execFileSync(program("rgs-convert"), ["--quiet", "--overwrite", from, to]);
    return readFileSync(to);
  };
  const single = plyOf([[1, 2, 3]], 0.3);
  const tiny = plyOf(Array.from({ length: 20 }, (_, i) => [0.01 * Math.sin(i), 0.01 * Math.cos(i), 0.01 * Math.sin(3 * i)]), 0.004);
  await open("a.ply", single);
  assert.match(await page.getAttribute("#picture", "aria-label"), /1 Gaussian$/);
  await open("a.rgs", asRgs(single));
  await open("b.ply", tiny);
  await open("b.rgs", asRgs(tiny));
});

/** Away from the native camera, as a share of its distance: what the same numbers give, and what other rounding does. Two golden files state no view. */
const kFirstViews = { "a.ply": 1e-5, "a.compressed.ply": 1e-3, "v3.spz": 1e-5, "v4.spz": 1e-5, "a.sog": 1e-2, "up.rgs": 1e-5, "packed.rgs": 1e-5, "low.rgs": 1e-5, "levels.rgs": 1e-5, "packed_degree3.rgs": 1e-5, "levels_packed.rgs": 1e-5 };
inBrowser("without cameras a scene is seen from where rgs-render sees it", { allowed: [k404] }, async ({ t, page }) => {
  const path = (name) => join([scenes(), golden].find((at) => existsSync(join(at, name))) ?? folder, name);
  const make = (name, ...options) => execFileSync(program("rgs-convert"), ["--quiet", "--overwrite", ...options, join(scenes(), "scene.ply"), join(folder, name)]);
  writeFileSync(join(folder, "a.ply"), readFileSync(join(scenes(), "scene.ply")));
  make("a.compressed.ply");
  make("flat.ply", "--sh-degree", "0");
  const transform = join(dirname(fileURLToPath(import.meta.resolve("@playcanvas/splat-transform"))), "../bin/cli.mjs");
  execFileSync(process.execPath, [transform, "-q", "-w", "-g", "cpu", join(folder, "flat.ply"), join(folder, "a.sog")], { stdio: "ignore" });
  for (const version of ["3", "4"]) make(`v${version}.spz`, "--spz-version", version);
  make("up.rgs", "--axes", "right,forward,up");
  const names = Object.keys(kFirstViews);
  const size = await page.evaluate(() => [byId("picture").width, byId("picture").height].map(String));
  const lines = execFileSync(program("rgs_first_view"), [...size, ...names.map(path)], { encoding: "utf8" }).trim().split("\n");
  const away = {};
  for (const [i, name] of names.entries()) {
    await page.evaluate(() => history.replaceState(null, "", location.pathname));
    await page.reload();
    await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
    await drop(page, name, readFileSync(path(name)));
    await page.waitForFunction((name) => byId("title").textContent === name, name);
    const native = lines[i].split(" ").map(Number);
    // Read to its end, an .rgs that states no view is seen from another one.
    await page.locator("#loading").waitFor({ state: "hidden" });
    await settled(page);
    await page.locator("#link").click();
    const state = new URLSearchParams((await hashOf(page)).slice(1));
    const numbers = (field) => state.get(field).split(",").map(Number);
    const [at, axes, lens, pivot] = ["at", "axes", "lens", "pivot"].map(numbers);
    const distance = Math.hypot(...at.map((value, k) => value - pivot[k]));
    away[name] = Math.hypot(...at.map((value, k) => value - native[k])) / distance;
    // The page's axes are camera to world.
    axes.forEach((value, k) => assert.ok(Math.abs(value - native[3 + 3 * (k % 3) + Math.floor(k / 3)]) < 1e-6, `${name}: ${axes}`));
    // In a picture that is wider than 16:9 what lies above and below is as in one that is not.
    const share = Math.min(1, (16 / 9) * (size[1] / size[0]));
    const focal = (0.5 / Math.tan(Math.PI / 6)) * share;
    assert.deepEqual(lens.map((value) => value.toFixed(6)), [focal.toFixed(6), "1.000000", "0.000000", "0.000000"], name);
  }
  t.diagnostic(JSON.stringify(away));
  for (const name of names) assert.ok(away[name] < kFirstViews[name], `${name}: ${away[name]}`);
});

inBrowser("the page begins with the view that a file states, and comes back to it", { allowed: [k404] }, async ({ page }) => {
  const bytes = readFileSync(join(golden, "first_view.rgs"));
  const file = await open(bytes);
  const { firstView, declarations: { origin } } = file;
  file.close();
  await drop(page, "a.rgs", bytes);
  await page.waitForFunction(() => byId("title").textContent === "a.rgs");
  const lookedFrom = async () => {
    await page.locator("#loading").waitFor({ state: "hidden" });
    await settled(page);
    await page.locator("#link").click();
    const state = new URLSearchParams((await hashOf(page)).slice(1));
    return ["at", "pivot"].map((name) => state.get(name).split(",").map(Number));
  };
  const isNear = ([found, pivot]) => [[found, firstView.position], [pivot, firstView.pivot]].every(([a, b]) => a.every((value, k) => Math.abs(value - b[k] - origin[k]) < 1e-5));
  const first = await lookedFrom();
  assert.ok(isNear(first), `${first} for ${firstView.position} and ${firstView.pivot}`);
  for (const goHome of [() => page.keyboard.press("h"), () => page.keyboard.press("Home"), () => page.locator("#home").click()]) {
    await page.locator("#picture").focus();
    await page.keyboard.press("ArrowRight");
    const [away] = await lookedFrom();
    assert.ok(away.some((value, k) => Math.abs(value - first[0][k]) > 1e-3), "it has moved");
    await goHome();
    const back = await lookedFrom();
    assert.ok(isNear(back), `${back} for ${first}`);
  }
});

inBrowser("a PLY that ends too early is said to be damaged", { allowed: [k404] }, async ({ page }) => {
  const whole = plyOf([[1, 2, 3], [4, 5, 6]], 1);
  await drop(page, "a.ply", whole.subarray(0, whole.length - 1));
  await page.waitForFunction(() => byId("errors").children.length > 0);
  assert.match((await errors(page))[0], /^a\.ply is damaged: the file is too short for the vertex count in its header \(truncated at byte \d+\)/);
});

inBrowser("a PLY without Gaussians is no scene", { allowed: [k404] }, async ({ page }) => {
  await drop(page, "a.ply", plyOf([], 1));
  await page.waitForFunction(() => byId("errors").children.length > 0);
  assert.match((await errors(page))[0], /^a\.ply could not be opened: it holds no Gaussians\./);
  assert.ok(await page.locator("#welcome").isVisible());
});

inBrowser("two PLY are two", { allowed: [k404] }, async ({ page }) => {
  const path = join(scenes(), "scene.ply");
  await drop(page, "a.ply", firstOf(path, 2000));
  await page.waitForFunction(() => byId("title").textContent === "a.ply");
  await drop(page, "b.ply", firstOf(path, 1000));
  await page.waitForFunction(() => byId("title").textContent === "a.ply | b.ply");
  await page.getByRole("radio", { name: "Difference" }).click();
  await page.locator("#map").waitFor();
  assert.match(await text(page, "#psnr"), /^[\d.]+ dB$/);
  // A third takes the place of the second, which goes.
  await drop(page, "c.ply", firstOf(path, 500));
  await page.waitForFunction(() => byId("title").textContent === "a.ply | c.ply");
});

inBrowser("flying ends where one camera is left", { ...one, files: one.files() }, async ({ page }) => {
  await page.locator("#picture").focus();
  await page.keyboard.press("p");
  assert.equal(await page.getAttribute("#play", "aria-pressed"), "true");
  const [camera] = readCameras(join(scenes(), "cameras.json"));
  await drop(page, "cameras.json", JSON.stringify([camera]));
  await page.waitForFunction(() => byId("cameras").children.length === 1);
  assert.equal(await page.getAttribute("#play", "aria-pressed"), "false");
});

inBrowser("what is asked for while a picture is taken is shown after it", { ...one, files: one.files() }, async ({ page }) => {
  await page.locator("#picture").focus();
  await page.keyboard.press("n");
  const first = await still(page);
  await page.keyboard.press("n");
  const second = await still(page);
  assert.notEqual(first, second);
  await page.keyboard.press("b");
  assert.equal(await still(page), first);
  await Promise.all([
    page.waitForEvent("download"),
    page.evaluate(async () => {
      byId("screenshot").click();
      for (let i = 0; i < 5; ++i) await Promise.resolve();
      document.dispatchEvent(new KeyboardEvent("keydown", { code: "KeyN" }));
    }),
  ]);
  assert.equal(await still(page), second);
});

inBrowser("a scene is dropped, and a second one beside it", { allowed: [k404] }, async ({ page }) => {
  assert.ok(await page.locator("#welcome").isVisible());
  await drop(page, "<img src=x onerror=alert(1)>.rgs", readFileSync(join(golden, "degree3.rgs")));
  await page.waitForFunction(() => /onerror/.test(byId("title").textContent));
  assert.equal(await page.locator("img").count(), 0, "names are text");
  await drop(page, "levels.rgs", readFileSync(join(golden, "levels_packed.rgs")));
  await page.waitForFunction(() => / \| levels\.rgs/.test(byId("title").textContent));
  assert.ok(await page.locator("#split").isVisible());
});

inBrowser("fingers move the view, and two taps focus", { ...one, files: one.files(), size: { width: 360, height: 640 }, hasTouch: true, panel: "" }, async ({ page }) => {
  const link = async () => {
    await page.evaluate(() => history.replaceState(null, "", location.pathname));
    await page.locator("#link").evaluate((button) => button.click());
    return new URLSearchParams((await hashOf(page)).slice(1));
  };
  const box = await page.locator("#picture").boundingBox();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  const devtools = await page.context().newCDPSession(page);
  let seconds = 1e6;
  /** A hundredth of a second after the one before, however long that takes. */
  const touch = (type, points) => devtools.send("Input.dispatchTouchEvent", { type, timestamp: (seconds += 0.01), touchPoints: points.map(([x, y], id) => ({ x, y, id })) });
  const before = await link();
  await touch("touchStart", [[x, y]]);
  await touch("touchMove", [[x + 60, y]]);
  await touch("touchEnd", []);
  const turned = await link();
  assert.notEqual(turned.get("axes"), before.get("axes"));
  assert.equal(turned.get("pivot"), before.get("pivot"));
  const away = (state) => Math.hypot(...state.get("at").split(",").map((value, i) => value - state.get("pivot").split(",")[i]));
  await touch("touchStart", [[x - 40, y], [x + 40, y]]);
  await touch("touchMove", [[x - 80, y], [x + 80, y]]);
  await touch("touchEnd", []);
  const near = await link();
  assert.ok(Math.abs(away(near) / away(turned) - 0.5) < 0.01, `${away(near)} of ${away(turned)}`);
  // One tap does nothing, a second one beside it focuses.
  const tap = async () => {
    await touch("touchStart", [[x + 20, y + 10]]);
    await touch("touchEnd", []);
  };
  await tap();
  assert.equal(`${await link()}`, `${near}`);
  await tap();
  assert.notEqual((await link()).get("pivot"), near.get("pivot"));
});

inBrowser("a phone has the picture above its settings", { ...one, files: one.files(), size: { width: 360, height: 640 }, panel: "" }, async ({ page }) => {
  const box = await page.locator("#stage").boundingBox();
  assert.equal(box.width, 360);
  assert.ok(await page.locator("#panel").isHidden());
  await page.locator("#menu").click();
  assert.equal(await page.getAttribute("#menu", "aria-expanded"), "true");
  assert.ok((await page.locator("#panel").boundingBox()).width === 360);
  assert.equal(await page.evaluate(() => document.documentElement.scrollWidth), 360, "nothing sticks out");
});

const everyButton = { view: { ...one.view, scenes: [scene("scene.ply")] }, size: { width: 320, height: 640 }, hasTouch: true, panel: "" };
inBrowser("a small phone has room for every button", { ...everyButton, files: { ...one.files(), "scenes/0/scene.ply": join(scenes(), "scene.ply") } }, async ({ page }) => {
  const all = await page.locator("header button:visible").all();
  assert.equal(all.length, 7);
  for (const { x, width } of await Promise.all(all.map((button) => button.boundingBox()))) assert.ok(x >= 8 && x + width <= 312 && width >= 40, `${x}, ${width}`);
});

inBrowser("everything has a name for screen readers, and dark is not light", { ...two, files: two.files() }, async ({ page }) => {
  const nameless = await page.evaluate(() =>
    [...document.querySelector("rgs-view").shadowRoot.querySelectorAll("button, input:not([hidden]), select, canvas:not([aria-hidden])")]
      .filter((e) => !e.closest("#cameras") && !(e.getAttribute("aria-label") || e.textContent.trim() || e.labels?.length))
      .map((e) => e.id),
  );
  assert.deepEqual(nameless, []);
  const colour = () => page.evaluate(() => getComputedStyle(document.querySelector("rgs-view")).backgroundColor);
  await page.locator("#theme").click();
  const dark = await colour();
  await page.locator("#theme").click();
  assert.notEqual(await colour(), dark);
  // What is chosen holds for the next visit.
  await page.locator("#theme").click();
  await page.reload();
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  assert.equal(await colour(), dark);
  // Where the system is dark, the first press makes it light.
  await page.evaluate(() => localStorage.clear());
  await page.emulateMedia({ colorScheme: "dark" });
  await page.reload();
  assert.equal(await colour(), dark);
  assert.equal(await page.getAttribute("#theme", "aria-pressed"), "true");
  await page.locator("#theme").click();
  assert.notEqual(await colour(), dark);
  assert.equal(await page.getAttribute("#theme", "aria-pressed"), "false");
});

const levelsFile = () => join(scenes(), "levels.rgs");
const levelsOnly = { view: { ...one.view, scenes: [scene("levels.rgs")] }, files: { ...one.files(), "scenes/0/levels.rgs": levelsFile() } };

async function secondPage() {
  const file = await open(readFileSync(levelsFile()));
  const { offset } = file.levels.page(1);
  file.close();
  return offset;
}

/** Holds what lies behind the first page until `open()` is called. */
function gate() {
  let release;
  let offset;
  const opened = new Promise((resolve) => (release = resolve));
  const hold = async (url, begin) => {
    if (!url.endsWith("levels.rgs")) return;
    offset ??= secondPage();
    if (begin >= (await offset)) await opened;
  };
  return { hold, open: release };
}
const held = gate();
const heldForEver = gate();

inBrowser("of a file with levels the coarsest page comes first", { ...levelsOnly, hold: held.hold }, async ({ t, page, server }) => {
  await page.locator("#stats").check();
  await page.waitForFunction(() => /, [1-9] pages, \d+ wanted/.test(byId("overlay").textContent));
  await untilDrawn(page);
  const whole = readFileSync(levelsFile()).length;
  const first = server.bytes["scenes/0/levels.rgs"];
  assert.ok(await page.locator("#stream").isVisible());
  t.diagnostic(`first picture from ${first} of ${whole} bytes`);
  assert.ok(first < whole / 4, `${first} of ${whole} bytes`);
  held.open();
  await page.locator("#detail").fill("0");
  // Leaves alone: all Gaussians.
  await page.waitForFunction(() => /^60k of 60k Gaussians/.test(byId("overlay").textContent));
  // A budget holds.
  await page.locator("#budget").fill("4");
  await page.waitForFunction(() => /^(\d{4}|10k) of 60k Gaussians/.test(byId("overlay").textContent));
  const plain = await still(page, "#stage");
  assert.ok(await page.locator("#stream").isHidden());
  await page.locator("#tint").selectOption("level");
  await page.locator("#boxes").check();
  assert.notEqual(await still(page, "#stage"), plain);
});

const wideOnly = { view: { ...one.view, scenes: [scene("wide.rgs")] }, files: { "scenes/0/wide.rgs": join(scenes(), "wide.rgs"), "cameras.json": join(scenes(), "cameras.json") } };
let readTable;
let openTable;
const tableIsRead = new Promise((resolve) => (readTable = resolve));
const tableIsOpen = new Promise((resolve) => (openTable = resolve));
/** Holds what opening a file does not need of its table. */
const holdTable = async (url, begin) => {
  if (!url.endsWith("wide.rgs") || begin === 0 || begin >= (await firstPage())) return;
  readTable();
  await tableIsOpen;
};
async function firstPage() {
  const file = await open(readFileSync(join(scenes(), "wide.rgs")));
  const { offset } = file.levels.page(0);
  file.close();
  return offset;
}
inBrowser("the first picture does not wait for the whole table of pages", { ...wideOnly, hold: holdTable }, async ({ page }) => {
  await page.locator("#stats").check();
  await untilDrawn(page, 50);
  // Few pages are wanted from far away, of which some may be unknown; then idle readers read the table.
  await page.locator("#detail").fill("16");
  await page.locator("#picture").focus();
  for (let i = 0; i < 12; ++i) await page.keyboard.press("-");
  await tableIsRead;
  openTable();
  await page.waitForFunction(() => /\d pages(?!, )/.test(byId("overlay").textContent));
});

/** docs/format/FORMAT.md, "Error and cut", of every page by itself. */
function drawnPages({ levels, declarations }, { position, focalPx, detailPx }) {
  const isFine = ({ error, core: { min, max } }) => {
    const outside = position.map((p, i) => Math.max(min[i] - p, 0, p - max[i]));
    return error <= (detailPx * Math.max(declarations.zNear, Math.hypot(...outside))) / focalPx;
  };
  const all = Array.from({ length: levels.nPages }, (_, i) => levels.page(i));
  return all.filter((page) => isFine(page) && (page.parent < 0 || !isFine(all[page.parent])));
}

inBrowser("a view draws the pages that the format defines, inside a core too", { allowed: [k404] }, async ({ page }) => {
  const bytes = readFileSync(join(golden, "levels_packed.rgs"));
  const file = await open(bytes);
  await drop(page, "a.rgs", bytes);
  await page.waitForFunction(() => byId("title").textContent === "a.rgs");
  await page.locator("#stats").check();
  const width = await page.evaluate(() => byId("picture").width);
  const found = [];
  for (const [detailPx, z, focal, aspect] of [[0, 0, 0.5, 1], [1, 0, 0.5, 1], [2, 0, 0.5, 1], [2, 0, 0.5, 2], [4, 0, 0.5, 1], [4, 0, 0.5, 2], [0.25, -20, 20, 1], [1, -20, 20, 1], [2, -20, 20, 1]]) {
    await follow(page, { at: [0, 0, z], axes: [1, 0, 0, 0, 1, 0, 0, 0, 1], lens: [focal, aspect, 0, 0], pivot: [0, 0, z + 1], detail: detailPx });
    await settled(page);
    const expected = drawnPages(file, { position: [0, 0, z], focalPx: focal * width * aspect, detailPx });
    const n = expected.reduce((sum, { count }) => sum + count, 0);
    const overlay = await text(page, "#overlay");
    assert.ok(new RegExp(`^${n} of .*, ${expected.length} pages$`, "m").test(overlay), `detail ${detailPx} at ${z}: ${n} in ${expected.length} pages, not ${overlay}`);
    found.push(expected.length);
  }
  file.close();
  assert.deepEqual([...new Set(found)].sort(), [1, 2, 5], `${found}`);
});

inBrowser("bounds are drawn over the picture, and stay there", { allowed: [k404] }, async ({ page }) => {
  const yellow = async () => {
    return page.evaluate(async (base64) => {
      const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))]));
      const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
      context.drawImage(bitmap, 0, 0);
      const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
      let n = 0;
      for (let i = 0; i < data.length; i += 4) n += data[i] > 200 && data[i + 1] > 150 && data[i + 2] < 80;
      return n;
    }, await still(page));
  };
  // Two small Gaussians in corners of their box.
  await drop(page, "a.ply", plyOf([[0, 0, 0], [1, 1, 1]], 0.01));
  await page.waitForFunction(() => byId("title").textContent === "a.ply");
  const without = await yellow();
  await page.locator("#boxes").check();
  assert.ok((await yellow()) > without + 300, `${await yellow()} of ${without}`);
  await page.locator("#boxes").uncheck();
  assert.equal(await yellow(), without);
});

inBrowser("colours by error are of the view that is shown", levelsOnly, async ({ page }) => {
  // So far away that the coarsest page alone is drawn, with an error of less than four pixels.
  await page.locator("#detail").fill("16");
  await page.locator("#picture").focus();
  for (let i = 0; i < 12; ++i) await page.keyboard.press("-");
  await page.locator("#tint").selectOption("error");
  const near = await still(page);
  await page.locator("#picture").focus();
  for (let i = 0; i < 4; ++i) await page.keyboard.press("-");
  const far = await still(page);
  await page.locator("#tint").selectOption("none");
  assert.notEqual(await still(page), far);
  await page.locator("#tint").selectOption("error");
  assert.equal(await still(page), far);
  assert.notEqual(far, near);
});

inBrowser("a server that goes away is said, and what is there stays", { ...levelsOnly, hold: heldForEver.hold, allowed: [/ERR_(CONNECTION|EMPTY|SOCKET)/] }, async ({ page, server }) => {
  await server.end();
  await page.waitForFunction(() => byId("errors").children.length > 0);
  const [said] = await errors(page);
  assert.match(said, /^levels\.rgs is incomplete: reading failed, and is tried again .*start it again/);
  await untilDrawn(page);
});

let nRefused = 0;
let isRefusing = true;
const refuses = async (url, begin) => isRefusing && url.endsWith("levels.rgs") && begin >= (await secondPage()) && (nRefused += 1) && 404;
inBrowser("a server that comes back is read on", { ...levelsOnly, hold: refuses, allowed: [k404] }, async ({ page }) => {
  await page.locator("#stats").check();
  await page.locator("#detail").fill("0");
  await page.waitForFunction(() => byId("errors").children.length > 0);
  while (nRefused <= 4) await page.evaluate(() => new Promise(requestAnimationFrame));
  assert.match((await errors(page)).join(), /^levels\.rgs is incomplete: reading failed, .*\(read_failed: the server answers with HTTP 404\)/);
  isRefusing = false;
  await page.waitForFunction(() => /^60k of 60k Gaussians/.test(byId("overlay").textContent));
  assert.deepEqual(await errors(page), []);
});

inBrowser("damaged files are said, with code and byte", { allowed: [k404] }, async ({ t, page }) => {
  const reject = join(golden, "reject");
  const names = readdirSync(reject).filter((name) => name.endsWith(".rgs"));
  assert.ok(names.length > 200);
  const opened = [];
  for (const name of names) {
    // An error, or a scene: damage in a page is seen when that page is needed.
    const refused = await page.evaluate(
      async ([name, base64]) => {
        const data = new DataTransfer();
        data.items.add(new File([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))], name));
        const list = byId("errors");
        const loading = byId("loading");
        list.replaceChildren();
        document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
        await new Promise((resolve) => {
          const look = () => loading.hidden && (observer.disconnect(), resolve());
          const observer = new MutationObserver(look);
          observer.observe(loading, { attributes: true });
        });
        return list.textContent;
      },
      [name, readFileSync(join(reject, name)).toString("base64")],
    );
    if (refused === "") {
      opened.push(name);
      continue;
    }
    assert.ok(refused.startsWith(name), `${name}: ${refused}`);
    assert.match(refused, /\([a-z_]+( at byte \d+)?[:)]/, name);
  }
  t.diagnostic(`${names.length} files, ${opened.length} of them with pages that the first view did not need`);
  for (const name of opened) {
    const file = await open(readFileSync(join(reject, name)));
    assert.ok(file.levels, name);
    file.close();
  }
  // The page still does what it is told.
  await page.locator("#theme").click();
});

/** Draws what the page asks for with rgs-render, as rgs-view does with the same library. */
function renderer() {
  let n = 0;
  return async (request) => {
    const { camera, width, height, background, sh_degree } = request;
    const cameras = join(folder, `camera-${(n += 1)}.json`);
    const out = join(folder, `frame-${n}.png`);
    writeFileSync(cameras, JSON.stringify([{ ...camera, world_to_camera: undefined }]));
    const settings = ["--size", `${width}x${height}`, "--background", background.join(","), "--sh-degree", String(sh_degree)];
    execFileSync(program("rgs-render"), [join(scenes(), "packed.rgs"), "--cameras", cameras, "--backend", "cpu", "--quiet", ...settings, "--out", out]);
    return out;
  };
}
const framed = { ...one.view, frames: { url: "frame", backend: "cpu" } };

inBrowser("the reference picture beside the engine's", { ...one, view: framed, files: one.files(), frame: renderer() }, async ({ t, page, server }) => {
  await page.locator("#picture").focus();
  await page.keyboard.press("n");
  await page.keyboard.press("t");
  await page.locator("#reference-picture").waitFor();
  await page.waitForFunction(() => byId("reference-picture").width === byId("picture").width);
  assert.ok(server.requests.includes("POST frame"));
  // Of another size it is another picture.
  await page.setViewportSize({ width: 640, height: 360 });
  await page.waitForFunction(() => byId("picture").width !== 800 && byId("reference-picture").width === byId("picture").width);
  await page.keyboard.press("x");
  await page.locator("#map").waitFor();
  const db = Number(/^([\d.]+) dB$/.exec(await text(page, "#psnr"))?.[1]);
  t.diagnostic(`${db} dB`);
  assert.ok(db >= 35, `${db} dB`);
});

const refusing = async () => ({ status: 500, error: { code: "host_out_of_memory", message: "it is too large", offset: null } });
inBrowser("a picture that the server refuses is said", { ...one, view: framed, files: one.files(), frame: refusing, allowed: [/500/] }, async ({ page }) => {
  await page.locator("#picture").focus();
  await page.keyboard.press("t");
  await page.waitForFunction(() => byId("errors").children.length > 0);
  assert.match((await errors(page))[0], /^The reference picture could not be made: host_out_of_memory: it is too large\./);
});

let red;
let nBusy = 0;
const busyFirst = async () => ((nBusy += 1) <= 2 ? { status: 503, error: { code: "busy", message: "later" }, headers: { "Retry-After": "0" } } : red);
inBrowser("a busy server is asked again, and a screenshot has the reference picture", { ...one, view: framed, files: one.files(), frame: busyFirst, allowed: [/503/] }, async ({ page }) => {
  const base64 = await page.evaluate(async () => {
    const canvas = new OffscreenCanvas(1000, 1000);
    const context = canvas.getContext("2d");
    context.fillStyle = "red";
    context.fillRect(0, 0, 1000, 1000);
    return btoa(String.fromCharCode(...new Uint8Array(await (await canvas.convertToBlob()).arrayBuffer())));
  });
  red = join(folder, "red.png");
  writeFileSync(red, Buffer.from(base64, "base64"));
  await page.locator("#picture").focus();
  await page.keyboard.press("t");
  await page.waitForFunction(() => byId("reference-picture").width === 1000);
  assert.ok(nBusy > 2);
  assert.deepEqual(await errors(page), []);
  const [download] = await Promise.all([page.waitForEvent("download"), page.locator("#screenshot").click()]);
  const png = readFileSync(await download.path()).toString("base64");
  const colour = await page.evaluate(async (base64) => {
    const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))]));
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
    context.drawImage(bitmap, 0, 0);
    return [...context.getImageData(bitmap.width / 2, bitmap.height / 2, 1, 1).data];
  }, png);
  assert.deepEqual(colour, [255, 0, 0, 255]);
});

inBrowser("a lost device is said, and comes back", { ...one, files: one.files(), allowed: [/context/i] }, async ({ page }) => {
  await page.evaluate(() => {
    window.lose = byId("picture").getContext("webgl2").getExtension("WEBGL_lose_context");
    window.lose.loseContext();
  });
  await page.waitForFunction(() => byId("errors").children.length > 0);
  assert.match((await errors(page))[0], /^The graphics device was lost/);
  await page.evaluate(() => window.lose.restoreContext());
  await page.waitForFunction(() => byId("status").textContent === "The graphics device is back");
  assert.deepEqual(await errors(page), []);
  await untilDrawn(page);
});

test("a browser without WebGL 2 is told so", async (t) => {
  if (!browser) return skip(t, "chromium is not installed");
  const server = await startServer();
  const page = await newPage(browser);
  t.after(() => Promise.all([page.close(), server.end()]));
  await page.addInitScript(() => (HTMLCanvasElement.prototype.getContext = () => null));
  await page.goto(server.url);
  await page.waitForSelector("#errors p");
  assert.match((await errors(page))[0], /^This browser has neither WebGPU nor WebGL 2/);
});

inBrowser("a screenshot is named as the scene is, whatever that is", { allowed: [k404] }, async ({ page }) => {
  await page.locator("#screenshot").click();
  assert.match((await errors(page))[0], /^There is no picture to save yet\. Open a scene first\./);
  const name = "a scene #1, 100%41.rgs";
  await drop(page, name, readFileSync(join(golden, "degree3.rgs")));
  await page.waitForFunction((name) => byId("title").textContent === name, name);
  assert.equal(await page.title(), `${name} | RoofGS viewer`);
  const [download] = await Promise.all([page.waitForEvent("download"), page.locator("#screenshot").click()]);
  assert.equal(download.suggestedFilename(), `${name}.png`);
});

inBrowser("a screenshot has the picture's size", { ...one, files: one.files() }, async ({ page }) => {
  const [download] = await Promise.all([page.waitForEvent("download"), page.locator("#screenshot").click()]);
  assert.equal(download.suggestedFilename(), "packed.rgs.png");
  const png = readFileSync(await download.path());
  const { width, height } = await page.evaluate(() => byId("picture"  ).getBoundingClientRect().toJSON());
  assert.deepEqual([png.readUInt32BE(16), png.readUInt32BE(20)], [Math.round(width), Math.round(height)]);
});

inBrowser("a PLY comes through the engine", { view: { ...one.view, scenes: [scene("scene.ply")] }, files: { ...one.files(), "scenes/0/scene.ply": join(scenes(), "scene.ply") } }, async ({ page }) => {
  assert.match(await page.getAttribute("#picture", "aria-label"), /scene\.ply, 60k Gaussians/);
  await untilDrawn(page);
});

/** Presses a button that saves; the download's name and bytes. */
async function saved(page, name) {
  const [download] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name }).click()]);
  return { name: download.suggestedFilename(), bytes: readFileSync(await download.path()) };
}

inBrowser("a dropped PLY is saved as the .rgs that rgs-convert makes of it", { allowed: [k404], panel: "" }, async ({ page, server }) => {
  const ply = firstOf(join(scenes(), "scene.ply"), 20000);
  // The opacity of a few Gaussians.
  const begin = ply.indexOf("end_header\n") + "end_header\n".length;
  const names = [...ply.toString("latin1", 0, begin).matchAll(/^property float (\w+)/gm)].map(([, name]) => name);
  for (let i = 0; i < 3; ++i) ply.writeFloatLE(NaN, begin + 4 * (names.length * 1000 * i + names.indexOf("opacity")));
  await drop(page, "scene.ply", ply);
  await page.getByRole("button", { name: "Save as .rgs" }).click();
  const wasm = () => server.requests.filter((line) => /rgs-[^/]*wasm$/.test(line)).length;
  assert.equal(wasm(), 1, "the reader's alone");
  for (const [profile, levels] of [["packed", false], ["archive:small", false], ["direct", true]]) {
    await page.locator("#profile").selectOption(profile);
    await page.locator("#save-levels").setChecked(levels);
    const { name, bytes } = await saved(page, "Save scene.rgs");
    assert.equal(name, "scene.rgs");
    assert.ok(bytes.equals(byProgramOf(ply, "--profile", profile, ...(levels ? ["--lod"] : [])).bytes), profile);
    await page.locator("#save-scenes").waitFor();
    assert.match(await text(page, "#saved"), /^scene\.rgs: [\d.]+ [kM]B instead of 5\.0 MB; 3 of 20k Gaussians were damaged and are left out$/);
  }
  assert.ok(wasm() > 1);
  assert.ok(await page.locator("#saving").isHidden());
  assert.deepEqual(server.requests.filter((line) => !/^(GET|HEAD) /.test(line)), []);
  assert.deepEqual(await errors(page), ["scene.ply has damaged Gaussians, with NaN or infinity, which are left out. (gaussians_damaged: 3 of 20000)"]);
});

const plyOnly = { ...one.view, scenes: [scene("scene.ply")] };
let isSaving = false;
let goOn = () => undefined;
const heldAgain = async (url) => {
  if (!isSaving || url !== "scenes/0/scene.ply") return;
  await new Promise((resolve) => (goOn = resolve));
};
inBrowser("saving is cancelled, and begun again", { view: plyOnly, files: { ...one.files(), "scenes/0/scene.ply": join(scenes(), "scene.ply") }, hold: heldAgain, panel: "save" }, async ({ page }) => {
  const button = page.getByRole("button", { name: "Save scene.rgs" });
  page.on("download", () => assert.ok(!isSaving, "it was cancelled"));
  isSaving = true;
  await button.click();
  await page.locator("#saving").waitFor();
  assert.ok(await button.isHidden());
  await page.locator("#cancel-save").click();
  await button.waitFor();
  isSaving = false;
  goOn();
  assert.equal(await text(page, "#saved"), "");
  const { bytes } = await saved(page, "Save scene.rgs");
  assert.ok(bytes.equals(byProgramOf(readFileSync(join(scenes(), "scene.ply"))).bytes));
  assert.deepEqual(await errors(page), []);
});

inBrowser("what cannot be saved is said", { allowed: [k404, /ERR_CONNECTION/], panel: "save" }, async ({ page, server }) => {
  // A memory that this file does not fit into.
  await page.route(/worker-web-[\w-]+\.js$/, async (route) => {
    const answer = await route.fetch();
    await route.fulfill({ response: answer, body: (await answer.text()).replace(/2\s*\*\*\s*31|2147483647/, "1000") });
  });
  await drop(page, "house.ply", firstOf(join(scenes(), "scene.ply"), 1000));
  const button = page.getByRole("button", { name: "Save house.rgs" });
  await button.click();
  await page.waitForFunction(() => byId("errors").children.length > 0);
  assert.match((await errors(page))[0], /^house\.ply does not fit into this browser's memory\. Convert it with rgs-convert --lod.*host_out_of_memory/);
  await button.waitFor();
  // The server has gone.
  await page.unroute(/worker-web-[\w-]+\.js$/);
  await server.end();
  await button.click();
  await page.waitForFunction(() => byId("errors").children.length > 1);
  assert.match((await errors(page))[1], /^house\.ply could not be read: the worker for it does not start\..*unavailable/);
});

test("a PLY that rgs-view shows is saved, within the server's policy", async (t) => {
  if (!browser) return skip(t, "chromium is not installed");
  const path = join(folder, "scene.ply");
  writeFileSync(path, firstOf(join(scenes(), "scene.ply"), 1000));
  const server = spawn(program("rgs-view"), ["--no-browser", path], { env: { ...process.env, RGS_VIEWER_DIR: dist } });
  let said = "";
  for await (const part of server.stdout) if (/http:\S+\s/.test((said += part))) break;
  const page = await newPage(browser, { viewport: kSize });
  t.after(async () => {
    await page.close();
    server.kill("SIGINT");
  });
  const problems = [];
  page.on("console", (message) => message.type() === "error" && problems.push(message.text()));
  await page.goto(/http:\S+/.exec(said)[0]);
  await page.getByRole("button", { name: "Save as .rgs" }).click();
  const { bytes } = await saved(page, "Save scene.rgs");
  assert.ok(bytes.equals(byProgramOf(readFileSync(path)).bytes));
  assert.deepEqual(problems, []);
});

test("what rgs-view exports opens from the disk, with scene and cameras inside", async (t) => {
  if (!browser) return skip(t, "chromium is not installed");
  const path = join(folder, "look.html");
  execFileSync(program("rgs-view"), [join(scenes(), "packed.rgs"), "--cameras", join(scenes(), "cameras.json"), "--export", path]);
  const page = await newPage(browser, { viewport: kSize });
  t.after(() => page.close());
  const problems = [];
  page.on("console", (message) => message.type() === "error" && problems.push(message.text()));
  page.on("request", (request) => /^(file|data|blob):/.test(request.url()) || problems.push(request.url()));
  await page.goto(pathToFileURL(path).href);
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  assert.deepEqual(await errors(page), []);
  assert.equal(await text(page, "#title"), "packed.rgs");
  assert.equal(await page.locator("#cameras button").count(), 8);
  await untilDrawn(page);
  assert.deepEqual(problems, []);
});

test("the page shows its scene in a notebook's frame, which has no address", async (t) => {
  if (!browser) return skip(t, "chromium is not installed");
  const data = readFileSync(join(golden, "packed_degree3.rgs"));
  const view = { version: 1, scenes: [{ name: "a.rgs", url: "#rgs-file-0", bytes: data.length }], cameras: null, photos: [], frames: null };
  const inside = readFileSync(join(dist, "../dist-single/page.html"), "utf8").replace("<!-- rgs-view:insert -->", () =>
    `<script type="application/json" id="rgs-view">${JSON.stringify(view)}</script>` +
    `<script type="application/octet-stream;base64" id="rgs-file-0">${data.toString("base64")}</script>`);
  const page = await newPage(browser);
  t.after(() => page.close());
  const problems = [];
  page.on("pageerror", (error) => problems.push(String(error)));
  await page.setContent("<iframe width=640 height=360></iframe>");
  await page.evaluate((text) => (document.querySelector("iframe").srcdoc = text), inside);
  const shown = page.frameLocator("iframe").locator("rgs-view[data-ready]");
  await shown.waitFor({ state: "attached" });
  await page.frameLocator("iframe").locator("#link").click(); // which writes the view into the address
  assert.deepEqual(problems, []);
});

test("what rgs-view exports saves no .rgs", async (t) => {
  if (!browser) return skip(t, "chromium is not installed");
  const [ply, path] = [join(folder, "exported.ply"), join(folder, "ply.html")];
  writeFileSync(ply, firstOf(join(scenes(), "scene.ply"), 1000));
  execFileSync(program("rgs-view"), [ply, "--export", path]);
  const page = await newPage(browser, { viewport: kSize });
  t.after(() => page.close());
  await page.goto(pathToFileURL(path).href);
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  await drop(page, "b.ply", readFileSync(ply));
  await page.waitForFunction(() => byId("title").textContent === "exported.ply | b.ply" && byId("loading").hidden);
  assert.ok(await page.locator("#screenshot").isVisible());
  assert.ok(await page.locator("#save").isHidden());
});

test("what rgs-view exports has the photographs of its cameras", async (t) => {
  if (!browser) return skip(t, "chromium is not installed");
  const [path, photos] = [join(folder, "photos.html"), join(folder, "photos")];
  const [camera] = readCameras(join(scenes(), "cameras.json"));
  mkdirSync(photos);
  writeFileSync(join(folder, "camera.json"), JSON.stringify([camera]));
  execFileSync(program("rgs-render"), [join(scenes(), "packed.rgs"), "--cameras", join(folder, "camera.json"), "--backend", "cpu", "--quiet", "--size", "64x48", "--out", join(photos, `${camera.img_name}.png`)]);
  execFileSync(program("rgs-view"), [join(scenes(), "packed.rgs"), "--cameras", join(folder, "camera.json"), "--photos", photos, "--export", path]);
  const page = await newPage(browser, { viewport: kSize });
  t.after(() => page.close());
  await page.goto(pathToFileURL(path).href);
  await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
  await page.locator("#views").click();
  await page.waitForFunction(() => byId("cameras").querySelector("img")?.naturalWidth === 64);
});

const kMeasured = { "south.rgs": 0.25, "south-levels.rgs": 0.1 };
for (const [name, share] of Object.entries(kMeasured)) {
  test(`40 MB from the loopback address, ${name}`, async (t) => {
    if (!browser) return skip(t, "chromium is not installed");
    const folderOfSouth = process.env.RGS_WEB_SOUTH ? dirname(process.env.RGS_WEB_SOUTH) : "";
    if (!folderOfSouth) {
      if ((process.env.RGS_REQUIRE_DATA ?? "0") !== "0") throw new Error("RGS_REQUIRE_DATA is set, but there is no south");
      return t.skip("there is no south in RGS_DATA_DIR");
    }
    const path = join(folderOfSouth, name);
    const { size } = statSync(path);
    const url = `scenes/0/${name}`;
    // From a part of the file, the rest being held back.
    let goOn;
    const going = new Promise((resolve) => (goOn = resolve));
    const hold = async (asked) => asked === url && (server.bytes[url] ?? 0) > share * size && going;
    const view = { ...one.view, scenes: [scene(name)], cameras: null };
    const server = await startServer({ view, files: { [url]: path }, hold });
    const page = await newPage(browser, { viewport: { width: 320, height: 240 } });
    t.after(async () => {
      await page.close();
      await server.end();
    });
    const picture = (page) => page.waitForFunction((what) => performance.getEntriesByName(what, "measure")[0]?.duration, `first picture of ${name}`);
    await page.goto(server.url);
    const first = await (await picture(page)).jsonValue();
    await untilDrawn(page, 100);
    const bytes = server.bytes[url];
    // What was under way when the share was reached comes too.
    assert.ok(bytes < share * size + 3 * (1 << 22), `${bytes} of ${size} bytes`);
    if (name === "south.rgs") assert.ok(await page.locator("#loading").isVisible());
    goOn();
    await page.waitForSelector("rgs-view[data-ready]", { state: "attached" });
    const ms = await page.evaluate(() => performance.now());
    // The beginning is read first, and where all is read once more with the rest.
    if (name === "south.rgs") assert.ok(server.bytes[url] <= size + (1 << 17), `${server.bytes[url]} bytes`);
    assert.ok(await page.locator("#loading").isHidden());
    // A page that is there already.
    const other = await newPage(browser, { viewport: { width: 320, height: 240 } });
    await other.goto(`${server.url}index.html?scene=`);
    await other.setInputFiles("#file", path);
    const chosen = await (await picture(other)).jsonValue();
    await other.close();
    t.diagnostic(`first picture after ${Math.round(first)} ms with the page itself, all of it after ${Math.round(ms)} ms; chosen in a page that is there after ${Math.round(chosen)} ms`);
  });
}
