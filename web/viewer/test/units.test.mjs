// units.test.mjs - what of the page needs no browser: links, cameras, the cut, the difference, sentences.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import test, { after, before } from "node:test";
import { fileURLToPath } from "node:url";
import { build } from "vite";

let folder;
const modules = {};
before(async () => {
  folder = mkdtempSync(join(tmpdir(), "rgs-web-units-"));
  const names = ["cameras", "controls", "difference", "levels", "link", "manifest", "messages"];
  const input = Object.fromEntries(names.map((name) => [name, fileURLToPath(new URL(`../src/${name}.ts`, import.meta.url))]));
  const output = { entryFileNames: "[name].mjs" };
  await build({ configFile: false, logLevel: "error", build: { outDir: folder, lib: { entry: input, formats: ["es"] }, rollupOptions: { output } } });
  for (const name of names) modules[name] = await import(join(folder, `${name}.mjs`));
});
after(() => rmSync(folder, { recursive: true }));

const identity = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
const view = { position: [1, -2.5, 3e5], rotation: identity, focal: 0.866, aspect: 1, offset: [0.01, 0], pivot: [0, 0, 4] };
const state = { view, mode: "slider", split: 0.25, background: [0, 0.5, 1], shDegree: 2, detailPx: 1.5, budget: 250000 };

test("a link says what the page shows, and nothing that it does not know", () => {
  const { readLink, writeLink } = modules.link;
  assert.deepEqual(readLink(`#${writeLink(state)}`), state);
  assert.deepEqual(readLink(""), {});
  assert.deepEqual(readLink("#at=1,2&mode=<b>&split=x&background=1,2,3,4&sh=&detail=NaN"), {});
  assert.deepEqual(readLink("#split=7&sh=9&background=2,-1,0.5&budget=1"), { split: 1, shDegree: 3, background: [1, 0, 0.5], budget: 1000 });
});

test("cameras of both formats are one", () => {
  const { parseCameras, pinholeOf, viewOf } = modules.cameras;
  // 90 degrees around y, and a step.
  const own = { name: "a", width: 400, height: 300, fx: 500, fy: 510, cx: 190, world_to_camera: [[0, 0, -1, 1], [0, 1, 0, 2], [1, 0, 0, 3], [0, 0, 0, 1]] };
  const theirs = { id: 0, img_name: "a", width: 400, height: 300, fx: 500, fy: 510, cx: 190, position: [-3, -2, 1], rotation: [[0, 0, 1], [0, 1, 0], [-1, 0, 0]] };
  const [a, b] = [parseCameras(JSON.stringify([own])), parseCameras(JSON.stringify([theirs]))].map(([camera]) => camera);
  assert.deepEqual(a, b);
  assert.deepEqual([a.cx, a.cy], [190, 150]);
  // The same picture twice as large has everything twice as large.
  const { fx, fy, cx, cy } = pinholeOf(viewOf(a, [0, 0, 0]), 800, 600);
  assert.deepEqual([fx, fy, cx, cy], [1000, 1020, 380, 300]);
  assert.throws(() => parseCameras(`[{"width": 1}]`), /camera 0/);
  assert.throws(() => parseCameras(`{}`), /no list/);
});

test("the path goes through its cameras", () => {
  const { pathPosition } = modules.cameras;
  const points = [[0, 0, 0], [1, 0, 0], [1, 2, 0], [5, 5, 5]];
  points.forEach((point, i) => pathPosition(points, i / 3).position.forEach((value, k) => assert.ok(Math.abs(value - point[k]) < 1e-6)));
  const { position } = pathPosition(points, 0.5);
  assert.ok(position[1] > 0.2 && position[1] < 1.8, `${position}`);
});

test("orbiting keeps the distance and stays upright", () => {
  const { approached, moved, orbited } = modules.controls;
  const world = { up: [0, -1, 0], speed: 1 };
  const start = { ...view, position: [0, 0, -5], pivot: [0, 0, 0] };
  const quarter = orbited(start, world, Math.PI / 2, 0, "pivot");
  assert.ok(Math.abs(Math.abs(quarter.position[0]) - 5) < 1e-9 && Math.abs(quarter.position[2]) < 1e-9, `${quarter.position}`);
  // It still looks at the pivot.
  const forward = quarter.rotation.map((row) => row[2]);
  forward.forEach((value, i) => assert.ok(Math.abs(value + quarter.position[i] / 5) < 1e-9));
  let steep = start;
  for (let i = 0; i < 100; ++i) steep = orbited(steep, world, 0, 0.1, "pivot");
  assert.ok(Math.abs(Math.hypot(...steep.position) - 5) < 1e-6);
  assert.ok(Math.abs(steep.rotation[1][0]) < 1e-6, "right is level");
  assert.ok(steep.rotation[1][1] > 0 && Math.abs(steep.rotation[1][2]) > 0.9, "nearly straight down, never over");
  assert.deepEqual(moved(start, [1, 2, 3]).position, [1, 2, -2]);
  assert.deepEqual(approached(start, 0.5).position, [0, 0, -2.5]);
});

