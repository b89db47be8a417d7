// units.test.mjs - what of the page needs no browser: links, cameras, pages, the difference, sentences.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync, spawnSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import test, { after, before } from "node:test";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";
import { build } from "vite";
import { program } from "../../playcanvas/test/pictures.mjs";
import { open, readSpz } from "../../reader/dist/node.js";
import { PageScheduler } from "../../reader/dist/pages.js";
import { golden, scenes } from "../../reader/test/dump.mjs";

let folder;
const modules = {};
before(async () => {
  folder = mkdtempSync(join(tmpdir(), "rgs-web-units-"));
  const names = ["cameras", "chooser", "controls", "declared", "difference", "first-picture", "flight", "flip", "keys", "kind", "link", "manifest", "messages", "page-driver", "picking", "picture-size", "rgs-scene", "splats", "store"];
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
  for (const z of [3e5, 5412345.625]) {
    const here = { ...state, view: { ...view, position: [1, -2.5, z] } };
    assert.deepEqual(readLink(`#${writeLink(here)}`), here);
  }
  assert.deepEqual(readLink(""), {});
  assert.deepEqual(readLink("#at=1,2&mode=<b>&split=x&background=1,2,3,4&sh=&detail=NaN"), {});
  assert.deepEqual(readLink("#split=7&sh=9&background=2,-1,0.5&budget=1"), { split: 1, shDegree: 3, background: [1, 0, 0.5], budget: 1000 });
});

test("camera files give what they should", () => {
  const { parseCameras } = modules.cameras;
  const folder = new URL("../../../tests/golden/cameras/", import.meta.url);
  const near = (found, wanted) => Math.abs(found - wanted) < 1e-12;
  for (const [name, { cameras, camera, page }] of Object.entries(JSON.parse(readFileSync(new URL("expected.json", folder), "utf8")))) {
    // As answer.text() has it. Other formats are for programs.
    const parse = () => parseCameras(page === false ? "{}" : new TextDecoder().decode(readFileSync(new URL(name, folder))));
    if (page === false) assert.throws(parse, /not a list/);
    else if (!cameras) assert.throws(parse, camera === undefined ? Error : new RegExp(`camera ${camera} `), name);
    else {
      const found = parse();
      assert.equal(found.length, cameras.length, name);
      found.forEach((entry, i) => {
        const { name: label, test: _, position, rotation, ...lens } = cameras[i];
        assert.equal(entry.img_name, label, name);
        for (const [key, value] of Object.entries(lens)) assert.equal(entry[key], value, `${name}: ${key}`);
        assert.ok(position.every((value, k) => near(entry.position[k], value)), name);
        assert.ok(rotation.every((row, r) => row.every((value, k) => near(entry.rotation[r][k], value))), name);
      });
    }
  }
});

test("cameras that are no pinholes are refused", () => {
  const text = readFileSync(new URL("../../../tests/golden/cameras/list_models.json", import.meta.url), "utf8");
  assert.throws(() => modules.cameras.parseCameras(text), /camera 0 is no pinhole/);
  const training = JSON.parse(readFileSync(new URL("../../../tests/golden/cameras/training.json", import.meta.url), "utf8"));
  for (const lens of [{ model: "opencv_fisheye" }, { distortion: [0, 0.1] }])
    assert.throws(() => modules.cameras.parseCameras(JSON.stringify([{ ...training[0], ...lens }])), /camera 0 is no pinhole/);
});

test("a view keeps a camera's picture at any size", () => {
  const { pinholeOf, viewOf } = modules.cameras;
  const camera = { width: 400, height: 300, fx: 500, fy: 510, cx: 190, position: [-3, -2, 1], rotation: identity };
  // The same picture twice as large has everything twice as large.
  const { fx, fy, cx, cy } = pinholeOf(viewOf(camera, [0, 0, 0]), 800, 600);
  assert.deepEqual([fx, fy, cx, cy], [1000, 1020, 380, 300]);
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
  // A camera may begin steeper than that, and comes back.
  const down = { ...start, position: [0, -5, 0], rotation: [[1, 0, 0], [0, 0, 1], [0, -1, 0]] };
  const back = orbited(down, world, 0, -0.05, "pivot");
  assert.ok(Math.abs(back.rotation[1][2] - Math.cos(0.05)) < 1e-9, `${back.rotation}`);
  assert.deepEqual(moved(start, [1, 2, 3]).position, [1, 2, -2]);
  assert.deepEqual(approached(start, 0.5).position, [0, 0, -2.5]);
});

test("the view that is chosen of Gaussians is that of the C++ library, in whatever parts they come", async () => {
  const wasm = new WebAssembly.Module(readFileSync(new URL("../../../build/web/first-view.wasm", import.meta.url)));
  const choose = (parts, up = [0, -1, 0]) => {
    const chooser = new modules.chooser.Chooser(wasm);
    for (const part of parts) chooser.add(part);
    return chooser.choose(up);
  };
  const read = async (path) => {
    const file = await open(readFileSync(path));
    const parts = [];
    for await (const part of file.storedParts()) parts.push(part);
    const gaussians = file.levels ? undefined : await file.read();
    file.close();
    return { parts, gaussians };
  };
  // These state no view.
  const paths = ["packed_degree3.rgs", "degree3.rgs", "archive_degree3.rgs"].map((name) => join(golden, name));
  const lines = execFileSync(program("rgs_first_view"), ["640", "360", ...paths], { encoding: "utf8" }).trim().split("\n");
  for (const [i, path] of paths.entries()) {
    const native = lines[i].split(" ").map(Number);
    const { parts, gaussians } = await read(path);
    const view = choose(parts);
    assert.equal(view.horizontalFov, 60);
    const away = view.pivot.map((value, k) => value - view.position[k]);
    for (let k = 0; k < 3; ++k) {
      assert.ok(Math.abs(view.position[k] - native[k]) < 1e-5, `${path}: ${view.position} for ${native}`);
      assert.ok(Math.abs(away[k] / Math.hypot(...away) - native[9 + k]) < 1e-6, `${path}: it looks at ${view.pivot}`);
    }
    assert.deepEqual(choose([gaussians]), view, path);
    assert.deepEqual(choose(parts.reverse()), view, path);
  }
  const { gaussians } = await read(join(scenes(), "packed.rgs"));
  // Leaves are all of a scene's Gaussians.
  assert.deepEqual(choose((await read(join(scenes(), "levels.rgs"))).parts), choose([gaussians]));
  assert.ok(choose([gaussians], [0, 0, 1]).up[2] > 0.8);
  assert.equal(choose([{ ...gaussians, opacities: new Float32Array(gaussians.n) }]), null);
  assert.equal(choose([]), null);
});

