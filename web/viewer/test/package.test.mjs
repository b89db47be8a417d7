// package.test.mjs - what `npm pack` makes of the page, in an empty project, and what the page's policy allows.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { execFileSync } from "node:child_process";
import { existsSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import test from "node:test";
import { fileURLToPath } from "node:url";

const viewer = fileURLToPath(new URL("..", import.meta.url));
const tsc = fileURLToPath(new URL("../../node_modules/typescript/bin/tsc", import.meta.url));

const kTypes = `
import type { RgsView, RgsViewEvents } from "@roofgs/viewer";
import "@roofgs/viewer";
const view: RgsView = document.createElement("rgs-view");
const found: RgsView | null = document.querySelector("rgs-view");
const isThere: boolean = await view.flyTo("view2");
const png: Blob = await view.screenshot();
await view.compare(new File([], "a.rgs"));
await found?.compare();
view.addEventListener("error", ({ detail }) => console.log(detail.message));
view.addEventListener("progress", ({ detail }) => console.log(detail?.share ?? 0));
view.addEventListener("camera", ({ detail: { name, link } }) => console.log(name ?? "", link.length));
view.addEventListener("keydown", ({ code }) => console.log(code));
// @ts-expect-error: ready has no detail
view.addEventListener("ready", ({ detail }) => detail.message);
// @ts-expect-error: there is no such method
view.land();
const failed: RgsViewEvents["error"] = { message: "" };
console.log(isThere, png, failed);
`;

function policyOf(html) {
  const [, policy] = /<meta http-equiv="Content-Security-Policy" content="([^"]+)">/.exec(html) ?? [];
  assert.ok(policy, "no policy");
  return Object.fromEntries(policy.split("; ").map((rule) => [rule.split(" ")[0], rule.split(" ").slice(1)]));
}

test("the page's package", async (t) => {
  const folder = mkdtempSync(join(tmpdir(), "rgs-web-package-"));
  t.after(() => rmSync(folder, { recursive: true }));
  const npm = (...args) => execFileSync("npm", args, { cwd: folder, encoding: "utf8", stdio: ["ignore", "pipe", "pipe"] });
  const [packed] = JSON.parse(npm("pack", viewer, "--json", "--ignore-scripts"));
  writeFileSync(join(folder, "package.json"), `{"name": "empty", "private": true, "type": "module"}`);
  npm("install", "--offline", "--no-audit", "--no-fund", join(folder, packed.filename));
  const installed = join(folder, "node_modules/@roofgs/viewer");
  const folderPage = readFileSync(join(installed, "dist/index.html"), "utf8");
  const singlePage = readFileSync(join(installed, "dist-single/page.html"), "utf8");

  await t.test("holds what it needs and nothing else", (t) => {
    t.diagnostic(`${packed.size} bytes, ${singlePage.length} of them the page in one file before it is packed`);
    const names = packed.files.map(({ path }) => path);
    for (const needed of ["package.json", "README.md", "LICENSE", "NOTICE"]) assert.ok(names.includes(needed), needed);
    const known = /^(package\.json|README\.md|LICENSE|NOTICE|dist\/index\.html|dist\/assets\/[\w-]+\.(js|wasm)|dist-single\/(page\.html|rgs-view\.js)|rgs-view\.d\.ts)$/;
    assert.deepEqual(names.filter((name) => !known.test(name)), []);
    for (const part of [/PlayCanvas/, /Zstandard/]) assert.match(readFileSync(join(installed, "NOTICE"), "utf8"), part);
  });

  await t.test("has types", () => {
    writeFileSync(join(folder, "types.ts"), kTypes);
    const flags = "--noEmit --strict --target es2022 --module nodenext --lib es2022,dom types.ts".split(" ");
    execFileSync(process.execPath, [tsc, ...flags], { cwd: folder, encoding: "utf8" });
  });

  await t.test("every address is relative and there", () => {
    const addresses = [...folderPage.matchAll(/(?:src|href)="([^"#]+)"/g)].map(([, address]) => address).filter((address) => !address.startsWith("data:"));
    assert.ok(addresses.length >= 1);
    for (const address of addresses) assert.ok(address.startsWith("./") && existsSync(join(installed, "dist", address)), address);
  });

  await t.test("the folder's policy allows its own scripts alone", () => {
    const policy = policyOf(folderPage);
    assert.deepEqual(policy["default-src"], ["'none'"]);
    assert.deepEqual(policy["script-src"], ["'self'", "'wasm-unsafe-eval'"]);
    assert.deepEqual(policy["connect-src"], ["'self'", "blob:"]);
    assert.ok(!/<script(?![^>]*src=)/.test(folderPage), "a script inside the page");
  });

  await t.test("the single file's policy names its script by its hash", () => {
    const policy = policyOf(singlePage);
    const hash = (text) => `'sha256-${createHash("sha256").update(text).digest("base64")}'`;
    const script = /<script type="module">([\s\S]*?)<\/script>/.exec(singlePage)[1];
    assert.deepEqual(policy["script-src"], [hash(script), "'wasm-unsafe-eval'"]);
    assert.deepEqual(policy["connect-src"], ["blob:", "data:"]);
    assert.equal(singlePage.split("<!-- rgs-view:insert -->").length, 2);
    assert.ok(!/(?:src|href)="(?!data:|#)/.test(singlePage.replace(script, "")), "an address");
  });
});
