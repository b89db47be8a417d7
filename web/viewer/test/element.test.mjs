// element.test.mjs - <rgs-view> in pages of others: attributes, methods, events, and several of them.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { join } from "node:path";
import test, { after, before } from "node:test";
import { fileURLToPath } from "node:url";
import { readCameras } from "../../playcanvas/test/pictures.mjs";
import { hasChromium, launch } from "../../reader/test/chromium.mjs";
import { scenes } from "../../reader/test/dump.mjs";
import { skip } from "../../reader/test/servers.mjs";
import { newPage, startServer } from "./server.mjs";

const viewer = fileURLToPath(new URL("..", import.meta.url));
const served = () => ({
  "example.html": join(viewer, "example.html"),
  "rgs-view.js": join(viewer, "dist-single/rgs-view.js"),
  "town.rgs": join(scenes(), "packed.rgs"),
  "other.rgs": join(scenes(), "low.rgs"),
  "cameras.json": join(scenes(), "cameras.json"),
});

let browser;
before(async () => {
  if (hasChromium) browser = await launch("webgl2");
});
after(() => browser?.close());

/** One test with the example page, or with `html` in its place. */
function inPage(name, { html, allowed = [] }, body) {
  test(name, async (t) => {
    if (!browser) return skip(t, "chromium is not installed");
    const server = await startServer({ files: served() });
    const page = await newPage(browser, { viewport: { width: 800, height: 600 } });
    const problems = [];
    page.on("console", (message) => message.type() === "error" && problems.push(message.text()));
    page.on("pageerror", (error) => problems.push(String(error)));
    t.after(async () => {
      await page.close();
      await server.end();
    });
    // Before the element starts.
    await page.addInitScript(() => {
      window.told = [];
      for (const name of ["ready", "progress", "error", "camera"]) addEventListener(name, ({ detail, target }) => target.localName === "rgs-view" && window.told.push([name, detail]), true);
    });
    await page.route("**/favicon.ico", (route) => route.fulfill({ status: 204 }));
    if (html) await page.route("**/example.html", (route) => route.fulfill({ contentType: "text/html", body: html }));
    await page.goto(`${server.url}example.html`);
    await page.waitForFunction(() => [...document.querySelectorAll("rgs-view")].every((element) => element.dataset.ready));
    await body({ page, server });
    assert.deepEqual(problems.filter((text) => !allowed.some((pattern) => pattern.test(text))), []);
  });
}

const settled = (element) => element.locator(`#picture[aria-busy="false"]`).waitFor();
const label = (element) => element.locator("#picture").getAttribute("aria-label");
const position = (link) => new URLSearchParams(link).get("at").split(",").map(Number);
const lastCamera = (page) => page.evaluate(() => window.told.filter(([name]) => name === "camera").at(-1)?.[1]);

inPage("the example page shows its scene, and moves to a camera", {}, async ({ page }) => {
  const element = page.locator("rgs-view");
  assert.match(await label(element), /^town\.rgs, 60k Gaussians/);
  assert.equal((await element.boundingBox()).height, 384);
  assert.equal(await page.title(), "A town");
  const told = await page.evaluate(() => window.told.map(([name]) => name));
  assert.ok(told.includes("progress") && told.includes("ready") && !told.includes("error"), `${told}`);
  const camera = readCameras(join(scenes(), "cameras.json"))[3];
  assert.equal(await element.evaluate((view, name) => view.flyTo(name), camera.img_name), true);
  await page.waitForFunction((name) => window.told.some(([event, detail]) => event === "camera" && detail.name === name), camera.img_name);
  const { link } = await lastCamera(page);
  position(link).forEach((value, i) => assert.ok(Math.abs(value - camera.position[i]) < 1e-5, link));
  assert.equal(new URL(page.url()).hash, "", "the address is the page's own");
  assert.equal(await element.evaluate((view) => view.flyTo("no such camera")), false);
  const size = await element.evaluate(async (view) => {
    const { width, height } = await createImageBitmap(await view.screenshot());
    const canvas = view.shadowRoot.getElementById("picture");
    return [width - canvas.width, height - canvas.height];
  });
  assert.deepEqual(size, [0, 0]);
});

inPage("a second scene comes and goes", {}, async ({ page }) => {
  const element = page.locator("rgs-view");
  await element.evaluate((view) => view.compare("other.rgs"));
  assert.match(await label(element), /beside other\.rgs/);
  await element.locator("#split").waitFor();
  await element.evaluate((view) => view.compare());
  assert.doesNotMatch(await label(element), /beside/);
  await element.locator("#split").waitFor({ state: "hidden" });
});