test("a first view is 60 degrees wide, and as high as in a picture of 16:9", () => {
  const { viewFromFirst } = modules.cameras;
  const first = { kind: "outside", position: [0, -1, -4], pivot: [0, -1, 0], up: [0, -1, 0], horizontalFov: 60 };
  const focal = 0.5 / Math.tan(Math.PI / 6);
  const found = viewFromFirst(first, [10, 0, 1e6], 3 / 4);
  assert.deepEqual([found.position, found.pivot], [[10, -1, 1e6 - 4], [10, -1, 1e6]]);
  assert.deepEqual(found.rotation.map((row) => row.map((value) => value + 0)), identity);
  assert.ok(Math.abs(found.focal - focal) < 1e-12);
  assert.ok(Math.abs(viewFromFirst(first, [0, 0, 0], 9 / 32).focal - focal / 2) < 1e-12);
});

const flights = (now, ...more) => {
  const from = { ...view, position: [0, 0, -5], pivot: [0, 0, 0] };
  const behind = { ...from, position: [0, 0, 5], rotation: [[-1, 0, 0], [0, 1, 0], [0, 0, -1]], focal: 1 };
  const store = new modules.store.Store({ view: from, flight: undefined, playing: 0.5 });
  modules.flight.watchFlights(store, new AbortController().signal);
  const over = modules.flight.fly(store, behind, now, ...more);
  return { from, behind, store, over };
};

test("a flight goes round the pivot, slowly off and slowly in, and ends where it should", async () => {
  const { advanceFlight } = modules.flight;
  const { from, behind, store, over } = flights(1000, false);
  assert.deepEqual([store.state.view, store.state.playing], [from, undefined]);
  const angles = [1000, 1100, 1300, 1500, 1599].map((now) => {
    advanceFlight(store, now);
    const { position, rotation, pivot } = store.state.view;
    assert.deepEqual(pivot, [0, 0, 0]);
    assert.ok(Math.abs(Math.hypot(...position) - 5) < 1e-9 && Math.abs(position[1]) < 1e-9, `${position}`);
    rotation.forEach((row, k) => assert.ok(Math.abs(row[2] + position[k] / 5) < 1e-9, "it looks at the pivot"));
    return Math.acos(Math.max(-1, Math.min(1, -position[2] / 5))) / Math.PI;
  });
  assert.ok(angles[0] === 0 && angles[1] < 0.1 && Math.abs(angles[2] - 0.5) < 1e-9 && angles[3] > 0.9 && angles[4] < 1, `${angles}`);
  advanceFlight(store, 1600);
  assert.equal(store.state.view, behind);
  assert.equal(store.state.flight, undefined);
  await over;
});

test("a flight ends where somebody else moves the view, or takes over", async () => {
  const { advanceFlight } = modules.flight;
  const moved = flights(0, false);
  advanceFlight(moved.store, 200);
  const other = { ...moved.from };
  moved.store.set({ view: other });
  advanceFlight(moved.store, 300);
  assert.deepEqual([moved.store.state.view, moved.store.state.flight], [other, undefined]);
  await moved.over;
  const stopped = flights(0, false);
  advanceFlight(stopped.store, 200);
  const { view: at } = stopped.store.state;
  stopped.store.set({ flight: undefined });
  advanceFlight(stopped.store, 300);
  assert.equal(stopped.store.state.view, at);
  await stopped.over;
});

test("touching the picture ends a flight, scrolling the page past it does not", () => {
  const { store } = flights(0, false);
  const picture = new EventTarget();
  new modules.controls.Controls(store, picture, () => false);
  const isFlying = (name, fields) => {
    picture.dispatchEvent(Object.assign(new Event(name), fields));
    modules.flight.advanceFlight(store, 100);
    return store.state.flight !== undefined;
  };
  const wheel = (ctrlKey) => isFlying("wheel", { deltaY: 100, ctrlKey });
  assert.deepEqual([wheel(false), isFlying("keydown", { code: "Tab" })], [true, false]);
  modules.flight.fly(store, view, 0, false);
  assert.deepEqual([wheel(false), wheel(true)], [true, false]);
});

test("where less motion is wished, or there is no view yet, a flight is a jump", async () => {
  const { behind, store, over } = flights(0, true);
  assert.equal(store.state.view, behind);
  await over;
  store.set({ view: undefined });
  await modules.flight.fly(store, behind, 0, false);
  assert.equal(store.state.view, behind);
});

test("keys hold beside checkboxes and sliders, but not where somebody types, and Home is a slider's own", () => {
  class Input {
    constructor(type) {
      this.type = type;
    }
  }
  Object.assign(globalThis, { HTMLInputElement: Input, HTMLSelectElement: class {} });
  let isDone = false;
  let heard;
  const store = { state: { scenes: [], cameras: [] }, set: () => (isDone = true) };
  const host = { getAttribute: () => ((isDone = true), null) };
  modules.keys.connectKeys({ store, host, listen: (_, hear) => (heard = hear) });
  const acts = (code, target) => {
    isDone = false;
    heard({ code, composedPath: () => [target] });
    return isDone;
  };
  const targets = [{}, new Input("checkbox"), new Input("range"), new Input("text"), new HTMLSelectElement()];
  assert.deepEqual(targets.map((target) => acts("KeyI", target)), [true, true, true, false, false]);
  assert.deepEqual(targets.map((target) => acts("Home", target)), [true, false, false, false, false]);
  delete globalThis.HTMLInputElement;
  delete globalThis.HTMLSelectElement;
});

test("a view of the state is called when what it depends on changes, and only then", () => {
  const store = new modules.store.Store({ a: 1, b: 1, sum: 2 });
  const seen = [];
  store.subscribe(({ a }) => [a], ([a], before) => seen.push(["a", a, before?.[0]]));
  // A view that changes the state: those after it see only what it makes of it.
  store.subscribe(({ a, b }) => [a, b], ([a, b]) => store.set({ sum: a + b }));
  store.subscribe(({ b, sum }) => [b, sum], (values) => seen.push(["sum", ...values]));
  assert.deepEqual(seen.splice(0), [["a", 1, undefined], ["sum", 1, 2]]);
  store.set({ b: 2 });
  assert.deepEqual(seen.splice(0), [["sum", 2, 3]]);
  store.set({ a: 5 });
  assert.deepEqual(seen.splice(0), [["a", 5, 1], ["sum", 2, 7]]);
  store.set({ a: 5, b: 2 });
  assert.deepEqual(seen, []);
  assert.deepEqual(store.state, { a: 5, b: 2, sum: 7 });
});

test("the Gaussian nearest to the pointer is found", () => {
  const { depthAlong } = modules.picking;
  const ray = [0, 0, 1];
  const depth = (...means) => depthAlong(means.map((each) => new Float32Array(each)), [1, 0, 0], ray);
  assert.equal(depth([1, 0, 8, 1, 0, 5], [1, 0, 6]), 5);
  // On the ray counts more than near; what is behind, too near or far off the ray counts nothing.
  assert.equal(depth([1.1, 0, 5], [1, 0, 7]), 7);
  assert.equal(depth([1, 0, -3, 1, 0, 0.1, 3, 0, 5]), 0);
});

