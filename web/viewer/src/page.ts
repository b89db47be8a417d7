// page.ts - elements by id, error messages, loading progress, announcements to screen readers.
// SPDX-License-Identifier: Apache-2.0
import { bytesText, sentence } from "./messages.js";
import type { PageStore } from "./state.js";

export function element<T extends HTMLElement>(id: string, type: abstract new () => T): T {
  const found = document.getElementById(id);
  if (!(found instanceof type)) throw new Error(`the page has no ${id}`);
  return found;
}

export const input = (id: string): HTMLInputElement => element(id, HTMLInputElement);

export function onClick(id: string, action: () => void): void {
  element(id, HTMLButtonElement).addEventListener("click", action);
}

/** Shows an error until somebody closes it. The same error is not shown twice. */
export function showError(sentence: string): void {
  const list = element("errors", HTMLElement);
  if ([...list.children].some(({ firstChild }) => firstChild?.textContent === sentence)) return;
  const line = document.createElement("p");
  const close = document.createElement("button");
  Object.assign(close, { type: "button", textContent: "×" });
  close.setAttribute("aria-label", "Close");
  close.addEventListener("click", () => line.remove());
  line.append(sentence, close);
  list.append(line);
  // More than four would cover the picture.
  while (list.children.length > 4) list.firstElementChild?.remove();
}

/** Shows what happened to `name`. */
export function fail(name: string, error: unknown): void {
  if ((error as { name?: string } | null)?.name !== "AbortError") showError(sentence(name, error));
}

/** Removes an error that no longer holds. */
export function withdrawError(sentence: string): void {
  for (const line of [...element("errors", HTMLElement).children]) if (line.firstChild?.textContent === sentence) line.remove();
}

/** Announces a text to screen readers. */
export function say(text: string): void {
  element("status", HTMLElement).textContent = text;
}

export function beginLoading(store: PageStore, name: string): void {
  store.set({ loading: { text: `Opening ${name}`, share: undefined } });
}

/** Takes bytes read and the total, 0 where it is not known. */
export const progressOf = (store: PageStore) => (done: number, total: number): void => {
  const { loading } = store.state;
  const text = `Reading ${bytesText(done)}${total > 0 ? ` of ${bytesText(total)}` : ""}`;
  if (loading) store.set({ loading: { text, share: total > 0 ? done / total : loading.share } });
};

export function showLoading(store: PageStore): void {
  const bar = element("progress", HTMLProgressElement);
  store.subscribe(({ loading, scenes }) => [loading, scenes], ([loading, [left]]) => {
    element("loading", HTMLElement).hidden = loading === undefined;
    element("welcome", HTMLElement).hidden = loading !== undefined || left !== undefined;
    if (!loading) return;
    element("progress-text", HTMLElement).textContent = loading.text;
    if (loading.share === undefined) bar.removeAttribute("value");
    else bar.value = loading.share;
  });
}
