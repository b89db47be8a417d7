// package.test.mjs - what `npm pack` makes, installed into an empty project beside the reader's.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync, spawnSync } from "node:child_process";
import { mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import test from "node:test";
import { fileURLToPath } from "node:url";

const kUse = `
import { antiAliasingOf, requestDevice, SplatRenderer } from "@roofgs/webgpu";
const of = (aaMode, coarser) => Object.values(antiAliasingOf({ aaMode, lowPassPx2: 0.5 }, coarser)).join();
console.log(of("undeclared"), of("classic"), of("mip_splatting"), of("classic", true), requestDevice.name, SplatRenderer.name);
`;
const kTypes = `
import { open, RgsError } from "@roofgs/reader";
import { antiAliasingOf, type Frame, type Pinhole, SplatRenderer } from "@roofgs/webgpu";
export async function use(device: GPUDevice, texture: GPUTexture, pinhole: Pinhole): Promise<Frame> {
  const renderer = await SplatRenderer.create(device);
  const file = await open("scene.rgs");
  renderer.setParts([renderer.add(await file.readStored())]);
  renderer.setView(pinhole, file.declarations.origin);
  // @ts-expect-error: no such camera
  renderer.setView({ width: 1 });
  console.log(RgsError.name);
  return renderer.render(texture, { antiAliasing: antiAliasingOf(file.declarations), background: [1, 1, 1] });
}
`;

test("the package of the renderer", async (t) => {
  const folder = mkdtempSync(join(tmpdir(), "rgs-web-package-"));
  t.after(() => rmSync(folder, { recursive: true }));
  const workspace = (path) => fileURLToPath(new URL(`../../${path}`, import.meta.url));
  const npm = (...args) => execFileSync("npm", args, { cwd: folder, encoding: "utf8", stdio: ["ignore", "pipe", "pipe"] });
  const pack = (path) => JSON.parse(npm("pack", workspace(path), "--json", "--ignore-scripts"))[0];
  const packed = pack("webgpu");

  await t.test("holds what it needs and nothing else", () => {
    const names = packed.files.map(({ path }) => path);
    for (const needed of ["package.json", "README.md", "LICENSE", "dist/index.js", "dist/index.d.ts", "dist/shaders/blend.js"]) assert.ok(names.includes(needed), needed);
    assert.deepEqual(names.filter((name) => !/^(package\.json|README\.md|LICENSE|dist\/(shaders\/)?[a-z-]+\.(js|d\.ts))$/.test(name)), []);
  });

  await t.test("works in an empty project, without a browser", () => {
    const archives = [packed, pack("reader")].map(({ filename }) => join(folder, filename));
    writeFileSync(join(folder, "package.json"), `{"name": "empty", "private": true, "type": "module"}`);
    npm("install", "--offline", "--no-audit", "--no-fund", workspace("node_modules/@webgpu/types"), ...archives);
    writeFileSync(join(folder, "use.js"), kUse);
    const said = execFileSync(process.execPath, ["use.js"], { cwd: folder, encoding: "utf8" });
    assert.equal(said, "0.3,false 0.5,false 0.5,true 0.1,true requestDevice SplatRenderer\n");
  });

  await t.test("has types", () => {
    writeFileSync(join(folder, "types.ts"), kTypes);
    const flags = "--noEmit --strict --skipLibCheck --target es2022 --module nodenext --lib es2022,dom --types @webgpu/types types.ts".split(" ");
    const said = spawnSync(process.execPath, [workspace("node_modules/typescript/bin/tsc"), ...flags], { cwd: folder, encoding: "utf8" });
    assert.equal(said.stdout, "");
  });
});
