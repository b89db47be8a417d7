// converter.ts - for the page in a folder: the converter is loaded when something is to be saved.
// SPDX-License-Identifier: Apache-2.0
export const loadConverter: (() => Promise<typeof import("@roofgs/convert")>) | undefined = () => import("@roofgs/convert");
