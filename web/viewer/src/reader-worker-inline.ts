// reader-worker-inline.ts - the reader's worker for the single-file page.
// SPDX-License-Identifier: Apache-2.0
import ReaderWorker from "@roofgs/reader/worker?worker&inline";

export const worker: (() => Worker) | undefined = () => new ReaderWorker();