test("a picture is no larger than browsers draw", () => {
  const { pictureSize } = modules["picture-size"];
  const of = (width, height, ratio, most = 16384) => Object.values(pictureSize({ width, height }, ratio, most));
  assert.deepEqual(of(800, 360, 1), [800, 360]);
  assert.deepEqual(of(360, 640, 3), [720, 1280]);
  assert.deepEqual(of(3840, 2160, 2), [7680, 4320]);
  assert.deepEqual(of(0, 0, 1), [1, 1]);
  assert.deepEqual(of(9000, 100, 1, 8192), [8192, 91]);
  const [width, height] = of(9500, 6400, 1);
  assert.ok(width * height <= 7680 * 4320 && width * height > 0.99 * 7680 * 4320, `${width}x${height}`);
  assert.ok(Math.abs(width / height - 9500 / 6400) < 1e-3);
});

test("a first picture is shown once it is within 64 px, or nothing more is to come, or after 0.3 s", () => {
  const { isWorthShowing } = modules["first-picture"];
  assert.deepEqual([64, 65].map((errorPx) => isWorthShowing(errorPx, 5, 299)), [true, false]);
  assert.deepEqual([isWorthShowing(6000, 0, 0), isWorthShowing(6000, 5, 300)], [true, true]);
});

test("a scene with levels shows its first picture when that is worth showing", () => {
  const file = { declarations: { origin: [0, 0, 0], axes: [] }, subjectBox: { min: [], max: [] }, header: {}, levels: { page: () => ({}) } };
  const splats = { set: () => undefined };
  const stage = { scenes: new Set(), addSplats: () => splats, request: () => undefined };
  /** Whether a view is drawn so many ms after the first, by its coarsest page. */
  const isDrawn = (errorPx, nWanted, ms) => {
    const step = ([[event]]) => (event === "frame" ? [{ is: "draw", pages: [0] }] : []);
    const scheduler = { addView: () => 0, step, errorPx: () => errorPx, nWanted: () => nWanted };
    const scene = new modules["rgs-scene"].RgsScene("a.rgs", { file }, { n: 0 }, scheduler, stage, "left", {});
    for (const now of [1000, 1000 + ms]) scene.look({ mostGaussians: 1e6 }, now);
    return scene.pages.drawn === 1;
  };
  assert.deepEqual([isDrawn(64, 5, 0), isDrawn(65, 0, 0), isDrawn(65, 5, 299), isDrawn(65, 5, 300)], [true, true, false, true]);
});

test("a scene stays where its first view cannot be chosen", async () => {
  const file = { declarations: { origin: [0, 0, 0], axes: [] }, subjectBox: { min: [], max: [] }, header: {}, levels: null, firstView: null, close: () => undefined };
  const splats = { set: () => undefined };
  const stage = { scenes: new Set(), addSplats: () => splats };
  const scene = new modules["rgs-scene"].RgsScene("a.rgs", { file, parts: [] }, { n: 1 }, null, stage, 0, {});
  // Node has no Worker.
  await scene.complete();
  assert.equal(scene.firstView, null);
});

test("the difference of two pictures", () => {
  const { difference } = modules.difference;
  const a = new Uint8ClampedArray([10, 20, 30, 255, 0, 0, 0, 255]);
  const b = new Uint8ClampedArray([10, 20, 30, 255, 16, 0, 0, 255]);
  assert.equal(difference(a, a).psnrDb, Infinity);
  assert.ok(Math.abs(difference(a, b).psnrDb - 10 * Math.log10((255 ** 2 * 6) / 256)) < 1e-9);
  // One of two pixels exceeds all but the next round number.
  assert.equal(difference(a, b).top, 20);
  assert.deepEqual([...difference(a, b).map], [0, 0, 5, 255, 250, 191, 36, 255]);
  const many = new Uint8ClampedArray(8000).fill(7);
  const [one, two] = [1, 2].map((n) => many.map((value, i) => (i % 4 === 0 && i < 4 * n * 2 ? 40 + i : value)));
  assert.equal(difference(many, one).top, 1, "one in a thousand may be white");
  assert.deepEqual([...difference(many, one).map.subarray(0, 4)], [255, 255, 255, 255]);
  assert.equal(difference(many, two).top, 50);
  assert.throws(() => difference(a, b.subarray(4)), RangeError);
});

/** A driver of a tree of 44 pages, that of a golden trace, of which `nKnown` are known; the test answers its reads, in a time that it tells. */
async function driven(nKnown = Infinity) {
  const trace = readFileSync(join(golden, "pages/failures.txt"), "utf8").split("\n");
  const pages = trace.filter((line) => line.startsWith("page ")).map((line) => line.slice(5).split(" ").map(Number));
  const childrenOf = (page) => Array.from({ length: pages[page][3] }, (_, i) => pages[page][2] + i);
  const { kSchedule, PageDriver } = modules["page-driver"];
  const module = new WebAssembly.Module(readFileSync(fileURLToPath(import.meta.resolve("@roofgs/reader/rgs.wasm"))));
  const known = pages.map((_, page) => page < nKnown);
  const numbersOf = (from, end) => Float64Array.from(pages.slice(from, end).flatMap((page, i) => (known[from + i] ? page : [0, -1, ...page.slice(2).fill(0)])));
  const scheduler = await PageScheduler.start(module, numbersOf(0, pages.length), kSchedule);
  const log = { now: 0, open: [], nChanges: 0, said: [], timer: null };
  const read = (page) => new Promise((resolve, reject) => log.open.push({ page, resolve, reject }));
  const readTable = (group) => read(`table ${group}`);
  /** Up to six more pages are known. */
  const grow = (group) => {
    const first = known.findIndex((isKnown, page) => !isKnown && (pages[page][1] === group || group === 0xffffffff));
    for (let page = first; page < Math.min(first + 6, pages.length) && !known[page] && known[pages[page][1]]; ++page) known[page] = true;
    const isComplete = !known.includes(false);
    return ["tableGrew", group, Float64Array.of(Number(isComplete), first, Math.min(6, pages.length - first), ...numbersOf(first, first + 6))];
  };
  const on = { changed: () => (log.nChanges += 1), waiting: (error) => log.said.push(error?.code ?? "goes on"), damaged: ({ code }) => log.said.push(code) };
  const startTimer = (ms, ring) => {
    const timer = { at: log.now + ms, ring };
    log.timer = timer;
    return () => log.timer === timer && (log.timer = null);
  };
  const driver = new PageDriver(scheduler, { childrenOf, read, readTable }, "page 0", on, { now: () => log.now, startTimer });
  const answer = async (page, code) => {
    const [found] = log.open.splice(log.open.findIndex((each) => each.page === page), 1);
    if (code) found.reject({ code });
    else found.resolve(typeof page === "string" ? grow(Number(page.slice(6))) : `page ${page}`);
    await new Promise(setImmediate);
  };
  const open = () => log.open.map(({ page }) => page);
  /** All reads end, and those that follow from it. `codeOf`: of those that fail. */
  const answerAll = async (codeOf = () => undefined) => {
    while (log.open.length > 0) await answer(open()[0], codeOf(open()[0]));
  };
  /** Milliseconds until something is read again. */
  const pause = () => {
    const { at, ring } = log.timer;
    const ms = at - log.now;
    [log.now, log.timer] = [at, null];
    ring();
    return ms;
  };
  const look = (changes = {}) => {
    let drawn = [];
    driver.look({ position: [48, 10, 48], focalPx: 700, zNear: 0.5, detailPx: 0, mostGaussians: 1e6, ...changes }, (pages) => {
      pages.forEach((page) => assert.equal(driver.page(page), `page ${page}`));
      drawn = pages;
    });
    return drawn;
  };
  return { log, pages, driver, look, answer, answerAll, open, pause };
}

