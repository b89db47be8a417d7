// declared.ts - the anti-aliasing that PLY and SOG files declare, read as rgs-convert does: docs/user/INTERCHANGE.md, "Declarations".
// SPDX-License-Identifier: Apache-2.0
import type { DeclaredAntiAliasing } from "@roofgs/reader";

/** `comments` of a PLY's header, without the word "comment"; the last one wins. Throws bad_value if a comment of ours has a bad value. */
export function antiAliasingOfComments(comments: readonly string[]): DeclaredAntiAliasing {
  let aaMode: DeclaredAntiAliasing["aaMode"] = "classic";
  let lowPassPx2: number | undefined;
  for (const comment of comments) {
    const text = comment.trim().toLowerCase();
    const theirs = /^splatrendermode\s*:?\s*(mip|default)$/.exec(text)?.[1] ?? /^antialiased\s+([01])$/.exec(text)?.[1];
    if (theirs) aaMode = theirs === "mip" || theirs === "1" ? "mip_splatting" : "classic";
    const [, key, value = ""] = /^rgs_(anti_aliasing|low_pass_px2)\s*:\s*(.*)$/.exec(text) ?? [];
    if (key === "anti_aliasing") {
      if (value !== "classic" && value !== "mip-splatting" && value !== "undeclared") throw badValue(comment);
      aaMode = value === "mip-splatting" ? "mip_splatting" : value;
    } else if (key === "low_pass_px2") {
      lowPassPx2 = /^\d*\.?\d*(e[-+]?\d+)?$/.test(value) ? parseFloat(value) : NaN;
      if (!Number.isFinite(lowPassPx2)) throw badValue(comment);
    }
  }
  return { aaMode, lowPassPx2 };
}

function badValue(comment: string): Error {
  return Object.assign(new Error(), { code: "bad_value", text: `the comment "${comment}" has a bad value` });
}

/** meta.json of an SOG: splat-transform writes "model"; other viewers look for "antialias". */
export function antiAliasingOfMeta({ model, antialias }: { model?: unknown; antialias?: unknown }): DeclaredAntiAliasing {
  return { aaMode: (model === undefined ? antialias === true : model === "antialiased") ? "mip_splatting" : "classic" };
}
