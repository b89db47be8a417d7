// peers.mjs - readers and writers of other programs, in Node, for scripts/interop.py: node peers.mjs JOBS.json. A job names a peer, what
// it does, a file and the file to make of it: what is read becomes a PLY of floats. Prints each job's error, or null.
// SPDX-License-Identifier: Apache-2.0
import { resolveObjectURL } from "node:buffer";
import { readFileSync, writeFileSync } from "node:fs";
import { zstdDecompressSync } from "node:zlib";

const kC0 = 0.28209479177387814;
const [kMean, kSh0] = [["x", "y", "z"], ["f_dc_0", "f_dc_1", "f_dc_2"]];
const [kScale, kRotation] = [["scale_0", "scale_1", "scale_2"], ["rot_0", "rot_1", "rot_2", "rot_3"]];
const range = (n, f) => Array.from({ length: n }, (_, i) => f(i));
/** A slice of `size` numbers for each Gaussian. */
const rows = (values, size) => (i) => values.slice(size * i, size * (i + 1));
const logit = (p) => Math.log(p / (1 - p));
const colour = (value) => (value - 0.5) / kC0;
const buffer = (bytes) => bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);

/** The i-th Gaussian: mean, logarithms of scale, rotation w, x, y, z, opacity's logit, sh0, and rest [coefficients * 3]. */
function writePly(path, n, gaussian) {
  const nRest = gaussian(0).rest.length / 3;
  const names = [...kMean, ...kScale, ...kRotation, "opacity", ...kSh0, ...range(3 * nRest, (i) => `f_rest_${i}`)];
  const body = new Float32Array(n * names.length);
  for (let i = 0; i < n; ++i) {
    const { mean, scale, rotation, opacity, sh0, rest } = gaussian(i);
    const byChannel = range(3 * nRest, (k) => rest[3 * (k % nRest) + Math.floor(k / nRest)]);
    body.set([...mean, ...scale, ...rotation, opacity, ...sh0, ...byChannel], i * names.length);
  }
  const header = ["ply", "format binary_little_endian 1.0", `element vertex ${n}`, ...names.map((name) => `property float ${name}`), "end_header"];
  writeFileSync(path, Buffer.concat([Buffer.from(`${header.join("\n")}\n`), Buffer.from(body.buffer)]));
}

// Spark's readers run in a worker, GaussianSplats3D looks for a window.
globalThis.self = globalThis.window = globalThis;
globalThis.Worker = class extends EventTarget {
  #inside = new EventTarget();
  #ready;
  constructor(url) {
    super();
    this.#inside.postMessage = (data) => this.onmessage({ data });
    this.#ready = resolveObjectURL(url).text().then((text) => new Function("self", text)(this.#inside));
  }
  postMessage(data) {
    this.#ready.then(() => this.#inside.dispatchEvent(new MessageEvent("message", { data })));
  }
};

async function readBySpark(bytes, name) {
  const { ExtSplats, utils } = await import("@sparkjsdev/spark");
  const { numSplats, extra, extArrays } = await new ExtSplats({ fileBytes: bytes, fileName: name, lod: false }).initialized;
  // Words of 4 coefficients, as many as there are.
  const words = [extra.sh1, extra.sh2, extra.sh3a, extra.sh3b].filter(Boolean);
  const nRest = [0, 3, 8, 8, 15][words.length];
  return [numSplats, (i) => {
    const { center, scales, quaternion: q, opacity, color } = utils.decodeExtSplat(extArrays, i);
    const sh0 = color.toArray().map(colour); // before the same object is used again
    const rest = range(nRest, (k) => utils.decodeExtRgb(words[k >> 2][4 * i + (k & 3)]).toArray()).flat();
    return { mean: center.toArray(), scale: scales.toArray().map(Math.log), rotation: [q.w, q.x, q.y, q.z], opacity: logit(opacity), sh0, rest };
  }];
}