const several = `<!doctype html><title>two</title><script type="module" src="rgs-view.js"></script>
<rgs-view src="town.rgs" cameras="cameras.json" chrome="full"></rgs-view><rgs-view src="town.rgs" compare="other.rgs" chrome="none"></rgs-view>`;
inPage("several elements are several viewers", { html: several }, async ({ page }) => {
  const [first, second] = [page.locator("rgs-view").nth(0), page.locator("rgs-view").nth(1)];
  await page.addStyleTag({ content: "rgs-view { height: 250px }" });
  await settled(first);
  await settled(second);
  assert.match(await label(second), /beside other\.rgs/);
  assert.doesNotMatch(await label(first), /beside/);
  const still = async (element) => (await element.locator("#picture").screenshot()).toString("base64");
  const [one, two] = [await still(first), await still(second)];
  assert.ok(await second.locator("header").isHidden());
  await first.locator("#picture").focus();
  for (let i = 0; i < 2; ++i) await page.keyboard.press("n");
  await settled(first);
  assert.notEqual(await still(first), one);
  assert.equal(await still(second), two);
  // One that goes takes nothing of the other.
  await first.evaluate((element) => element.remove());
  const left = page.locator("rgs-view");
  await left.evaluate((view) => view.compare());
  assert.match(await label(left), /^town\.rgs, 60k Gaussians$/);
  await settled(left);
});

const posted = `<!doctype html><title>posted</title><script type="module" src="rgs-view.js"></script>
<rgs-view src="town.rgs" cameras="cameras.json" camera="view2" poster="data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAA="></rgs-view><div style="height: 2000px"></div>`;
inPage("an element begins with its poster and its camera, and leaves the wheel to the page until it is used", { html: posted }, async ({ page }) => {
  const element = page.locator("rgs-view");
  await element.locator("#poster").waitFor({ state: "detached" });
  const camera = readCameras(join(scenes(), "cameras.json"))[2];
  await page.waitForFunction((name) => window.told.some(([event, detail]) => event === "camera" && detail.name === name), camera.img_name);
  await page.addStyleTag({ content: "rgs-view { height: 300px }" });
  await settled(element);
  const box = await element.boundingBox();
  await page.mouse.move(box.x + 100, box.y + 100);
  await page.mouse.wheel(0, 100);
  await page.waitForFunction(() => scrollY > 0);
  await page.evaluate(() => scrollTo(0, 0));
  await element.locator("#picture").focus();
  const n = await page.evaluate(() => window.told.length);
  await page.mouse.wheel(0, 100);
  await page.waitForFunction((n) => window.told.slice(n).some(([name]) => name === "camera"), n);
  assert.equal(await page.evaluate(() => scrollY), 0);
  assert.equal((await lastCamera(page)).name, null, "nobody else's view has a camera's name");
});

inPage("another file is another scene, and one that is missing is told", { allowed: [/404/] }, async ({ page }) => {
  const element = page.locator("rgs-view");
  await element.evaluate((view) => ["town.rgs?again", "other.rgs"].forEach((src) => view.setAttribute("src", src)));
  await page.waitForFunction(() => /^other\.rgs/.test(byId("picture").getAttribute("aria-label")));
  await element.evaluate((view) => view.setAttribute("src", "missing.rgs"));
  await page.waitForFunction(() => window.told.some(([name]) => name === "error"));
  const [, { message }] = await page.evaluate(() => window.told.find(([name]) => name === "error"));
  assert.match(message, /^missing\.rgs /);
});

const missing = `<!doctype html><title>missing</title><script type="module" src="rgs-view.js"></script>
<rgs-view src="missing.rgs" poster="data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAA="></rgs-view>`;
inPage("a poster hides no error, and what is asked of an element that goes ends", { html: missing, allowed: [/404/] }, async ({ page }) => {
  const element = page.locator("rgs-view");
  await page.addStyleTag({ content: "rgs-view { height: 300px }" });
  await element.locator("#errors button").click();
  assert.equal(await element.locator("#errors p").count(), 0);
  await element.evaluate((view) => {
    const shot = () => view.screenshot().then(() => "a picture", ({ name }) => name);
    view.addEventListener("ready", () => {
      window.shot = shot();
      window.flown = view.flyTo("at=0,0,0&axes=1,0,0,0,1,0,0,0,1&lens=1,1,0,0&pivot=0,0,1");
      view.remove();
    });
    view.setAttribute("src", "town.rgs");
  });
  assert.equal(await page.waitForFunction(() => window.shot).then((shot) => shot.jsonValue()), "AbortError");
  assert.equal(await page.evaluate(() => window.flown), false);
});