test("a view is drawn from what is resident, and what it wants is read, coarse to fine", async () => {
  const { log, pages, driver, look, answerAll, open, answer } = await driven();
  assert.deepEqual(look(), [0]);
  // The root's children, and theirs, which are not drawn before them.
  assert.deepEqual(open(), [1, 2, 3, 4, 5, 6]);
  for (const page of [3, 4]) await answer(page);
  assert.deepEqual(look(), [0]);
  for (const page of [1, 2]) await answer(page);
  assert.deepEqual(look(), [3, 4, 2]);
  assert.ok(driver.nWanted > 0);
  assert.equal(log.nChanges, 2);
  await answerAll();
  const leaves = pages.flatMap(([level], page) => (level === 0 ? [page] : []));
  assert.deepEqual(look(), leaves);
  assert.deepEqual([driver.nWanted, open(), log.timer, log.said], [0, [], null, []]);
  assert.deepEqual(look({ position: [1e5, 0, 0], detailPx: 1 }), [0]);
});

test("a budget of Gaussians holds for what is drawn, and twice that for what is kept", async () => {
  const { log, pages, driver, look, answerAll } = await driven();
  const count = (drawn) => drawn.reduce((sum, page) => sum + pages[page][5], 0);
  const total = count(pages.map((_, page) => page));
  const atRest = async (changes) => {
    for (let n = -1; n !== log.nChanges; ) {
      n = log.nChanges;
      look(changes);
      await answerAll();
    }
    return look(changes);
  };
  const resident = () => count(pages.flatMap((_, page) => (driver.page(page) === undefined || page === 0 ? [] : [page])));
  const all = await atRest({});
  assert.equal(resident(), total - pages[0][5]);
  const mostGaussians = Math.round(count(all) / 5);
  for (const position of [[0, 2, 0], [96, 2, 96], [0, 2, 96]]) {
    const drawn = await atRest({ position, mostGaussians });
    assert.ok(count(drawn) <= mostGaussians && count(drawn) > mostGaussians / 2, `${count(drawn)} of ${mostGaussians}`);
    assert.ok(resident() <= 2 * mostGaussians, `${resident()} of ${mostGaussians}`);
    assert.equal(driver.nWanted, 0);
  }
  assert.deepEqual(await atRest({}), all);
});

test("reads that fail are tried again until they succeed, ever more rarely", async () => {
  const { log, driver, look, answerAll, open, pause } = await driven();
  look();
  const pauses = [];
  for (let i = 0; i < 100; ++i) {
    await answerAll(() => "read_failed");
    // New views request nothing meanwhile.
    look({ position: [i, 10, 40] });
    assert.deepEqual(open(), []);
    pauses.push(pause());
    // What could be read before is read again.
    assert.deepEqual(open(), [0]);
  }
  assert.deepEqual(pauses.slice(0, 8), [250, 500, 1000, 2000, 4000, 8000, 8000, 8000]);
  assert.deepEqual([...new Set(pauses.slice(8))], [8000]);
  assert.deepEqual(log.said, ["read_failed"]);
  await answerAll();
  assert.deepEqual(log.said, ["read_failed", "goes on"]);
  assert.ok(look().length > 10 && driver.nWanted === 0);
});

test("a group that cannot be read does not hold up others", async () => {
  const { log, driver, look, answer, answerAll, open, pause } = await driven();
  look();
  for (const page of [1, 2]) await answer(page);
  for (const page of [3, 4]) await answer(page, "read_failed");
  await answerAll();
  assert.deepEqual(log.said, []);
  assert.ok(look().includes(1));
  assert.equal(pause(), 250);
  assert.deepEqual(open(), [3, 4]);
  assert.ok(driver.nWanted > 0);
  await answerAll();
  assert.ok(!look().includes(1));
  assert.equal(driver.nWanted, 0);
});

test("a damaged group is quarantined, after six tries if a checksum does not match", async () => {
  const { log, driver, look, answerAll, open, pause } = await driven();
  const codeOf = (page) => ({ 3: "bad_value", 5: "checksum_mismatch", 9: "pages_missing" })[page];
  look();
  await answerAll(codeOf);
  assert.deepEqual(log.said, ["bad_value"]);
  for (const ms of [250, 500, 1000, 2000, 4000]) {
    assert.ok(look() && driver.nWanted === 1);
    assert.equal(pause(), ms);
    assert.deepEqual(open(), [5, 6]);
    await answerAll(codeOf);
  }
  look();
  assert.deepEqual([driver.nWanted, open(), log.timer], [0, [], null]);
  // Later ones are not said.
  assert.deepEqual(log.said, ["bad_value"]);
});

test("the table of pages is read where a view looks, and the rest of it when readers are idle", async () => {
  const { log, pages, driver, look, answer, answerAll, open, pause } = await driven(5);
  const near = { position: [pages[2][13], 1, pages[2][15]], detailPx: 1 };
  look(near);
  assert.deepEqual(open(), [1, 2, 3, 4, "table 2"]);
  for (const page of [1, 2]) await answer(page);
  await answer("table 2", "read_failed");
  for (const page of [3, 4]) await answer(page);
  await answer(0); // the source answers, so only that range fails
  assert.deepEqual(look(near), [3, 4, 2]);
  assert.ok(driver.nWanted > 0);
  assert.deepEqual([pause(), open()], [250, ["table 2"]]);
  await answer("table 2");
  assert.deepEqual(open().slice(0, 2), [5, 6]);
  await answerAll();
  const leaves = pages.flatMap(([level], page) => (level === 0 ? [page] : []));
  assert.deepEqual(look({ detailPx: 0 }), leaves);
  assert.deepEqual([driver.nWanted, open(), log.timer, log.said], [0, [], null, []]);
});

