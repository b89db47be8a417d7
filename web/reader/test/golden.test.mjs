// golden.test.mjs - every golden file decodes to the C++ library's arrays, bit for bit, and damaged ones are refused alike.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { basename, join } from "node:path";
import test from "node:test";
import { open, RgsError } from "@roofgs/reader";
import { dump, filesIn, golden, scenes } from "./dump.mjs";

const kColumns = 59; // of an ActivatedSplat: mean, rotation, scale, opacity, SH [16, 3]

const bitsOf = (array) => Buffer.from(array.buffer, array.byteOffset, array.byteLength);

function assertSame(found, expected, what) {
  assert.equal(found.length, expected.length, `${what}: number of values`);
  // NaN, -0 and everything else as it is.
  if (bitsOf(found).equals(bitsOf(expected))) return;
  const i = found.findIndex((value, k) => !Object.is(value, expected[k]));
  assert.fail(`${what}: value ${i} is ${found[i]}, not ${expected[i]}`);
}

/** Rows of ActivatedSplat from the reader's arrays. */
function asRows(g) {
  const rest = 3 * (g.shDegree + 1) ** 2 - 3;
  const rows = new Float32Array(kColumns * g.n);
  for (let i = 0; i < g.n; ++i) {
    const row = rows.subarray(kColumns * i);
    row.set(g.means.subarray(3 * i, 3 * i + 3), 0);
    row.set(g.rotations.subarray(4 * i, 4 * i + 4), 3);
    row.set(g.scales.subarray(3 * i, 3 * i + 3), 7);
    row[10] = g.opacities[i];
    row.set(g.sh0.subarray(3 * i, 3 * i + 3), 11);
    row.set(g.shN.subarray(rest * i, rest * (i + 1)), 14);
  }
  return rows;
}

