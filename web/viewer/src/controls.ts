// controls.ts - mouse, touch, keys and gamepads orbit, pan, zoom and fly.
// SPDX-License-Identifier: Apache-2.0
import { add, axisOf, cross, dot, fromAxes, length, normalised, turned, type ViewState } from "./cameras.js";
import { focus } from "./picking.js";
import { type PageStore, worldOf } from "./state.js";

/** Radians per pixel of dragging, and per second of an arrow key. */
const kDrag = 0.006;
const kArrow = 1.2;
const kPressSeconds = 1 / 30;
/** Radians per second of a gamepad's stick, and its dead zone. */
const kLook = 1.5;
const kDeadZone = 0.15;
/** A double tap: milliseconds from one lift to the next, and pixels between taps and within one. */
const kDoubleTapMs = 350;
const kTapPx = 24;
/** Cosine of the steepest view. */
const kUpright = 0.995;

export interface World {
  up: readonly number[];
  /** World units per second. */
  speed: number;
}

/** Turns the view around its pivot or around the camera, by angles to the right and downwards, radians. */
export function orbited(view: ViewState, world: World, right: number, down: number, around: "pivot" | "camera"): ViewState {
  const [x, y, z] = [axisOf(view.rotation, 0), axisOf(view.rotation, 1), axisOf(view.rotation, 2)] as const;
  const turn = (v: readonly number[]): number[] => turned(v, world.up, -right);
  let pitched = (v: readonly number[]): number[] => turned(v, x, -down);
  const steep = Math.abs(dot(pitched(z), world.up));
  // A camera that starts steeper may only become less steep.
  if (steep > kUpright && steep > Math.abs(dot(z, world.up))) pitched = (v) => [...v];
  const all = (v: readonly number[]): number[] => turn(pitched(v));
  const [newX, newZ] = [normalised(all(x)), normalised(all(z))];
  const rotation = fromAxes(newX, length(y) > 0 ? cross(newZ, newX) : y, newZ);
  const position = around === "pivot" ? add(view.pivot, all(add(view.position, view.pivot, -1))) : view.position;
  return { ...view, position, rotation };
}

/** Moves view and pivot along the view's axes: right, down, forward, world units. */
export function moved(view: ViewState, by: readonly number[]): ViewState {
  const step = [0, 1, 2].reduce((sum, axis) => add(sum, axisOf(view.rotation, axis), by[axis] as number), [0, 0, 0]);
  return { ...view, position: add(view.position, step), pivot: add(view.pivot, step) };
}

/** Scales the distance to the pivot. */
export function approached(view: ViewState, factor: number): ViewState {
  return { ...view, position: add(view.pivot, add(view.position, view.pivot, -1), factor) };
}

const kFlying: Record<string, readonly number[]> = {
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyQ: [0, 1, 0],
  KeyE: [0, -1, 0],
};
const kArrows: Record<string, readonly [number, number]> = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, -1],
  ArrowDown: [0, 1],
};

/** Gamepads with the standard mapping: https://w3c.github.io/gamepad/#remapping. */
function gamepads(): Gamepad[] {
  try {
    return navigator.getGamepads().filter((pad) => pad !== null && pad.connected && pad.mapping === "standard") as Gamepad[];
  } catch {
    // A page that embeds this one may forbid it.
    return [];
  }
}

export class Controls {
  private readonly held = new Set<string>();
  private isPadHeld = false;
  private readonly fingers = new Map<number, { x: number; y: number }>();
  /** A finger that has not moved since it touched; the last tap; the time of the last double tap. */
  private touched: { id: number; x: number; y: number } | undefined;
  private tapped: { x: number; y: number; at: number } | undefined;
  private doubleTapped = -Infinity;

