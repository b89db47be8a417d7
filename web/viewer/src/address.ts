// address.ts - the link in the address bar.
// SPDX-License-Identifier: Apache-2.0
import { type LinkState, readLink, writeLink } from "./link.js";
import { onClick, say, showError } from "./page.js";
import type { PageStore } from "./state.js";

export function restore(store: PageStore, link: Partial<LinkState>): void {
  const { view } = store.state;
  // A copy of the view, so that the address is written anew even if the link says nothing.
  store.set({ ...link, view: link.view ?? (view && { ...view }), playing: undefined });
}

function write({ state }: PageStore): void {
  const { view } = state;
  if (view) history.replaceState(null, "", `#${writeLink({ ...state, view })}`);
}

async function copy(store: PageStore): Promise<void> {
  write(store);
  try {
    await navigator.clipboard.writeText(location.href);
    say("Link copied");
  } catch {
    showError("The browser does not let this page copy. The link is in the address bar.");
  }
}

export function showLink(store: PageStore): void {
  store.subscribe(({ isAtRest }) => [isAtRest], ([isAtRest]) => isAtRest && write(store));
  store.subscribe(({ view }) => [view === undefined], ([isGone], before) => {
    if (isGone && before) history.replaceState(null, "", location.pathname + location.search);
  });
  window.addEventListener("hashchange", () => restore(store, readLink(location.hash)));
  onClick("link", () => void copy(store));
}
