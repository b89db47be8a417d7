// names.ts - the names of what is shown: title, tags on the picture, description.
// SPDX-License-Identifier: Apache-2.0
import { countText } from "./messages.js";
import { element, say } from "./page.js";
import type { PageStore } from "./state.js";

const kTitle = "RoofGS viewer";

export function showNames(store: PageStore): void {
  store.subscribe(
    ({ scenes: [left, right], isReferenceShown }) => [left, right, isReferenceShown],
    ([left, right, isReferenceShown], before) => {
      const second = isReferenceShown ? `${left?.name ?? ""}, reference picture` : right?.name;
      const names = [left?.name, second].filter((name) => name !== undefined);
      element("title", HTMLElement).textContent = names.join(" | ") || kTitle;
      document.title = [...names, kTitle].join(" | ");
      element("left", HTMLElement).textContent = left?.name ?? "";
      element("right", HTMLElement).textContent = second ?? "";
      const what = left ? `${left.name}, ${countText(left.nGaussians)} ${left.nGaussians === 1 ? "Gaussian" : "Gaussians"}${second ? `, beside ${second}` : ""}` : "No scene yet";
      element("picture", HTMLElement).setAttribute("aria-label", what);
      if (before) say(what);
    },
  );
}
