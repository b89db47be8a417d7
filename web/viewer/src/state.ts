// state.ts - what the page knows: all that it shows follows from this.
// SPDX-License-Identifier: Apache-2.0
import { add, axisOf, type CameraEntry, defaultView, length, normalised, viewFrom, viewFromFirst, type ViewState } from "./cameras.js";
import type { World } from "./controls.js";
import type { Flight } from "./flight.js";
import type { Frame } from "./frames.js";
import type { LinkState } from "./link.js";
import type { Size } from "./picture-size.js";
import type { Scene, Tint } from "./scene.js";
import type { Store } from "./store.js";

/** What is shown beside the picture, by the ids of their buttons. */
export const kPanels = ["views", "save", "help", "menu"] as const;
export type Panel = (typeof kPanels)[number];

export interface State extends Omit<LinkState, "view"> {
  /** Undefined until there is a scene, or a link that has one. */
  view: ViewState | undefined;
  /** Of the picture, pixels. */
  size: Size;
  /** No change of the picture for a while. */
  isAtRest: boolean;
  /** Left and right. */
  scenes: readonly [Scene | undefined, Scene | undefined];
  /** The left scene is read to its end. */
  isComplete: boolean;
  /** Counts changes of what the scenes draw, such as new pages. */
  nChanges: number;
  /** Shown while a file is read; `share` of it, 0 to 1, where that is known. */
  loading: { text: string; share: number | undefined } | undefined;
  /** What the conversion for "Save as .rgs" does now, and what the last one made. */
  saving: { text: string; share: number | undefined } | undefined;
  saved: string;
  /** A scene has been drawn. */
  hasPicture: boolean;
  /** What the page begins with is open, or has failed. */
  isReady: boolean;
  cameras: readonly CameraEntry[];
  /** Addresses, by the names of their cameras. */
  photos: ReadonlyMap<string, string>;
  /** The camera that was jumped to last, or -1. */
  camera: number;
  /** The view that it was jumped to; `view` while nobody has moved. */
  cameraView: ViewState | undefined;
  /** Where the view is on the path through the cameras, 0 to 1; undefined if the path is not played. */
  playing: number | undefined;
  /** The view is flying to another one. */
  flight: Flight | undefined;
  tint: Tint;
  statistics: boolean;
  bounds: boolean;
  /** There is a server that draws reference pictures; the left scene's number on it; its last picture. */
  hasReference: boolean;
  isReferenceShown: boolean;
  referenceScene: number;
  frame: Frame | undefined;
  panel: Panel | undefined;
  /** Undefined: the system's. */
  theme: "dark" | "light" | undefined;
}

export type PageStore = Store<State>;

export function firstState(size: Size): State {
  return {
    view: undefined, size, isAtRest: false, mode: "single", split: 0.5, background: [0, 0, 0], shDegree: 3, detailPx: 1, budget: 1e6,
    scenes: [undefined, undefined], isComplete: false, nChanges: 0, loading: undefined, saving: undefined, saved: "", hasPicture: false, isReady: false,
    cameras: [], photos: new Map(), camera: -1, cameraView: undefined, playing: undefined, flight: undefined, tint: "none", statistics: false, bounds: false,
    hasReference: false, isReferenceShown: false, referenceScene: 0, frame: undefined, panel: undefined, theme: undefined,
  };
}

/** What is compared with the left scene: another one, the reference picture, or nothing. */
export function rightOf({ scenes, isReferenceShown }: State): "scene" | "reference" | "none" {
  return isReferenceShown ? "reference" : scenes[1] ? "scene" : "none";
}

/** The view from which the left scene is seen first: that of the first camera, else its own. */
export function homeOf(state: State): ViewState | undefined {
  const { cameras: [camera], scenes: [left], size } = state;
  if (!left) return undefined;
  if (camera) return viewFrom(camera, left.box);
  const height = size.height / size.width;
  return left.firstView ? viewFromFirst(left.firstView, left.origin, height) : viewFromFirst(defaultView(left.box, worldOf(state).up), [0, 0, 0], height);
}

export function worldOf({ cameras, scenes: [left] }: State): World {
  const up = cameras.length > 0 ? cameras.reduce((sum, { rotation }) => add(sum, axisOf(rotation, 1), -1), [0, 0, 0]) : null;
  const size = left ? length(add(left.box.max, left.box.min, -1)) : 1;
  return { up: normalised(up && length(up) > 0.1 ? up : (left?.firstView?.up ?? left?.up ?? [0, -1, 0])), speed: 0.15 * size };
}
