// package.test.mjs - what `npm pack` makes: how large it is, what is in it, and that an empty project can use it.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { statSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import test from "node:test";
import { fileURLToPath } from "node:url";
import { folder, scene } from "./same.mjs";

const kMostBytes = 700_000;
const packages = ["..", "../../reader"].map((path) => fileURLToPath(new URL(path, import.meta.url)));
const tsc = fileURLToPath(new URL("../../node_modules/typescript/bin/tsc", import.meta.url));

const kUse = `
import { readFileSync } from "node:fs";
import { convert, RgsError } from "@roofgs/convert";
import { open } from "@roofgs/reader";
const { blob, report } = await convert(readFileSync(process.argv[2]));
const file = await open(blob);
console.log(report.nWritten, (await file.read()).n, RgsError.name);
`;
const kTypes = `
import { convert, type Converted, type Profile, RgsError } from "@roofgs/convert";
const profile: Profile = "archive:small";
const made: Converted = await convert(new Blob([]), { profile, onProgress: ({ stage, done, total }) => console.log(stage, done / total) });
const dropped: number = made.report.nSource - made.report.nWritten;
// @ts-expect-error: no such profile
await convert("https://example.org/scene.ply", { profile: "small" }).catch((error: RgsError) => error.offset);
console.log(made.blob.size, dropped);
`;

test("the package", async (t) => {
  const npm = (...args) => execFileSync("npm", args, { cwd: folder, encoding: "utf8", stdio: ["ignore", "pipe", "pipe"] });
  const packed = packages.map((path) => JSON.parse(npm("pack", path, "--json", "--ignore-scripts"))[0]);

  await t.test(`has at most ${kMostBytes} bytes`, (t) => {
    const { size } = statSync(join(folder, packed[0].filename));
    t.diagnostic(`${size} bytes`);
    assert.ok(size <= kMostBytes, `${size} bytes`);
  });

  await t.test("holds what it needs and nothing else", () => {
    const names = packed[0].files.map(({ path }) => path);
    for (const needed of ["package.json", "README.md", "LICENSE", "NOTICE", "dist/rgs.wasm", "dist/web.js", "dist/node.js"]) {
      assert.ok(names.includes(needed), `no ${needed}`);
    }
    const others = names.filter((name) => !/^(package\.json|README\.md|LICENSE|NOTICE|dist\/[a-z-]+\.(js|d\.ts|wasm))$/.test(name));
    assert.deepEqual(others, []);
  });

  await t.test("works in an empty project", () => {
    writeFileSync(join(folder, "package.json"), `{"name": "empty", "private": true, "type": "module"}`);
    npm("install", "--offline", "--no-audit", "--no-fund", ...packed.map(({ filename }) => join(folder, filename)));
    writeFileSync(join(folder, "use.js"), kUse);
    const path = scene("small.ply", "--gaussians", "1000");
    assert.equal(execFileSync(process.execPath, ["use.js", path], { cwd: folder, encoding: "utf8" }), "1000 1000 RgsError\n");
    assert.match(npm("exec", "--offline", "--", "rgs-convert", path, "small.rgs"), /^small\.rgs: 1000 Gaussians/);
  });

  await t.test("has types", () => {
    writeFileSync(join(folder, "types.ts"), kTypes);
    const flags = "--noEmit --strict --target es2022 --module nodenext --lib es2022,dom types.ts".split(" ");
    execFileSync(process.execPath, [tsc, ...flags], { cwd: folder, encoding: "utf8" });
  });
});
