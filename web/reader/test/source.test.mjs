// source.test.mjs - files from memory, Blobs, callers' own sources, a web server, and one that lies.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { copyFileSync, readFileSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { join } from "node:path";
import test from "node:test";
import { open, RgsError } from "@roofgs/reader";
import { golden, scenes } from "./dump.mjs";
import { hasNginx, skip, startHostileServer, startNginx } from "./servers.mjs";

// Not Buffers, of which slice() is no copy.
const bytesOf = (name) => new Uint8Array(readFileSync(join(golden, `${name}.rgs`)));
const packed = bytesOf("packed_degree3");
const levels = bytesOf("levels_packed");

async function meansOf(source, options) {
  const file = await open(source, options);
  try {
    return (await file.read(options)).means;
  } finally {
    file.close();
  }
}

/** What a promise rejects with. */
async function failure(promise) {
  let value;
  try {
    value = await promise;
  } catch (error) {
    return error;
  }
  assert.fail(`no error, but ${value}`);
}

const expected = await meansOf(packed);

/** Larger than what is read at a time, so that later requests matter: Gaussians of `packed` behind 9 MB of nothing. */
function longFile() {
  const bytes = new Uint8Array(9_000_000);
  bytes.set(packed);
  return bytes;
}

test("sources of every kind give the same", async () => {
  const copy = packed.buffer.slice(packed.byteOffset, packed.byteOffset + packed.length);
  for (const source of [copy, packed, Buffer.from(packed), new DataView(copy), new Blob([packed])]) {
    assert.deepEqual(await meansOf(source), expected, source.constructor.name);
  }
  assert.equal(copy.byteLength, packed.length, "the caller's memory stays his");
  let asked = 0;
  const own = {
    size: packed.length,
    async read(offset, bytes) {
      asked += 1;
      return packed.subarray(offset, offset + bytes); // and keeps it
    },
  };
  assert.deepEqual(await meansOf(own), expected);
  assert.ok(asked >= 2);
  assert.deepEqual(await meansOf({ ...own, size: undefined }), expected, "a source that does not know its size");
});

test("a source that gives other than was asked for is refused", async () => {
  for (const change of [-1, 1, 1000]) {
    const source = {
      size: packed.length,
      read: async (offset, bytes) => new Uint8Array(Math.max(0, bytes + change)),
    };
    const error = await failure(open(source));
    assert.equal(error.code, "read_failed");
  }
  const thrown = new Error("mine");
  assert.equal(await failure(open({ size: 100, read: () => Promise.reject(thrown) })), thrown);
});

test("a page is read by its own range alone", async () => {
  const ranges = [];
  const source = {
    size: levels.length,
    async read(offset, bytes) {
      ranges.push([offset, bytes]);
      return levels.slice(offset, offset + bytes);
    },
  };
  const file = await open(source);
  const before = ranges.length;
  const page = file.levels.page(3);
  assert.equal((await file.readPage(3)).n, page.count);
  assert.deepEqual(ranges.slice(before), [[page.offset, page.storedBytes]]);
  file.close();
});

test("the beginning of a file with levels gives its pages, and says that others are missing", async () => {
  const whole = await open(levels);
  const { offset } = whole.levels.page(5);
  const file = await open(levels.subarray(0, offset + 1));
  assert.equal(file.nPresent, 5);
  assert.deepEqual(await file.readPage(4), await whole.readPage(4));
  const page = await failure(file.readPage(5));
  assert.deepEqual([page.code, page.offset], ["pages_missing", offset + 1]);
  const all = await failure(file.read());
  assert.deepEqual([all.code, all.offset], ["pages_missing", offset + 1]);
  assert.throws(() => whole.levels.page(whole.levels.nPages), RangeError);
  whole.close();
  file.close();
});

