// scoreboard.mjs - how far web clients of 3D Gaussian splats are from the image's definition, and why: node scoreboard.mjs [--out FOLDER]
// [--work FOLDER] [--data FOLDER] [--client KEY]... [--scene NAME]... [--resume]. Draws the conformance scenes, two generated ones and, if
// --data has it, a trained one by each client, has rgs-judge say why, and writes scoreboard.json and scoreboard.html. --resume takes what
// an earlier run left in --work.
// SPDX-License-Identifier: Apache-2.0
import { execFile, execFileSync } from "node:child_process";
import { existsSync, mkdirSync, readFileSync, realpathSync, renameSync, rmSync, writeFileSync } from "node:fs";
import { availableParallelism } from "node:os";
import { join, resolve } from "node:path";
import { fileURLToPath } from "node:url";
import { parseArgs, promisify } from "node:util";
import { program } from "../playcanvas/test/pictures.mjs";
import { launch, newPage } from "../reader/test/chromium.mjs";
import { drawAll, kClients } from "./draw.mjs";
import { scoreboardPage } from "./scoreboard-page.mjs";

const kRoot = fileURLToPath(new URL("../..", import.meta.url));
const kLeastShare = 0.01;

const readJson = (path) => JSON.parse(readFileSync(path, "utf8"));
const rounded = (value, digits = 4) => (value === null ? null : Number(value.toFixed(digits)));
const psnrOf = (mse) => (mse > 0 ? -10 * Math.log10(mse) : null);

/** The first camera of a list, 180 rows high: rgs-judge draws a large scene some hundred times. */
function resized(from, to) {
  const [camera] = readJson(from);
  const { width, height, fx, fy, cx, cy } = camera;
  const scale = 180 / height;
  const size = { width: Math.round(scale * width), height: 180, fx: scale * fx, fy: scale * fy, cx: scale * cx, cy: scale * cy };
  writeFileSync(to, JSON.stringify([{ ...camera, split: "test", ...size }]));
}

/** Writes the scenes of these names, or all. */
export function makeScenes(work, { data, names = [], resumes = false } = {}) {
  const make = (...words) => execFileSync(program("rgs-make-scene"), words, { stdio: "pipe" });
  const wanted = (name) => names.length === 0 || names.includes(name);
  const path = (name) => join(work, name);
  if (!resumes) rmSync(path("conformance"), { recursive: true, force: true });
  if (!existsSync(path("conformance"))) make("--conformance", path("conformance"));
  const scenes = readJson(path("conformance/conformance.json")).scenes.map(({ name, rule, folder, scene, cameras_file, near_plane, gaussians }) => {
    const file = (word) => join(work, "conformance", folder, word);
    return { name, kind: "conformance", rule, gaussians, scene: file(scene), cameras: file(cameras_file), near: near_plane };
  });
  const larger = (name, kind, rule, prepare) => {
    if (!wanted(name)) return;
    const [scene, all, cameras] = ["ply", "all.json", "json"].map((end) => path(`${name}.${end}`));
    if (!resumes || !existsSync(cameras)) {
      prepare(scene, all);
      resized(all, cameras);
    }
    scenes.push({ name, kind, rule, scene, cameras, near: 0.2 });
  };
  larger("house", "generated", "A generated house, as rgs-make-scene --gaussians 150k makes it.", (scene, all) => make("--overwrite", "--gaussians", "150k", "--cameras", all, scene));
  larger("town", "generated", "A generated town, as rgs-make-scene --town --gaussians 300k --seed 2 makes it.", (scene, all) =>
    make("--overwrite", "--town", "--gaussians", "300k", "--seed", "2", "--cameras", all, scene),
  );
  const south = data && join(data, "south/south.ply.zst");
  if (south && existsSync(south))
    larger("south", "real", "A brick building, trained on 128 photographs.", (scene, all) => {
      execFileSync("zstd", ["-q", "-d", "-f", south, "-o", scene]);
      writeFileSync(all, readFileSync(join(data, "south/cameras.json")));
    });
  return scenes.filter(({ name }) => wanted(name));
}

/** What rgs-judge says of pictures in a folder; null if there are none. */
async function judged(scene, folder) {
  if (readJson(join(folder, "client.json")).error) return null;
  const out = join(folder, "judged");
  const json = join(out, "judge.json");
  if (existsSync(json)) return readJson(json);
  rmSync(out, { recursive: true, force: true });
  mkdirSync(out);
  const words = ["--cameras", scene.cameras, "--split", "all", "--against", folder, "--near", `${scene.near}`, "--json", json, "--pictures", out];
  await promisify(execFile)(program("rgs-judge"), [scene.scene, ...words, "--threads", "1", "--quiet"]);
  return readJson(json);
}

