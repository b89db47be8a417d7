// reader-worker-inline.ts - the workers for the single-file page.
// SPDX-License-Identifier: Apache-2.0
import ReaderWorker from "@roofgs/reader/worker?worker&inline";
import ChooserWorker from "./chooser-worker.js?worker&inline";
import SplatsWorker from "./splats-worker.js?worker&inline";

export const worker: (() => Worker) | undefined = () => new ReaderWorker();
export const startChooser = (): Worker => new ChooserWorker();
export const startSplats = (): Worker => new SplatsWorker();