test("the table of pages is read where it is wanted", async () => {
  const bytes = new Uint8Array(readFileSync(join(scenes(), "wide.rgs")));
  const whole = await open(bytes);
  const { nPages } = whole.levels;
  const ranges = [];
  let damage = -1;
  const source = {
    size: bytes.length,
    async read(offset, n) {
      ranges.push([offset, n]);
      const part = bytes.slice(offset, offset + n);
      if (damage >= offset && damage < offset + n) part[damage - offset] ^= 1;
      return part;
    },
  };
  const file = await open(source, { table: "beginning" });
  assert.deepEqual(ranges, [[0, 1 << 16]]);
  const { levels } = file;
  const known = () => Array.from({ length: nPages }, (_, i) => i).filter((i) => levels.isKnown(i));
  const nKnown = known().length;
  assert.ok(nKnown > 500 && nKnown < nPages);
  assert.ok(!levels.isComplete && whole.levels.isComplete);
  assert.equal(levels.ofLevel(0).at(-1).index, nKnown - 1);
  assert.throws(() => levels.page(nPages - 1), RangeError);
  assert.equal((await failure(file.readPage(nPages - 1))).name, "RangeError");
  assert.equal((await failure(file.readTable(nPages - 1))).name, "RangeError");
  // Below the last page that has several children: theirs become known, what is before them does not.
  const last = whole.levels.page(whole.levels.ofLevel(1).findLast(({ nChildren }) => nChildren > 2).index);
  await file.readTable(last.index, {}, 112 * 2);
  assert.deepEqual(known().slice(nKnown), [last.firstChild, last.firstChild + 1]);
  await file.readTable(last.index);  // and of what follows
  const nLast = nPages - last.firstChild;
  assert.deepEqual(known().slice(nKnown), Array.from({ length: nLast }, (_, k) => last.firstChild + k));
  assert.deepEqual(await file.readPage(last.firstChild), await whole.readPage(last.firstChild));
  // What is known already is told again.
  for (const group of [last.index, nKnown - 1]) assert.deepEqual((await file.readTable(group)).slice(0, 2), ["tableGrew", group]);
  assert.equal(known().length, nKnown + nLast);
  // Wrong bytes are noticed by the last part, and may be right the next time. A page's own checksum is in bytes 8 to 15 of its record.
  damage = file.sections.find(({ type }) => type === "LODS").offset + 64 + 112 * nKnown + 8;
  const refused = await failure(file.readTable());
  assert.deepEqual([refused.code, levels.isComplete, levels.isKnown(nKnown)], ["checksum_mismatch", false, false]);
  damage = -1;
  await file.readTable(undefined, {}, 112 * 20 + 50);
  assert.equal(known().length, nKnown + nLast + 20);
  while (!levels.isComplete) await file.readTable();
  for (let i = 0; i < nPages; ++i) assert.deepEqual(levels.page(i), whole.levels.page(i));
  assert.equal(file.nPresent, nPages);
  for (const each of [file, whole]) each.close();
  // A scheduler asks for what it was not told: all, or what it has missed of a table that is complete by now.
  for (const isLate of [false, true]) {
    const growing = await open(bytes, { table: "beginning" });
    const setup = { budget: 1e12, pageBytes: 0, rowBytes: 1, nReaders: 1, mostBytes: 1, gapBytes: 0, prefetches: false };
    const scheduler = await growing.pageScheduler(setup);
    if (isLate) scheduler.step([await growing.readTable(undefined, {}, 112 * 20)], 0);
    while (isLate && !growing.levels.isComplete) await growing.readTable();
    const view = scheduler.addView();
    const look = { position: [0, 0, 0], focalPx: 1000, zNear: 0.1, detailPx: 0, mostGaussians: Infinity };
    for (let now = 0, drawn = []; drawn.length !== whole.levels.ofLevel(0).length; ++now) {
      assert.ok(now < 5000, `${drawn.length} pages`);
      for (const action of scheduler.step([["looks", view, look], ["frame", view], ["frameEnds", view], ["idle"]], now)) {
        if (action.is === "draw") drawn = action.pages;
        if (action.is === "read") scheduler.step([["arrived", action.first], ["done"]], now);
        if (action.is === "readTable") scheduler.step([await growing.readTable(action.group), ["done"]], now);
      }
    }
    growing.close();
  }
  // A file that ends inside its table is refused at once.
  const cut = await failure(open(bytes.subarray(0, 70_000), { table: "beginning" }));
  assert.deepEqual([cut.code, cut.offset], ["truncated", 70_000]);
});

