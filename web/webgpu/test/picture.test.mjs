// picture.test.mjs - pictures beside the CPU renderer's, both of 8 bits rounded once; sums and sorts beside JavaScript's.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { cpSync, mkdirSync, readFileSync } from "node:fs";
import { basename, join } from "node:path";
import test from "node:test";
import { fileURLToPath } from "node:url";
import { build } from "vite";
import { program, psnr, readCameras, renderAll } from "../../playcanvas/test/pictures.mjs";
import { hasChromium, launch, newPage } from "../../reader/test/chromium.mjs";
import { scenes } from "../../reader/test/dump.mjs";
import { hasNginx, skip, startNginx } from "../../reader/test/servers.mjs";

const kSize = [240, 180];
const kLeastDb = 50;
/** Of arrays, whose values are those that the CPU renderer draws. */
const kLeastArraysDb = 90;
const bytes = (base64) => Buffer.from(base64, "base64");

test("pictures", async (t) => {
  if (!hasChromium) return skip(t, "chromium is not installed");
  if (!hasNginx) return skip(t, "nginx is not installed");
  const server = await startNginx();
  const browser = await launch("webgpu");
  t.after(async () => {
    await browser.close();
    await server.end();
  });
  const made = join(server.files, "made");
  mkdirSync(made);
  await build({
    configFile: false,
    logLevel: "error",
    root: fileURLToPath(new URL(".", import.meta.url)),
    base: "./",
    build: { outDir: join(server.files, "page"), target: "es2022", rollupOptions: { input: fileURLToPath(new URL("page.html", import.meta.url)) } },
  });
  const problems = [];
  const openPage = async (isLeast) => {
    const page = await newPage(browser);
    page.on("pageerror", (error) => problems.push(String(error)));
    await page.goto(`${server.url}/page/page.html`);
    await page.evaluate((isLeast) => window.splats.start(isLeast), isLeast);
    return page;
  };
  // A device as every browser has it.
  const page = await openPage(true);
  const call = (name, ...args) => page.evaluate(([name, args]) => window.splats[name](...args), [name, args]);
  const load = (scene, ...how) => {
    cpSync(scene, join(server.files, basename(scene)));
    return call(scene.endsWith(".rgs") ? "load" : "loadArrays", `/${basename(scene)}`, ...how);
  };
  const convert = (from, name, ...more) => {
    const to = join(made, name);
    execFileSync(program("rgs-convert"), [from, to, "--quiet", "--overwrite", ...more]);
    return to;
  };
  const generated = readCameras(join(scenes(), "cameras.json"));
  const draw = async (camera, [width, height] = kSize, options = {}) => bytes(await call("picture", camera, width, height, options));
  /** Least PSNR over some views of what is loaded, and that no channel is off by more. */
  const compare = async (t, scene, cameras, views, { size = kSize, options = {}, more = [], most = 255, least = kLeastDb } = {}) => {
    const list = readCameras(cameras);
    const found = [];
    for (const [i, path] of renderAll(scene, cameras, views, size, join(server.files, "pictures"), more).entries()) {
      const expected = bytes(await call("decode", `/pictures/views/${basename(path)}`));
      const drawn = await draw(list[views[i]], size, options);
      found.push(psnr(drawn, expected));
      for (let k = 0; k < drawn.length; ++k) if (k % 4 !== 3) assert.ok(Math.abs(drawn[k] - expected[k]) <= most, `pixel ${k >> 2}: ${drawn[k]}, not ${expected[k]}`);
    }
    t.diagnostic(`${[basename(scene), size.join("x"), ...more].join(" ")}: ${found.map((db) => db.toFixed(1)).join(" ")} dB`);
    assert.ok(Math.min(...found) >= least, `${found} dB`);
  };
  const packed = join(scenes(), "packed.rgs");
  const cameras = join(scenes(), "cameras.json");

  await t.test("sums", async () => {
    for (const n of [0, 1, 255, 256, 257, 2048, 2049, 5000]) {
      const values = Array.from({ length: n }, (_, i) => (i * 7919) % 1000);
      const [found, total] = await call("sums", values);
      let sum = 0;
      for (const [i, value] of values.entries()) {
        assert.equal(found[i], sum, `${n}: ${i}`);
        sum += value;
      }
      assert.equal(total, sum, `of ${n}`);
    }
    // Too many for 32 bits are as many as these hold.
    assert.deepEqual(await call("sums", [2 ** 31, 2 ** 31 + 5, 7]), [[0, 2 ** 31, 2 ** 32 - 1], 2 ** 32 - 1]);
  });

  await t.test("the sort is stable", async () => {
    let state = 1;
    const random = () => (state = Math.imul(state, 1664525) + 1013904223) >>> 0;
    for (const n of [0, 1, 2047, 2048, 2049, 20000]) {
      for (const [bits, kinds] of [[31, 2 ** 31], [31, 3], [13, 8160]]) {
        const keys = Array.from({ length: n }, () => (random() % kinds) * (kinds === 3 ? 2 ** 29 : 1));
        const order = keys.map((_, i) => i).sort((a, b) => keys[a] - keys[b] || a - b);
        const [sorted, places] = await call("sort", keys, bits);
        assert.deepEqual(places, order, `${n} keys of ${bits} bits`);
        assert.deepEqual(sorted, order.map((i) => keys[i]));
      }
    }
  });

  await t.test("conformance scenes", async (t) => {
    const folder = join(made, "conformance");
    execFileSync(program("rgs-make-scene"), ["--conformance", folder, "--quiet"]);
    for (const { folder: name, scene, cameras_file, near_plane, cameras } of JSON.parse(readFileSync(join(folder, "conformance.json"), "utf8")).scenes) {
      const near = near_plane === undefined ? [] : ["--near", String(near_plane)];
      const { width, height } = cameras[0];
      const ply = join(folder, name, scene);
      for (const drawn of [ply, convert(ply, `${name}.rgs`)]) {
        await load(drawn);
        await compare(t, drawn, join(folder, name, cameras_file), [...cameras.keys()], { size: [width, height], options: { near: near_plane }, more: near, most: 1 });
      }
    }
  });

  await t.test("a generated scene, and what options change", async (t) => {
    await load(packed);
    await compare(t, packed, cameras, [0, 2, 5], { most: 2 });
    // Narrower and wider than the pinhole's picture, and of no whole tiles.
    for (const size of [[37, 61], [101, 16], [1, 1]]) await compare(t, packed, cameras, [1], { size, most: 2 });
    for (const [more, options] of [
      [["--aa", "mip"], { antiAliasing: { lowPassPx2: 0.1, compensated: true } }],
      [["--aa", "classic", "--low-pass", "1.5"], { antiAliasing: { lowPassPx2: 1.5, compensated: false } }],
      [["--background", "1,0.5,0.25"], { background: [1, 0.5, 0.25] }],
      [["--sh-degree", "0"], { shDegree: 0 }],
      [["--sh-degree", "2"], { shDegree: 2 }],
      [["--near", "4", "--far", "9"], { near: 4, far: 9 }],
    ]) {
      await compare(t, packed, cameras, [0], { size: [120, 90], options, more, most: 2 });
    }
  });

  await t.test("a picture is the same every time, and after others", async () => {
    const first = await draw(generated[0]);
    await draw(generated[3]);
    assert.ok((await draw(generated[0])).equals(first));
    const [other, isComplete] = await call("rendered", generated[0], ...kSize);
    assert.ok(isComplete);
    assert.deepEqual(bytes(other), first, "in a texture of another format");
  });

  await t.test("without room a frame leaves the picture, and makes room", async () => {
    const background = [0, 1, 0];
    const first = await draw(generated[0], kSize, { background });
    await load(packed, [100, 100]);
    const frames = [];
    do frames.push(await call("rendered", generated[0], ...kSize, background));
    while (!frames.at(-1)[1] && frames.length < 9);
    assert.equal(frames.length, 3, "splats, entries, then the picture");
    for (const [pixels] of frames.slice(0, 2)) assert.ok(bytes(pixels).every((byte, i) => byte === [0, 255, 0, 0][i % 4]));
    assert.deepEqual(bytes(frames[2][0]), first);
  });

  await t.test("equal depths are in the order of parts, wherever these lie", async () => {
    const size = [120, 90];
    const twice = async (...how) => {
      await call("loadTwice", `/${basename(packed)}`, ...how);
      return draw(generated[0], size);
    };
    await load(packed);
    const first = await twice([0, 3, 4, 1, 2, 5], false);
    assert.deepEqual(await twice([0, 3, 4, 1, 2, 5], true), first);
    assert.ok(psnr(await twice([0, 3, 1, 4, 2, 5], false), first) < kLeastDb);
  });

  // Where FP32 has eighths, a camera is somewhere between.
  await t.test("far from a file's origin the picture is the same", async (t) => {
    const far = 2 ** 20;
    const camera = { ...generated[0], position: generated[0].position.map((value) => Math.round(2 ** 20 * value) / 2 ** 20 + 0.06) };
    await load(packed, undefined, 0);
    const near = await draw(camera, [120, 90]);
    await load(packed, undefined, far);
    const db = psnr(await draw({ ...camera, position: camera.position.map((value) => value + far) }, [120, 90]), near);
    t.diagnostic(`${db.toFixed(1)} dB`);
    assert.ok(db >= kLeastDb, `${db} dB`);
  });

  await t.test("what a file declares, and files of each degree", async (t) => {
    const ply = join(scenes(), "scene.ply");
    for (const [name, declared] of [
      ["wide-filter.rgs", ["--aa", "classic", "--low-pass", "1.5"]],
      ["mip.rgs", ["--aa", "mip"]],
      ["direct.rgs", ["--profile", "direct"]],
    ]) {
      const rgs = convert(ply, name, ...declared);
      await load(rgs);
      await compare(t, rgs, cameras, [2], { size: [120, 90], most: 2 });
    }
    for (const degree of [0, 1, 2]) {
      const [low, own] = [join(made, "low.ply"), join(made, "low.json")];
      execFileSync(program("rgs-make-scene"), ["--gaussians", "5k", "--degree", String(degree), "--cameras", own, low, "--quiet", "--overwrite"]);
      const rgs = convert(low, `degree-${degree}.rgs`);
      await load(rgs);
      await compare(t, rgs, own, [0], { size: [120, 90], most: 2 });
    }
  });

  await t.test("arrays of PLY and SPZ, of each degree and in other axes", async (t) => {
    const ply = join(scenes(), "scene.ply");
    const to = (name, ...more) => convert(ply, name, "--crop=-2,-3,-2,2,3,2", ...more);
    for (const scene of [
      to("degree-0.ply", "--sh-degree", "0"),
      to("degree-1.ply", "--sh-degree", "1"),
      to("degree-2.ply", "--sh-degree", "2"),
      to("turned.ply", "--to-axes", "left,up,forward"),
      to("mip.ply", "--aa", "mip"),
      to("two.spz", "--spz-version", "2"),
      to("three.spz", "--spz-version", "3"),
      to("four.spz", "--spz-version", "4", "--sh-degree", "1"),
    ]) {
      await load(scene);
      await compare(t, scene, cameras, [2], { most: 1, least: kLeastArraysDb });
    }
    await load(ply);
    await compare(t, ply, cameras, [0, 5], { most: 1, least: kLeastArraysDb });
    await compare(t, ply, cameras, [0], { size: [120, 90], options: { shDegree: 1 }, more: ["--sh-degree", "1"], most: 1 });
  });

  await t.test("levels of detail", async (t) => {
    const levels = join(scenes(), "levels.rgs");
    await load(levels);
    await compare(t, levels, cameras, [0], { more: ["--detail", "0"], most: 2 });
    const numbers = [];
    for (const detail of [16, 4]) {
      numbers.push(await call("loadCut", generated[0], kSize[0], detail));
      await compare(t, levels, cameras, [0], { more: ["--detail", String(detail)], options: { coarser: true }, most: 2 });
    }
    assert.ok(numbers[0] < numbers[1], `${numbers} pages`);
  });

  await t.test("12 views of a trained scene", async (t) => {
    const data = process.env.RGS_DATA_DIR;
    const scene = process.env.RGS_WEB_SOUTH;
    if (!scene) {
      if ((process.env.RGS_REQUIRE_DATA ?? "0") !== "0") throw new Error("RGS_REQUIRE_DATA is set, but there is no south");
      return t.skip("there is no south in RGS_DATA_DIR");
    }
    await load(scene);
    await compare(t, scene, join(data, "south", "cameras.json"), Array.from({ length: 12 }, (_, i) => 10 * i));
  });

  await t.test("a crop of a trained scene as PLY", async (t) => {
    const data = process.env.RGS_DATA_DIR;
    if (!data) return t.skip("RGS_DATA_DIR names no data");
    const crop = join(data, "formats", "crop.ply");
    await load(crop);
    await compare(t, crop, join(data, "south", "cameras.json"), [0, 40, 80], { most: 1, least: kLeastArraysDb });
  });

  await t.test("a device with larger buffers draws the same", async () => {
    const camera = generated[2];
    await load(packed);
    const least = await draw(camera, [120, 90]);
    const larger = await openPage(false);
    await larger.evaluate((url) => window.splats.load(url), `/${basename(packed)}`);
    assert.ok(bytes(await larger.evaluate((camera) => window.splats.picture(camera, 120, 90), camera)).equals(least));
    problems.push(...(await larger.evaluate(() => window.splats.problems())));
    await larger.close();
  });

  await t.test("the device has nothing to complain of", async () => assert.deepEqual([...problems, ...(await call("problems"))], []));
});
