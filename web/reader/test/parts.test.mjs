// parts.test.mjs - Gaussians that are given while the file is read are those of readStored(), and what is refused there is refused.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { basename, join } from "node:path";
import test from "node:test";
import { open, RgsError, subjectBox } from "@roofgs/reader";
import { filesIn, golden, scenes } from "./dump.mjs";

// By the number of parts: 16,384 Gaussians a group, in an archive 32,768.
const plain = new Map([["packed.rgs", 3], ["direct.rgs", 3], ["low.rgs", 3]].map(([name, n]) => [join(scenes(), name), n]));

/** Bytes as a source that counts what it gives; `hold(offset)` is waited for. */
function counted(bytes, hold = async () => undefined) {
  const source = {
    size: bytes.length,
    given: 0,
    async read(offset, n) {
      await hold(offset);
      source.given += n;
      return bytes.slice(offset, offset + n);
    },
  };
  return source;
}

async function all(file, options) {
  const parts = [];
  for await (const part of file.storedParts(options)) parts.push(part);
  return parts;
}

/** Rows of an array of all parts, one behind the other. */
function joined(parts, field) {
  const values = parts.flatMap((part) => [...part[field]]);
  return new parts[0][field].constructor(values);
}

test("where a view without cameras looks is known with the first part", async () => {
  const file = await open(readFileSync(join(scenes(), "packed.rgs")));
  assert.equal(file.subjectBox, null);
  await file.storedParts().next();
  const { min, max } = file.subjectBox;
  file.close();
  const whole = await open(readFileSync(join(scenes(), "packed.rgs")));
  const { means, opacities } = await whole.read();
  whole.close();
  const exact = await subjectBox(means, opacities);
  const longest = Math.max(...exact.max.map((value, i) => value - exact.min[i]));
  for (const [found, wanted] of [[min, exact.min], [max, exact.max]]) found.forEach((value, i) => assert.ok(Math.abs(value - wanted[i]) < 0.1 * longest, `${found} for ${wanted}`));
  // Of the pages that are known, when the file is open.
  const levels = await open(readFileSync(join(scenes(), "levels.rgs")));
  assert.ok(levels.subjectBox.max.every((value, i) => value > levels.subjectBox.min[i]));
  levels.close();
});

test("all parts together are the file", async (t) => {
  for (const path of [...filesIn(golden), ...plain.keys()]) {
    const bytes = readFileSync(path);
    const source = counted(bytes);
    const file = await open(source);
    if (file.levels || file.header.nGaussians === 0) {
      file.close();
      continue;
    }
    const before = source.given;
    const parts = await all(file);
    assert.equal(source.given - before, bytes.length, `${path}: each byte once`);
    const whole = await file.readStored();
    file.close();
    const what = basename(path);
    assert.equal(parts.reduce((sum, { n }) => sum + n, 0), whole.n, what);
    for (const field of ["means", "geometry", "sh", "chunkBounds"]) {
      assert.ok(Buffer.from(joined(parts, field).buffer).equals(Buffer.from(whole[field].buffer)), `${what}, ${field}`);
    }
    const stepsOf = ({ chunkSteps, steps }) => [...chunkSteps].map((set) => [...steps.subarray(12 * set, 12 * set + 12)]);
    assert.deepEqual(parts.flatMap(stepsOf), stepsOf(whole), `${what}, steps`);
    for (const { shDegree, chunkSize, scaleExponent } of parts) {
      assert.deepEqual([shDegree, chunkSize, scaleExponent], [whole.shDegree, whole.chunkSize, whole.scaleExponent]);
    }
    if (plain.has(path)) assert.equal(parts.length, plain.get(path), what);
  }
});

test("the first part comes before the rest is read", async () => {
  for (const name of ["packed.rgs", "direct.rgs"]) {
    const path = join(scenes(), name);
    const bytes = readFileSync(path);
    let goOn;
    const going = new Promise((resolve) => (goOn = resolve));
    const source = counted(bytes, async () => source.given > bytes.length / 2 && going);
    const file = await open(source);
    const seen = [];
    const parts = file.storedParts({ onProgress: ({ phase, done, total }) => seen.push([phase, done, total]) });
    const first = await parts.next();
    assert.equal(first.value.n, 16384, path);
    assert.ok(source.given < 0.8 * bytes.length, `${path}: ${source.given} of ${bytes.length} bytes`);
    goOn();
    for await (const part of parts) assert.ok(part.n > 0);
    assert.deepEqual(seen.at(-1), ["decode", 60000, 60000]);
    assert.deepEqual(seen.at(-2), ["read", bytes.length, bytes.length]);
    file.close();
  }
});

