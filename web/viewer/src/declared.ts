// declared.ts - what PLY and SOG declare of anti-aliasing, as rgs-convert reads it: docs/INTERCHANGE.md, "Declarations".
// SPDX-License-Identifier: Apache-2.0
import type { AntiAliasing } from "@roofgs/playcanvas";

const kClassic: AntiAliasing = { lowPassPx2: 0.3, compensated: false };
const kMipSplatting: AntiAliasing = { lowPassPx2: 0.1, compensated: true };

/** Comments of a PLY's header, without that word; the last one holds. Throws at a value that one of ours cannot have. */
export function antiAliasingOfComments(comments: readonly string[]): AntiAliasing {
  let mode: "classic" | "mip-splatting" | "undeclared" = "classic";
  let lowPassPx2: number | undefined;
  for (const comment of comments) {
    const text = comment.trim().toLowerCase();
    const theirs = /^splatrendermode\s*:?\s*(mip|default)$/.exec(text)?.[1] ?? /^antialiased\s+([01])$/.exec(text)?.[1];
    if (theirs) mode = theirs === "mip" || theirs === "1" ? "mip-splatting" : "classic";
    const [, key, value = ""] = /^rgs_(anti_aliasing|low_pass_px2)\s*:\s*(.*)$/.exec(text) ?? [];
    if (key === "anti_aliasing") {
      if (value !== "classic" && value !== "mip-splatting" && value !== "undeclared") throw badValue(comment);
      mode = value;
    } else if (key === "low_pass_px2") {
      lowPassPx2 = /^\d*\.?\d*(e[-+]?\d+)?$/.test(value) ? parseFloat(value) : NaN;
      if (!Number.isFinite(lowPassPx2)) throw badValue(comment);
    }
  }
  const usual = mode === "mip-splatting" ? kMipSplatting : kClassic;
  return lowPassPx2 === undefined || mode === "undeclared" ? usual : { ...usual, lowPassPx2 };
}

function badValue(comment: string): Error {
  return Object.assign(new Error(), { code: "bad_value", text: `the comment "${comment}" states a value that it cannot have` });
}

/** meta.json of an SOG: "model" is splat-transform's, "antialias" is what other viewers look for. */
export function antiAliasingOfMeta({ model, antialias }: { model?: unknown; antialias?: unknown }): AntiAliasing {
  return (model === undefined ? antialias === true : model === "antialiased") ? kMipSplatting : kClassic;
}
