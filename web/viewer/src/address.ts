// address.ts - the link in the address bar.
// SPDX-License-Identifier: Apache-2.0
import { type LinkState, readLink, writeLink } from "./link.js";
import type { Page } from "./page.js";
import type { PageStore } from "./state.js";

export function restore(store: PageStore, link: Partial<LinkState>): void {
  const { view } = store.state;
  // A copy of the view, so that the address is written anew even if the link says nothing.
  store.set({ ...link, view: link.view ?? (view && { ...view }), playing: undefined });
}

/** Only where the address is this viewer's; others tell by an event. */
export function showLink(page: Page): void {
  const { store } = page;
  const hasAddress = page.isWhole && location.protocol !== "about:"; // a frame in a notebook has none
  const link = (): string | undefined => {
    const { view } = store.state;
    return view && writeLink({ ...store.state, view });
  };
  const write = (): void => {
    const text = link();
    if (text !== undefined && hasAddress) history.replaceState(null, "", `#${text}`);
  };
  const copy = async (): Promise<void> => {
    write();
    try {
      await navigator.clipboard.writeText(location.href);
      page.say("Link copied");
    } catch {
      page.showError("The browser does not let this page copy. The link is in the address bar.");
    }
  };
  store.subscribe(({ isAtRest }) => [isAtRest], ([isAtRest]) => {
    const text = link();
    if (!isAtRest || text === undefined) return;
    write();
    const { cameras, camera, cameraView, view } = store.state;
    page.tell("camera", { name: (view === cameraView && cameras[camera]?.img_name) || null, link: text });
  });
  page.onClick("link", () => void copy());
  if (!hasAddress) return;
  store.subscribe(({ view }) => [view === undefined], ([isGone], before) => {
    if (isGone && before) history.replaceState(null, "", location.pathname + location.search);
  });
  // Not location.hash: the page may have written its own address since.
  window.addEventListener("hashchange", ({ newURL }) => restore(store, readLink(new URL(newURL).hash)), { signal: page.signal });
}
