// package.test.mjs - what `npm pack` would make, and what its encoding keeps of harmonics.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import test from "node:test";
import { fileURLToPath } from "node:url";

test("the package of Spark's loader holds what it needs and nothing else", () => {
  const folder = fileURLToPath(new URL("..", import.meta.url));
  const [packed] = JSON.parse(execFileSync("npm", ["pack", "--dry-run", "--json", "--ignore-scripts"], { cwd: folder, encoding: "utf8", stdio: ["ignore", "pipe", "pipe"] }));
  assert.deepEqual(packed.files.map(({ path }) => path).sort(), ["LICENSE", "README.md", "dist/index.d.ts", "dist/index.js", "package.json"]);
});

test("Spark's encoding keeps a Gaussian, and harmonics to 1/510 of a power of two", async () => {
  // Spark looks for a window.
  globalThis.self = globalThis.window = globalThis;
  const { packSplats } = await import("@roofgs/spark");
  const { utils } = await import("@sparkjsdev/spark");
  const n = 3;
  const shN = Float32Array.from({ length: 45 * n }, (_, i) => Math.sin(i * 12.9898) * 2 ** ((i % 7) - 4));
  const gaussians = {
    n,
    shDegree: 3,
    means: Float32Array.from([1, 2, 3, -4.25, 5e5, 6, 7, 8, 9]),
    rotations: Float32Array.from([1, 0, 0, 0, 0.5, 0.5, -0.5, 0.5, 0.6, 0, 0.8, 0]),
    scales: Float32Array.from([0.01, 0.1, 1, 2, 3, 4, 5, 6, 7]),
    opacities: Float32Array.from([0.25, 0.5, 1]),
    sh0: Float32Array.from([0, 1, -1, 0.5, 0.25, 0, 2, 3, 0]),
    shN,
  };
  const { extArrays, extra, numSplats } = packSplats(gaussians);
  assert.equal(numSplats, n);
  const near = (found, wanted, most) => found.forEach((value, i) => assert.ok(Math.abs(value - wanted[i]) <= most, `${found} instead of ${wanted}`));
  for (let i = 0; i < n; ++i) {
    const { center, scales, quaternion: q, opacity, color } = utils.decodeExtSplat(extArrays, i);
    assert.deepEqual(center.toArray(), [...gaussians.means.slice(3 * i, 3 * i + 3)]);
    near(scales.toArray().map(Math.log), [...gaussians.scales.slice(3 * i, 3 * i + 3)].map(Math.log), 4e-3);
    near([q.w, q.x, q.y, q.z], gaussians.rotations.slice(4 * i, 4 * i + 4), 2e-3);
    assert.equal(opacity, gaussians.opacities[i]);
    near(color.toArray(), [...gaussians.sh0.slice(3 * i, 3 * i + 3)].map((v) => 0.5 + 0.28209479177387814 * v), 1e-3);
    const words = [extra.sh1, extra.sh2, extra.sh3a, extra.sh3b];
    for (let k = 0; k < 15; ++k) {
      const wanted = [...shN.slice(3 * (15 * i + k), 3 * (15 * i + k) + 3)];
      const power = 2 ** Math.ceil(Math.log2(Math.max(...wanted.map(Math.abs))));
      near(utils.decodeExtRgb(words[k >> 2][4 * i + (k & 3)]).toArray(), wanted, power / 509);
    }
  }
});
