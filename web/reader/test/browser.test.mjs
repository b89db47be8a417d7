// browser.test.mjs - in a real browser: over http by ranges in a worker, a Blob that is dropped, a page that keeps drawing.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { copyFileSync, cpSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import test from "node:test";
import { fileURLToPath } from "node:url";
import { open } from "@roofgs/reader";
import { hasChromium, launch, newPage } from "./chromium.mjs";
import { golden, scenes } from "./dump.mjs";
import { hasNginx, skip, startNginx } from "./servers.mjs";

// What a page must allow: its own scripts and workers, WebAssembly, and the file's server.
const kPolicy = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; connect-src 'self' http://127.0.0.1:*";

const kPage = `<!doctype html><meta charset="utf-8"><title>reader</title><body>drop here<script type="module" src="page.js"></script>`;
const kScript = `
import { open } from "./dist/web.js";
async function hashes(gaussians) {
  const found = {};
  for (const [name, value] of Object.entries(gaussians)) {
    if (!ArrayBuffer.isView(value)) found[name] = value;
    else found[name] = [...new Uint8Array(await crypto.subtle.digest("SHA-256", value))].map((b) => b.toString(16).padStart(2, "0")).join("");
  }
  return found;
}
async function all(source, options) {
  try {
    const file = await open(source, options);
    try {
      return { header: file.header, pages: file.levels?.nPages ?? 0, gaussians: await hashes(await file.read(options)) };
    } finally {
      file.close();
    }
  } catch (error) {
    return { error: error.code ?? String(error), offset: error.offset, isRgsError: error.name };
  }
}
async function page(source, index) {
  const file = await open(source);
  try {
    return await hashes(await file.readPage(index));
  } finally {
    file.close();
  }
}
document.addEventListener("dragover", (event) => event.preventDefault());
document.addEventListener("drop", async (event) => {
  event.preventDefault();
  window.dropped = await all(event.dataTransfer.files[0]);
});
function inWorker(url) {
  return new Promise((resolve) => {
    const worker = new Worker("worker.js", { type: "module" });
    worker.onmessage = ({ data }) => resolve(data);
    worker.postMessage(url);
  });
}
window.reader = { all, page, inWorker };
`;
const kWorker = `
import { open } from "./dist/web.js";
onmessage = async ({ data: url }) => {
  try {
    const file = await open(url);
    postMessage((await file.read()).n);
  } catch (error) {
    postMessage(String(error));
  }
};
`;

async function hashesOf(gaussians) {
  const found = {};
  for (const [name, value] of Object.entries(gaussians)) {
    found[name] = ArrayBuffer.isView(value) ? createHash("sha256").update(value).digest("hex") : value;
  }
  return found;
}

async function expectedOf(name) {
  const file = await open(readFileSync(join(golden, name)));
  const found = { header: file.header, pages: file.levels?.nPages ?? 0, gaussians: await hashesOf(await file.read()) };
  const page = file.levels ? await hashesOf(await file.readPage(3)) : null;
  file.close();
  return { found, page };
}

test("in Chromium", async (t) => {
  if (!hasChromium) return skip(t, "chromium is not installed");
  if (!hasNginx) return skip(t, "nginx is not installed");
  const server = await startNginx(`add_header Content-Security-Policy "${kPolicy}";`);
  const other = await startNginx("add_header Access-Control-Allow-Origin *; add_header Access-Control-Expose-Headers ETag;");
  const browser = await launch();
  t.after(async () => {
    await browser.close();
    await server.end();
    await other.end();
  });
  cpSync(fileURLToPath(new URL("../dist", import.meta.url)), join(server.files, "dist"), { recursive: true });
  writeFileSync(join(server.files, "index.html"), kPage);
  writeFileSync(join(server.files, "page.js"), kScript);
  writeFileSync(join(server.files, "worker.js"), kWorker);
  for (const name of ["packed_degree3.rgs", "levels_packed.rgs", "archive3_degree3.rgs"]) {
    copyFileSync(join(golden, name), join(server.files, name));
    copyFileSync(join(golden, name), join(other.files, name));
  }
  const page = await newPage(browser);
  const problems = [];
  page.on("pageerror", (error) => problems.push(String(error)));
  page.on("console", (message) => message.type() === "error" && problems.push(message.text()));
  await page.goto(`${server.url}/index.html`);
  await page.waitForFunction(() => "reader" in window);

  for (const name of ["packed_degree3.rgs", "levels_packed.rgs", "archive3_degree3.rgs"]) {
    const expected = await expectedOf(name);
    await t.test(`${name} over http`, async () => {
      assert.deepEqual(await page.evaluate((url) => window.reader.all(url), `${server.url}/${name}`), expected.found);
      assert.match(server.log(), new RegExp(`"GET /${name} HTTP/1.1" 206 `));
    });
    await t.test(`${name} of another origin, whose sizes a page does not see`, async () => {
      assert.deepEqual(await page.evaluate((url) => window.reader.all(url), `${other.url}/${name}`), expected.found);
    });
    await t.test(`${name}, dropped`, async () => {
      const bytes = readFileSync(join(golden, name)).toString("base64");
      await page.evaluate((text) => {
        window.dropped = undefined;
        const data = new DataTransfer();
        data.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], "scene.rgs"));
        document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
      }, bytes);
      await page.waitForFunction(() => window.dropped !== undefined);
      assert.deepEqual(await page.evaluate(() => window.dropped), expected.found);
    });
    if (expected.page) {
      await t.test(`a page of ${name}`, async () => {
        assert.deepEqual(await page.evaluate((url) => window.reader.page(url, 3), `${server.url}/${name}`), expected.page);
      });
    }
  }

  await t.test("a larger file by several requests, in a worker", async () => {
    copyFileSync(join(scenes(), "packed.rgs"), join(server.files, "large.rgs"));
    const file = await open(readFileSync(join(scenes(), "packed.rgs")));
    const expected = await hashesOf(await file.read());
    file.close();
    const worker = page.waitForEvent("worker");
    const found = await page.evaluate((url) => window.reader.all(url), `${server.url}/large.rgs`);
    assert.deepEqual(found.gaussians, expected);
    await worker;
    const requests = server.log().split("\n").filter((line) => line.includes("GET /large.rgs"));
    // 304: the browser asks whether what it has kept of the beginning still holds.
    assert.ok(requests.length >= 2 && requests.every((line) => / (206|304) /.test(line)), requests.join("\n"));
  });

  await t.test("a worker of the page's own asks another origin no more leave than the page does", async () => {
    copyFileSync(join(scenes(), "packed.rgs"), join(other.files, "large.rgs"));
    assert.equal(await page.evaluate((url) => window.reader.inWorker(url), `${other.url}/large.rgs`), 60000);
    assert.doesNotMatch(other.log(), /"OPTIONS /);
  });

  await t.test("damaged files give an error", async () => {
    copyFileSync(join(golden, "reject", "checksum_GEOM.rgs"), join(server.files, "damaged.rgs"));
    const found = await page.evaluate((url) => window.reader.all(url), `${server.url}/damaged.rgs`);
    assert.equal(found.error, "checksum_mismatch");
    assert.equal(found.isRgsError, "RgsError");
    assert.equal(typeof found.offset, "number");
  });

  await t.test("a server that is away gives an error", async () => {
    const found = await page.evaluate(() => window.reader.all("http://127.0.0.1:1/x.rgs", { url: { retries: 0 } }));
    assert.equal(found.error, "open_failed");
    problems.length = 0; // the browser says so too
  });

  await t.test("the page has nothing to complain of", () => assert.deepEqual(problems, []));
});
