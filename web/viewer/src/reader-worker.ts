// reader-worker.ts - for the page in a folder: the reader finds its worker by itself.
// SPDX-License-Identifier: Apache-2.0
export const worker: (() => Worker) | undefined = undefined;
