// dump.mjs - what the C++ library makes of a file, by tests/format/dump_file.cpp; RGS_DUMP_FILE names the program.
// SPDX-License-Identifier: Apache-2.0
import { spawnSync } from "node:child_process";
import { readdirSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";

const kTypes = { f4: Float32Array, f8: Float64Array, i8: BigInt64Array, u8: BigUint64Array, u1: Uint8Array };

export const golden = fileURLToPath(new URL("../../../tests/golden/", import.meta.url));

export function filesIn(folder) {
  return readdirSync(folder).filter((name) => name.endsWith(".rgs")).sort().map((name) => join(folder, name));
}

/**
 * Folder of packed.rgs, direct.rgs and levels.rgs, one scene of 60,000 Gaussians, and wide.rgs, whose table of pages is longer than what is
 * read first; scripts/test_web.sh makes them.
 */
export function scenes() {
  const folder = process.env.RGS_WEB_SCENES;
  if (!folder) throw new Error("RGS_WEB_SCENES is not set: sh scripts/test_web.sh");
  return folder;
}

/** Arrays by name, or { error: code, offset } of a file that is refused. */
export function dump(path) {
  const program = process.env.RGS_DUMP_FILE;
  if (!program) throw new Error("RGS_DUMP_FILE is not set: sh scripts/test_web.sh");
  const { stdout, status, error } = spawnSync(program, [path], { maxBuffer: 1 << 30 });
  if (error) throw error;
  const arrays = {};
  for (let at = 0; at < stdout.length; ) {
    const end = stdout.indexOf(10, at);
    const words = stdout.toString("latin1", at, end).split(" ");
    if (words[0] === "error") return { error: words[1], offset: Number(words[2]), status };
    const [name, type, rows, columns] = words;
    const Type = kTypes[type];
    const bytes = Number(rows) * Number(columns) * Type.BYTES_PER_ELEMENT;
    arrays[name] = new Type(new Uint8Array(stdout.subarray(end + 1, end + 1 + bytes)).buffer);
    at = end + 1 + bytes;
  }
  return arrays;
}
