// load-engine-inline.ts - the engine in a page that is one file.
// SPDX-License-Identifier: Apache-2.0
import * as engine from "./engine.js";

export const loadEngine = async () => engine;