function fromHalf(code) {
  const sign = code & 0x8000 ? -1 : 1;
  const exponent = (code >> 10) & 31;
  const fraction = code & 1023;
  return exponent === 0 ? sign * fraction * 2 ** -24 : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

/** What the arrays as stored say, of the same rows: rotation as in `trained`, the rest as in `activated`. */
function assertStoredMeansTheSame(g, activated, trained, what) {
  const shBytes = [4, 12, 28, 48][g.shDegree];
  const values = 3 * (g.shDegree + 1) ** 2;
  assert.equal(g.sh.length, shBytes * g.n, `${what}: bytes of SH`);
  for (let i = 0; i < g.n; ++i) {
    const row = activated.subarray(kColumns * i, kColumns * (i + 1));
    for (let k = 0; k < 3; ++k) {
      assert.equal(g.means[3 * i + k], row[k], `${what}: mean`);
      assert.equal(fromHalf(g.geometry[8 * i + 4 + k]) * 2 ** -g.scaleExponent, row[7 + k], `${what}: scale`);
    }
    // A Splat is mean, log-scale, rotation.
    for (let k = 0; k < 4; ++k) {
      assert.equal(fromHalf(g.geometry[8 * i + k]), trained[kColumns * i + 6 + k], `${what}: rotation`);
    }
    assert.equal(fromHalf(g.geometry[8 * i + 7]), row[10], `${what}: opacity`);
    const set = g.chunkSteps[Math.floor(i / g.chunkSize)];
    for (let k = 0; k < values; ++k) {
      const degree = [0, 1, 1, 1, 2, 2, 2, 2, 2, 3, 3, 3, 3, 3, 3, 3][Math.floor(k / 3)];
      const step = g.steps[12 * set + 3 * degree + (k % 3)];
      assert.equal(Math.fround(g.sh[shBytes * i + k] * step) + 0, row[11 + k] + 0, `${what}: SH ${k}`);
    }
  }
}

function assertHead(file, arrays) {
  const h = file.header;
  const header = [
    h.versionMajor,
    h.versionMinor,
    h.fileBytes,
    h.nGaussians,
    h.nStepSets,
    h.chunkSize,
    h.shDegree,
    h.scaleExponent,
  ];
  assert.deepEqual(header.map(BigInt), [...arrays.header]);
  const sections = file.sections.flatMap((s) => [
    BigInt(Buffer.from(s.type, "latin1").readUInt32LE()),
    BigInt(s.flags),
    BigInt(["none", "planes", "archive_draco", "archive"].indexOf(s.codec)),
    BigInt(s.offset),
    BigInt(s.storedBytes),
    BigInt(s.decodedBytes),
    s.xxh3,
  ]);
  assert.deepEqual(sections, [...arrays.sections]);

  const d = file.declarations;
  const names = {
    axes: ["undeclared", "right", "left", "up", "down", "forward", "backward"],
    colourSpace: ["undeclared", "srgb_display", "linear_display"],
    shBasis: ["", "real_3dgs"],
    kernel: ["", "gaussian_ewa"],
    aaMode: ["undeclared", "classic", "mip_splatting"],
    sortMetric: ["", "z_depth"],
    depthMapping: ["", "linear", "logarithmic"],
    depthSource: ["", "cameras", "scene_extent", "by_hand"],
    order: ["", "input", "morton"],
  };
  const { axes, ...others } = names;
  const enumerators = [
    ...d.axes.map((axis) => axes.indexOf(axis)),
    ...Object.keys(others).map((name) => others[name].indexOf(d[name])),
  ];
  assert.deepEqual(enumerators, [...arrays.enumerators]);
  const constants = [
    d.zNear,
    d.zFar,
    d.metresPerUnit,
    d.cutoffSigma,
    d.alphaThreshold,
    d.alphaMax,
    d.lowPassPx2,
    d.transmittanceMin,
    d.robustFraction,
  ];
  assert.deepEqual(constants, [...arrays.constants]);
  assert.deepEqual([...d.full.min, ...d.full.max, ...d.robust.min, ...d.robust.max], [...arrays.boxes]);
  const counts = [d.nSource, d.nDropped, d.nRepaired, d.nScaleSubnormal, d.nScaleZero, d.nOpacityZero, d.nOpacityOne];
  assert.deepEqual(counts.map(BigInt), [...arrays.counts]);
  assert.deepEqual([...d.origin], [...arrays.origin]);
  assert.equal(file.firstView, d.firstView);
  if (arrays.first_view) {
    const { kind, position, pivot, up, horizontalFov } = d.firstView;
    assert.deepEqual([["none", "outside", "inside"].indexOf(kind), ...position, ...pivot, ...up, horizontalFov], [...arrays.first_view]);
  } else {
    assert.equal(d.firstView, null);
  }
  if (arrays.crs) {
    assert.equal(d.crs.text, Buffer.from(arrays.crs).toString());
    assert.deepEqual(d.crs.axes.map((axis) => axes.indexOf(axis)), [...arrays.crs_axes]);
  } else {
    assert.equal(d.crs, null);
  }
  if (arrays.source) {
    const p = file.provenance;
    assert.deepEqual([BigInt(p.sourceBytes), p.sourceXxh3], [...arrays.source]);
    assert.equal(p.sourceName, Buffer.from(arrays.source_name).toString());
    assert.equal(p.tool, Buffer.from(arrays.tool).toString());
  } else {
    assert.equal(file.provenance, null);
  }
}

/** Gaussians of one page or file, in rows of what the C++ library has for it. */
async function assertPlain(file, arrays, what) {
  const { gaussians, sourceIndex } = await file.readAll();
  assertSame(asRows(gaussians), arrays.activated, `${what}, activated`);
  const n = file.header.nGaussians;
  const index = sourceIndex ?? Float64Array.from({ length: n }, (_, i) => i);
  assert.deepEqual([...index].map(BigInt), [...arrays.source_index]);
  const stored = await file.readStored();
  assertStoredMeansTheSame(stored, arrays.activated, arrays.trained, `${what}, stored`);
  assertSame(stored.steps, arrays.steps, `${what}, steps`);
  assert.deepEqual([...stored.chunkSteps].map(BigInt), [...arrays.chunk_integers].filter((_, i) => i % 2 === 0));
  // There box, radius, opacity.
  assert.equal(stored.chunkBounds.length, arrays.chunk_floats.length);
  for (let i = 0; i < stored.chunkBounds.length / 8; ++i) {
    const [a, b] = [stored.chunkBounds.subarray(8 * i), arrays.chunk_floats.subarray(8 * i)];
    assert.deepEqual([a[0], a[1], a[2], a[4], a[5], a[6], a[3], a[7]], [...b.subarray(0, 8)]);
  }
}

async function assertLevels(file, arrays, what) {
  const { levels } = file;
  assert.equal(levels.nPages, arrays.page_floats.length / 13);
  assert.equal(file.nPresent, levels.nPages);
  assert.equal(Math.fround(levels.qualityDb), arrays.quality[0]);
  let first = 0;
  for (let i = 0; i < levels.nPages; ++i) {
    const page = levels.page(i);
    const integers = [...arrays.pages.subarray(13 * i, 13 * i + 10)].map((value) => Number(BigInt.asIntN(64, value)));
    const found = [
      page.offset,
      page.storedBytes,
      page.count,
      page.parent === -1 ? 0xffffffff : page.parent,
      page.firstChild,
      page.level,
      page.nChildren,
      page.nStepSets,
      page.scaleExponent,
    ];
    integers.splice(1, 1); // a hash
    assert.deepEqual(found, integers);
    const floats = [page.error, ...page.bounds.min, ...page.bounds.max, ...page.core.min, ...page.core.max];
    assert.deepEqual(floats, [...arrays.page_floats.subarray(13 * i, 13 * i + 13)]);
    assert.equal(page.first, first);
    const [begin, end] = [kColumns * first, kColumns * (first + page.count)];
    const expected = arrays.activated.subarray(begin, end);
    assertSame(asRows(await file.readPage(i)), expected, `${what}, page ${i}`);
    const stored = await file.readPageStored(i);
    assertStoredMeansTheSame(stored, expected, arrays.trained.subarray(begin, end), `${what}, page ${i} as stored`);
    first += page.count;
  }
  assert.equal(levels.nStored, first);
  const leaves = levels.ofLevel(0);
  assert.equal(leaves.reduce((sum, page) => sum + page.count, 0), file.header.nGaussians);
  const { gaussians, sourceIndex } = await file.readAll();
  assertSame(asRows(gaussians), arrays.activated.subarray(kColumns * leaves[0].first), `${what}, leaves`);
  const index = sourceIndex ?? Float64Array.from({ length: gaussians.n }, (_, i) => i);
  assert.deepEqual([...index].map(BigInt), [...arrays.source_index]);
}

test("golden files decode to the arrays of the C++ library", async (t) => {
  const files = filesIn(golden);
  assert.ok(files.length >= 20);
  for (const path of files) {
    await t.test(basename(path), async () => {
      const arrays = dump(path);
      const file = await open(readFileSync(path));
      assertHead(file, arrays);
      await (file.levels ? assertLevels : assertPlain)(file, arrays, basename(path));
      file.close();
    });
  }
});

test("a file of many frames decodes to the arrays of the C++ library", async () => {
  for (const name of ["packed.rgs", "direct.rgs"]) {
    const path = join(scenes(), name);
    const arrays = dump(path);
    const file = await open(readFileSync(path));
    assertSame(asRows(await file.read()), arrays.activated, name);
    file.close();
  }
});

test("damaged files are refused with code and place of the C++ library", async () => {
  const files = filesIn(join(golden, "reject"));
  assert.ok(files.length >= 100);
  for (const path of files) {
    const expected = dump(path);
    if (!expected.error) continue; // a file that can be read, beside those that cannot
    let found;
    try {
      const file = await open(readFileSync(path));
      try {
        await file.read();
      } finally {
        file.close();
      }
    } catch (error) {
      found = error;
    }
    assert.ok(found instanceof RgsError, `${basename(path)} gives ${found}`);
    assert.deepEqual({ code: found.code, offset: found.offset }, { code: expected.error, offset: expected.offset }, basename(path));
  }
});