test("a damaged table is read six times and said once; what is known of it is drawn", async () => {
  const { log, driver, look, answerAll, open, pause } = await driven(5);
  look();
  const codeOf = (page) => (typeof page === "string" ? "checksum_mismatch" : undefined);
  await answerAll(codeOf);
  for (const ms of [250, 500, 1000, 2000, 4000]) {
    assert.deepEqual(log.said, []);
    assert.ok(look().length === 3 && driver.nWanted > 0);
    assert.equal(pause(), ms);
    await answerAll(codeOf);
  }
  assert.deepEqual(look(), [3, 4, 2]);
  assert.deepEqual([driver.nWanted, open(), log.timer, log.said], [0, [], null, ["checksum_mismatch"]]);
});

test("closed while it waits, a file is read no more and nothing is said of it", async () => {
  const early = await driven(5);
  early.look();
  assert.ok(early.open().includes("table 2"));
  early.driver.end();
  await early.answerAll((page) => (page % 2 === 1 ? "bad_value" : "read_failed"));
  assert.deepEqual([early.open(), early.log.timer, early.log.said, early.log.nChanges], [[], null, [], 0]);
  for (const inFlight of [false, true]) {
    const { log, driver, look, answerAll, open, pause } = await driven();
    look();
    await answerAll(() => "read_failed");
    if (inFlight) pause();
    driver.end();
    assert.deepEqual(log.said, ["read_failed", "goes on"]);
    await answerAll();
    assert.deepEqual([look(), open(), log.timer], [[], [], null]);
    assert.deepEqual(log.said, ["read_failed", "goes on"]);
  }
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
  assert.match(sentence("a.rgs", { code: "read_failed", text: "x" }), /start it again and open its new address/);
  assert.match(sentence("a.rgs", { code: "open_failed", text: "the server answers with HTTP 404" }), /^a\.rgs is not on the server\. Check .*HTTP 404\)$/);
  assert.match(sentence("a.rgs", { code: "open_failed", text: "the server answers with HTTP 409" }), /Start rgs-view again/);
  assert.match(sentence("a.rgs", { code: "open_failed", text: "the request failed" }), /^a\.rgs could not be fetched/);
  assert.match(sentence("a.rgs", { code: "foreign_host", text: "x" }), /another host.*beside the page/);
  assert.match(sentence("a.rgs", { code: "bad_magic", text: "x", offset: 0 }), /is not a scene that this page can open.*at byte 0/);
  assert.equal(sentence("The reference picture", new ServerError("internal", "x")), "The reference picture could not be made: internal: x.");
  assert.equal(sentence("a.ply", new Error("no")), "a.ply could not be opened: no.");
});

test("FLIP is what rgs::flip() computes", () => {
  const [width, height] = [40, 24];
  const seeded = (seed) => () => (seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0) / 2 ** 32;
  const picture = (random) => Uint8ClampedArray.from({ length: 4 * width * height }, (_, i) => (i % 4 === 3 ? 255 : 128 + 100 * Math.sin(i / 37) + 40 * random()));
  const pictures = [picture(seeded(1)), picture(seeded(2))];
  const paths = pictures.map((pixels, k) => {
    const path = join(folder, `${k}.raw`);
    writeFileSync(path, Buffer.from(Float32Array.from(pixels.filter((_, i) => i % 4 < 3), (level) => level / 255).buffer));
    return path;
  });
  const { stdout } = spawnSync(program("rgs_dump_image_metrics"), [width, height, 3, ...paths].map(String), { encoding: "utf8" });
  const expected = Number(stdout.trim().split(/\s+/)[5]);
  assert.ok(expected > 0.01 && expected < 1, stdout);
  const steps = modules.flip.flip(...pictures, width, height);
  let step = steps.next();
  for (; !step.done; step = steps.next()) assert.ok(step.value >= 0 && step.value < 1);
  assert.ok(Math.abs(step.value - expected) < 1e-6, `${step.value}, not ${expected}`);
});

test("what PLY and SOG declare of anti-aliasing is what rgs-convert reads", () => {
  const { antiAliasingOfComments, antiAliasingOfMeta } = modules.declared;
  const [classic, mip] = ["classic", "mip_splatting"].map((aaMode) => ({ aaMode }));
  const of = (...comments) => JSON.parse(JSON.stringify(antiAliasingOfComments(comments))); // without what is undefined
  for (const text of ["SplatRenderMode: mip", " splatrendermode mip\r", "SPLATRENDERMODE:MIP", "antialiased 1", "rgs_anti_aliasing: mip-splatting"]) assert.deepEqual(of(text), mip, text);
  for (const text of ["", "SplatRenderMode: 2dgs", "SplatRenderMode: default", "antialiased 0", "antialiased", "Generated by x", "rgs_of_a_later_version: x"]) assert.deepEqual(of(text), classic, text);
  assert.deepEqual(of("antialiased 1", "SplatRenderMode: default"), classic, "the last one holds");
  assert.deepEqual(of("rgs_low_pass_px2: 0.2", "SplatRenderMode: mip"), { ...mip, lowPassPx2: 0.2 });
  assert.deepEqual(of("rgs_low_pass_px2: 0"), { ...classic, lowPassPx2: 0 });
  assert.deepEqual(of("rgs_low_pass_px2: 0.2", "rgs_anti_aliasing: undeclared"), { aaMode: "undeclared", lowPassPx2: 0.2 });
  for (const text of ["rgs_low_pass_px2: much", "rgs_low_pass_px2:", "rgs_low_pass_px2: -1", "rgs_anti_aliasing: mip"]) assert.throws(() => of(text), { code: "bad_value" }, text);
  assert.deepEqual([{ model: "antialiased" }, { antialias: true }].map(antiAliasingOfMeta), [mip, mip]);
  assert.deepEqual([{}, { model: "x", antialias: true }, { antialias: "yes" }].map(antiAliasingOfMeta), [classic, classic, classic]);
});

test("what is in a file is told by its first bytes", () => {
  const { kBeginningBytes, kindOf, otherArchive } = modules.kind;
  const of = (bytes) => kindOf(new Uint8Array(Buffer.from(bytes)));
  assert.equal(of(`ply\ncomment ${"x".repeat(16384)}\nproperty uint packed_position\n${" ".repeat(1e5)}`.slice(0, kBeginningBytes)), "compressed ply");
  assert.equal(of([0x89, 0x52, 0x47, 0x53, 13, 10]), "rgs");
  assert.equal(of("ply\nformat"), "ply");
  const zip = (name) => new Uint8Array(Buffer.concat([Buffer.from("PK\x03\x04"), Buffer.alloc(22), Buffer.from([name.length, 0, 0, 0]), Buffer.from(`${name}.npy`)]));
  for (const name of ["", "meta.json", "means_l.webp"]) assert.deepEqual([kindOf(zip(name)), otherArchive(zip(name))], ["sog", null], name);
  for (const [name, what] of Object.entries({ "means.npy": /NumPy/, "archive/data.pkl": /PyTorch/, "scene.usda": /usdz/, "0_0/meta.json": /streamed SOG/ })) {
    assert.equal(kindOf(zip(name)), null, name);
    assert.match(otherArchive(zip(name)), what);
  }
  assert.equal(otherArchive(new Uint8Array(40)), null);
  assert.equal(of([0x1f, 0x8b, 8]), "spz");
  assert.equal(of("NGSP"), "spz");
  for (const text of ["[", "  \r\n[{", "\uFEFF{\"a\""]) assert.equal(of(text), "cameras");
  for (const text of ["", "pl", "RGS", "<html>", "PK", "a["]) assert.equal(of(text), null);
});

