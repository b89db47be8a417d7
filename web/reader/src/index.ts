// index.ts - exports that the entries for browsers and Node share.
// SPDX-License-Identifier: Apache-2.0
export { type AntiAliasing, antiAliasingOf, type DeclaredAntiAliasing, type Pinhole } from "./camera.js";
export type { OpenOptions, Progress, ReadOptions, RgsFile, Source } from "./reader.js";
export type { Gaussians, Limits, StoredGaussians } from "./decoder.js";
export { RgsError, type RgsErrorCode, type RgsErrorFields } from "./errors.js";
export type {
  Axis,
  Box,
  Codec,
  Crs,
  Declarations,
  FirstView,
  Header,
  Levels,
  Page,
  Provenance,
  Section,
  Vector3,
} from "./head.js";
export type { Look, PageAction, PageEvent, PageSchedule, PageScheduler } from "./pages.js";
export type { RangeSource, UrlOptions } from "./source.js";
export type { Spz } from "./spz.js";
