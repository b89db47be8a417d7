// spz-parser.d.ts - of the engine's script, which comes without types.
// SPDX-License-Identifier: Apache-2.0
declare module "playcanvas/scripts/esm/parsers/spz-parser.mjs" {
  import { type GraphicsDevice, GSplatResourceBase } from "playcanvas";
  export class GSplatSpzResource extends GSplatResourceBase {
    constructor(device: GraphicsDevice, data: object, options?: object);
  }
}