/** Largest difference of two PNGs, in levels. */
const largest = (page, a, b) =>
  page.evaluate(
    async (urls) => {
      const [p, q] = await Promise.all(
        urls.map(async (url) => {
          const bitmap = await createImageBitmap(await (await fetch(url)).blob());
          const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
          context.drawImage(bitmap, 0, 0);
          return context.getImageData(0, 0, bitmap.width, bitmap.height).data;
        }),
      );
      return p.reduce((most, value, i) => Math.max(most, Math.abs(value - q[i])), 0);
    },
    [a, b].map((path) => `data:image/png;base64,${readFileSync(path, "base64")}`),
  );

/** A PNG as a data URI of WebP, exact at quality 1. */
const webp = (page, path, quality) =>
  page.evaluate(
    async ([url, quality]) => {
      const bitmap = await createImageBitmap(await (await fetch(url)).blob());
      const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
      canvas.getContext("2d").drawImage(bitmap, 0, 0);
      const bytes = new Uint8Array(await (await canvas.convertToBlob({ type: "image/webp", quality })).arrayBuffer());
      return `data:image/webp;base64,${btoa(String.fromCharCode(...bytes))}`;
    },
    [`data:image/png;base64,${readFileSync(path, "base64")}`, quality],
  );

/** Causes in their order. What is below 0, as some are that others make up for, is taken off the next ones. */
function netted(causes) {
  let owed = 0;
  return causes.map((cause) => {
    const share = cause.share + owed;
    owed = Math.min(share, 0);
    return { ...cause, share: Math.max(share, 0) };
  });
}

/** Over scenes of `cells`, each picture by its pixels. */
function total(cells) {
  const sums = { error: 0, rest: 0, pixels: 0, n: 0, nAsDefined: 0 };
  const causes = new Map();
  for (const { pixels, found, levels } of cells) {
    if (!found) continue;
    const error = pixels * found.mse;
    sums.error += error;
    sums.rest += error * (1 - found.named);
    sums.pixels += pixels;
    ++sums.n;
    if (levels <= 1) ++sums.nAsDefined;
    for (const { key, sentence, known, share } of netted(found.causes)) {
      const cause = causes.get(key) ?? { key, sentence, known, share: 0 };
      cause.share += share * error;
      causes.set(key, cause);
    }
  }
  const share = (value) => (sums.error > 0 ? value / sums.error : 0);
  const list = [...causes.values()].map((cause) => ({ ...cause, share: rounded(share(cause.share)) }));
  return {
    scenes: sums.n,
    as_defined: sums.nAsDefined,
    psnr: sums.n > 0 ? rounded(psnrOf(sums.error / sums.pixels), 2) : null,
    named: rounded(1 - share(sums.rest)),
    causes: list.filter((cause) => cause.share >= kLeastShare).sort((a, b) => b.share - a.share),
  };
}