const kSpzHeader = (version, n, { degree = 0, bits = 12, flags = 0, streams = 0, table = 32 } = {}) => {
  const bytes = Buffer.alloc(version < 4 ? 16 : 32);
  bytes.write("NGSP", 0, "latin1");
  bytes.writeUInt32LE(version, 4);
  bytes.writeUInt32LE(n, 8);
  bytes.set([degree, bits, flags, streams], 12);
  if (version >= 4) bytes.writeUInt32LE(table, 16);
  return bytes;
};
const unfold = (bytes) => readSpz(Uint8Array.from(bytes));

test("an SPZ is unfolded to its streams", async () => {
  const body = Buffer.from(Array.from({ length: 20 }, (_, i) => i));
  const { streams, ...header } = await unfold(gzipSync(Buffer.concat([kSpzHeader(3, 1), body])));
  assert.deepEqual(header, { version: 3, n: 1, shDegree: 0, fractionalBits: 12, antialiased: false, axes: null });
  assert.deepEqual([...streams.positions], [0, 1, 2, 3, 4, 5, 6, 7, 8]);
  assert.deepEqual([streams.alphas, streams.colors, streams.scales, streams.rotations, streams.sh].map((stream) => [...stream]), [[9], [10, 11, 12], [13, 14, 15], [16, 17, 18, 19], []]);
});

/** One frame of Zstandard, a raw block: RFC 8878. `size`: what it says that it holds, in 4 bytes; null: nothing, but a window. */
const frameOf = (bytes, { size = bytes.length, window = 0, checksum = null } = {}) => {
  const flag = checksum === null ? 0 : 4;
  const head = Buffer.from(size === null ? [flag, window] : [0xa0 | flag, 0, 0, 0, 0]);
  if (size !== null) head.writeUInt32LE(size, 1);
  const block = Buffer.alloc(3);
  block.writeUIntLE((bytes.length << 3) | 1, 0, 3);
  return Buffer.concat([Buffer.from([0x28, 0xb5, 0x2f, 0xfd]), head, block, bytes, Buffer.from(checksum ?? [])]);
};
/** As `zstd --check` writes it behind nine ones. */
const kChecksum = [0xb2, 0x36, 0x9c, 0xe9];
/** Of one Gaussian; `edit` may put another frame in place of that of its positions. */
const versionFour = (edit = (bytes) => frameOf(bytes)) => {
  const sizes = [9, 1, 3, 3, 4];
  const frames = sizes.map((size, i) => (i === 0 ? edit : frameOf)(Buffer.alloc(size, i + 1)));
  const table = Buffer.alloc(80);
  sizes.forEach((size, i) => {
    table.writeBigUInt64LE(BigInt(frames[i].length), 16 * i);
    table.writeBigUInt64LE(BigInt(size), 16 * i + 8);
  });
  return Buffer.concat([kSpzHeader(4, 1, { streams: 5 }), table, ...frames]);
};

/** What a decoder passes over: RFC 8878, 3.1.2. */
const skippable = (bytes) => {
  const head = Buffer.from([0x5a, 0x2a, 0x4d, 0x18, 0, 0, 0, 0]);
  head.writeUInt32LE(bytes.length, 4);
  return Buffer.concat([head, bytes]);
};

// The reference library unfolds them with ZSTD_decompress, as rgs-convert does: the program says so below.
test("a stream of an SPZ is frames that unfold to its size, and nothing else", async () => {
  const sound = {
    "a size": frameOf,
    "no size": (bytes) => frameOf(bytes, { size: null }),
    "a checksum": (bytes) => frameOf(bytes, { checksum: kChecksum }),
    "a window of 2 GB": (bytes) => frameOf(bytes, { size: null, window: 0xa8 }),
    "two frames": (bytes) => Buffer.concat([frameOf(bytes.subarray(0, 4)), frameOf(bytes.subarray(4), { size: null })]),
    "a frame of nothing": (bytes) => Buffer.concat([frameOf(bytes.subarray(0, 0)), frameOf(bytes, { checksum: kChecksum })]),
    "frames that may be skipped": (bytes) => Buffer.concat([skippable(Buffer.alloc(3)), frameOf(bytes), skippable(Buffer.alloc(0))]),
  };
  for (const [what, edit] of Object.entries(sound)) {
    const { streams } = await unfold(versionFour((bytes) => edit(bytes)));
    assert.deepEqual([...streams.positions], Array(9).fill(1), what);
    assert.deepEqual([...streams.rotations], Array(4).fill(5), what);
  }
  const bad = {
    "too few": (bytes) => frameOf(bytes.subarray(1)),
    "too few, unsaid": (bytes) => frameOf(bytes.subarray(1), { size: null }),
    "too many": () => frameOf(Buffer.alloc(10)),
    "too many, unsaid": () => frameOf(Buffer.alloc(10), { size: null }),
    "another size than it says": (bytes) => frameOf(bytes, { size: 10 }),
    "two frames of too many": (bytes) => Buffer.concat([frameOf(bytes), frameOf(bytes.subarray(0, 1))]),
    "two frames of too many, unsaid": (bytes) => Buffer.concat([frameOf(bytes), frameOf(bytes.subarray(0, 1), { size: null })]),
    "two frames of too few": (bytes) => Buffer.concat([frameOf(bytes.subarray(0, 4)), frameOf(bytes.subarray(5))]),
    "a wrong checksum of the second": (bytes) => Buffer.concat([frameOf(bytes.subarray(0, 0)), frameOf(bytes, { checksum: [0xb3, 0x36, 0x9c, 0xe9] })]),
    "bytes behind it": (bytes) => Buffer.concat([frameOf(bytes), Buffer.alloc(1)]),
    "a skippable frame beyond its end": (bytes) => Buffer.concat([frameOf(bytes), skippable(Buffer.alloc(4)).subarray(0, 10)]),
    "a dictionary": (bytes) => Buffer.from(frameOf(bytes).map((byte, i) => (i === 4 ? byte | 1 : byte))),
    "a window of 4 GB": (bytes) => frameOf(bytes, { size: null, window: 0xb0 }),
    "a wrong checksum": (bytes) => frameOf(bytes, { checksum: [0xb3, 0x36, 0x9c, 0xe9] }),
    "half a checksum": (bytes) => frameOf(bytes, { checksum: [0xb2, 0x36] }),
    "half of it": (bytes) => frameOf(bytes).subarray(0, 12),
    "no frame": () => Buffer.alloc(20),
  };
  for (const [what, edit] of Object.entries(bad)) await assert.rejects(unfold(versionFour(edit)), { code: "corrupt_data", offset: 112 }, what);
  const whole = versionFour();
  await assert.rejects(unfold(Buffer.concat([whole, Buffer.alloc(1)])), { code: "trailing_bytes", offset: whole.length });
  // A stream that the table has a byte too long or too short is noticed before any is unfolded.
  const edited = (difference) => Buffer.from(whole.map((byte, i) => (i === 32 ? byte + difference : byte)));
  await assert.rejects(unfold(edited(1)), { code: "truncated", offset: 96 });
  await assert.rejects(unfold(edited(-1)), { code: "trailing_bytes", offset: whole.length - 1 });
  const path = join(folder, "a.spz");
  for (const [all, expected] of [[sound, 0], [bad, 4]]) {
    for (const [what, edit] of Object.entries(all)) {
      writeFileSync(path, versionFour((bytes) => edit(bytes)));
      const { status } = spawnSync(program("rgs-convert"), ["--quiet", "--overwrite", path, join(folder, "a.ply")]);
      assert.equal(status, expected, `rgs-convert: ${what}`);
    }
  }
});

