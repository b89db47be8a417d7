// judge.test.mjs - rgs-judge names what was broken in our own page on purpose, on the conformance scene that is about it.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import test from "node:test";
import { program } from "../../playcanvas/test/pictures.mjs";
import { hasChromium } from "../../reader/test/chromium.mjs";
import { skip } from "../../reader/test/servers.mjs";
import { drawAll } from "../draw.mjs";

// Scene, cause, and texts of @roofgs/playcanvas.
const kBreaks = [
  ["01-round-in-the-middle", "cut-2", "if (A > 1.44)", "if (A > 0.5)"],
  ["05-sub-pixel-classic", "low-pass-0.075", "4 * lowPassPx2", "0.3"],
  ["06-sub-pixel-mip", "not-compensated", "lowPassPx2: 0.1, compensated: true", "lowPassPx2: 0.1, compensated: false"],
  ["07-near-plane", "near-0", "centerView.z > -camera_params.z", "centerView.z > 0.0"],
  ["16-slope-clamp", "slope-unclamped", "vp.xy = clamp(vp.xy / vp.z, -edge, edge) * vp.z;", ""],
];

test("what is broken is named", async (t) => {
  if (!hasChromium) return skip(t, "chromium is not installed");
  const folder = mkdtempSync(join(tmpdir(), "rgs-web-judge-"));
  t.after(() => rmSync(folder, { recursive: true }));
  const conformance = join(folder, "conformance");
  execFileSync(program("rgs-make-scene"), ["--conformance", conformance], { stdio: "pipe" });
  const job = (name, out) => ({ scene: join(conformance, name, "scene.ply"), cameras: join(conformance, name, "cameras.json"), out: join(folder, out) });
  // --test-timeout alone ends what hangs.
  const draw = async (jobs, more = {}) => assert.equal(await drawAll("roofgs", jobs, { seconds: 3600, ...more }), jobs.length);
  const causes = ({ scene, cameras, out }) => {
    const json = execFileSync(program("rgs-judge"), [scene, "--cameras", cameras, "--split", "all", "--against", out, "--json", "-"], { encoding: "utf8" });
    return JSON.parse(json).causes.sort((a, b) => b.share - a.share);
  };
  const whole = kBreaks.map(([name]) => job(name, name));
  await draw(whole);
  for (const [i, [name, key, from, to]] of kBreaks.entries()) {
    await t.test(key, async (t) => {
      assert.ok(!causes(whole[i]).some((cause) => cause.key === key));
      const broken = job(name, `${name}-broken`);
      await draw([broken], { replace: [[from, to]] });
      const [largest] = causes(broken);
      t.diagnostic(`${(100 * largest.share).toFixed(1)}%`);
      assert.equal(largest.key, key);
    });
  }
});
