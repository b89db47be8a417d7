// same.mjs - what rgs-convert makes of a file: the output's bytes, or its error.
// SPDX-License-Identifier: Apache-2.0
import { execFileSync, spawnSync } from "node:child_process";
import { mkdirSync, mkdtempSync, readdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { program } from "../../playcanvas/test/pictures.mjs";

export const folder = mkdtempSync(join(tmpdir(), "rgs-web-converter-"));
process.on("exit", () => rmSync(folder, { recursive: true }));

/** A generated scene. */
export function scene(name, ...options) {
  const path = join(folder, name);
  execFileSync(program("rgs-make-scene"), ["--quiet", "--no-sync", "--overwrite", "--seed", "1", ...options, path]);
  return path;
}

/**
 * Runs rgs-convert with the Zstandard that the package has: tables and pages of another version may differ, though they decode to the
 * same. It is built once, as a shared library.
 */
let library;
function withZstd() {
  if (library) return library;
  library = join(folder, "zstd");
  mkdirSync(library);
  const sources = fileURLToPath(new URL("../../node_modules/zstd-napi/deps/zstd/lib", import.meta.url));
  const files = ["common", "compress", "decompress"].flatMap((part) =>
    readdirSync(join(sources, part)).filter((name) => name.endsWith(".c")).map((name) => join(sources, part, name)),
  );
  execFileSync("cc", ["-O1", "-fPIC", "-shared", "-DZSTD_DISABLE_ASM", "-Wl,-soname,libzstd.so.1", ...files, "-o", join(library, "libzstd.so.1")]);
  return library;
}

/** { bytes }, or { error: { code, offset, expected, found, message } }: the message has offset, text and numbers. */
export function byProgram(path, ...options) {
  const output = join(folder, "by-program.rgs");
  rmSync(output, { force: true });
  const env = { ...process.env, RGS_MESSAGES: "json", LD_LIBRARY_PATH: withZstd() };
  const { status, stderr } = spawnSync(program("rgs-convert"), ["--quiet", "--no-sync", ...options, path, output], { env, encoding: "utf8" });
  if (status === 0) return { bytes: readFileSync(output) };
  const line = stderr.split("\n").find((text) => text.startsWith('{"error"'));
  if (!line) throw new Error(`rgs-convert: ${status} ${stderr}`);
  const { code, offset, expected, found, message } = JSON.parse(line).error;
  return { error: { code, offset, expected, found, message } };
}

/** The same, of bytes. */
export function byProgramOf(bytes, ...options) {
  const path = join(folder, "scene.ply");
  writeFileSync(path, bytes);
  return byProgram(path, ...options);
}