async function readBySplats3d(bytes, name) {
  const { PlyLoader, SplatLoader, SpzLoader, KSplatLoader } = await import("@mkkellogg/gaussian-splats-3d");
  const { Quaternion, Vector3, Vector4 } = await import("three");
  const loaders = { ply: PlyLoader, splat: SplatLoader, spz: SpzLoader, ksplat: KSplatLoader };
  const loader = loaders[name.split(".").pop()];
  if (!loader) throw new Error("no loader");
  // Of least opacity 0 and level 0, not reordered, SH of degree 2. Node decompresses views only.
  const splats = await loader.loadFromFileData(loader === SpzLoader ? bytes : buffer(bytes), 0, 0, false, 2);
  const degree = splats.getMinSphericalHarmonicsDegree();
  const n = splats.getSplatCount();
  const size = [0, 9, 24][degree];
  const sh = new Float32Array(n * size);
  splats.fillSphericalHarmonicsArray(sh, degree, undefined, undefined, undefined, undefined, 0);
  return [n, (i) => {
    const [mean, scale, q, colours] = [new Vector3(), new Vector3(), new Quaternion(), new Vector4()];
    splats.getSplatCenter(i, mean);
    splats.getSplatScaleAndRotation(i, scale, q);
    splats.getSplatColor(i, colours);
    const [r, g, b, opacity] = colours.toArray().map((code) => code / 255);
    const rest = rows(sh, size)(i);
    return { mean: mean.toArray(), scale: scale.toArray().map(Math.log), rotation: [q.w, q.x, q.y, q.z], opacity: logit(opacity), sh0: [r, g, b].map(colour), rest };
  }];
}

async function readByPlayCanvas(bytes, name) {
  const { Asset, GSplatHandler, NullGraphicsDevice, WasmModule } = await import("playcanvas");
  const { SpzParser } = await import("playcanvas/scripts/esm/parsers/spz-parser.mjs");
  const graphicsDevice = new NullGraphicsDevice({ addEventListener() {}, getContext() {} });
  const app = { graphicsDevice, scene: { gsplatCentersEnabled: false } };
  const handler = new GSplatHandler(app);
  handler.addParser(new SpzParser(app));
  const contents = name.endsWith(".ply") ? new Response(bytes) : buffer(bytes);
  const asset = new Asset(name, "gsplat", { url: name, contents }, { reorder: false, decompress: true });
  WasmModule.getInstance = (_, callback) => callback({ decompress: (from) => zstdDecompressSync(from) });
  WasmModule.setConfig("ZstdDecoderModule", {});
  const { gsplatData: data } = await new Promise((resolve, reject) => {
    handler.load({ load: name, original: name }, (error, resource) => (error ? reject(error) : resolve(resource)), asset);
  });
  if (data.getProp) {
    const columns = (names) => {
      const found = names.map((name) => data.getProp(name));
      return (i) => found.map((values) => values[i]);
    };
    const nRest = [0, 3, 8, 15][data.shBands];
    const [mean, scale, rotation, opacity, sh0] = [kMean, kScale, kRotation, ["opacity"], kSh0].map(columns);
    const rest = columns(range(3 * nRest, (k) => `f_rest_${(k % 3) * nRest + Math.floor(k / 3)}`));
    return [data.numSplats, (i) => ({ mean: mean(i), scale: scale(i), rotation: rotation(i), opacity: opacity(i)[0], sh0: sh0(i), rest: rest(i) })];
  }
  // An SPZ stays as it is until the shader decodes it; its rotations are left to the tests of pictures.
  const [mean, scale, sh0, rest] = [rows(data.getCenters(), 3), rows(data.scales, 3), rows(data.colors, 3), rows(data.sh, 3 * data.shDim)];
  return [data.numSplats, (i) => ({
    mean: mean(i),
    scale: [...scale(i)].map((code) => code / 16 - 10),
    rotation: [1, 0, 0, 0],
    opacity: logit(data.alphas[i] / 255),
    sh0: [...sh0(i)].map((code) => (code / 255 - 0.5) / 0.15),
    rest: [...rest(i)].map((code) => (code - 128) / 128),
  })];
}

