// cli.test.mjs - npx @roofgs/convert: files of rgs-convert, its exit codes, and nothing lost.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { spawnSync } from "node:child_process";
import { existsSync, mkdirSync, readdirSync, readFileSync, truncateSync, writeFileSync } from "node:fs";
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
  const large = join(common, "large.ply");
  writeFileSync(large, "ply");
  truncateSync(large, 2 ** 31);
  expect(3, /large\.ply: a PLY of 2 GiB or more .*rgs-convert \[host_out_of_memory\]/, large, missing);
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

/** The program, with link() of Node replaced by this. */
function runLinking(link, ...args) {
  const script = `import fs from "node:fs/promises"; import { syncBuiltinESMExports } from "node:module"; fs.link = ${link}; syncBuiltinESMExports();`;
  const { status, signal, stderr } = spawnSync(process.execPath, ["--import", `data:text/javascript,${encodeURIComponent(script)}`, cli, "--quiet", ...args], { encoding: "utf8" });
  return { status, signal, stderr };
}

test("a file system without links gets the file, too, and keeps one that is there by now", () => {
  const place = join(common, "no links");
  mkdirSync(place);
  const made = join(place, "a.rgs");
  const refused = `throw Object.assign(new Error("no links"), { code: "EPERM" })`;
  assert.deepEqual(runLinking(`async () => { ${refused}; }`, ply, made), { status: 0, signal: null, stderr: "" });
  assert.ok(readFileSync(made).equals(byProgram(ply).bytes));
  const late = join(place, "b.rgs");
  const { status, stderr } = runLinking(`async (_, to) => { await fs.writeFile(to, "kept"); ${refused}; }`, ply, late);
  assert.equal(status, 3);
  assert.match(stderr, /b\.rgs: it exists/);
  assert.equal(readFileSync(late, "utf8"), "kept");
  assert.deepEqual(readdirSync(place).sort(), ["a.rgs", "b.rgs"]);
});

test("a signal while the file is written leaves nothing", { skip: process.platform === "win32" && "Windows has no signals" }, () => {
  const place = join(common, "stopped");
  mkdirSync(place);
  for (const name of ["SIGINT", "SIGTERM"]) {
    const { status, signal } = runLinking(`() => new Promise(() => { setInterval(() => undefined, 1000); process.kill(process.pid, "${name}"); })`, ply, join(place, "a.rgs"));
    assert.deepEqual({ status, signal }, { status: null, signal: name });
    assert.deepEqual(readdirSync(place), []);
  }
});
