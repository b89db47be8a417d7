// cesium.js - pictures by CesiumJS, from cameras in the axes of 3DGS, by its defaults, but without a globe and several samples a pixel,
// which change no Gaussian. Each has a scene of its own, because it keeps the order of views that are much alike. Principal points are
// lost where it copies its frustum.
// SPDX-License-Identifier: Apache-2.0
import { Cartesian3, Cesium3DTileset, Color, JulianDate, PerspectiveFrustum, Scene } from "@cesium/engine";
import { kFar, newCanvas, nextFrame, pixels } from "./pixels.js";

/** Of 3D Tiles: left, backward, up. */
const turned = ([right, down, forward]) => new Cartesian3(-right, -forward, -down);
const kTime = JulianDate.fromIso8601("2026-01-01");

/** What a camera sees of a tileset once nothing is left to load or to sort: tiles, their Gaussians and pixels. */
window.draw = async (url, pinhole) => {
  const { position, rotation, width, height, fx, fy, near = 0.2 } = pinhole;
  const canvas = newCanvas(pinhole);
  const scene = new Scene({ canvas, contextOptions: { webgl: { alpha: false } }, msaaSamples: 1 });
  Object.assign(scene, { backgroundColor: Color.BLACK, rethrowRenderErrors: true });
  Object.assign(scene.screenSpaceCameraController, { enableInputs: false, enableCollisionDetection: false });
  const axis = (k) => rotation.map((row) => row[k]);
  const [right, down, direction] = [0, 1, 2].map((k) => turned(axis(k)));
  const up = Cartesian3.negate(down, down);
  const aspectRatio = width / fx / (height / fy);
  const frustum = new PerspectiveFrustum({ fov: 2 * Math.atan(Math.max(width / 2 / fx, height / 2 / fy)), aspectRatio, near, far: kFar });
  Object.assign(scene.camera, { position: turned(position), direction, up, right, frustum });

  const tileset = await Cesium3DTileset.fromUrl(url, { show: false, preloadWhenHidden: true });
  const failed = new Promise((_, reject) => tileset.tileFailed.addEventListener(({ url, message }) => reject(new Error(`${url}: ${message}`))));
  scene.primitives.add(tileset);
  const render = () => {
    scene.initializeFrame();
    scene.render(kTime);
  };
  const isSorted = () => {
    if (tileset.tilesLoaded && tileset._selectedTiles.length === 0) return true;
    const splats = tileset.gaussianSplatPrimitive;
    const isDrawn = splats?._drawCommand && splats.isStable && !splats._needsSnapshotRebuild && !splats._pendingSnapshot;
    return tileset.tilesLoaded && isDrawn && splats._numSplats === tileset.statistics.numberOfPointsSelected;
  };
  const renderUntil = async (isDone) => {
    do {
      render();
      await Promise.race([nextFrame(), failed]);
    } while (!isDone());
  };
  // Nothing is drawn until all is loaded: pictures take long in software.
  await renderUntil(() => tileset.tilesLoaded);
  tileset.show = true;
  await renderUntil(isSorted);
  render();
  const rgba = pixels(canvas);
  const tiles = tileset._selectedTiles.map(({ content }) => content.url.split("/").pop()).sort();
  const gaussians = tileset.gaussianSplatPrimitive?._numSplats ?? 0;
  scene.destroy();
  canvas.remove();
  return { tiles, gaussians, rgba };
};
