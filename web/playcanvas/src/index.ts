// index.ts - .rgs files in the PlayCanvas engine.
// SPDX-License-Identifier: Apache-2.0
/**
 * Draws .rgs files with the PlayCanvas engine.
 * @module @roofgs/playcanvas
 */
export { type AntiAliasing, antiAliasingOf, type DeclaredAntiAliasing, type Pinhole, RgsError, type RgsErrorCode } from "@roofgs/reader";
export { drawAsDefined } from "./as-defined.js";
export { resizePinhole, setPinhole } from "./pinhole.js";
export { RgsParser, type RgsParserOptions } from "./parser.js";
export { RgsResource, type RgsResourceOptions } from "./resource.js";
export { type Colour, readStoredParts } from "./stored.js";
