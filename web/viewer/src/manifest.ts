// manifest.ts - what the page is to show: from view.json beside it or inside it, or from its own address.
// SPDX-License-Identifier: Apache-2.0

/** Of an SPZ that declares none: right, down, forward as in PLY, or right, up, backward. */
export type SpzAxes = "ply" | "opengl";

export interface SceneEntry {
  name: string;
  /** Relative to the page, or `#rgs-file-0`: the id of an element of the page. */
  url: string;
  bytes?: number;
}

export interface Manifest {
  version: 1;
  /** One or two; two are compared. */
  scenes: SceneEntry[];
  cameras: string | null;
  photos: { camera: string; url: string }[];
  /** The server that draws reference pictures. */
  frames: { url: string; backend: "cpu" | "cuda" } | null;
  settings?: { background?: number[]; sh_degree?: number; spz_axes?: SpzAxes };
}

const kEmpty: Manifest = { version: 1, scenes: [], cameras: null, photos: [], frames: null };

/** Missing fields are empty. Throws if the version is not 1. */
export function parseManifest(text: string): Manifest {
  const found = JSON.parse(text) as Partial<Manifest>;
  if (found.version !== 1) throw new Error("view.json has a version that this page does not know");
  const manifest = { ...kEmpty, ...found };
  if (!Array.isArray(manifest.scenes) || manifest.scenes.length > 2) throw new Error("view.json names more than two scenes");
  return manifest;
}

/** The file name in an address, for display. */
export function nameOf(url: string): string {
  const path = url.split(/[?#]/)[0] ?? "";
  const last = path.slice(path.lastIndexOf("/") + 1);
  try {
    return decodeURIComponent(last);
  } catch {
    return last;
  }
}

/** `?scene=URL&other=URL&cameras=URL` of the page's address. */
export function manifestOfAddress(search: string): Manifest | null {
  const parameters = new URLSearchParams(search);
  const urls = [parameters.get("scene"), parameters.get("other")].filter((url) => url !== null);
  if (urls.length === 0) return null;
  return { ...kEmpty, scenes: urls.map((url) => ({ name: nameOf(url), url })), cameras: parameters.get("cameras") };
}

/** The axes of SPZ files that declare none: `&spz-axes=` of the page's address, or the settings. */
export function spzAxesOf(search: string, { settings }: Manifest): SpzAxes {
  return (new URLSearchParams(search).get("spz-axes") ?? settings?.spz_axes) === "opengl" ? "opengl" : "ply";
}

/** Of the attributes `src`, `compare` and `cameras`. */
function manifestOf(host: HTMLElement): Manifest {
  const urls = ["src", "compare"].map((name) => host.getAttribute(name)).filter((url) => url !== null);
  return { ...kEmpty, scenes: urls.map((url) => ({ name: nameOf(url), url })), cameras: host.getAttribute("cameras") };
}

/** `isWhole`: the page's address and view.json say what to show. */
export async function readManifest(host: HTMLElement, isWhole: boolean): Promise<Manifest> {
  if (!isWhole || host.hasAttribute("src")) return manifestOf(host);
  const inside = document.getElementById("rgs-view");
  if (inside) return parseManifest(inside.textContent ?? "");
  const address = manifestOfAddress(location.search);
  if (address) return address;
  if (location.protocol === "file:") return kEmpty;
  const answer = await fetch("view.json", { cache: "no-store" }).catch(() => null);
  return answer?.ok ? parseManifest(await answer.text()) : kEmpty;
}

/** Decodes the base64 content of the element `#id`, which rgs-view --export put there. */
export async function readInside(url: string): Promise<Blob> {
  const text = document.getElementById(url.slice(1))?.textContent;
  if (text === null || text === undefined) throw new Error(`this page has no element ${url}`);
  return (await fetch(`data:application/octet-stream;base64,${text.replace(/\s+/g, "")}`)).blob();
}
