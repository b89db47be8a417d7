// flight.ts - flies from one view to another.
// SPDX-License-Identifier: Apache-2.0
import { add, axisOf, cross, dot, fromAxes, length, normalised, turned, type ViewState } from "./cameras.js";
import type { PageStore } from "./state.js";

/** Milliseconds. */
const kFlightMs = 600;

export interface Flight {
  readonly from: ViewState;
  readonly to: ViewState;
  /** Milliseconds, by the clock of advanceFlight(). */
  readonly began: number;
  /** What it made of the view last: a view that is another one ends it. */
  readonly at: ViewState;
  /** Called when it is over. */
  landed(): void;
}

/** A view on the way, at `share` 0 to 1 of it: the camera turns about the pivot, which moves straight. */
export function between(from: ViewState, to: ViewState, share: number): ViewState {
  if (share >= 1) return to;
  const mix = (a: number, b: number): number => a + share * (b - a);
  const all = (a: readonly number[], b: readonly number[]): number[] => a.map((value, i) => mix(value, b[i] as number));
  const [before, after] = [from, to].map(({ rotation }) => [0, 1, 2].map((k) => axisOf(rotation, k))) as [number[][], number[][]];
  // Twice the sine of the angle times its axis, and the trace, 1 + twice its cosine.
  const twist = before.reduce((sum, axis, k) => add(sum, cross(axis, after[k] as number[])), [0, 0, 0]);
  const trace = before.reduce((sum, axis, k) => sum + dot(axis, after[k] as number[]), 0);
  const angle = share * Math.atan2(length(twist), trace - 1);
  const axis = length(twist) > 1e-6 ? normalised(twist) : (before[1] as number[]);
  const [right, down, forward] = before.map((v) => turned(v, axis, angle)) as [number[], number[], number[]];
  const seen = ({ position, pivot }: ViewState, axes: number[][]): number[] => axes.map((v) => dot(v, add(position, pivot, -1)));
  const away = all(seen(from, before), seen(to, after));
  const pivot = all(from.pivot, to.pivot);
  const position = [right, down, forward].reduce((sum, v, k) => add(sum, v, away[k] as number), pivot);
  const offset: [number, number] = [mix(from.offset[0], to.offset[0]), mix(from.offset[1], to.offset[1])];
  return { position, rotation: fromAxes(right, down, forward), focal: mix(from.focal, to.focal), aspect: mix(from.aspect, to.aspect), offset, pivot };
}

/** Flies to a view from `now` on, ms; where less motion is wished, it jumps. Resolves when that is over, or somebody else moves the view. */
export function fly(store: PageStore, to: ViewState, now: number, jumps = matchMedia("(prefers-reduced-motion: reduce)").matches): Promise<void> {
  const { view: from } = store.state;
  return new Promise((landed) => {
    store.set({ playing: undefined, flight: { from: from ?? to, to, began: now, at: from ?? to, landed } });
    if (jumps || !from) advanceFlight(store, Infinity);
  });
}

/** Called before each frame. */
export function advanceFlight(store: PageStore, now: number): void {
  const { flight, view } = store.state;
  if (!flight) return;
  if (view !== flight.at && now !== Infinity) return store.set({ flight: undefined });
  const t = Math.min(1, Math.max(0, (now - flight.began) / kFlightMs));
  // Slowly off and slowly in.
  const at = between(flight.from, flight.to, t * t * (3 - 2 * t));
  store.set({ view: at, flight: t < 1 ? { ...flight, at } : undefined });
}

/** Tells who awaits a flight when it is over. */
export function watchFlights(store: PageStore, signal: AbortSignal): void {
  store.subscribe(({ flight }) => [flight?.landed], (_, before) => before?.[0]?.());
  signal.addEventListener("abort", () => store.state.flight?.landed());
}