/** The scoreboard, and the pictures of its page by scene and client, "definition" among them. */
export async function score(scenes, keys, work, { resumes = false, say = console.error } = {}) {
  const folder = (key, { name }) => join(work, key, name);
  for (const key of keys) {
    if (!resumes) for (const scene of scenes) rmSync(folder(key, scene), { recursive: true, force: true });
    const left = scenes.filter((scene) => !existsSync(join(folder(key, scene), "client.json")));
    const jobs = left.map((scene) => ({ scene: scene.scene, cameras: scene.cameras, near: scene.near, out: folder(key, scene) }));
    if (jobs.length > 0) say(`${kClients[key][0]}: ${await drawAll(key, jobs, { seconds: 120, say })} of ${jobs.length} scenes drawn`);
  }
  // Scenes that take long come last in the list, and first here.
  const cells = scenes.flatMap((scene) => keys.map((key) => ({ scene, key }))).reverse();
  const waiting = [...cells];
  const work1 = async () => {
    for (let cell = waiting.shift(); cell; cell = waiting.shift()) cell.found = await judged(cell.scene, folder(cell.key, cell.scene));
  };
  await Promise.all(Array.from({ length: availableParallelism() }, work1));

  const browser = await launch();
  try {
    const page = await newPage(browser);
    const pictures = {};
    const board = { schema: "rgs-scoreboard/1", scenes: [], clients: keys.map((key) => ({ key, name: kClients[key][0] })) };
    for (const scene of scenes) {
      const { name, kind, rule } = scene;
      const cameras = readJson(scene.cameras);
      const of = cells.filter((cell) => cell.scene === scene);
      const drawn = of.filter(({ found }) => found);
      // What is shown is the view that differs most.
      const errors = cameras.map((_, i) => drawn.reduce((sum, { found }) => sum + 10 ** (-(found.views[i].psnr ?? Infinity) / 10), 0));
      const shown = errors.indexOf(Math.max(...errors));
      const gaussians = scene.gaussians ?? drawn[0]?.found.gaussians;
      board.scenes.push({ name, kind, rule, gaussians, views: cameras.length, shown: cameras[shown].name });
      const quality = kind === "conformance" ? 1 : 0.8;
      const judgedPicture = (cell, camera, what) => join(folder(cell.key, scene), "judged", `${camera.name}.${what}.png`);
      pictures[name] = {};
      if (kind !== "real" && drawn.length > 0) {
        pictures[name].definition = await webp(page, judgedPicture(drawn[0], cameras[shown], "definition"), quality);
        for (const cell of drawn) pictures[name][cell.key] = await webp(page, judgedPicture(cell, cameras[shown], "client"), quality);
      }
      for (const cell of of) {
        cell.pixels = cameras.reduce((sum, { width, height }) => sum + width * height, 0);
        if (!cell.found) continue;
        cell.levels = 0;
        for (const camera of cameras)
          cell.levels = Math.max(cell.levels, await largest(page, judgedPicture(cell, camera, "definition"), judgedPicture(cell, camera, "client")));
      }
    }
    for (const client of board.clients) {
      client.version = readJson(join(folder(client.key, scenes[0]), "client.json")).version;
      const of = cells.filter(({ key }) => key === client.key).reverse();
      client.conformance = total(of.filter(({ scene }) => scene.kind === "conformance"));
      client.scenes = {};
      for (const { scene, found, levels } of of) {
        const { browser, error } = readJson(join(folder(client.key, scene), "client.json"));
        board.browser ??= browser;
        if (!found) {
          client.scenes[scene.name] = { error };
          continue;
        }
        const causes = netted(found.causes).filter(({ share }) => share >= kLeastShare);
        client.scenes[scene.name] = {
          psnr: rounded(found.psnr, 2),
          largest_difference: levels,
          named: rounded(found.named),
          rounding: rounded(found.rounding),
          causes: causes.map(({ key, sentence, known, share }) => ({ key, sentence, known, share: rounded(share) })),
        };
      }
    }
    return { board, pictures };
  } finally {
    await browser.close();
  }
}

/** Writes both files. */
export function writeScoreboard(out, { board, pictures }) {
  const git = (...words) => execFileSync("git", ["-C", kRoot, ...words], { encoding: "utf8" }).trim();
  const { schema, browser, ...rest } = board;
  const about = { schema, date: new Date().toISOString().slice(0, 10), commit: git("rev-parse", "--short=8", "HEAD"), device: "SwiftShader, in software", browser };
  mkdirSync(out, { recursive: true });
  const write = (name, text) => {
    writeFileSync(join(out, `${name}.new`), text);
    renameSync(join(out, `${name}.new`), join(out, name));
  };
  write("scoreboard.json", `${JSON.stringify({ ...about, ...rest }, null, 1)}\n`);
  write("scoreboard.html", scoreboardPage({ ...about, ...rest }, pictures));
}

if (process.argv[1] && realpathSync(process.argv[1]) === fileURLToPath(import.meta.url)) {
  const text = { type: "string" };
  const list = { type: "string", multiple: true };
  const options = { out: text, work: text, data: text, client: list, scene: list, resume: { type: "boolean" } };
  const { values } = parseArgs({ options });
  const work = resolve(values.work ?? join(kRoot, "build/scoreboard"));
  mkdirSync(work, { recursive: true });
  const keys = values.client ?? Object.keys(kClients);
  const unknown = keys.filter((key) => !kClients[key]);
  if (unknown.length > 0) {
    console.error(`no client ${unknown.join(", ")}: ${Object.keys(kClients).join(" ")}`);
    process.exit(2);
  }
  const scenes = makeScenes(work, { data: values.data, names: values.scene, resumes: values.resume });
  writeScoreboard(resolve(values.out ?? join(kRoot, "docs/records")), await score(scenes, keys, work, { resumes: values.resume }));
}
