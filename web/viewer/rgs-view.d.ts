// rgs-view.d.ts - the element <rgs-view> for TypeScript. README.md lists its attributes.
// SPDX-License-Identifier: Apache-2.0

/** Details of the element's events, by name. */
export interface RgsViewEvents {
  /** What the attributes name is open, or has failed. */
  ready: null;
  /** What is being read, and the `share` of it, 0 to 1, where that is known; null: nothing. */
  progress: { text: string; share: number | undefined } | null;
  error: { message: string };
  /** A view that has come to rest: the name of the camera, if it is one's, and what a link has behind #. */
  camera: { name: string | null; link: string };
}

export type RgsViewEventMap = Omit<HTMLElementEventMap, keyof RgsViewEvents> & { [Name in keyof RgsViewEvents]: CustomEvent<RgsViewEvents[Name]> };

export interface RgsView extends HTMLElement {
  /** Flies to a camera, by its name, or to the view of a link, by what is behind its #. Resolves when it is there, with whether there is one. */
  flyTo(camera: string): Promise<boolean>;
  /** A PNG of what is shown, once all scenes are complete. */
  screenshot(): Promise<Blob>;
  /** Opens a second scene, an address or a file, beside the first; without one, closes it. */
  compare(scene?: string | File): Promise<void>;
  addEventListener<Name extends keyof RgsViewEventMap>(type: Name, listener: (this: RgsView, event: RgsViewEventMap[Name]) => unknown, options?: boolean | AddEventListenerOptions): void;
  addEventListener(type: string, listener: EventListenerOrEventListenerObject, options?: boolean | AddEventListenerOptions): void;
  removeEventListener<Name extends keyof RgsViewEventMap>(type: Name, listener: (this: RgsView, event: RgsViewEventMap[Name]) => unknown, options?: boolean | EventListenerOptions): void;
  removeEventListener(type: string, listener: EventListenerOrEventListenerObject, options?: boolean | EventListenerOptions): void;
}

declare global {
  interface HTMLElementTagNameMap {
    "rgs-view": RgsView;
  }
}
