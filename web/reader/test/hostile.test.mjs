// hostile.test.mjs - damaged files end with an error of the file's: no trap, no endless loop, no memory that nobody promised.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { basename, join } from "node:path";
import test from "node:test";
import { Decoder } from "../dist/decoder.js";
import { RgsError } from "../dist/errors.js";
import { parseHead } from "../dist/head.js";
import { filesIn, golden } from "./dump.mjs";

const module = new WebAssembly.Module(readFileSync(new URL("../dist/rgs.wasm", import.meta.url)));

// Those that speak of what is around the file, not of it.
const kNotOfFiles = new Set(["internal", "unavailable", "bad_argument", "host_out_of_memory", "read_failed", "open_failed"]);

/** Everything that the worker does with a file, in this thread: Gaussians read, or the error's code. */
function readAll(bytes) {
  const opened = new Decoder(module, {});
  opened.addPart(0, bytes.subarray(0, 1 << 16));
  for (const { offset, bytes: size } of opened.needs(bytes.length)) {
    if (offset + size <= bytes.length) opened.addPart(offset, bytes.subarray(offset, offset + size));
  }
  const hasLevels = opened.openParts(bytes.length);
  const { values, text } = opened.head();
  const { nGaussians, shDegree } = parseHead(values, text).header;
  if (hasLevels) {
    const { offset, bytes: unread } = opened.unreadTable();
    if (unread > 0) opened.extend(offset, bytes.subarray(offset, offset + unread));
  }
  const whole = new Decoder(module, {});
  const address = whole.allocateWhole(bytes.length);
  whole.putWhole(address, 0, bytes);
  whole.openWhole(address, bytes.length);
  const work = whole.gaussians(nGaussians, shDegree);
  for (;;) {
    const step = work.next();
    if (step.done) return step.value.n;
  }
}

function outcome(bytes, what) {
  try {
    return readAll(bytes);
  } catch (error) {
    assert.ok(error instanceof RgsError && !kNotOfFiles.has(error.code), `${what}: ${error?.stack}`);
    return error.code;
  }
}

const kFiles = ["two", "packed_degree2", "archive_degree1", "levels_direct", "levels_packed", "levels_archive"];

test("no beginning of a file is taken for the file", () => {
  for (const name of kFiles) {
    const bytes = new Uint8Array(readFileSync(join(golden, `${name}.rgs`)));
    assert.equal(typeof outcome(bytes, name), "number");
    const step = Math.max(1, Math.floor(bytes.length / 400));
    for (let size = 0; size < bytes.length; size += step) {
      const code = outcome(bytes.slice(0, size), `${name}, ${size} bytes`);
      const missing = name.startsWith("levels") ? ["truncated", "pages_missing"] : ["truncated"];
      assert.ok(missing.includes(code), `${name}, ${size} bytes: ${code}`);
    }
    assert.equal(outcome(new Uint8Array([...bytes, 0]), name), "trailing_bytes");
  }
});

test("no change of a byte gets by", () => {
  for (const name of kFiles) {
    const bytes = new Uint8Array(readFileSync(join(golden, `${name}.rgs`)));
    const step = Math.max(1, Math.floor(bytes.length / 400));
    for (let at = 0; at < bytes.length; at += step) {
      const changed = bytes.slice();
      changed[at] ^= 1 << at % 8;
      const what = `${name}, byte ${at}`;
      assert.equal(typeof outcome(changed, what), "string", what);
    }
  }
});

test("files of the fuzzers' corpus end as they should", () => {
  const corpus = filesIn(join(golden, "reject"));
  assert.ok(corpus.length >= 100);
  for (const path of corpus) {
    // Bytes of no sense behind a head that has some.
    const bytes = new Uint8Array(readFileSync(path));
    outcome(bytes, basename(path));
    outcome(bytes.slice(0, bytes.length >> 1), basename(path));
  }
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