/** A PLY or an SPZ as the page's worker reads it: {head, arrays}. */
async function splatsOf(bytes, axes = ["right", "down", "forward"]) {
  const splats = new modules.splats.Splats(await WebAssembly.compile(readFileSync(new URL("../../../build/web/splats.wasm", import.meta.url))));
  if (bytes.subarray(0, 3).toString() === "ply") {
    for (let at = 0; at < bytes.length; at += 100_000) splats.append(bytes.subarray(at, at + 100_000), at === 0 ? bytes.length : 0);
    const head = splats.openPly(axes);
    return { head, arrays: splats.read(0, head.n) };
  }
  const head = await unfold(bytes);
  splats.openSpz(head, axes, axes);
  const half = head.n >> 1;
  const [first, second] = [splats.read(0, half), splats.read(half, head.n - half)];
  return { head, arrays: Object.fromEntries(Object.entries(first).map(([name, values]) => [name, values instanceof Float32Array ? Float32Array.of(...values, ...second[name]) : head[name]])) };
}
const kBegin = "end_header\n";
/** The first Gaussians of a generated PLY: its names, and a row each. */
function rowsOf(ply, n) {
  const begin = ply.indexOf(kBegin) + kBegin.length;
  const names = [...ply.toString("latin1", 0, begin).matchAll(/^property float (\w+)/gm)].map(([, name]) => name);
  return { names, rows: Array.from({ length: n }, (_, i) => names.map((_, k) => ply.readFloatLE(begin + 4 * (i * names.length + k)))) };
}
const headerOf = (format, n, names, more = "") => `ply\nformat ${format} 1.0\n${more}element vertex ${n}\n${names.map((name) => `property float ${name}\n`).join("")}${kBegin}`;
function plyOf({ names, rows }, more = "") {
  const values = rows.flat();
  const body = Buffer.alloc(4 * values.length);
  values.forEach((value, i) => body.writeFloatLE(value, 4 * i));
  return Buffer.concat([Buffer.from(headerOf("binary_little_endian", rows.length, names, more)), body]);
}

test("an SPZ of each version has the values of the PLY that rgs-convert makes of it", async () => {
  const path = (name) => join(folder, name);
  const convert = (...args) => execFileSync(program("rgs-convert"), ["--quiet", "--overwrite", ...args]);
  for (const version of ["2", "3", "4"]) {
    convert("--spz-version", version, "--crop=-1,-1,-1,0,0,0", join(scenes(), "scene.ply"), path("a.spz"));
    convert(path("a.spz"), path("a.ply"));
    const [spz, ply] = [await splatsOf(readFileSync(path("a.spz"))), await splatsOf(readFileSync(path("a.ply")))];
    assert.ok(spz.head.n > 100);
    assert.deepEqual(spz.arrays, ply.arrays, `version ${version}`);
  }
});

test("a PLY is read in any order, encoding and frame", async () => {
  const few = rowsOf(readFileSync(join(scenes(), "scene.ply")), 7);
  const { arrays } = await splatsOf(plyOf(few));
  const at = (name) => few.names.indexOf(name);
  few.rows.forEach((row, i) => {
    const near = (found, expected) => assert.ok(Math.abs(found - expected) <= 1e-6 * Math.abs(expected), `${found}, not ${expected}`);
    const norm = Math.hypot(...[0, 1, 2, 3].map((k) => row[at(`rot_${k}`)]));
    for (let k = 0; k < 4; ++k) near(arrays.rotations[4 * i + k], row[at(`rot_${k}`)] / norm);
    for (let k = 0; k < 3; ++k) near(arrays.scales[3 * i + k], Math.exp(row[at(`scale_${k}`)]));
    near(arrays.opacities[i], 1 / (1 + Math.exp(-row[at("opacity")])));
    for (const [k, name] of ["x", "y", "z"].entries()) assert.equal(arrays.means[3 * i + k], row[at(name)]);
    for (let k = 0; k < 3; ++k) assert.equal(arrays.sh0[3 * i + k], row[at(`f_dc_${k}`)]);
    // 15 of a channel, one channel after the other.
    for (let k = 0; k < 45; ++k) assert.equal(arrays.shN[45 * i + 3 * (k % 15) + Math.floor(k / 15)], row[at(`f_rest_${k}`)]);
  });
  const backward = { names: [...few.names].reverse(), rows: few.rows.map((row) => [...row].reverse()) };
  assert.deepEqual((await splatsOf(plyOf(backward))).arrays, arrays);
  const swapped = plyOf(few);
  const big = Buffer.concat([Buffer.from(headerOf("binary_big_endian", 7, few.names)), Buffer.from(swapped.subarray(swapped.indexOf(kBegin) + kBegin.length)).swap32()]);
  assert.deepEqual((await splatsOf(big)).arrays, arrays);
  const text = Buffer.from(`${headerOf("ascii", 7, few.names)}${few.rows.map((row) => `${row.map((value) => (Object.is(value, -0) ? "-0" : value)).join(" ")}\n`).join("")}`);
  assert.deepEqual((await splatsOf(text)).arrays, arrays);

  const { head, arrays: turned } = await splatsOf(plyOf(few, "comment rgs_axes: right,up,backward\ncomment SplatRenderMode: mip\n"));
  assert.deepEqual([head.n, head.shDegree, head.aaMode, head.origin], [7, 3, "mip_splatting", [0, 0, 0]]);
  assert.deepEqual([...turned.means], [...arrays.means].map((value, i) => (i % 3 === 0 ? value : -value)));
  assert.deepEqual([...turned.sh0], [...arrays.sh0]);
});

