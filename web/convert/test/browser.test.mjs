// browser.test.mjs - in a real browser: a page converts a File, and nothing leaves it.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { copyFileSync, cpSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import test from "node:test";
import { fileURLToPath } from "node:url";
import { hasChromium, launch, newPage } from "../../reader/test/chromium.mjs";
import { hasNginx, skip, startNginx } from "../../reader/test/servers.mjs";
import { byProgram, scene } from "./same.mjs";

const kPage = `<!doctype html><meta charset="utf-8"><title>convert</title><link rel="icon" href="data:,">
<script type="importmap">{ "imports": { "@roofgs/reader": "./reader/web.js" } }</script><script type="module" src="page.js"></script>`;
const kScript = `
import { convert } from "./convert/web.js";
/** The file, or its first \`size\` bytes as a File. */
window.run = async (size, options, stopAt) => {
  const controller = new AbortController();
  const stages = new Set();
  const onProgress = ({ stage }) => {
    stages.add(stage);
    if (stage === stopAt) controller.abort();
  };
  const source = size === undefined ? "house.ply" : new File([(await (await fetch("house.ply")).blob()).slice(0, size)], "house.ply");
  try {
    const { blob, report } = await convert(source, { ...options, onProgress, signal: controller.signal });
    const hash = new Uint8Array(await crypto.subtle.digest("SHA-256", await blob.arrayBuffer()));
    return { hash: [...hash].map((b) => b.toString(16).padStart(2, "0")).join(""), n: report.nWritten, stages: [...stages] };
  } catch (error) {
    return { name: error.name, code: error.code, offset: error.offset };
  }
};
`;

test("in Chromium", async (t) => {
  if (!hasChromium) return skip(t, "chromium is not installed");
  if (!hasNginx) return skip(t, "nginx is not installed");
  const server = await startNginx();
  const browser = await launch();
  t.after(async () => {
    await browser.close();
    await server.end();
  });
  for (const name of ["convert", "reader"]) {
    cpSync(fileURLToPath(new URL(`../../${name}/dist`, import.meta.url)), join(server.files, name), { recursive: true });
  }
  writeFileSync(join(server.files, "index.html"), kPage);
  writeFileSync(join(server.files, "page.js"), kScript);
  const path = scene("house.ply", "--gaussians", "5k");
  copyFileSync(path, join(server.files, "house.ply"));
  const bytes = readFileSync(path);
  const page = await newPage(browser);
  const requests = [];
  page.context().on("request", (request) => requests.push(`${request.method()} ${request.url()}`));
  const problems = [];
  page.on("pageerror", (error) => problems.push(String(error)));
  page.on("console", (message) => message.type() === "error" && problems.push(message.text()));
  await page.goto(`${server.url}/index.html`);
  await page.waitForFunction(() => "run" in window);
  const run = (...args) => page.evaluate((all) => window.run(...all), args);
  const expected = (profile) => createHash("sha256").update(byProgram(path, "--profile", profile).bytes).digest("hex");

  for (const profile of ["packed", "archive:small"]) {
    await t.test(`a File as ${profile}`, async () => {
      const { hash, n, stages } = await run(bytes.length, { profile });
      assert.deepEqual({ hash, n }, { hash: expected(profile), n: 5000 });
      assert.deepEqual(stages.slice(0, 4), ["read", "scan", "sort", "encode"]);
    });
  }
  await t.test("a URL", async () => {
    assert.equal((await run(undefined, { profile: "direct" })).hash, expected("direct"));
  });
  await t.test("a damaged file", async () => {
    const found = await run(100_000, {});
    assert.deepEqual(found, { name: "RgsError", code: "truncated", offset: 100_000 });
  });
  await t.test("a signal", async () => {
    assert.equal((await run(bytes.length, { profile: "archive:high" }, "encode")).name, "AbortError");
  });
  await t.test("nothing leaves the page", () => {
    assert.deepEqual(requests.filter((request) => !request.startsWith(`GET ${server.url}/`)), []);
    assert.doesNotMatch(server.log(), /"(?:POST|PUT) /);
    assert.deepEqual(problems, []);
  });
});
