// element.ts - <rgs-view>: a viewer in a page of others. README.md lists its attributes, events and methods.
// SPDX-License-Identifier: Apache-2.0
import type { RgsView as Declared } from "../rgs-view.js";
import kStyle from "./style.css?inline";
import { kTemplate } from "./template.js";
import { Viewer } from "./viewer.js";

export class RgsView extends HTMLElement implements Declared {
  static readonly observedAttributes = ["src", "compare", "cameras", "camera"];
  private viewer: Viewer | undefined;

  constructor() {
    super();
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(kStyle);
    this.attachShadow({ mode: "open" }).adoptedStyleSheets = [sheet];
  }

  connectedCallback(): void {
    // In an iframe, too, the page's address may choose how much is around the picture.
    const chrome = this.hasAttribute("whole") && new URLSearchParams(location.search).get("chrome");
    if (chrome) this.setAttribute("chrome", chrome);
    this.start();
  }

  disconnectedCallback(): void {
    this.viewer?.end();
    this.viewer = undefined;
  }

  attributeChangedCallback(name: string, before: string | null, value: string | null): void {
    if (!this.viewer || before === value) return;
    if (name === "camera") void (value !== null && this.flyTo(value));
    else this.start();
  }

  /** Shows the view of a camera, by its name, or of a link, by what is behind its #. Resolves with whether there is one. */
  async flyTo(camera: string): Promise<boolean> {
    return (await this.viewer?.flyTo(camera)) ?? false;
  }

  /** A PNG of what is shown, once all scenes are complete. */
  async screenshot(): Promise<Blob> {
    if (!this.viewer) throw new Error("the element is in no document");
    return this.viewer.screenshot();
  }

  /** Opens a second scene, an address or a file, beside the first; without one, closes it. */
  async compare(scene?: string | File): Promise<void> {
    await this.viewer?.compare(scene);
  }

  private start(): void {
    this.viewer?.end();
    delete this.dataset["ready"];
    const root = this.shadowRoot as ShadowRoot;
    root.innerHTML = kTemplate;
    this.viewer = new Viewer(this, root);
  }
}
