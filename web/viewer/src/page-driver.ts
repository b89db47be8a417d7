// page-driver.ts - carries out what the scheduler of a file's pages decides, and decides nothing: docs/develop/PAGES.md.
// SPDX-License-Identifier: Apache-2.0
import type { Look, PageEvent, PageSchedule, PageScheduler } from "@roofgs/reader";

/** Groups read at a time. */
const kReaders = 3;
/** The scheduler's budget: more than any page's slider allows; keep() takes what the slider does not allow. */
const kMostGaussians = 2 ** 40;
/** Most Gaussians of resident pages, as a multiple of those that a view draws. */
const kKept = 2;

/** In Gaussians, and a group at a time, because each page is a request. */
export const kSchedule: PageSchedule = { budget: kMostGaussians, pageBytes: 0, rowBytes: 1, nReaders: kReaders, mostBytes: 1, gapBytes: 0, prefetches: true };

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

export interface Pages<T> {
  /** The children of a page. */
  childrenOf(page: number): readonly number[];
  read(page: number): Promise<T>;
  /** RgsFile.readTable() */
  readTable(group: number): Promise<PageEvent>;
}

type Fault = "lost" | "checksum" | "damaged";

function faultOf(error: unknown): Fault {
  const { code } = error as { code?: string };
  return code === "read_failed" ? "lost" : code === "checksum_mismatch" ? "checksum" : "damaged";
}

export class PageDriver<T> {
  private readonly view: number;
  private readonly resident = new Map<number, T>();
  private drawn: readonly number[] = [];
  private nBusy = 0;
  /** Idle readers should ask again. */
  private isAwake = false;
  /** Taken of the budget, and whether the last try took more. */
  private taken = 0;
  private isTaken = false;
  /** Could be read. */
  private known = 0;
  /** Counts reads that found bytes, right or wrong. */
  private nFound = 0;
  private isTroubled = false;
  private hasSaidDamage = false;
  private hasEnded = false;
  private stopTimer = (): void => undefined;

  /** `scheduler` is one of kSchedule. */
  constructor(
    private readonly scheduler: PageScheduler,
    private readonly pages: Pages<T>,
    root: T,
    /** `changed`: what look() draws and nWanted may be others now. */
    private readonly on: Trouble & { changed(): void },
    private readonly clock = kClock,
  ) {
    this.view = scheduler.addView();
    this.resident.set(0, root);
  }

  /** Calls `draw` with the resident pages that a camera's picture is drawn from; afterwards they may leave. */
  look(look: Look, draw: (pages: readonly number[]) => void): void {
    if (this.hasEnded) return;
    this.tell(["looks", this.view, look], ["frame", this.view]);
    draw(this.drawn);
    this.tell(["frameEnds", this.view]);
    this.keep(kKept * look.mostGaussians);
    this.ask();
  }

  /** Of those that are drawn. */
  page(page: number): T {
    return this.resident.get(page) as T;
  }

  /** Projected error for the last camera. */
  errorPx(page: number): number {
    return this.scheduler.errorPx(this.view, page);
  }

  /** Groups that are going to change the picture. */
  get nWanted(): number {
    return this.scheduler.nWanted(this.view);
  }

  end(): void {
    this.hasEnded = true;
    this.stopTimer();
    this.setTrouble(null);
  }

  /** Leaves pages room for so many Gaussians; if that takes several steps, the next frame goes on. */
  private keep(nGaussians: number): void {
    const more = kMostGaussians - nGaussians - this.taken;
    if (more === 0) return;
    this.isTaken = true;
    this.tell(more > 0 ? ["take", more] : ["release", -more]);
    if (this.isTaken) this.taken += more;
  }

  private tell(...events: PageEvent[]): void {
    for (const event of events) {
      for (const action of this.scheduler.step([event], this.clock.now())) {
        switch (action.is) {
          case "read":
            void this.work(this.read(action.first, action.n));
            break;
          case "readTable":
            void this.work(this.readTable(action.group));
            break;
          case "probe":
            void this.work(this.probe());
            break;
          case "evict":
            for (const page of this.pages.childrenOf(action.group)) this.resident.delete(page);
            break;
          case "draw":
            this.drawn = action.pages;
            break;
          case "taken":
            this.isTaken = action.isTaken;
            break;
          case "wakeAt":
            this.stopTimer = this.clock.startTimer(action.at - this.clock.now(), () => this.ask());
            break;
          case "wake":
            this.isAwake = true;
        }
      }
    }
  }

  /** Idle readers ask for work until there is none. */
  private ask(): void {
    for (let goesOn = true; goesOn && this.nBusy < kReaders; ) {
      const { nBusy } = this;
      this.stopTimer();
      this.isAwake = false;
      this.tell(["idle"]);
      goesOn = this.nBusy > nBusy || this.isAwake;
    }
  }

  private async work(task: Promise<void>): Promise<void> {
    this.nBusy += 1;
    await task;
    this.nBusy -= 1;
    if (this.hasEnded) return;
    this.tell(["done"]);
    this.ask();
    this.on.changed();
  }

  private async read(first: number, n: number): Promise<void> {
    for (let group = first; group < first + n; ++group) {
      const children = this.pages.childrenOf(group);
      const { nFound } = this;
      const found = await Promise.allSettled(children.map((page) => this.pages.read(page)));
      if (this.hasEnded) return;
      const failed = found.find((each) => each.status === "rejected");
      if (!failed) {
        found.forEach((each, i) => this.resident.set(children[i] as number, (each as PromiseFulfilledResult<T>).value));
        this.known = children[0] as number;
        this.setFound();
        this.tell(["arrived", group]);
        continue;
      }
      const fault = this.fail(failed.reason, nFound, (fault) => ["failed", group, fault === "lost" ? first + n - group : 1, fault]);
      if (fault === "lost") return;
    }
  }

  private async readTable(group: number): Promise<void> {
    const { nFound } = this;
    const grew = await this.pages.readTable(group).catch((error: unknown) => {
      if (!this.hasEnded) this.fail(error, nFound, (fault) => ["tableFailed", fault]);
    });
    if (!grew || this.hasEnded) return;
    this.setFound();
    this.tell(grew);
  }

  /** `nFound`: before the read. */
  private fail(error: unknown, nFound: number, event: (fault: Fault) => PageEvent): Fault {
    const fault = faultOf(error);
    if (fault !== "lost") this.setFound();
    else if (this.nFound === nFound) this.setTrouble(error);
    const { nQuarantined } = this.scheduler;
    this.tell(event(fault));
    if (this.scheduler.nQuarantined > nQuarantined) this.sayDamage(error);
    return fault;
  }

  private async probe(): Promise<void> {
    const isThere = await this.pages.read(this.known).then(() => true, () => false);
    if (!this.hasEnded) this.tell(["probed", isThere]);
  }

  private setFound(): void {
    this.nFound += 1;
    this.setTrouble(null);
  }

  private setTrouble(error: unknown): void {
    const isTroubled = error !== null;
    if (isTroubled !== this.isTroubled) this.on.waiting(error);
    this.isTroubled = isTroubled;
  }

  private sayDamage(error: unknown): void {
    // Pages that the file lacks are said when it is opened.
    if (this.hasSaidDamage || (error as { code?: string }).code === "pages_missing") return;
    this.hasSaidDamage = true;
    this.on.damaged(error);
  }
}
