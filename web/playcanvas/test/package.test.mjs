// package.test.mjs - what `npm pack` makes, installed into an empty project beside the reader's and the engine's.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync, spawnSync } from "node:child_process";
import { mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import test from "node:test";
import { fileURLToPath } from "node:url";

const kUse = `
import { resizePinhole, RgsParser, RgsResource } from "@roofgs/playcanvas";
const parser = new RgsParser({});
const camera = { width: 400, height: 300, fx: 500, fy: 500, cx: 210, position: [0, 0, 0], rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]] };
const { fx, cx, cy } = resizePinhole(camera, 200, 200);
console.log(parser.canParse({ ext: "rgs" }), parser.canParse({ ext: "ply" }), RgsResource.name, fx, cx, cy);
`;
const kTypes = `
import { drawAsDefined, RgsError, RgsParser, RgsResource, setPinhole } from "@roofgs/playcanvas";
import { type AppBase, Entity, type GSplatHandler } from "playcanvas";
export function use(app: AppBase, camera: Entity): void {
  (app.loader.getHandler("gsplat") as GSplatHandler).addParser(new RgsParser(app, { limits: { maxGaussians: 1e6 } }));
  const resource = new RgsResource(app.graphicsDevice, []);
  if (camera.camera) drawAsDefined(app, camera.camera, resource.antiAliasing);
  new Entity().addComponent("gsplat", { resource });
  // @ts-expect-error: no such camera
  setPinhole(camera, { width: 1 });
  console.log(RgsError.name);
}
`;

test("the package of the engine's parser", async (t) => {
  const folder = mkdtempSync(join(tmpdir(), "rgs-web-package-"));
  t.after(() => rmSync(folder, { recursive: true }));
  const workspace = (path) => fileURLToPath(new URL(`../../${path}`, import.meta.url));
  const npm = (...args) => execFileSync("npm", args, { cwd: folder, encoding: "utf8", stdio: ["ignore", "pipe", "pipe"] });
  const pack = (path) => JSON.parse(npm("pack", workspace(path), "--json", "--ignore-scripts"))[0];
  const packed = pack("playcanvas");

  await t.test("holds what it needs and nothing else", () => {
    const names = packed.files.map(({ path }) => path);
    for (const needed of ["package.json", "README.md", "LICENSE", "dist/index.js", "dist/index.d.ts"]) assert.ok(names.includes(needed), needed);
    assert.deepEqual(names.filter((name) => !/^(package\.json|README\.md|LICENSE|dist\/[a-z-]+\.(js|d\.ts))$/.test(name)), []);
  });

  await t.test("works in an empty project", () => {
    const archives = [packed, pack("reader"), pack("node_modules/playcanvas")].map(({ filename }) => join(folder, filename));
    writeFileSync(join(folder, "package.json"), `{"name": "empty", "private": true, "type": "module"}`);
    // The engine's own dependencies too: npm's cache need not have what `npm ci` reads from the lock file.
    const types = ["@types/webxr", "@webgpu/types"].map((name) => workspace(`node_modules/${name}`));
    npm("install", "--offline", "--no-audit", "--no-fund", "--legacy-peer-deps", ...types, ...archives);
    writeFileSync(join(folder, "use.js"), kUse);
    const said = execFileSync(process.execPath, ["use.js"], { cwd: folder, encoding: "utf8" });
    assert.equal(said, "true false RgsResource 250 105 100\n");
  });

  await t.test("has types", () => {
    writeFileSync(join(folder, "types.ts"), kTypes);
    const flags = "--noEmit --strict --skipLibCheck --target es2022 --module nodenext --lib es2022,dom types.ts".split(" ");
    const said = spawnSync(process.execPath, [workspace("node_modules/typescript/bin/tsc"), ...flags], { cwd: folder, encoding: "utf8" });
    assert.equal(said.stdout, "");
  });
});