test("a damaged page is refused alone", async () => {
  const whole = await open(levels);
  const { offset } = whole.levels.page(5);
  whole.close();
  const bytes = new Uint8Array(levels);
  bytes[offset + 9] ^= 1;
  const file = await open(bytes);
  const error = await failure(file.readPage(5));
  assert.deepEqual([error.code, error.offset], ["checksum_mismatch", offset]);
  assert.equal(typeof error.expected, "bigint");
  assert.notEqual(error.expected, error.found);
  assert.ok((await file.readPage(4)).n > 0, "others can still be read");
  file.close();
});

test("limits are kept", async () => {
  for (const limits of [{ maxGaussians: 10 }, { maxFileBytes: 1000 }]) {
    assert.equal((await failure(open(packed, { limits }))).code, "limit_exceeded");
  }
  const file = await open(packed, { limits: { maxDecodedBytes: 1000 } });
  assert.equal((await failure(file.read())).code, "limit_exceeded");
  file.close();
});

test("progress comes to its end", async () => {
  const seen = [];
  const file = await open(packed);
  await file.read({ onProgress: (progress) => seen.push(progress) });
  file.close();
  assert.deepEqual(seen.at(0), { phase: "read", done: packed.length, total: packed.length });
  assert.deepEqual(seen.at(-1), { phase: "decode", done: 300, total: 300 });
});

test("a signal stops what is at work, with its reason", async () => {
  const reason = new Error("enough");
  assert.equal(await failure(open(packed, { signal: AbortSignal.abort(reason) })), reason);

  const whileReading = new AbortController();
  let opened = false;
  const file = await open({
    size: packed.length,
    async read(offset, bytes) {
      if (opened) whileReading.abort(reason);
      return packed.slice(offset, offset + bytes);
    },
  });
  opened = true;
  assert.equal(await failure(file.read({ signal: whileReading.signal })), reason);
  assert.deepEqual((await file.read()).means, expected, "the file is as good as before");

  const whileDecoding = new AbortController();
  const onProgress = ({ phase }) => phase === "read" && whileDecoding.abort(reason);
  assert.equal(await failure(file.read({ signal: whileDecoding.signal, onProgress })), reason);
  assert.deepEqual((await file.read()).means, expected);
  file.close();
  assert.equal((await failure(file.read())).code, "bad_argument");
});

test("a signal stops a read that waits for another", async () => {
  const reason = new Error("enough");
  let held = Promise.resolve();
  const file = await open({
    size: packed.length,
    async read(offset, bytes) {
      await held;
      return packed.slice(offset, offset + bytes);
    },
  });
  let goOn;
  held = new Promise((resolve) => (goOn = resolve));
  const first = file.read();
  const stopped = new AbortController();
  const second = failure(file.read({ signal: stopped.signal }));
  stopped.abort(reason);
  assert.equal(await second, reason);
  assert.equal(await failure(file.read({ signal: AbortSignal.abort(reason) })), reason);
  goOn();
  assert.deepEqual((await first).means, expected);
  assert.deepEqual((await file.read()).means, expected);
  file.close();
});

test("a file that is another when it is read as a whole is refused", async () => {
  let bytes = bytesOf("global");
  assert.equal(bytes.length, bytesOf("origin").length);
  const file = await open({ size: bytes.length, read: async (offset, n) => bytes.slice(offset, offset + n) });
  const means = (await file.read()).means;
  bytes = bytesOf("origin");
  for (const read of [file.read(), file.readStored()]) {
    const error = await failure(read);
    assert.equal(error.code, "read_failed");
    assert.match(error.message, /has changed/);
  }
  bytes = bytesOf("global");
  assert.deepEqual((await file.read()).means, means);
  file.close();
});

test("several things may be asked for at a time", async () => {
  const file = await open(levels);
  const one = await file.read();
  const [a, b, page] = await Promise.all([file.read(), file.read(), file.readPage(0)]);
  assert.deepEqual(a, one);
  assert.deepEqual(b, one);
  assert.equal(page.n, file.levels.page(0).count);
  file.close();
});

