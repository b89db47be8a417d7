// converter.test.mjs - files are those of rgs-convert bit for bit, and errors too.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { openAsBlob, readFileSync } from "node:fs";
import { createServer } from "node:http";
import { basename } from "node:path";
import test from "node:test";
import { convert, RgsError } from "@roofgs/convert";
import { open } from "@roofgs/reader";
import { byProgram, byProgramOf, scene } from "./same.mjs";

const kProfiles = ["packed", "direct", "archive:high", "archive:small", "archive:tiny"];
const bytesOf = async (blob) => Buffer.from(await blob.arrayBuffer());
const fileOf = (path) => new File([readFileSync(path)], basename(path));

const house = scene("house3.ply", "--gaussians", "20k", "--degree", "3");
const plain = scene("house0.ply", "--gaussians", "20k", "--degree", "0");
const far = scene("far.ply", "--gaussians", "5k", "--degree", "1", "--origin", "512345.25,5412345.5,432.125");

/** Rows of a binary PLY of floats. */
function parse(bytes) {
  const end = bytes.indexOf("end_header\n") + 11;
  const header = bytes.subarray(0, end).toString("latin1");
  const columns = header.match(/^property float /gm).length;
  const values = new Float32Array(bytes.buffer.slice(bytes.byteOffset + end, bytes.byteOffset + bytes.length));
  return { header, columns, values };
}

/** The first Gaussians as text. `edit` changes the texts of a row. */
function asText(bytes, n, edit = (row) => row) {
  const { header, columns, values } = parse(bytes);
  const rows = [];
  for (let i = 0; i < n; ++i) rows.push(edit([...values.subarray(i * columns, (i + 1) * columns)].map(String), i).join(" "));
  return Buffer.from(header.replace("binary_little_endian", "ascii").replace(/element vertex \d+/, `element vertex ${n}`) + rows.join("\n") + "\n");
}

async function same(bytes, name, options, ...flags) {
  const expected = byProgramOf(bytes, ...flags);
  assert.ok(expected.bytes, expected.error?.message);
  const { blob, report } = await convert(new File([bytes], "scene.ply"), options);
  assert.ok((await bytesOf(blob)).equals(expected.bytes), name);
  return report;
}

const kMade = [...kProfiles.map((profile) => [profile, false]), ...["packed", "direct", "archive:small"].map((profile) => [profile, true])];
for (const path of [house, plain, far]) {
  for (const [profile, levels] of kMade) {
    test(`${basename(path)} as ${profile}${levels ? " with levels" : ""} is rgs-convert's file`, async () => {
      const expected = byProgram(path, "--profile", profile, ...(levels ? ["--lod"] : []));
      const { blob, report } = await convert(fileOf(path), { profile, levels });
      assert.equal(report.nLevels > 0, levels);
      assert.ok((await bytesOf(blob)).equals(expected.bytes));
      assert.equal(report.bytes, expected.bytes.length);
      assert.equal(report.nWritten, report.nSource);
    });
  }
}

test("other encodings of a PLY", async () => {
  const bytes = readFileSync(house);
  const rest = "-1.5E-3 +2 .5 7. 1e-50 1.23456789012345678 -0 1e-40 0.1".split(" ");
  const edit = (row, i) => row.map((value, column) => (i < 200 && column > 8 && column < 50 ? rest[(i + column) % rest.length] : value));
  const report = await same(asText(bytes, 1000, edit), "text", {});
  assert.equal(report.nSource, 1000);
  // Beyond 4096 Gaussians, whose rows are kept beyond the first MiB.
  await same(asText(bytes, 6000), "longer text", { profile: "direct" }, "--profile", "direct");
  const { header, values } = parse(bytes);
  const swapped = Buffer.from(values.buffer.slice(0)).swap32();
  await same(Buffer.concat([Buffer.from(header.replace("little_endian", "big_endian")), swapped]), "big-endian", {});
  const stated = "binary_little_endian 1.0\ncomment rgs_metres_per_unit: 0.25\ncomment rgs_axes: right,up,backward\n";
  await same(Buffer.from(bytes.toString("latin1").replace("binary_little_endian 1.0\n", stated), "latin1"), "comments", {});
  await same(Buffer.from(asText(bytes, 0)), "no Gaussians", {});
});

test("damaged Gaussians are dropped", async () => {
  const bytes = Buffer.from(readFileSync(house));
  const { header, columns } = parse(bytes);
  for (let i = 0; i < 20; ++i) bytes.writeFloatLE(NaN, header.length + 4 * columns * 997 * i);
  const report = await same(bytes, "a few", {});
  assert.equal(report.nWritten, 20000 - 20);
  assert.equal(report.defects.mean, 20);
});

/** The same error as rgs-convert's; its code. */
async function sameError(bytes, what) {
  const { error: expected } = byProgramOf(bytes);
  assert.ok(expected, `${what}: rgs-convert takes it`);
  const error = await convert(bytes).then(() => assert.fail(`${what}: ${expected.message}`), (caught) => caught);
  assert.ok(error instanceof RgsError, `${what}: ${error?.stack}`);
  const number = (value) => (value === undefined ? null : Number(value));
  const found = { code: error.code, offset: number(error.offset), expected: number(error.expected), found: number(error.found) };
  assert.deepEqual(found, { code: expected.code, offset: expected.offset, expected: expected.expected, found: expected.found }, what);
  assert.ok(expected.message.includes(error.text), `${what}: ${error.text}, ${expected.message}`);
  return error.code;
}

