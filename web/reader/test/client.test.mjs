// client.test.mjs - the page's side of a worker, against one that says what a test wants.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import test from "node:test";
import { Client } from "../dist/client.js";

function make() {
  const sent = [];
  const port = { held: [], ended: false };
  const client = new Client({
    send: (request) => sent.push(request),
    listen: (on) => Object.assign(port, on),
    hold: (held) => port.held.push(held),
    end: () => (port.ended = true),
  });
  return { client, sent, port };
}

test("a signal ends a request at once, and what comes later is for nobody", async () => {
  const { client, sent, port } = make();
  const controller = new AbortController();
  const stopped = client.call("levels", {}, { signal: controller.signal });
  const other = client.call("levels", {});
  const reason = new Error("enough");
  controller.abort(reason);
  await assert.rejects(stopped, (error) => error === reason);
  assert.deepEqual(sent.at(-1), { id: 0, name: "cancel", args: { id: sent[0].id } });
  port.answer({ id: sent[0].id, result: 1 });
  port.answer({ id: sent[1].id, result: 2 });
  assert.equal(await other, 2);
  assert.equal(port.held.at(-1), false, "the process may end");
  controller.abort();
});

test("a worker that fails ends all requests, and those to come", async () => {
  const { client, port } = make();
  const one = client.call("levels", {});
  port.fail(new Error("no such script"));
  await assert.rejects(one, (error) => error.code === "unavailable" && error.message.includes("no such script"));
  await assert.rejects(client.call("levels", {}), (error) => error.code === "unavailable");
  assert.ok(port.ended);
});

test("errors keep their fields, and progress reaches who asked", async () => {
  const { client, sent, port } = make();
  const seen = [];
  const one = client.call("levels", {}, { onProgress: (share) => seen.push(share) });
  port.answer({ id: sent[0].id, progress: 0.5 });
  port.answer({ id: sent[0].id, error: { code: "bad_value", text: "x", offset: 7, expected: 1n, found: 2n } });
  await assert.rejects(one, { name: "RgsError", code: "bad_value", offset: 7, expected: 1n, found: 2n });
  assert.deepEqual(seen, [0.5]);
});