/** The arrays of the reference library. */
function cloud({ numPoints, positions, scales, rotations, alphas, colors, sh }) {
  const [mean, scale, rotation, sh0] = [rows(positions, 3), rows(scales, 3), rows(rotations, 4), rows(colors, 3)];
  const rest = rows(sh, sh.length / numPoints);
  return [numPoints, (i) => {
    const [x, y, z, w] = rotation(i);
    return { mean: mean(i), scale: scale(i), rotation: [w, x, y, z], opacity: alphas[i], sh0: sh0(i), rest: rest(i) };
  }];
}
const adobe = async () => (await import("@adobe/spz")).default();
const kRead = {
  Spark: readBySpark,
  GaussianSplats3D: readBySplats3d,
  "PlayCanvas engine": readByPlayCanvas,
  "@adobe/spz": async (bytes) => {
    const spz = await adobe();
    return cloud(spz.loadSpzFromBuffer(bytes, { to: spz.CoordinateSystem.UNSPECIFIED }));
  },
  "@spz-loader/core": async (bytes) => {
    const { loadSpz } = await import("@spz-loader/core");
    // Its bundle lacks what it takes from Node, unless it finds a browser.
    process.type = "renderer";
    const { scales, alphas, colors, ...rest } = await loadSpz(bytes, { colorScaleFactor: kC0 }).finally(() => delete process.type);
    return cloud({ ...rest, scales: scales.map(Math.log), alphas: alphas.map(logit), colors: colors.map(colour) });
  },
};
const kWrite = {
  Spark: async (bytes) => {
    const { ExtSplats, transcodeSpz } = await import("@sparkjsdev/spark");
    await new ExtSplats({ fileBytes: bytes.slice(), fileType: "ply" }).initialized; // its module too
    return (await transcodeSpz({ inputs: [{ fileBytes: bytes, fileType: "ply" }] })).fileBytes;
  },
  GaussianSplats3D: async (bytes, level) => {
    const { PlyParser, SplatBufferGenerator } = await import("@mkkellogg/gaussian-splats-3d");
    const splats = PlyParser.parseToUncompressedSplatArray(buffer(bytes), 2);
    return new Uint8Array(SplatBufferGenerator.getStandardGenerator(0, level, 0).generateFromUncompressedSplatArray(splats).bufferData);
  },
  /** Its own file, read and written again. */
  "@adobe/spz": async (bytes, version) => {
    const spz = await adobe();
    const { UNSPECIFIED } = spz.CoordinateSystem;
    return spz.saveSpzToBuffer(spz.loadSpzFromBuffer(bytes, { to: UNSPECIFIED }), { version, from: UNSPECIFIED, sh1Bits: 5, shRestBits: 4 });
  },
};
/** The errors of the validator that are not about the names of the splats' attributes, which it does not know. */
async function validate(bytes) {
  const { issues } = await (await import("gltf-validator")).default.validateBytes(bytes);
  const ofExtension = ({ code, pointer }) => code === "MESH_PRIMITIVE_INVALID_ATTRIBUTE" && pointer.includes("/KHR_gaussian_splatting:");
  const found = issues.messages.filter((issue) => issue.severity === 0 && !ofExtension(issue));
  if (found.length > 0 || issues.truncated) throw new Error(found.map(({ message }) => message).join("; ") || "too many issues");
}

const answers = [];
console.error = console.warn = () => {};
for (const { peer, does, from, to, option } of JSON.parse(readFileSync(process.argv[2], "utf8"))) {
  try {
    const bytes = new Uint8Array(readFileSync(from));
    if (does === "validate") await validate(bytes);
    else if (does === "write") writeFileSync(to, await kWrite[peer](bytes, option));
    else writePly(to, ...(await kRead[peer](bytes, from)));
    answers.push(null);
  } catch (error) {
    answers.push(String(error?.message ?? error));
  }
}
console.log(JSON.stringify(answers));
