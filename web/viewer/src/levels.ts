// levels.ts - which pages of a file with levels of detail a view needs: docs/develop/LEVELS.md, "The cut".
// SPDX-License-Identifier: Apache-2.0
import type { Page } from "@roofgs/reader";

export interface CutView {
  /** Camera's centre, in the coordinates of the pages. */
  position: readonly number[];
  focalPx: number;
  /** Error that may be drawn, pixels; 0: leaves. */
  detailPx: number;
  /** Gaussians that may be drawn. */
  budget: number;
}

export interface Cut {
  /** Pages to draw now: none stands above another, and together they are the scene. */
  draw: number[];
  /** Pages that would make it better, the most needed first. */
  want: number[];
  /** Gaussians of `draw`. */
  n: number;
}

/** From a point to a box, 0 inside. */
function distance(point: readonly number[], { min, max }: Page["core"]): number {
  let sum = 0;
  for (let i = 0; i < 3; ++i) {
    const p = point[i] as number;
    const outside = Math.max((min[i] as number) - p, 0, p - (max[i] as number));
    sum += outside * outside;
  }
  return Math.sqrt(sum);
}

/**
 * Pages are opened from the root down, the one whose error shows most first, as long as the error is more than `detailPx` and the
 * Gaussians fit into the budget. A page whose children are not all here stays, and its children are wanted.
 */
export function chooseCut(page: (index: number) => Page, isHere: (index: number) => boolean, view: CutView): Cut {
  const errorPx = (p: Page): number => (p.nChildren === 0 ? 0 : (p.error * view.focalPx) / Math.max(1e-9, distance(view.position, p.core)));
  const root = page(0);
  if (!isHere(0)) return { draw: [], want: [0], n: 0 };
  const want: { index: number; errorPx: number }[] = [];
  const draw: number[] = [];
  let n = root.count;
  // A heap would be faster; of the thousands of pages that a budget allows, sorted runs are fast enough.
  let open: { page: Page; errorPx: number }[] = [{ page: root, errorPx: errorPx(root) }];
  while (open.length > 0) {
    open.sort((a, b) => b.errorPx - a.errorPx);
    const next: typeof open = [];
    for (const entry of open) {
      const { page: p } = entry;
      if (p.nChildren === 0 || entry.errorPx <= view.detailPx) {
        draw.push(p.index);
        continue;
      }
      const children = Array.from({ length: p.nChildren }, (_, i) => page(p.firstChild + i));
      const grown = n - p.count + children.reduce((sum, child) => sum + child.count, 0);
      const missing = children.filter((child) => !isHere(child.index));
      if (grown > view.budget || missing.length > 0) {
        draw.push(p.index);
        if (grown <= view.budget) want.push(...missing.map(({ index }) => ({ index, errorPx: entry.errorPx })));
        continue;
      }
      n = grown;
      next.push(...children.map((child) => ({ page: child, errorPx: errorPx(child) })));
    }
    open = next;
  }
  want.sort((a, b) => b.errorPx - a.errorPx);
  return { draw, want: want.map(({ index }) => index), n };
}
