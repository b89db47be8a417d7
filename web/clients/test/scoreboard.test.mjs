// scoreboard.test.mjs - the scoreboard of one client that draws one scene and refuses another.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import test from "node:test";
import { hasChromium } from "../../reader/test/chromium.mjs";
import { skip } from "../../reader/test/servers.mjs";
import { makeScenes, score, writeScoreboard } from "../scoreboard.mjs";

test("a scoreboard", async (t) => {
  if (!hasChromium) return skip(t, "chromium is not installed");
  const folder = mkdtempSync(join(tmpdir(), "rgs-web-scoreboard-"));
  t.after(() => rmSync(folder, { recursive: true }));
  const names = ["05-sub-pixel-classic", "20-far-origin"];
  writeScoreboard(folder, await score(makeScenes(folder, { names }), ["gsplatjs"], folder, { say() {} }));
  const { scenes, clients } = JSON.parse(readFileSync(join(folder, "scoreboard.json"), "utf8"));
  assert.deepEqual(scenes.map(({ name, kind }) => [name, kind]), names.map((name) => [name, "conformance"]));
  const [{ name, version, conformance, scenes: found }] = clients;
  const [drawn, refused] = names.map((name) => found[name]);
  assert.equal(name, "gsplat.js");
  assert.deepEqual(refused, { error: "Unsupported property type: double" });
  assert.equal(drawn.causes[0].key, "low-pass-0.075");
  assert.ok(drawn.named > 0.9 && drawn.largest_difference > 1, JSON.stringify(drawn));
  // Of the only scene that is drawn.
  const { psnr, named, causes } = drawn;
  assert.deepEqual(conformance, { scenes: 1, as_defined: 0, psnr, named, causes });
  const page = readFileSync(join(folder, "scoreboard.html"), "utf8");
  for (const words of [`<b>gsplat.js</b><small>${version}</small>`, refused.error, "a quarter of the definition", "0.075 px\u00b2"]) assert.ok(page.includes(words), words);
  assert.equal(page.match(/<img alt="[^"]+" src="data:image\/webp;base64,/g).length, 2);
  assert.doesNotMatch(page, /<script|(src|href)="https?:|undefined|NaN/);
});
