// page.ts - elements by id, error messages, loading progress, announcements to screen readers.
// SPDX-License-Identifier: Apache-2.0
import { bytesText } from "./messages.js";

export function element<T extends HTMLElement>(id: string, type: abstract new () => T): T {
  const found = document.getElementById(id);
  if (!(found instanceof type)) throw new Error(`the page has no ${id}`);
  return found;
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

/** Removes an error that no longer holds. */
export function withdrawError(sentence: string): void {
  for (const line of [...element("errors", HTMLElement).children]) if (line.firstChild?.textContent === sentence) line.remove();
}

/** Announces a text to screen readers. */
export function say(text: string): void {
  element("status", HTMLElement).textContent = text;
}

export function showLoading(text: string): void {
  element("progress", HTMLProgressElement).removeAttribute("value");
  element("progress-text", HTMLElement).textContent = text;
  element("loading", HTMLElement).hidden = false;
}

export function hideLoading(): void {
  element("loading", HTMLElement).hidden = true;
}

/** Bytes read; `total` is 0 where it is not known. */
export function showProgress(done: number, total: number): void {
  if (total > 0) element("progress", HTMLProgressElement).value = done / total;
  element("progress-text", HTMLElement).textContent = `Reading ${bytesText(done)}${total > 0 ? ` of ${bytesText(total)}` : ""}`;
}