  constructor(
    private readonly store: PageStore,
    private readonly element: HTMLElement,
    /** Whether gamepads and the wheel are meant for this viewer, not for another one or for the page around it. */
    private readonly isAttended: () => boolean = () => true,
  ) {
    // Whoever touches anything takes over; a wheel does where it moves the view.
    for (const name of ["pointerdown", "keydown"] as const) element.addEventListener(name, () => store.state.flight && store.set({ flight: undefined }));
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      const isAlone = event.pointerType === "touch" && this.fingers.size === 1;
      this.touched = isAlone ? { id: event.pointerId, x: event.offsetX, y: event.offsetY } : undefined;
    });
    element.addEventListener("pointerup", (event) => this.tap(event));
    element.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"] as const) {
      element.addEventListener(name, (event) => this.fingers.delete(event.pointerId));
    }
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener("dblclick", (event) => {
      // Some browsers send dblclick for a double tap as well.
      if (event.timeStamp - this.doubleTapped > kDoubleTapMs) focus(store, element, event.offsetX, event.offsetY);
    });
    element.addEventListener(
      "wheel",
      (event) => {
        if (!this.isAttended() && !event.ctrlKey) return;
        event.preventDefault();
        this.change((view) => approached(view, Math.exp(Math.max(-1, Math.min(1, event.deltaY * 0.0015)))));
      },
      { passive: false },
    );
    element.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.code in kFlying || event.code in kArrows) {
        // So that a press shorter than a frame counts.
        if (!event.repeat) this.press(event.code, kPressSeconds);
        this.held.add(event.code);
        event.preventDefault();
      } else if (event.key === "+" || event.key === "-") {
        this.change((view) => approached(view, event.key === "+" ? 0.85 : 1 / 0.85));
      }
    });
    element.addEventListener("keyup", (event) => this.held.delete(event.code));
    element.addEventListener("blur", () => this.held.clear());
  }

  /** Whether the user is moving the view. */
  get active(): boolean {
    return this.held.size > 0 || this.fingers.size > 0 || this.isPadHeld;
  }

  /** Called before each frame. */
  step(seconds: number): void {
    for (const code of this.held) this.press(code, seconds);
    this.isPadHeld = false;
    if (this.isAttended()) for (const pad of gamepads()) this.fly(pad, seconds);
  }

  /** Left stick: sideways and forward. Right stick: look around. Triggers: down and up. */
  private fly({ axes, buttons }: Gamepad, seconds: number): void {
    const past = (value = 0): number => (Math.abs(value) >= kDeadZone ? value : 0);
    const by = [past(axes[0]), past(buttons[6]?.value) - past(buttons[7]?.value), -past(axes[1])];
    const [right, down] = [past(axes[2]), past(axes[3])];
    if ([...by, right, down].every((value) => value === 0)) return;
    this.isPadHeld = true;
    const world = worldOf(this.store.state);
    this.change((view) => {
      const flown = moved(view, by.map((value) => value * world.speed * seconds));
      return orbited(flown, world, right * kLook * seconds, down * kLook * seconds, "camera");
    });
  }

  private press(code: string, seconds: number): void {
    const world = worldOf(this.store.state);
    const by = kFlying[code];
    const turn = kArrows[code];
    if (by) this.change((view) => moved(view, by.map((value) => value * world.speed * seconds)));
    if (turn) this.change((view) => orbited(view, world, turn[0] * kArrow * seconds, turn[1] * kArrow * seconds, "pivot"));
  }

  private tap(event: PointerEvent): void {
    const { touched, tapped } = this;
    const { offsetX: x, offsetY: y, timeStamp: at } = event;
    this.touched = this.tapped = undefined;
    if (touched?.id !== event.pointerId || Math.hypot(x - touched.x, y - touched.y) > kTapPx) return;
    if (!tapped || at - tapped.at > kDoubleTapMs || Math.hypot(x - tapped.x, y - tapped.y) > kTapPx) {
      this.tapped = { x, y, at };
      return;
    }
    this.doubleTapped = at;
    focus(this.store, this.element, x, y);
  }

  private drag(event: PointerEvent): void {
    const finger = this.fingers.get(event.pointerId);
    if (!finger) return;
    const by = { x: event.clientX - finger.x, y: event.clientY - finger.y };
    const [first, second] = this.fingers.size > 1 ? [...this.fingers.values()] : [];
    const apart = first && second ? Math.hypot(first.x - second.x, first.y - second.y) : 0;
    finger.x = event.clientX;
    finger.y = event.clientY;
    if (first && second) {
      // Two fingers: pinch to zoom, drag to pan.
      const now = Math.hypot(first.x - second.x, first.y - second.y);
      this.change((view) => this.shifted(approached(view, apart / Math.max(1, now)), by, 0.5));
    } else if (event.buttons & 4 || (event.buttons & 1 && event.shiftKey)) {
      this.change((view) => this.shifted(view, by, 1));
    } else if (event.buttons & 2) {
      this.change((view) => orbited(view, worldOf(this.store.state), by.x * kDrag * 0.5, by.y * kDrag * 0.5, "camera"));
    } else {
      this.change((view) => orbited(view, worldOf(this.store.state), by.x * kDrag, by.y * kDrag, "pivot"));
    }
  }

  /** Pans so that the pivot follows the pointer. */
  private shifted(view: ViewState, by: { x: number; y: number }, share: number): ViewState {
    const perPixel = length(add(view.position, view.pivot, -1)) / (view.focal * this.element.clientWidth);
    return moved(view, [-by.x * perPixel * share, -by.y * perPixel * share, 0]);
  }

  private change(how: (view: ViewState) => ViewState): void {
    const { view } = this.store.state;
    if (view) this.store.set({ view: how(view) });
  }
}
