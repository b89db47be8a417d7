// first-picture.ts - when the first picture of a scene with levels of detail is worth showing.
// SPDX-License-Identifier: Apache-2.0

/** Projected error of its coarsest page, px, and the time after which any picture is shown, ms. */
const kFirstErrorPx = 64;
const kFirstMs = 300;

/** `nWanted`: groups that are still going to change it. */
export function isWorthShowing(errorPx: number, nWanted: number, waitedMs: number): boolean {
  return errorPx <= kFirstErrorPx || nWanted === 0 || waitedMs >= kFirstMs;
}
