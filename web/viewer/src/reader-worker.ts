// reader-worker.ts - the reader's worker: beside the script, as the reader finds it by itself.
// SPDX-License-Identifier: Apache-2.0
export const worker: (() => Worker) | undefined = undefined;
