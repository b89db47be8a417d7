// store.ts - one state, and views that follow it.
// SPDX-License-Identifier: Apache-2.0

export class Store<State extends object> {
  private readonly views: (() => void)[] = [];
  private hasEnded = false;

  constructor(private current: Readonly<State>) {}

  /** No view is called any more. */
  end(): void {
    this.hasEnded = true;
    this.views.length = 0;
  }

  get state(): Readonly<State> {
    return this.current;
  }

  /** Changes some fields. Before it returns, it calls the views of these fields in the order of their subscriptions. A view may call it too. */
  set(patch: Partial<State>): void {
    this.current = { ...this.current, ...patch };
    for (const view of this.views) view();
  }

  /** Calls `view` at once, and whenever a value that `select` returns has changed: with these values, and with those of the call before. */
  subscribe<const Values extends readonly unknown[]>(select: (state: Readonly<State>) => Values, view: (values: Values, before: Values | undefined) => void): void {
    let last: Values | undefined;
    const update = (): void => {
      const [values, before] = [select(this.current), last];
      if (before && values.every((value, i) => Object.is(value, before[i]))) return;
      last = values;
      view(values, before);
    };
    if (this.hasEnded) return;
    this.views.push(update);
    update();
  }
}
