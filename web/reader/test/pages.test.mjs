// pages.test.mjs - the scheduler of pages in WebAssembly answers as in C++: tests/golden/pages.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";
import test from "node:test";
import { open, RgsError } from "@roofgs/reader";
import { PageScheduler } from "../dist/pages.js";
import { golden } from "./dump.mjs";

const module = new WebAssembly.Module(readFileSync(new URL("../dist/rgs.wasm", import.meta.url)));
const folder = join(golden, "pages");
const numbers = (words) => words.trim().split(" ").filter(Boolean).map(Number);

for (const name of readdirSync(folder)) {
  test(`the trace ${name}`, async () => {
    const lines = readFileSync(join(folder, name), "utf8").trimEnd().split("\n");
    const of = (kind) => lines.filter((line) => line.startsWith(`${kind} `)).map((line) => line.slice(kind.length));
    const scheduler = await PageScheduler.startNumbers(module, Float64Array.from(of("page").flatMap(numbers)), of("setup").flatMap(numbers));
    assert.equal(scheduler.addView(), 0);
    const steps = of("at");
    assert.ok(steps.length > 100);
    for (const step of steps) {
      const [told, expected] = step.split(">").map(numbers);
      const [now, ...events] = told;
      assert.deepEqual(Buffer.from(scheduler.stepNumbers(events, now).buffer), Buffer.from(Float64Array.from(expected).buffer), step);
    }
  });
}

const kSchedule = { budget: 1e9, pageBytes: 0, rowBytes: 1, nReaders: 1, mostBytes: 1, gapBytes: 0, prefetches: false };

test("the scheduler of a file, by names", async () => {
  const file = await open(readFileSync(join(golden, "levels_packed.rgs")));
  const scheduler = await file.pageScheduler(kSchedule);
  const view = scheduler.addView();
  const look = { position: [0, 0, -20], focalPx: 1000, zNear: 0.1, detailPx: 0, mostGaussians: Infinity };
  assert.deepEqual(scheduler.step([["looks", view, look], ["frame", view]], 1000.5).at(-1), { is: "draw", view, pages: [0] });
  assert.equal(scheduler.nWanted(view), 1);
  assert.deepEqual(scheduler.step([["idle"]], 1001), [{ is: "read", first: 0, n: 1 }]);
  assert.deepEqual(scheduler.step([["failed", 0, 1, "lost"], ["done"]], 1002), [{ is: "evict", group: 0 }, { is: "wake" }]);
  assert.deepEqual(scheduler.step([["idle"]], 1003), [{ is: "probe" }]);
  assert.deepEqual(scheduler.step([["probed", true], ["done"], ["idle"]], 1004).at(-1), { is: "wakeAt", at: 1252 });
  assert.deepEqual(scheduler.step([["idle"]], 1252), [{ is: "read", first: 0, n: 1 }]);
  scheduler.step([["arrived", 0], ["done"], ["frame", view], ["frameEnds", view]], 1300);
  const { nChildren, error, core } = file.levels.page(0);
  assert.deepEqual(scheduler.step([["frame", view]], 1301), [{ is: "draw", view, pages: Array.from({ length: nChildren }, (_, i) => 1 + i) }]);
  const distance = Math.hypot(...look.position.map((x, k) => Math.max(core.min[k] - x, 0, x - core.max[k])));
  assert.ok(Math.abs(scheduler.errorPx(view, 0) / ((1000 * error) / distance) - 1) < 1e-6);
  scheduler.step([["idle"], ["failed", 1, 1, "damaged"], ["done"]], 1302);
  assert.equal(scheduler.nQuarantined, 1);
  // A view behind the camera of which nothing is.
  const picture = { width: 800, height: 600, fx: 1000, fy: 1000, cx: 400, cy: 300, lowPassPx2: 0.3, rotation: [1, 0, 0, 0, -1, 0, 0, 0, -1] };
  assert.deepEqual(scheduler.step([["looks", view, { ...look, picture }], ["frame", view]], 1303).at(-1), { is: "draw", view, pages: [] });
  assert.equal(scheduler.step([["take", 2e9]], 1304).find(({ is }) => is === "taken").isTaken, false);
  file.close();
});

test("a file without pages has no scheduler", async () => {
  const file = await open(readFileSync(join(golden, "two.rgs")));
  await assert.rejects(file.pageScheduler(kSchedule), (error) => error instanceof RgsError && error.code === "bad_argument");
  file.close();
});
