// package.test.mjs - what `npm pack` makes: how large it is, what is in it, and that an empty project can use it.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { mkdtempSync, rmSync, statSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import test from "node:test";
import { fileURLToPath } from "node:url";
import { golden } from "./dump.mjs";

const kMostBytes = 155_000;
const reader = fileURLToPath(new URL("..", import.meta.url));
const tsc = fileURLToPath(new URL("../../node_modules/typescript/bin/tsc", import.meta.url));

const kUse = `
import { readFileSync } from "node:fs";
import { open, RgsError } from "@roofgs/reader";
const file = await open(readFileSync(process.argv[2]));
const { n, means } = await file.read();
console.log(n, means.length, file.header.shDegree, RgsError.name);
// No close(): the worker does not keep the process.
`;
const kTypes = `
import { open, type Gaussians, type RgsFile, RgsError, type RgsErrorCode } from "@roofgs/reader";
const file: RgsFile = await open("https://example.org/scene.rgs", { signal: AbortSignal.timeout(1000) });
const g: Gaussians = await file.read({ onProgress: ({ phase, done, total }) => console.log(phase, done, total) });
const first: number | undefined = g.means[0];
const level: number | undefined = file.levels?.page(0).level;
// @ts-expect-error: no such axis
const wrong: boolean = file.declarations.axes[0] === "north";
const code: RgsErrorCode = new RgsError({ code: "truncated", text: "" }).code;
console.log(first, level, wrong, code);
`;

test("the package", async (t) => {
  const folder = mkdtempSync(join(tmpdir(), "rgs-web-package-"));
  t.after(() => rmSync(folder, { recursive: true }));
  const npm = (...args) => execFileSync("npm", args, { cwd: folder, encoding: "utf8", stdio: ["ignore", "pipe", "pipe"] });
  const [packed] = JSON.parse(npm("pack", reader, "--json", "--ignore-scripts"));
  const archive = join(folder, packed.filename);

  await t.test(`has at most ${kMostBytes} bytes`, (t) => {
    const { size } = statSync(archive);
    t.diagnostic(`${size} bytes`);
    assert.ok(size <= kMostBytes, `${size} bytes`);
  });

  await t.test("holds what it needs and nothing else", () => {
    const names = packed.files.map(({ path }) => path);
    for (const needed of ["package.json", "README.md", "LICENSE", "NOTICE", "dist/rgs.wasm", "dist/web.js", "dist/node.js"]) {
      assert.ok(names.includes(needed), `no ${needed}`);
    }
    const others = names.filter((name) => !/^(package\.json|README\.md|LICENSE|NOTICE|dist\/[a-z-]+\.(js|d\.ts|wasm))$/.test(name));
    assert.deepEqual(others, []);
  });

  await t.test("works in an empty project", () => {
    writeFileSync(join(folder, "package.json"), `{"name": "empty", "private": true, "type": "module"}`);
    npm("install", "--offline", "--no-audit", "--no-fund", archive);
    writeFileSync(join(folder, "use.js"), kUse);
    const said = execFileSync(process.execPath, ["use.js", join(golden, "packed_degree3.rgs")], { cwd: folder, encoding: "utf8" });
    assert.equal(said, "300 900 3 RgsError\n");
  });

  await t.test("has types", () => {
    writeFileSync(join(folder, "types.ts"), kTypes);
    const flags = "--noEmit --strict --target es2022 --module nodenext --lib es2022,dom types.ts".split(" ");
    execFileSync(process.execPath, [tsc, ...flags], { cwd: folder, encoding: "utf8" });
  });
});
