// home.ts - goes to a view by its name, and back to the first one.
// SPDX-License-Identifier: Apache-2.0
import { restore } from "./address.js";
import { jump } from "./cameras-panel.js";
import { fly } from "./flight.js";
import { readLink } from "./link.js";
import type { Page } from "./page.js";
import { homeOf } from "./state.js";

/** By the name of a camera, or the part of a link behind #. Resolves when it is there, with whether there is one. */
export async function goTo(page: Page, name: string, flies = true): Promise<boolean> {
  const { store } = page;
  const i = store.state.cameras.findIndex(({ img_name }) => img_name === name);
  const { view, ...link } = i >= 0 ? { view: jump(page, i, false) } : readLink(name);
  if (i < 0 && view) restore(store, link);
  if (view) await fly(store, view, performance.now(), flies ? undefined : true);
  return i >= 0 || view !== undefined;
}

/** To the attribute's camera, else to the first view of the scene. */
export async function goHome(page: Page): Promise<void> {
  const name = page.host.getAttribute("camera");
  if (name !== null && (await goTo(page, name))) return;
  const home = homeOf(page.store.state);
  if (home) await fly(page.store, home, performance.now());
}
