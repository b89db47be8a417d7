// levels.ts - chooses the cut of a view: docs/format/FORMAT.md, "Error and cut".
// SPDX-License-Identifier: Apache-2.0
import type { Page } from "@roofgs/reader";

export interface CutView {
  /** Centre of the camera, in the pages' coordinates. */
  position: readonly number[];
  /** The larger focal length. */
  focalPx: number;
  /** As the scene declares: nearer pages count as this near. */
  zNear: number;
  /** Projected error that is allowed, pixels; 0 draws leaves. */
  detailPx: number;
  /** Most Gaussians to draw. */
  budget: number;
}

export interface Cut {
  /** Resident pages that replace every leaf exactly once. */
  draw: number[];
  /** Absent pages that would refine the cut, the largest projected error first. */
  want: number[];
  /** Gaussians of `draw`. */
  n: number;
}

/** World units that a pixel covers where the page's core is nearest. */
function footprint({ core: { min, max } }: Page, { position, focalPx, zNear }: CutView): number {
  const outside = position.map((p, i) => Math.max((min[i] as number) - p, 0, p - (max[i] as number)));
  return Math.max(zNear, Math.hypot(...outside)) / focalPx;
}

export function projectedError(page: Page, view: CutView): number {
  return page.error / footprint(page, view);
}

/**
 * Refines from the root down, the largest projected error first, while the error is above `detailPx` and the children fit the budget. A
 * page with absent children stays in the cut, and those children are wanted.
 */
export function chooseCut(page: (index: number) => Page, isResident: (index: number) => boolean, view: CutView): Cut {
  const errorPx = (p: Page): number => projectedError(p, view);
  const root = page(0);
  if (!isResident(0)) return { draw: [], want: [0], n: 0 };
  const want: { index: number; errorPx: number }[] = [];
  const draw: number[] = [];
  let n = root.count;
  // Sorting each round is fast enough for the thousands of pages that a budget allows.
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
      const missing = children.filter((child) => !isResident(child.index));
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
