// link.ts - the state that a link restores, as text behind the # of the page's address.
// SPDX-License-Identifier: Apache-2.0
import type { ViewState } from "./cameras.js";

export type Mode = "single" | "slider" | "flicker" | "difference";

export interface LinkState {
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
/** Seven digits, and four behind the point, of positions far from 0. */
const digits = (value: number): string => String(Number(Math.abs(value) < 1000 ? value.toPrecision(7) : value.toFixed(4)));
const list = (values: readonly number[]): string => values.map(digits).join(",");

export function writeLink(state: LinkState): string {
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
export function readLink(hash: string): Partial<LinkState> {
  const parameters = new URLSearchParams(hash.replace(/^#/, ""));
  const numbers = (name: string, n: number): number[] | undefined => {
    const values = (parameters.get(name) ?? "").split(",").map((text) => (text === "" ? NaN : Number(text)));
    return values.length === n && values.every(Number.isFinite) ? values : undefined;
  };
  const between = (name: string, low: number, high: number, round = (value: number): number => value): number | undefined => {
    const value = numbers(name, 1)?.[0];
    return value === undefined ? undefined : round(Math.min(high, Math.max(low, value)));
  };
  const [position, axes, lens, pivot] = [numbers("at", 3), numbers("axes", 9), numbers("lens", 4), numbers("pivot", 3)];
  const [focal, aspect, ...offset] = (lens ?? []) as [number, number, number, number];
  const rotation = [0, 3, 6].map((row) => axes?.slice(row, row + 3));
  const state = {
    view: position && axes && pivot && focal > 0 && aspect > 0 ? { position, rotation, focal, aspect, offset, pivot } : undefined,
    mode: kModes.find((name) => name === parameters.get("mode")),
    split: between("split", 0, 1),
    background: numbers("background", 3)?.map((value) => Math.min(1, Math.max(0, value))),
    shDegree: between("sh", 0, 3, Math.round),
    detailPx: between("detail", 0, 64),
    budget: between("budget", 1000, 1e9, Math.round),
  };
  return Object.fromEntries(Object.entries(state).filter(([, value]) => value !== undefined)) as Partial<LinkState>;
}