test("a PLY for which there is no memory is an error of its own", async () => {
  const splats = new modules.splats.Splats(await WebAssembly.compile(readFileSync(new URL("../../../build/web/splats.wasm", import.meta.url))));
  const { memory } = splats.wasm;
  // The C library has begun with the memory that there was.
  splats.append(Buffer.alloc(1), 0);
  memory.grow(65536 - memory.buffer.byteLength / 65536);
  assert.throws(() => splats.append(Buffer.alloc(1), 2 ** 30), { code: "host_out_of_memory" });
});

test("a PLY says what is wrong with it, and damaged Gaussians are left out", async () => {
  const few = rowsOf(readFileSync(join(scenes(), "scene.ply")), 3);
  const whole = plyOf(few);
  const refused = { truncated: whole.subarray(0, whole.length - 1), trailing_bytes: Buffer.concat([whole, Buffer.alloc(1)]), not_gaussian_splats: Buffer.from(whole.toString("latin1").replace("rot_3", "rot_x"), "latin1"), bad_value: plyOf(few, "comment rgs_low_pass_px2: much\n") };
  for (const [code, bytes] of Object.entries(refused)) {
    await assert.rejects(splatsOf(bytes), (error) => error.code === code && error.text.length > 10, code);
  }
  const { arrays } = await splatsOf(whole);
  few.rows[1][few.names.indexOf("scale_1")] = NaN;
  const { head, arrays: kept } = await splatsOf(plyOf(few));
  assert.deepEqual([head.n, kept.n], [3, 2]);
  assert.deepEqual([...kept.means], [...arrays.means.subarray(0, 3), ...arrays.means.subarray(6)]);
  assert.deepEqual([...kept.shN], [...arrays.shN.subarray(0, 45), ...arrays.shN.subarray(90)]);
});

test("an SPZ declares its axes by a record, and other records change nothing", async () => {
  const words = (...values) => Buffer.from(Uint32Array.from(values).buffer);
  const [orbit, georeference] = [words(0xadbe0002, 12, 0, 0, 0), words(0x4e530001, 4, 7)];
  const axes = (system) => words(0xadbe0003, 4, system);
  // The records of both framings: the end of the gzip stream, before the table.
  const streams = versionFour().subarray(32);
  const files = (records) => [
    gzipSync(Buffer.concat([kSpzHeader(3, 1, { flags: 2 }), Buffer.alloc(20), records])),
    Buffer.concat([kSpzHeader(4, 1, { streams: 5, flags: 2, table: 32 + records.length }), records, streams]),
  ];
  const [ply, openGl] = [["right", "down", "forward"], ["right", "up", "backward"]];
  const declared = [[axes(6), ply], [axes(4), openGl], [axes(5), ["left", "down", "forward"]], [axes(0), null], [orbit, null], [Buffer.alloc(0), null],
    [Buffer.concat([georeference, axes(4), orbit]), openGl], [Buffer.concat([words(0xadbe0002), words(0, 0, 0)]), null]];
  for (const [records, expected] of declared) {
    for (const file of files(records)) assert.deepEqual((await unfold(file)).axes, expected, records.toString("hex"));
  }
  const refused = [[Buffer.concat([axes(6), axes(6)]), "bad_header", 12], [words(0xadbe0002, 16, 0, 0, 0, 0), "bad_header", 4], [axes(17), "bad_value", 8], [words(0x12340001, 0), "unsupported_feature", 0], [words(0xadbe0003, 8, 6, 0), "bad_header", 4],
    [words(0x4e530001, 5, 0), "truncated", 4], [words(0x4e530001), "truncated", 0]];
  for (const [records, code, at] of refused) {
    const begins = [36, 32];
    for (const [i, file] of files(records).entries()) await assert.rejects(unfold(file), { code, offset: begins[i] + at }, records.toString("hex"));
  }
  const { spzAxesOf } = modules.manifest;
  assert.equal(spzAxesOf("", {}), "ply");
  assert.equal(spzAxesOf("?spz-axes=opengl", {}), "opengl");
  assert.equal(spzAxesOf("", { settings: { spz_axes: "opengl" } }), "opengl");
  assert.equal(spzAxesOf("?spz-axes=ply", { settings: { spz_axes: "opengl" } }), "ply");
});

test("a damaged SPZ is an error with code and byte, and makes no large allocation", async () => {
  const fails = async (bytes, code, offset) => assert.rejects(unfold(bytes), { code, offset });
  await fails(Buffer.from("NGSP"), "truncated", 4);
  await fails(kSpzHeader(5, 1), "unsupported_version", 4);
  await fails(kSpzHeader(4, 0xffffffff), "limit_exceeded", 8);
  await fails(kSpzHeader(4, 1, { degree: 4 }), "unsupported_feature", 12);
  await fails(kSpzHeader(4, 1, { bits: 25 }), "bad_header", 13);
  await fails(kSpzHeader(4, 1, { flags: 4 }), "reserved_bits", 14);
  await fails(kSpzHeader(4, 1, { streams: 6 }), "bad_header", 15);
  await fails(kSpzHeader(4, 1, { streams: 5 }), "bad_header", 16);
  await fails(kSpzHeader(4, 1, { streams: 5, table: 0xfffffff0 }), "bad_header", 16);
  const reserved = kSpzHeader(4, 1, { streams: 5 });
  reserved[31] = 1;
  await fails(reserved, "reserved_bits", 20);
  const table = Buffer.alloc(80);
  [9, 1, 3, 3, 4].forEach((size, i) => table.writeBigUInt64LE(BigInt(size), 16 * i + 8));
  await fails(Buffer.concat([kSpzHeader(4, 2, { streams: 5 }), table]), "size_mismatch", 40);
  await fails(Buffer.concat([kSpzHeader(4, 1, { streams: 5 }), table]), "corrupt_data", 112);
  table.writeBigUInt64LE(0xffffffffffffffffn, 0);
  await fails(Buffer.concat([kSpzHeader(4, 1, { streams: 5 }), table]), "truncated", 32);
  const gzip = (bytes) => gzipSync(bytes);
  await fails(gzip(Buffer.concat([kSpzHeader(3, 1), Buffer.alloc(19)])), "truncated", 35);
  await fails(gzip(Buffer.concat([kSpzHeader(3, 1), Buffer.alloc(21)])), "trailing_bytes", 36);
  // Unfolds to 100 MB, of which 36 bytes are read.
  await fails(gzip(Buffer.concat([kSpzHeader(3, 1), Buffer.alloc(1e8)])), "trailing_bytes", 36);
  await fails(gzip(kSpzHeader(3, 1)).subarray(0, 20), "corrupt_data", 0);
  await fails(gzip(kSpzHeader(4, 1)), "bad_header", 4);
  await fails(gzip(kSpzHeader(3, 1, { streams: 1 })), "reserved_bits", 15);
  await fails(gzip(Buffer.from("no SPZ at all, but text")), "bad_magic", 0);
});
