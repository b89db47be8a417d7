// hostile.test.mjs - damaged files end with an error of the file's: no trap, no endless loop, no memory that nobody promised.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { spawnSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { basename, join } from "node:path";
import test from "node:test";
import { Decoder } from "../dist/decoder.js";
import { RgsError } from "../dist/errors.js";
import { openWith } from "../dist/reader.js";
import { Service } from "../dist/service.js";
import { program } from "../../playcanvas/test/pictures.mjs";
import { filesIn, golden } from "./dump.mjs";

const module = new WebAssembly.Module(readFileSync(new URL("../dist/rgs.wasm", import.meta.url)));

// Those that speak of what is around the file, not of it.
const kNotOfFiles = new Set(["internal", "unavailable", "bad_argument", "host_out_of_memory", "read_failed", "open_failed"]);

/** Opens and reads as a program does, with the worker's side in this thread; returns the number of Gaussians. */
async function readAll(bytes) {
  let service;
  const port = {
    send: (request) => service.receive(request),
    listen: (on) => (service = new Service(() => Promise.resolve(module), (answer) => on.answer(answer))),
    hold: () => undefined,
    end: () => undefined,
  };
  const file = await openWith(() => port, bytes, {});
  return (await file.read()).n;
}

async function outcome(bytes, what) {
  try {
    return await readAll(bytes);
  } catch (error) {
    assert.ok(error instanceof RgsError && !kNotOfFiles.has(error.code), `${what}: ${error?.stack}`);
    return error.code;
  }
}

const kLevels = ["levels_direct", "levels_packed", "levels_archive", "levels_archive3"];
const kFiles = ["two", "packed_degree2", "archive_degree1", "archive3_degree1", ...kLevels];

test("no beginning of a file is taken for the file", async () => {
  for (const name of kFiles) {
    const bytes = new Uint8Array(readFileSync(join(golden, `${name}.rgs`)));
    assert.equal(typeof (await outcome(bytes, name)), "number");
    const step = Math.max(1, Math.floor(bytes.length / 400));
    for (let size = 0; size < bytes.length; size += step) {
      const code = await outcome(bytes.slice(0, size), `${name}, ${size} bytes`);
      const missing = name.startsWith("levels") ? ["truncated", "pages_missing"] : ["truncated"];
      assert.ok(missing.includes(code), `${name}, ${size} bytes: ${code}`);
    }
    assert.equal(await outcome(new Uint8Array([...bytes, 0]), name), "trailing_bytes");
  }
});

test("no change of a byte gets by", async () => {
  for (const name of kFiles) {
    const bytes = new Uint8Array(readFileSync(join(golden, `${name}.rgs`)));
    const step = Math.max(1, Math.floor(bytes.length / 400));
    for (let at = 0; at < bytes.length; at += step) {
      const changed = bytes.slice();
      changed[at] ^= 1 << at % 8;
      const what = `${name}, byte ${at}`;
      assert.equal(typeof (await outcome(changed, what)), "string", what);
    }
  }
});

test("files of the fuzzers' corpus end as they should", async () => {
  const corpus = filesIn(join(golden, "reject"));
  assert.ok(corpus.length >= 100);
  for (const path of corpus) {
    // Bytes of no sense behind a head that has some.
    const bytes = new Uint8Array(readFileSync(path));
    await outcome(bytes, basename(path));
    await outcome(bytes.slice(0, bytes.length >> 1), basename(path));
  }
});

test("mutated files end with the error of the C++ library, at the same byte", async (t) => {
  const { stdout, error } = spawnSync(program("rgs_mutate_files"), ["1", "6000", ...filesIn(golden)], { maxBuffer: 1 << 30 });
  if (error) throw error;
  const nOf = {};
  const differing = [];
  let nUnnoticed = 0;
  for (let at = 0; at < stdout.length; ) {
    const end = stdout.indexOf(10, at);
    const [code, offset, size] = stdout.toString("latin1", at, end).split(" ");
    const bytes = new Uint8Array(stdout.subarray(end + 1, end + 1 + Number(size)));
    at = end + 1 + Number(size);
    nOf[code] = (nOf[code] ?? 0) + 1;
    const found = await readAll(bytes).then(() => ({ code: "none" }), (error) => error);
    if (found.code === code && (found.offset ?? 0) === Number(offset)) continue;
    // On 64 bits Zstandard does not check where Huffman streams end, and goes on.
    if (found.text === "a frame cannot be decompressed") nUnnoticed += 1;
    else differing.push(`${found.code} ${found.offset}, not ${code} ${offset}`);
  }
  t.diagnostic(`${JSON.stringify(nOf)}, ${nUnnoticed} damaged frames of Zstandard that the C++ library has not noticed`);
  assert.deepEqual(differing, []);
});

test("a trap leaves an error, and the decoder does nothing more", () => {
  const decoder = new Decoder(module, {});
  // Not as rgs_open_parts() is to be called: without the parts it needs.
  decoder.wasm = { ...decoder.wasm, rgs_head: () => { throw new WebAssembly.RuntimeError("unreachable"); } };
  assert.throws(() => decoder.head(), (error) => error instanceof RgsError && error.code === "internal");
  assert.throws(() => decoder.needs(0), (error) => error.code === "internal");
});

test("more memory than there can be is an error of its own", () => {
  const decoder = new Decoder(module, {});
  assert.throws(() => decoder.allocateWhole(2 ** 33), (error) => error.code === "host_out_of_memory");
  assert.throws(() => decoder.gaussians(2 ** 40, 3).next(), (error) => error.code === "host_out_of_memory");
});

test("the module asks its host for nothing but to say that memory is out", () => {
  assert.deepEqual(WebAssembly.Module.imports(module), [{ module: "rgs", name: "out_of_memory", kind: "function" }]);
});
