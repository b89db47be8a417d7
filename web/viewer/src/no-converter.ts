// no-converter.ts - the single-file page has no converter, which would make it half as large again.
// SPDX-License-Identifier: Apache-2.0
export const loadConverter: undefined = undefined;