test("a file on nginx is read by ranges", async (t) => {
  if (!hasNginx) return skip(t, "nginx is not installed");
  const server = await startNginx();
  try {
    copyFileSync(join(golden, "packed_degree3.rgs"), join(server.files, "a file.rgs"));
    assert.deepEqual(await meansOf(new URL(`${server.url}/a file.rgs`)), expected);
    writeFileSync(join(server.files, "empty.rgs"), "");
    assert.equal((await failure(open(`${server.url}/empty.rgs`))).code, "truncated");
    const missing = await failure(open(`${server.url}/missing.rgs`));
    assert.equal(missing.code, "open_failed");
    assert.match(missing.message, /404/);

    // Larger than what is read at first: every request is answered with a range.
    for (const name of ["packed.rgs", "direct.rgs", "levels.rgs"]) {
      copyFileSync(join(scenes(), name), join(server.files, name));
      const file = await open(`${server.url}/${name}`);
      const near = await open(readFileSync(join(scenes(), name)));
      assert.deepEqual(file.header, near.header);
      assert.deepEqual(file.provenance, near.provenance, name);
      const last = (near.levels?.nPages ?? 0) - 1;
      if (last >= 0) assert.deepEqual(await file.readPage(last), await near.readPage(last));
      // Compared as bytes: deepEqual takes seconds for arrays as large.
      const [found, wanted] = [await file.read(), await near.read()];
      for (const key of Object.keys(wanted)) {
        const same = ArrayBuffer.isView(wanted[key])
          ? Buffer.from(found[key].buffer).equals(Buffer.from(wanted[key].buffer))
          : found[key] === wanted[key];
        assert.ok(same, `${name}: ${key}`);
      }
      file.close();
      near.close();
      assert.doesNotMatch(server.log(), new RegExp(`"GET /${name} HTTP/1.1" 200 `));
    }

    writeFileSync(join(server.files, "long.rgs"), longFile());
    const long = await failure(open(`${server.url}/long.rgs`));
    assert.equal(long.code, "trailing_bytes");
    assert.match(server.log(), /"GET \/a%20file.rgs HTTP\/1.1" 206 /);
    assert.match(server.log(), /"GET \/long.rgs HTTP\/1.1" 206 65536 /);
  } finally {
    await server.end();
  }
});

/** What timers take at most. */
const kNeverMs = 2 ** 31 - 1;

/** Pauses are over at once, silence too, unless it may take for ever. */
function startTimer(ms, ring) {
  if (ms !== kNeverMs) setImmediate(ring);
  return () => undefined;
}

// The hostile server serves a file that is larger than the first request: a golden file would be read at once. Its header says
// how long it is, so its size is put into it; then it is refused as such, unless the server has been noticed before.
const kHostile = [
  // Path, code or means; requests of the path at most.
  ["/plain?", "means"],
  ["/no_ranges?", "means"],
  ["/no_ranges_chunked?", "means"],
  ["/no_ranges_unknown_length?", "means"],
  ["/no_ranges_broken?breaks=1", "means"],
  ["/status?code=503", "open_failed"],
  ["/reset?times=1", "means"],
  ["/redirect_nowhere?", "open_failed"],
  ["/redirect?to=/plain?file=FILE", "means"],
  ["/chain?n=40", "open_failed"],
  ["/loop?", "open_failed"],
  ["/long_line?", "open_failed"],
  ["/many_lines?", "open_failed"],
  ["/garbage?", "open_failed"],
  ["/no_header_colon?", "open_failed"],
  ["/stall?after=1000", "open_failed"],
  ["/silent?", "open_failed"],
];

test("a server that lies is found out, and one that stumbles is asked again", async (t) => {
  const server = await startHostileServer();
  t.after(() => server.end());
  const file = join(golden, "packed_degree3.rgs");
  for (const [path, outcome] of kHostile) {
    const address = path.includes("FILE") ? path.replace("FILE", file) : `${path}&file=${file}`;
    const options = { url: { silenceMs: /^.(stall|silent)/.test(path) ? 100 : kNeverMs, startTimer } };
    if (outcome === "means") {
      assert.deepEqual(await meansOf(server.url(address), options), expected, path);
    } else {
      const error = await failure(meansOf(server.url(address), options));
      assert.ok(error instanceof RgsError, `${path}: ${error}`);
      assert.equal(error.code, outcome, `${path}: ${error}`);
    }
    assert.ok((await server.requests(`GET ${address} `)) <= (path === "/loop?" ? 63 : 3), path); // 20 redirects are followed
  }
});