test("errors of damaged files are rgs-convert's", async () => {
  const bytes = readFileSync(house);
  const { header, columns } = parse(bytes);
  for (const size of [4, 40, header.length - 1, header.length, header.length + 1, bytes.length >> 1, bytes.length - 1]) {
    assert.equal(await sameError(bytes.subarray(0, size), `${size} bytes`), "truncated");
  }
  assert.equal(await sameError(Buffer.concat([bytes, Buffer.from("x")]), "one byte more"), "trailing_bytes");
  const edited = (from, to) => Buffer.from(bytes.toString("latin1").replace(from, to), "latin1");
  assert.equal(await sameError(edited(/vertex \d+/, "vertex 18446744073709551615"), "a huge count"), "truncated");
  assert.equal(await sameError(edited("property float opacity", "property float opacitx"), "no opacity"), "not_gaussian_splats");
  assert.equal(await sameError(edited("format binary", "format banary"), "no format"), "bad_syntax");
  assert.equal(await sameError(edited("1.0\n", "1.0\ncomment rgs_axes: north,up,left\n"), "axes"), "bad_value");
  assert.equal(await sameError(asText(bytes, 100, (row, i) => (i === 50 ? ["x", ...row.slice(1)] : row)), "text"), "bad_syntax");
  const damaged = Buffer.from(bytes);
  for (let i = 0; i < 1000; ++i) damaged.writeFloatLE(NaN, header.length + 4 * columns * i);
  assert.equal(await sameError(damaged, "many damaged"), "too_many_bad");
});

test("what is no PLY", async () => {
  await assert.rejects(convert(Buffer.from("hello")), { name: "RgsError", code: "bad_magic", offset: 0 });
  await assert.rejects(convert(new Blob([])), { name: "RgsError", code: "bad_magic" });
  await assert.rejects(convert(readFileSync(house), { profile: "small" }), { name: "RgsError", code: "bad_argument" });
});

test("a file larger than the memory is refused before it is read", async () => {
  const part = new Blob([new Uint8Array(2 ** 24)]);
  await assert.rejects(convert(new Blob(Array(129).fill(part))), { name: "RgsError", code: "host_out_of_memory" });
});

test("sources, and what the provenance says of them", async (t) => {
  const bytes = readFileSync(plain);
  const lent = new Uint8Array(bytes.length + 10);
  lent.set(bytes, 5);
  const server = createServer((request, response) => response.writeHead(request.url === "/a%20b.ply" ? 200 : 404).end(bytes));
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  t.after(() => server.close());
  const url = `http://127.0.0.1:${server.address().port}`;
  const sources = [
    [new Blob([bytes]), ""],
    [await openAsBlob(plain), ""],
    [new File([bytes], "ä.ply"), "ä.ply"],
    [lent.buffer.slice(5, 5 + bytes.length), ""],
    [lent.subarray(5, 5 + bytes.length), ""],
    [`${url}/a%20b.ply`, "a b.ply"],
    [new URL(`${url}/a%20b.ply`), "a b.ply"],
  ];
  for (const [source, name] of sources) {
    const { blob } = await convert(source);
    const file = await open(blob);
    assert.equal(file.provenance.sourceName, name);
    assert.match(file.provenance.tool, /^rgs-convert \d/);
    assert.equal((await file.read()).n, 20000);
    file.close();
  }
  assert.equal(lent[5], bytes[0], "the caller keeps what it gave");
  const file = await open((await convert(bytes, { sourceName: "x", tool: "y" })).blob);
  assert.deepEqual([file.provenance.sourceName, file.provenance.tool], ["x", "y"]);
  file.close();
  for (const name of ["missing.ply", "100%.ply"]) await assert.rejects(convert(`${url}/${name}`), { name: "RgsError", code: "open_failed" });
});

test("progress runs through the stages", async () => {
  const seen = [];
  await convert(fileOf(house), { onProgress: (progress) => seen.push(progress) });
  const stages = seen.map(({ stage }) => stage).filter((stage, i, all) => stage !== all[i - 1]);
  assert.deepEqual(stages, ["read", "scan", "sort", "encode", "commit"]);
  for (const { done, total } of seen) assert.ok(done <= total || total === 0, `${done} of ${total}`);
  assert.equal(seen.find(({ stage }) => stage === "scan").total, 20000);
});

test("a signal stops it", async () => {
  const file = fileOf(house);
  const early = AbortSignal.abort(new Error("before"));
  await assert.rejects(convert(file, { signal: early }), { message: "before" });
  const controller = new AbortController();
  const seen = [];
  const running = convert(file, {
    profile: "archive:high",
    signal: controller.signal,
    onProgress: ({ stage }) => {
      seen.push(stage);
      if (stage === "encode") controller.abort(new Error("during"));
    },
  });
  await assert.rejects(running, { message: "during" });
  assert.equal(seen.at(-1), "encode");
});
