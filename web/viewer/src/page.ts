// page.ts - one viewer's state and elements, in a shadow root of its own: error messages, announcements, events.
// SPDX-License-Identifier: Apache-2.0
import type { RgsViewEvents } from "../rgs-view.js";
import { bytesText, sentence } from "./messages.js";
import type { PageStore } from "./state.js";
import { kCloseIcon } from "./template.js";

export class Page {
  /** Whether title, address, keys and drops of the whole document are this viewer's. */
  readonly isWhole: boolean;

  constructor(
    readonly store: PageStore,
    readonly host: HTMLElement,
    private readonly root: ShadowRoot,
    /** Aborted when the viewer ends. */
    readonly signal: AbortSignal,
  ) {
    this.isWhole = host.hasAttribute("whole");
  }

  /** Whether this viewer has all controls. */
  get isFull(): boolean {
    return this.host.getAttribute("chrome") === "full";
  }

  /** The query of the address, where that is this viewer's. */
  get search(): string {
    return this.isWhole ? location.search : "";
  }

  element<T extends HTMLElement>(id: string, type: abstract new () => T): T {
    const found = this.root.getElementById(id);
    if (!(found instanceof type)) throw new Error(`the page has no ${id}`);
    return found;
  }

  input(id: string): HTMLInputElement {
    return this.element(id, HTMLInputElement);
  }

  all<T extends HTMLElement>(selector: string): T[] {
    return [...this.root.querySelectorAll<T>(selector)];
  }

  onClick(id: string, action: () => void): void {
    this.element(id, HTMLButtonElement).addEventListener("click", action);
  }

  /** Listens wherever this viewer's keys and drops are, until it ends. */
  listen<Name extends keyof GlobalEventHandlersEventMap>(name: Name, heard: (event: GlobalEventHandlersEventMap[Name]) => void): void {
    const target: GlobalEventHandlers = this.isWhole ? document : this.host;
    target.addEventListener(name, heard, { signal: this.signal });
  }

  tell<Name extends keyof RgsViewEvents>(name: Name, detail: RgsViewEvents[Name]): void {
    // The next viewer has the same host.
    if (!this.signal.aborted) this.host.dispatchEvent(new CustomEvent(name, { detail }));
  }

  /** Shows an error until somebody closes it. The same error is not shown twice. */
  showError(message: string): void {
    if (this.signal.aborted) return;
    const list = this.element("errors", HTMLElement);
    if ([...list.children].some(({ firstChild }) => firstChild?.textContent === message)) return;
    const line = document.createElement("p");
    const close = document.createElement("button");
    Object.assign(close, { type: "button", innerHTML: kCloseIcon });
    close.setAttribute("aria-label", "Close");
    close.addEventListener("click", () => line.remove());
    line.append(message, close);
    list.append(line);
    // More than four would cover the picture.
    while (list.children.length > 4) list.firstElementChild?.remove();
    this.tell("error", { message });
  }

  /** Shows what happened to `name`. */
  fail(name: string, error: unknown): void {
    if ((error as { name?: string } | null)?.name !== "AbortError") this.showError(sentence(name, error));
  }

  /** Removes an error that no longer holds. */
  withdrawError(message: string): void {
    if (this.signal.aborted) return;
    for (const line of [...this.element("errors", HTMLElement).children]) if (line.firstChild?.textContent === message) line.remove();
  }

  /** Announces a text to screen readers. */
  say(text: string): void {
    if (!this.signal.aborted) this.element("status", HTMLElement).textContent = text;
  }
}

/** Offers a download. */
export function offer(blob: Blob, name: string): void {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  // Browsers may begin to read it later.
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
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

export function showLoading(page: Page): void {
  const bar = page.element("progress", HTMLProgressElement);
  page.store.subscribe(({ loading, scenes }) => [loading, scenes], ([loading, [left]]) => {
    page.element("loading", HTMLElement).hidden = loading === undefined;
    page.element("welcome", HTMLElement).hidden = loading !== undefined || left !== undefined;
    page.tell("progress", loading ?? null);
    if (!loading) return;
    page.element("progress-text", HTMLElement).textContent = loading.text;
    if (loading.share === undefined) bar.removeAttribute("value");
    else bar.value = loading.share;
  });
}

/** The picture of the attribute `poster`, until there is one of a scene. */
export function showPoster(page: Page): void {
  const src = page.host.getAttribute("poster");
  if (src === null) return;
  const image = document.createElement("img");
  Object.assign(image, { id: "poster", src, alt: "" });
  page.element("welcome", HTMLElement).after(image);
  page.store.subscribe(({ hasPicture }) => [hasPicture], ([hasPicture]) => hasPicture && image.remove());
}
