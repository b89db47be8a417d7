// draw.mjs - pictures of scenes by a web client of 3D Gaussian splats: node draw.mjs CLIENT JOBS.json [--api webgpu] [--seconds 20] [--replace FROM=TO]...
// JOBS.json: [{"scene": PLY, "cameras": FILE, "out": FOLDER, "near": 0.2}, ...]; writes OUT/NAME.png of each camera, RGB over black, and
// OUT/client.json, which has "error" if there are no pictures. Clients: those of kClients. Each draws by its own defaults, in software;
// cameras, near and far planes, a black background and waiting for orders are ours. --replace changes @roofgs/playcanvas and the reader, to break them.
// SPDX-License-Identifier: Apache-2.0
import { execFileSync } from "node:child_process";
import { mkdirSync, mkdtempSync, readFileSync, realpathSync, rmSync, symlinkSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { basename, dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";
import { parseArgs } from "node:util";
import { crc32, deflateSync } from "node:zlib";
import { build } from "vite";
import { program, readCameras } from "../playcanvas/test/pictures.mjs";
import { launch, newPage } from "../reader/test/chromium.mjs";
import { startServer } from "../viewer/test/server.mjs";

const kWeb = fileURLToPath(new URL("..", import.meta.url));

/** By key: the client, the package whose version is told, and the APIs that it draws by, its default first. */
export const kClients = {
  spark: ["Spark", "@sparkjsdev/spark", ["webgl2"]],
  playcanvas: ["PlayCanvas", "playcanvas", ["webgl2", "webgpu"]],
  gaussiansplats3d: ["GaussianSplats3D", "@mkkellogg/gaussian-splats-3d", ["webgl2"]],
  gsplatjs: ["gsplat.js", "gsplat", ["webgl2"]],
  cesium: ["CesiumJS", "@cesium/engine", ["webgl2"]],
  babylon: ["Babylon.js", "@babylonjs/core", ["webgl2", "webgpu"]],
  roofgs: ["RoofGS", "@roofgs/playcanvas", ["webgl2", "webgpu"]],
};

/** Page and script of a client, in a folder. `replace`: pairs of texts. */
export async function buildPage(key, folder, replace = []) {
  const left = new Set(replace.map(([from]) => from));
  const ours = ["playcanvas/dist", "reader/dist"].map((path) => realpathSync(join(kWeb, path)));
  const breaks = {
    name: "replace",
    transform(code, id) {
      if (!ours.some((path) => id.startsWith(path))) return undefined;
      for (const [from, to] of replace) {
        if (code.includes(from)) left.delete(from);
        code = code.replaceAll(from, () => to);
      }
      return { code, map: null };
    },
  };
  const input = fileURLToPath(new URL(`pages/${key}.js`, import.meta.url));
  const rollupOptions = { input, output: { entryFileNames: "[name].js" } };
  const options = { outDir: folder, emptyOutDir: false, target: "es2022", minify: false, modulePreload: false, rollupOptions };
  await build({ configFile: false, root: kWeb, base: "./", publicDir: false, logLevel: "error", plugins: [breaks], worker: { format: "es" }, build: options });
  if (left.size > 0) throw new Error(`neither @roofgs/playcanvas nor the reader has ${[...left].join(", ")} to replace`);
  // What CesiumJS looks for beside its module.
  const engine = dirname(fileURLToPath(import.meta.resolve("@cesium/engine")));
  if (key === "cesium") for (const part of ["Build/Workers", "Source/Assets", "Source/ThirdParty"]) symlinkSync(join(engine, part), join(folder, basename(part)));
  writeFileSync(join(folder, `${key}.html`), `<!doctype html><link rel="icon" href="data:,"><body><script type="module" src="${key}.js"></script>`);
}

/** RGB of RGBA. */
function png(rgba, width, height) {
  const rows = Buffer.alloc(height * (1 + 3 * width));
  for (let y = 0, at = 0; y < height; ++y) {
    ++at; // no filter
    for (let x = 0; x < width; ++x, at += 3) rgba.copy(rows, at, 4 * (y * width + x), 4 * (y * width + x) + 3);
  }
  const part = (name, data) => {
    const body = Buffer.concat([Buffer.from(name), data]);
    const [size, sum] = [data.length, crc32(body)].map((value) => Buffer.from(new Uint32Array([value]).buffer).swap32());
    return Buffer.concat([size, body, sum]);
  };
  const head = Buffer.concat([Buffer.from(new Uint32Array([width, height]).buffer).swap32(), Buffer.from([8, 2, 0, 0, 0])]);
  return Buffer.concat([Buffer.from("\x89PNG\r\n\x1a\n", "latin1"), part("IHDR", head), part("IDAT", deflateSync(rows)), part("IEND", Buffer.alloc(0))]);
}

/** Draws jobs; calls `say` with what is refused. Returns how many jobs have pictures. */
export async function drawAll(key, jobs, { api = "webgl2", replace = [], seconds = 20, say = console.error } = {}) {
  const [client, from] = kClients[key];
  const folder = mkdtempSync(join(tmpdir(), "rgs-clients-"));
  let server;
  let browser;
  let page;
  let said = [];
  const close = async () => {
    await browser?.close();
    browser = page = undefined;
  };
  /** A page that hangs is left behind with its browser. */
  const limited = async (work) => {
    let timer;
    const late = new Promise((_, reject) => {
      timer = setTimeout(() => reject(new Error(`no picture after ${seconds} s`)), 1000 * seconds);
    });
    try {
      return await Promise.race([work, late]);
    } finally {
      clearTimeout(timer);
    }
  };
  const openPage = async () => {
    browser ??= await launch(api);
    page = await newPage(browser);
    page.on("pageerror", (error) => said.push(String(error).split("\n")[0]));
    page.on("console", (message) => message.type() === "error" && said.push(message.text().split("\n")[0]));
    await page.goto(`${server.url}${key}.html?api=${api}`);
    await page.waitForFunction(() => window.draw);
  };
  /** What the client opens. */
  const served = (scene, i) => {
    // Our page draws PLY by the engine, and that by WebGL 2.
    const made = key === "cesium" ? "tileset.json" : key === "roofgs" && api === "webgpu" ? "scene.rgs" : undefined;
    if (!made) {
      symlinkSync(resolve(scene), join(folder, `${i}.ply`));
      return `${i}.ply`;
    }
    mkdirSync(join(folder, `${i}`));
    execFileSync(program("rgs-convert"), ["--quiet", scene, join(folder, `${i}`, made)], { stdio: ["ignore", "ignore", "pipe"] });
    return `${i}/${made}`;
  };
  try {
    await buildPage(key, folder, replace);
    server = await startServer({ root: folder });
    const { version } = JSON.parse(readFileSync(join(kWeb, "node_modules", from, "package.json"), "utf8"));
    let nDrawn = 0;
    for (const [i, { scene, cameras, out, near = 0.2 }] of jobs.entries()) {
      const pictures = [];
      const about = { client, key, version, browser: undefined, api };
      said = [];
      mkdirSync(out, { recursive: true });
      try {
        if (!page) await limited(openPage());
        about.browser = await limited(page.evaluate(() => navigator.userAgent));
        const url = served(scene, i);
        for (const { img_name: name, id, ...camera } of readCameras(cameras)) {
          const { width, height, cx = width / 2, cy = height / 2 } = camera;
          const { rgba } = await limited(page.evaluate(([url, camera]) => window.draw(url, camera), [url, { ...camera, cx, cy, near }]));
          pictures.push([`${name ?? id}.png`, png(Buffer.from(rgba, "base64"), width, height)]);
        }
        for (const [name, picture] of pictures) {
          mkdirSync(dirname(join(out, name)), { recursive: true });
          writeFileSync(join(out, name), picture);
        }
        ++nDrawn;
      } catch (error) {
        const [why] = String(error.stderr || error.message).replace(/^page\.evaluate: (Error: )?/, "").split("\n");
        about.error = [why, ...new Set(said)].join("; ");
        say(`${client}: ${scene}: ${about.error}`);
        // The next scene gets a page that nothing has happened to.
        await close();
      }
      writeFileSync(join(out, "client.json"), `${JSON.stringify(about)}\n`);
    }
    return nDrawn;
  } finally {
    await close();
    await server?.end();
    rmSync(folder, { recursive: true });
  }
}

if (process.argv[1] && realpathSync(process.argv[1]) === fileURLToPath(import.meta.url)) {
  const words = { api: { type: "string", default: "webgl2" }, seconds: { type: "string", default: "20" }, replace: { type: "string", multiple: true, default: [] } };
  const { values, positionals } = parseArgs({ allowPositionals: true, options: words });
  const [key, list] = positionals;
  const { api } = values;
  const seconds = Number(values.seconds);
  const replace = values.replace.map((text) => /^(.+?)=(.*)$/s.exec(text)?.slice(1));
  if (!kClients[key]?.[2].includes(api) || !list || positionals.length !== 2 || !(seconds > 0) || replace.includes(undefined)) {
    console.error(`usage: node draw.mjs CLIENT JOBS.json [--api webgpu] [--seconds 20] [--replace FROM=TO]...`);
    for (const [name, [, , apis]] of Object.entries(kClients)) console.error(`${name}: ${apis.join(", ")}`);
    process.exit(2);
  }
  const jobs = JSON.parse(readFileSync(list, "utf8"));
  const nDrawn = await drawAll(key, jobs, { api, replace, seconds });
  console.log(`${kClients[key][0]}: ${nDrawn} of ${jobs.length} scenes drawn`);
}
