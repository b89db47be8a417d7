// vite.config.ts - the page as a folder that a server serves, and with `--mode single` as one file that needs none.
// SPDX-License-Identifier: Apache-2.0
import { fileURLToPath } from "node:url";
import { defineConfig, type Plugin } from "vite";

const kMarker = "<!-- rgs-view:insert -->";
const kFolderPolicy = [
  "default-src 'none'",
  "script-src 'self' 'wasm-unsafe-eval'",
  // The engine sorts in a worker made from a text, and loads the images of SOG files from blobs.
  "worker-src 'self' blob:",
  "connect-src 'self' blob:",
  "img-src 'self' blob: data:",
];

/** The hash of a text as a content security policy names it. */
async function hashOf(text: string): Promise<string> {
  const digest = await crypto.subtle.digest("SHA-256", new TextEncoder().encode(text));
  return `'sha256-${btoa(String.fromCharCode(...new Uint8Array(digest)))}'`;
}

const meta = (policy: string[]): string => `<meta http-equiv="Content-Security-Policy" content="${policy.join("; ")}">`;

const folderPolicy: Plugin = {
  name: "policy",
  transformIndexHtml: (html) => html.replace("<!-- policy -->", meta(kFolderPolicy)),
};

/** Puts the script into the page, whose policy names it by its hash, and beside it, for pages of others. */
const single: Plugin = {
  name: "single",
  enforce: "post",
  async generateBundle(_options, bundle) {
    let script = "";
    for (const [name, file] of Object.entries(bundle)) {
      if (name.endsWith(".html")) continue;
      if (file.type === "chunk") script += file.code;
      delete bundle[name];
    }
    this.emitFile({ type: "asset", fileName: "rgs-view.js", source: script });
    // Nothing in the script may end its element.
    script = script.replaceAll("</script", "<\\/script").replaceAll("<!--", "<\\!--");
    const policy = [
      "default-src 'none'",
      `script-src ${await hashOf(script)} 'wasm-unsafe-eval'`,
      "worker-src blob:",
      "connect-src blob: data:",
      "img-src blob: data:",
    ];
    for (const file of Object.values(bundle)) {
      if (file.type !== "asset" || !file.fileName.endsWith(".html")) continue;
      file.fileName = "page.html";
      file.source = String(file.source)
        .replace(/<script[^>]*src=[^>]*><\/script>\s*/g, "")
        .replace("<!-- policy -->", () => meta(policy))
        .replace(kMarker, () => `${kMarker}\n<script type="module">${script}</script>`);
    }
  },
};

export default defineConfig(({ mode }) => ({
  base: "./",
  plugins: mode === "single" ? [single] : [folderPolicy],
  // A page from file:// cannot run module workers.
  worker: { format: mode === "single" ? "iife" : "es" },
  resolve:
    mode === "single"
      ? {
          alias: Object.fromEntries(
            Object.entries({ "reader-worker": "reader-worker-inline", "load-engine": "load-engine-inline", converter: "no-converter" }).map(([name, other]) => [
              `./${name}.js`,
              fileURLToPath(new URL(`src/${other}.ts`, import.meta.url)),
            ]),
          ),
        }
      : {},
  build: {
    target: "es2022",
    outDir: mode === "single" ? "dist-single" : "dist",
    modulePreload: false,
    assetsInlineLimit: mode === "single" ? Number.MAX_SAFE_INTEGER : 0,
    chunkSizeWarningLimit: 4000,
    ...(mode === "single" ? { rollupOptions: { output: { codeSplitting: false } } } : {}),
  },
}));
