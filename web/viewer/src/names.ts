// names.ts - the names of what is shown: title, tags on the picture, description.
// SPDX-License-Identifier: Apache-2.0
import { countText } from "./messages.js";
import type { Page } from "./page.js";

const kTitle = "RoofGS viewer";

export function showNames(page: Page): void {
  page.store.subscribe(
    ({ scenes: [left, right], isReferenceShown }) => [left, right, isReferenceShown],
    ([left, right, isReferenceShown], before) => {
      const second = isReferenceShown ? `${left?.name ?? ""}, reference picture` : right?.name;
      const names = [left?.name, second].filter((name) => name !== undefined);
      page.element("title", HTMLElement).textContent = names.join(" | ") || kTitle;
      if (page.isWhole) document.title = [...names, kTitle].join(" | ");
      page.element("left", HTMLElement).textContent = left?.name ?? "";
      page.element("right", HTMLElement).textContent = second ?? "";
      const what = left ? `${left.name}, ${countText(left.nGaussians)} ${left.nGaussians === 1 ? "Gaussian" : "Gaussians"}${second ? `, beside ${second}` : ""}` : "No scene yet";
      page.element("picture", HTMLElement).setAttribute("aria-label", what);
      if (before) page.say(what);
    },
  );
}
