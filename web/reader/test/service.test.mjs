// service.test.mjs - the worker's side, without a worker.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import test from "node:test";
import { Service } from "../dist/service.js";
import { scenes } from "./dump.mjs";

const wasm = new WebAssembly.Module(readFileSync(new URL("../dist/rgs.wasm", import.meta.url)));

/** `on(answer)` sees every answer; ask() gives that which is a request's last. */
function make(on = () => undefined) {
  const waiting = new Map();
  const service = new Service(
    () => Promise.reject(new Error("the module was given")),
    (answer) => {
      on(answer);
      if (!("progress" in answer)) waiting.get(answer.id)(answer);
    },
    0,
  );
  const ask = (id, name, args) =>
    new Promise((resolve) => {
      waiting.set(id, resolve);
      service.receive({ id, name, args });
    });
  return { service, ask };
}

test("work on a large file ends when it is cancelled", async () => {
  const bytes = new Uint8Array(readFileSync(join(scenes(), "packed.rgs")));
  let progress = 0;
  let cancel = true;
  const { service, ask } = make((answer) => {
    if (!("progress" in answer)) return;
    progress += 1;
    if (cancel) service.receive({ id: 0, name: "cancel", args: { id: answer.id } });
  });
  await ask(1, "start", { limits: {}, wasm });
  await ask(2, "part", { offset: 0, bytes });
  assert.equal((await ask(3, "openParts", { fileBytes: bytes.length })).result?.levels, null);
  const read = async (first) => {
    await ask(first, "whole", { bytes: bytes.length });
    await ask(first + 1, "wholePart", { offset: 0, bytes });
    return ask(first + 2, "wholeGaussians", { n: 60000, shDegree: 3 });
  };
  const stopped = await read(10);
  assert.equal(stopped.error?.code, "cancelled");
  assert.equal(progress, 1);
  cancel = false;
  progress = 0;
  const whole = await read(20);
  assert.equal(whole.result.gaussians.n, 60000);
  assert.ok(progress >= 3);
});

test("a request that waits can be cancelled, one that is over cannot be any more", async () => {
  const { service, ask } = make();
  const started = ask(1, "start", { limits: {}, wasm });
  const waits = ask(2, "levels", {});
  service.receive({ id: 0, name: "cancel", args: { id: 2 } });
  assert.deepEqual(await started, { id: 1, result: undefined });
  assert.equal((await waits).error.code, "cancelled");
  service.receive({ id: 0, name: "cancel", args: { id: 1 } });
  assert.equal(service.cancelled.size, 0);
});

test("what fails in the worker is an error, not silence", async () => {
  const { ask } = make();
  const answer = await ask(1, "start", { limits: {} });
  assert.equal(answer.error.code, "internal");
  assert.match(answer.error.text, /the module was given/);
});