test("a server without ranges sends no more than is allowed", async (t) => {
  const server = await startHostileServer();
  t.after(() => server.end());
  const file = join(golden, "packed_degree3.rgs");
  for (const path of ["/no_ranges", "/no_ranges_chunked", "/no_ranges_unknown_length"]) {
    const address = server.url(`${path}?file=${file}`);
    const error = await failure(open(address, { limits: { maxFileBytes: packed.length - 1 } }));
    assert.deepEqual([error.code, await server.requests(`GET ${path}?`)], ["limit_exceeded", 1], `${path}: ${error}`);
    assert.match(error.message, /no ranges/);
    assert.deepEqual(await meansOf(address, { limits: { maxFileBytes: packed.length } }), expected, path);
  }
});

test("what is no .rgs is refused by its first bytes, though a server without ranges sends on", async (t) => {
  const other = Buffer.from("ply\nformat binary_little_endian 1.0\n");
  const damaged = Buffer.from(packed.subarray(0, 1000));
  damaged[6] ^= 1;
  for (const beginning of [other, damaged]) {
    let ended = 0;
    // It never ends.
    const server = createServer((_, answer) => {
      answer.on("close", () => (ended += 1));
      answer.writeHead(200, { "Content-Length": 1e9 });
      // The magic in two pieces.
      answer.write(beginning.subarray(0, 3), () => answer.write(beginning.subarray(3)));
    });
    await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
    t.after(() => server.close());
    const url = `http://127.0.0.1:${server.address().port}/`;
    const found = await failure(open(url, { url: { retries: 0, silenceMs: kNeverMs } }));
    const inMemory = await failure(open(new Uint8Array(beginning)));
    assert.deepEqual([found.message, found.code, found.offset], [inMemory.message, "bad_magic", beginning === other ? 0 : 6]);
    while (ended === 0) await new Promise(setImmediate);
  }
});

// Rows of tests/golden/http-rules.json: a file is opened, then bytes [100000, 200000) are read.
test("a file on a server is read by the rules that both readers have", async (t) => {
  const server = await startHostileServer();
  t.after(() => server.end());
  const { UrlSource, retryPause } = await import("../dist/source.js");
  const rules = JSON.parse(readFileSync(join(golden, "http-rules.json"), "utf8"));
  await Promise.all(
    rules.reads.map(async ({ path, requests, fails, status }, i) => {
      const address = `${path}&row=${i}`;
      let found;
      let source;
      try {
        source = await UrlSource.open(server.url(address), { retries: rules.retries, silenceMs: kNeverMs, startTimer });
        const bytes = await source.read(100000, 100000);
        assert.ok(Buffer.from(bytes).equals(kMade.subarray(100000)), path);
      } catch (error) {
        if (!(error instanceof RgsError)) throw error;
        found = error;
      }
      assert.deepEqual([found?.code, await server.requests(`&row=${i} `)], [fails, requests], `${path}: ${found}`);
      assert.equal(source !== undefined, fails !== "open_failed", path);
      if (status !== undefined) assert.match(found.message, new RegExp(`HTTP ${status}`), path);
    }),
  );
  for (const { failures, retry_after, random, seconds } of rules.pauses) {
    assert.equal(retryPause(failures, retry_after, random), seconds, `${failures} failures`);
  }
});

test("a server that sends a little at a time is not silent", async (t) => {
  const { UrlSource } = await import("../dist/source.js");
  // Each piece is sent when the one before has been heard, 900 ms later by a clock of the test's own.
  let answer;
  const server = createServer((_, response) => {
    answer = response;
    answer.writeHead(206, { "Content-Range": "bytes 0-9/10", "Content-Length": 10 });
    answer.write("0");
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  t.after(() => server.close());
  let now = 0;
  let n = 0;
  const startTimer = (ms, ring) => {
    const due = now + ms;
    let isStopped = false;
    if (answer && n < 9) {
      n += 1;
      now += 900;
      setImmediate(() => (now >= due && !isStopped ? ring() : answer.write("0")));
    }
    return () => (isStopped = true);
  };
  const source = await UrlSource.open(`http://127.0.0.1:${server.address().port}/`, { retries: 0, silenceMs: 1000, startTimer });
  assert.equal(source.size, 10);
  assert.ok(now > 5000, `${now} ms`);
});

/** As tests/support/made_bytes.hpp has them. */
const kMade = Uint8Array.from({ length: 200000 }, (_, offset) => Math.floor((offset * 2654435761) / 8192));
