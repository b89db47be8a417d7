// link.ts - the state that a link restores, as text behind the # of the page's address.
// SPDX-License-Identifier: Apache-2.0
import type { ViewState } from "./cameras.js";

export type Mode = "single" | "slider" | "flicker" | "difference";

export interface PageState {
  view: ViewState;
  mode: Mode;
  /** Position of the slider as a share of the picture's width. */
  split: number;
  /** 0 to 1. */
  background: readonly number[];
  shDegree: number;
  detailPx: number;
  /** Gaussians. */
  budget: number;
}

const kModes: readonly Mode[] = ["single", "slider", "flicker", "difference"];
const digits = (value: number): string => String(Number(value.toPrecision(7)));
const list = (values: readonly number[]): string => values.map(digits).join(",");

export function writeLink(state: PageState): string {
  const { view } = state;
  return new URLSearchParams({
    at: list(view.position),
    axes: list(view.rotation.flat()),
    lens: list([view.focal, view.aspect, ...view.offset]),
    pivot: list(view.pivot),
    mode: state.mode,
    split: digits(state.split),
    background: list(state.background),
    sh: String(state.shDegree),
    detail: digits(state.detailPx),
    budget: String(state.budget),
  }).toString();
}

/** Leaves out fields that are missing or are not numbers. */
export function readLink(hash: string): Partial<PageState> {
  const parameters = new URLSearchParams(hash.replace(/^#/, ""));
  const numbers = (name: string, n: number): number[] | undefined => {
    const values = (parameters.get(name) ?? "").split(",").map((text) => (text === "" ? NaN : Number(text)));
    return values.length === n && values.every(Number.isFinite) ? values : undefined;
  };
  const state: Partial<PageState> = {};
  const position = numbers("at", 3);
  const axes = numbers("axes", 9);
  const lens = numbers("lens", 4);
  const pivot = numbers("pivot", 3);
  if (position && axes && lens && pivot && (lens[0] as number) > 0 && (lens[1] as number) > 0) {
    const rotation = [axes.slice(0, 3), axes.slice(3, 6), axes.slice(6, 9)];
    state.view = { position, rotation, focal: lens[0] as number, aspect: lens[1] as number, offset: [lens[2] as number, lens[3] as number], pivot };
  }
  const mode = kModes.find((name) => name === parameters.get("mode"));
  if (mode) state.mode = mode;
  const between = (name: string, low: number, high: number): number | undefined => {
    const value = numbers(name, 1)?.[0];
    return value === undefined ? undefined : Math.min(high, Math.max(low, value));
  };
  const background = numbers("background", 3)?.map((value) => Math.min(1, Math.max(0, value)));
  const split = between("split", 0, 1);
  const shDegree = between("sh", 0, 3);
  const detailPx = between("detail", 0, 64);
  const budget = between("budget", 1000, 1e9);
  return {
    ...state,
    ...(background ? { background } : {}),
    ...(split !== undefined ? { split } : {}),
    ...(shDegree !== undefined ? { shDegree: Math.round(shDegree) } : {}),
    ...(detailPx !== undefined ? { detailPx } : {}),
    ...(budget !== undefined ? { budget: Math.round(budget) } : {}),
  };
}
