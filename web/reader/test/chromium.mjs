// chromium.mjs - Debian's Chromium, drawing in software.
// SPDX-License-Identifier: Apache-2.0
import { existsSync } from "node:fs";
import { chromium } from "playwright-core";

const kChromium = process.env.RGS_CHROMIUM ?? "/usr/bin/chromium";
export const hasChromium = existsSync(kChromium);

const kDevices = {
  webgl2: ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
  // The page is composed by SwiftShader's Vulkan too: a canvas of WebGPU cannot be shown otherwise, and the device is destroyed as soon
  // as a page asks for the canvas's texture.
  webgpu: ["--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--use-angle=swiftshader", "--enable-features=Vulkan", "--use-vulkan=swiftshader"],
};
export const kDeviceNames = Object.keys(kDevices);

/** A browser that can draw by a device, or need not draw. */
export function launch(device) {
  return chromium.launch({ executablePath: kChromium, timeout: 0, args: ["--no-sandbox", "--disable-dev-shm-usage", ...(device ? kDevices[device] : [])] });
}

/** A page that is waited for as long as it takes: --test-timeout alone ends a test that hangs. `from`: a browser or a context. */
export async function newPage(from, options) {
  const page = await from.newPage(options);
  page.setDefaultTimeout(0);
  return page;
}
