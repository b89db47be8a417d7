// page-reads.ts - reads wanted pages, a few at a time, and again what failed: docs/develop/STREAMING.md, "What goes wrong".
// SPDX-License-Identifier: Apache-2.0

/** Most pages in flight. */
const kPagesAtATime = 4;
/** After reads that failed, milliseconds; the pause doubles each time. */
const kFirstPauseMs = 250;
const kLongestPauseMs = 8000;
/** Of a page whose checksum does not match, before it is quarantined. */
const kMostTries = 6;

export interface Trouble {
  /** Reading failed and is tried again until it succeeds; null: it has, or has ended. */
  waiting(error: unknown): void;
  /** The first page is quarantined. */
  damaged(error: unknown): void;
}

export interface Clock {
  /** Milliseconds. */
  now(): number;
  /** Calls `ring` after so many ms, unless what it returns is called before. */
  startTimer(ms: number, ring: () => void): () => void;
}
const kClock: Clock = {
  now: () => performance.now(),
  startTimer: (ms, ring) => {
    const timer = setTimeout(ring, ms);
    return () => clearTimeout(timer);
  },
};

interface Failures {
  /** In a row, for one reason. */
  n: number;
  at: number;
  code?: string | undefined;
}

export class PageReads<T> {
  private readonly inFlight = new Set<number>();
  private readonly quarantined = new Set<number>();
  /** By page, and of the file while nothing of it can be read. */
  private readonly failed = new Map<number, Failures>();
  private unreachable: Failures = { n: 0, at: 0 };
  /** Counts reads that succeeded, and failures of the file. */
  private nNews = 0;
  private list: readonly number[] = [];
  private stopTimer = (): void => undefined;
  private hasEnded = false;

  constructor(
    private readonly read: (page: number) => Promise<T>,
    private readonly on: Trouble & { arrived(page: number, result: T): void },
    private readonly clock = kClock,
  ) {}

  /** Neither arrived nor quarantined. */
  get wanted(): readonly number[] {
    return this.list;
  }

  /** Replaces the wanted pages, the most wanted first. */
  want(pages: readonly number[]): void {
    this.list = pages.filter((page) => !this.quarantined.has(page));
    this.start();
  }

  end(): void {
    this.hasEnded = true;
    this.stopTimer();
    this.succeed();
  }

  private start(): void {
    this.stopTimer();
    if (this.hasEnded) return;
    let next = Infinity;
    for (const page of this.list) {
      if (this.inFlight.size >= kPagesAtATime) return;
      if (this.inFlight.has(page)) continue;
      const left = Math.max(this.pauseLeft(this.unreachable), this.pauseLeft(this.failed.get(page)));
      next = Math.min(next, left || Infinity);
      if (left === 0) void this.readPage(page);
    }
    if (next < Infinity) this.stopTimer = this.clock.startTimer(next, () => this.start());
  }

  private pauseLeft(failures: Failures | undefined): number {
    if (!failures || failures.n === 0) return 0;
    return Math.max(0, failures.at + Math.min(kFirstPauseMs * 2 ** (failures.n - 1), kLongestPauseMs) - this.clock.now());
  }

  private async readPage(page: number): Promise<void> {
    const { nNews } = this;
    this.inFlight.add(page);
    try {
      const result = await this.read(page);
      if (this.hasEnded) return;
      this.inFlight.delete(page);
      this.succeed();
      this.failed.delete(page);
      this.forget(page);
      this.on.arrived(page, result);
    } catch (error) {
      if (this.hasEnded) return;
      this.inFlight.delete(page);
      this.fail(page, error, this.nNews === nNews);
    }
    this.start();
  }

  /** `isAlone`: nothing has been read since it began. */
  private fail(page: number, error: unknown, isAlone: boolean): void {
    const { code } = error as { code?: string };
    const at = this.clock.now();
    const before = this.failed.get(page);
    const n = before && before.code === code ? before.n + 1 : 1;
    this.failed.set(page, { n, at, code });
    if (code !== "read_failed") {
      this.succeed();
      if (code === "checksum_mismatch" && n < kMostTries) return;
      this.quarantined.add(page);
      this.forget(page);
      if (this.quarantined.size === 1) this.on.damaged(error);
    } else if (isAlone) {
      this.nNews += 1;
      this.unreachable = { n: this.unreachable.n + 1, at };
      if (this.unreachable.n === 1) this.on.waiting(error);
    }
  }

  private forget(page: number): void {
    this.list = this.list.filter((each) => each !== page);
  }

  private succeed(): void {
    this.nNews += 1;
    if (this.unreachable.n > 0) this.on.waiting(null);
    this.unreachable = { n: 0, at: 0 };
  }
}