test("what is wrong with a file is said as readStored() says it", async (t) => {
  let refused = 0;
  for (const path of filesIn(join(golden, "reject"))) {
    const bytes = readFileSync(path);
    const file = await open(bytes).catch(() => null);
    if (!file) continue;
    if (!file.levels) {
      const expected = await file.readStored().then(() => null, (error) => error);
      const found = await all(file).then(() => null, (error) => error);
      assert.ok(found instanceof RgsError, path);
      assert.equal(found.message, expected.message, path);
      refused += 1;
    }
    file.close();
  }
  t.diagnostic(`${refused} files`);
  assert.ok(refused > 60);
});

test("damage at the end of a file is an error behind the parts before it", async () => {
  const bytes = readFileSync(join(scenes(), "packed.rgs"));
  const head = await open(bytes);
  const { offset, storedBytes } = head.sections.find(({ type }) => type === "SHI8");
  head.close();
  bytes[offset + storedBytes - 1] ^= 1;
  const file = await open(bytes);
  const parts = file.storedParts();
  assert.equal((await parts.next()).value.n, 16384);
  await assert.rejects(async () => {
    for await (const part of parts) assert.ok(part.n > 0);
  }, { code: "checksum_mismatch", offset });
  file.close();
});

test("damage in the first part is said as readStored() says it, though more is under way", async () => {
  const bytes = readFileSync(join(scenes(), "packed.rgs"));
  const head = await open(bytes);
  const { offset, storedBytes } = head.sections.find(({ type }) => type === "SHI8");
  head.close();
  bytes[offset + (storedBytes >> 3)] ^= 1;
  let goOn;
  const going = new Promise((resolve) => (goOn = resolve));
  // The second part is under way until the worker has found the damage.
  let held = 0;
  let isFound = false;
  const asked = [];
  const source = counted(bytes, async (at) => {
    if (isFound) asked.push(at);
    if (source.given > bytes.length / 4 && (held += 1) <= 3) await going;
  });
  const file = await open(source);
  const { client } = file;
  const call = client.call.bind(client);
  let askedEarly;
  client.call = (name, ...rest) => {
    const answer = call(name, ...rest);
    if (name === "nextEarly") {
      answer.catch(() => {
        isFound = true;
        // Whoever waits for the answer has had his turn by then.
        setImmediate(() => {
          askedEarly = [...asked];
          goOn();
        });
      });
    }
    return answer;
  };
  await assert.rejects(file.storedParts().next(), { code: "checksum_mismatch", offset });
  assert.deepEqual(askedEarly, [], "the rest is asked for when what is under way is there");
  assert.ok(asked.length > 0);
  file.close();
});

test("who stops reading leaves the file as it was, and a signal stops it", async () => {
  const file = await open(readFileSync(join(scenes(), "packed.rgs")));
  for await (const part of file.storedParts()) {
    assert.equal(part.n, 16384);
    break;
  }
  const stop = new AbortController();
  const parts = file.storedParts({ signal: stop.signal });
  await parts.next();
  stop.abort(new Error("enough"));
  await assert.rejects(parts.next(), { message: "enough" });
  assert.equal((await file.readStored()).n, 60000);
  file.close();
});

test("of a file with levels of detail the parts are the leaves in order", async (t) => {
  const bytes = readFileSync(join(scenes(), "levels.rgs"));
  for (const table of ["whole", "beginning"]) {
    await t.test(`opened with the ${table} of the table`, async () => {
      const file = await open(bytes, { table });
      await assert.rejects(file.readStored(), { code: "bad_argument" });
      const means = [];
      let last;
      for await (const part of file.storedParts({ onProgress: (progress) => (last = progress) })) means.push(...part.means);
      const n = file.header.nGaussians;
      assert.deepEqual(last, { phase: "decode", done: n, total: n });
      assert.deepEqual(new Float32Array(means), (await file.read()).means);
      file.close();
    });
  }
  await t.test("and a page that is damaged or missing is an error", async () => {
    const { levels } = await open(bytes);
    const { offset, storedBytes } = levels.ofLevel(0)[1];
    const damaged = Uint8Array.from(bytes);
    damaged[offset + storedBytes - 1] ^= 1;
    for (const [content, code] of [[damaged, "checksum_mismatch"], [bytes.subarray(0, offset), "pages_missing"]]) {
      const file = await open(content);
      const parts = file.storedParts();
      assert.ok((await parts.next()).value.n > 0);
      await assert.rejects(parts.next(), { code });
      file.close();
    }
  });
});

test("who stops waiting for another's read leaves it alone", async () => {
  const bytes = readFileSync(join(scenes(), "direct.rgs"));
  let goOn;
  const going = new Promise((resolve) => (goOn = resolve));
  let isOpen = false;
  const file = await open(counted(bytes, async () => isOpen && going));
  isOpen = true;
  const read = file.readStored();
  const stop = new AbortController();
  const parts = file.storedParts({ signal: stop.signal }).next();
  stop.abort(new Error("enough"));
  await assert.rejects(parts, { message: "enough" });
  const third = all(file);
  goOn();
  assert.equal((await read).n, 60000);
  assert.equal((await third).reduce((sum, { n }) => sum + n, 0), 60000);
  file.close();
});
