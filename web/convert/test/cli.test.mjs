// cli.test.mjs - npx @roofgs/convert: files of rgs-convert, its exit codes, and nothing lost.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { spawnSync } from "node:child_process";
import { existsSync, mkdirSync, readdirSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import test from "node:test";
import { fileURLToPath } from "node:url";
import { byProgram, folder as common, scene } from "./same.mjs";

const cli = fileURLToPath(new URL("../dist/cli.js", import.meta.url));
const folder = join(common, "cli");
mkdirSync(folder);
const ply = scene("cli.ply", "--gaussians", "5k", "--degree", "1");
const output = join(folder, "ä b.rgs");

function run(...args) {
  const { status, stdout, stderr } = spawnSync(process.execPath, [cli, ...args], { encoding: "utf8" });
  return { status, stdout, stderr };
}

test("files are those of rgs-convert", () => {
  const { status, stdout, stderr } = run(ply, output);
  assert.deepEqual({ status, stderr }, { status: 0, stderr: "" });
  assert.match(stdout, /ä b\.rgs: 5000 Gaussians of degree 1, \d+ bytes of \d+\n/);
  assert.ok(readFileSync(output).equals(byProgram(ply).bytes));
  const levels = join(folder, "levels.rgs");
  assert.deepEqual(run("--profile", "archive:small", "--lod", "-q", ply, levels), { status: 0, stdout: "", stderr: "" });
  assert.ok(readFileSync(levels).equals(byProgram(ply, "--profile", "archive:small", "--lod").bytes));
});

test("an existing output is kept, and replaced where asked", () => {
  const kept = join(folder, "kept.rgs");
  writeFileSync(kept, "kept");
  const { status, stderr } = run(ply, kept);
  assert.equal(status, 3);
  assert.match(stderr, /kept\.rgs: it exists; --overwrite replaces it \[output_exists\]/);
  assert.equal(readFileSync(kept, "utf8"), "kept");
  assert.equal(run("--overwrite", ply, kept).status, 0);
  assert.ok(readFileSync(kept).equals(byProgram(ply).bytes));
});

test("errors have the codes of rgs-convert, and leave nothing", () => {
  const broken = join(common, "broken.ply");
  writeFileSync(broken, readFileSync(ply).subarray(0, 5000));
  const missing = join(folder, "new.rgs");
  const expect = (status, pattern, ...args) => {
    const found = run(...args);
    assert.equal(found.status, status, found.stderr);
    assert.match(found.stderr, pattern);
  };
  expect(4, /broken\.ply: .* at byte 5000 \[truncated\]/, broken, missing);
  expect(3, /nothing\.ply: .*ENOENT.*\[open_failed\]/, join(folder, "nothing.ply"), missing);
  expect(3, /ENOENT.*\[write_failed\]/, ply, join(folder, "no", "folder.rgs"));
  expect(3, /\[output_unusable\]/, ply, mkdirSync(join(common, "folder.rgs"), { recursive: true }));
  expect(2, /--help/, ply);
  expect(2, /--profile: small is none of/, "--profile", "small", ply, missing);
  expect(2, /Unknown option '--levels'/, "--levels", ply, missing);
  expect(2, /writes \.rgs alone/, ply, join(folder, "new.spz"));
  expect(2, /it is the input/, "--overwrite", output, output);
  assert.equal(existsSync(missing), false);
  assert.deepEqual(readdirSync(folder).sort(), ["kept.rgs", "levels.rgs", "ä b.rgs"]);
});