test("the difference of two pictures", () => {
  const { difference } = modules.difference;
  const a = new Uint8ClampedArray([10, 20, 30, 255, 0, 0, 0, 255]);
  const b = new Uint8ClampedArray([10, 20, 30, 255, 16, 0, 0, 255]);
  assert.equal(difference(a, a).psnrDb, Infinity);
  assert.ok(Math.abs(difference(a, b).psnrDb - 10 * Math.log10((255 ** 2 * 6) / 256)) < 1e-9);
  assert.deepEqual([...difference(a, b).map.subarray(0, 4)], [0, 0, 0, 255]);
  assert.ok(difference(a, b).map[4] > 200);
  assert.throws(() => difference(a, b.subarray(4)), RangeError);
});

/** Root 0 with children 1 and 2, of which 1 has the leaf 3; boxes far apart on x. */
function tree() {
  const box = (x) => ({ min: [x, 0, 0], max: [x + 1, 1, 1] });
  const page = (index, firstChild, nChildren, count, error, x) => ({ index, firstChild, nChildren, count, error, core: box(x) });
  return [page(0, 1, 2, 10, 8, 0), page(1, 3, 1, 10, 2, 0), page(2, 0, 0, 10, 0, 100), page(3, 0, 0, 30, 0, 0)];
}

test("the cut of a tree of pages", () => {
  const { chooseCut } = modules.levels;
  const pages = tree();
  const cut = (here, changes = {}) => {
    const cutView = { position: [-10, 0, 0], focalPx: 10, detailPx: 1, budget: 1000, ...changes };
    return chooseCut((i) => pages[i], (i) => here.includes(i), cutView);
  };
  const all = [0, 1, 2, 3];
  assert.deepEqual(cut([]), { draw: [], want: [0], n: 0 });
  // Root: 8 * 10 / 10 = 8 px; page 1: 2 px.
  assert.deepEqual(cut(all), { draw: [2, 3], want: [], n: 40 });
  assert.deepEqual(cut(all, { detailPx: 2 }), { draw: [1, 2], want: [], n: 20 });
  assert.deepEqual(cut(all, { detailPx: 8 }), { draw: [0], want: [], n: 10 });
  assert.deepEqual(cut(all, { detailPx: 0 }), { draw: [2, 3], want: [], n: 40 });
  assert.deepEqual(cut(all, { budget: 39 }), { draw: [1, 2], want: [], n: 20 });
  assert.deepEqual(cut([0, 1]), { draw: [0], want: [2], n: 10 });
  assert.deepEqual(cut([0, 1, 2]), { draw: [1, 2], want: [3], n: 20 });
  // From inside a box nothing coarse is good enough.
  assert.deepEqual(cut(all, { position: [0.5, 0.5, 0.5], detailPx: 16 }).draw, [2, 3]);
});

test("view.json, and what an address says", () => {
  const { manifestOfAddress, nameOf, parseManifest } = modules.manifest;
  assert.equal(manifestOfAddress(""), null);
  const found = manifestOfAddress("?scene=a%2Fb.rgs&other=c.ply&cameras=d.json");
  assert.deepEqual(found.scenes, [{ name: "b.rgs", url: "a/b.rgs" }, { name: "c.ply", url: "c.ply" }]);
  assert.equal(found.cameras, "d.json");
  assert.equal(nameOf("x/%E4%B8%AD.rgs?y#z"), "中.rgs");
  assert.equal(nameOf("x/%.rgs"), "%.rgs");
  assert.throws(() => parseManifest(`{"version": 2}`), /version/);
  assert.throws(() => parseManifest(`{"version": 1, "scenes": [1, 2, 3]}`), /two/);
  assert.deepEqual(parseManifest(`{"version": 1}`).photos, []);
});

test("sentences say what to do", () => {
  const { sentence, ServerError } = modules.messages;
  const damaged = sentence("a.rgs", { code: "checksum_mismatch", text: "the section's bytes have changed", offset: 512 });
  assert.equal(damaged, "a.rgs is damaged: the section's bytes have changed (checksum_mismatch at byte 512). Copy the file again, or convert the scene again.");
  assert.match(sentence("a.rgs", { code: "read_failed", text: "x" }), /Start rgs-view again/);
  assert.match(sentence("a.rgs", { code: "bad_magic", text: "x", offset: 0 }), /is not an \.rgs file.*at byte 0/);
  assert.equal(sentence("The true picture", new ServerError("internal", "x")), "The true picture could not be made: internal: x.");
  assert.equal(sentence("a.ply", new Error("no")), "a.ply could not be opened: no.");
});
