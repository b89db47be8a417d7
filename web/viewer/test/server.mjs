// server.mjs - what rgs-view does, as far as the page sees it: the page, files by ranges, view.json and frames.
// SPDX-License-Identifier: Apache-2.0
import { createReadStream, existsSync, statSync } from "node:fs";
import { createServer } from "node:http";
import { extname, join, normalize } from "node:path";
import { fileURLToPath } from "node:url";
import { newPage as newPlainPage } from "../../reader/test/chromium.mjs";

export const dist = fileURLToPath(new URL("../dist/", import.meta.url));

/** A page in which `byId(id)` finds an element of the viewer's shadow root. `from`: a browser or a context. */
export async function newPage(from, options) {
  const page = await newPlainPage(from, options);
  await page.addInitScript(() => (window.byId = (id) => document.querySelector("rgs-view").shadowRoot.getElementById(id)));
  return page;
}

const kTypes = { ".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".wasm": "application/wasm", ".json": "application/json", ".png": "image/png" };

/**
 * `root`: folder of the page. `files`: paths below the token by URL. `view`: view.json, or null. `frame(request)`: path of a picture, or { status, error, headers }.
 * `hold(url, begin, bytes)`: answers once this resolves; a number is the status of a refusal. `ranges`: without them every answer is the whole file. Returns the page's
 * address, requests as they came and bytes by URL.
 */
export async function startServer({ root = dist, files = {}, view = null, frame = null, hold, ranges = true } = {}) {
  const requests = [];
  const bytes = {};
  const server = createServer(async (request, answer) => {
    const url = decodeURIComponent(new URL(request.url, "http://x").pathname).replace(/^\/token\//, "");
    requests.push(`${request.method} ${url}`);
    if (request.method === "POST" && url === "frame" && frame) {
      let body = "";
      for await (const part of request) body += part;
      const found = await frame(JSON.parse(body));
      if (typeof found !== "string") {
        answer.writeHead(found.status, { "Content-Type": "application/json", ...found.headers }).end(JSON.stringify({ error: found.error }));
        return;
      }
      answer.writeHead(200, { "Content-Type": "image/png", "X-Render-Ms": "12.5" });
      createReadStream(found).pipe(answer);
      return;
    }
    if (url === "view.json" && view) {
      answer.writeHead(200, { "Content-Type": "application/json" }).end(JSON.stringify(view));
      return;
    }
    const path = files[url] ?? join(root, normalize(url === "" ? "index.html" : url));
    if (!existsSync(path) || url.includes("..")) {
      answer.writeHead(404).end();
      return;
    }
    const { size } = statSync(path);
    const [, from, to] = /^bytes=(\d+)-(\d*)$/.exec((ranges && request.headers.range) || "") ?? [];
    const begin = Number(from ?? 0);
    const end = Math.min(size - 1, to ? Number(to) : size - 1);
    const headers = { "Content-Type": kTypes[extname(path)] ?? "application/octet-stream", "Content-Length": size === 0 ? 0 : end - begin + 1, "Accept-Ranges": ranges ? "bytes" : "none", "Cache-Control": "no-store" };
    if (from !== undefined) headers["Content-Range"] = `bytes ${begin}-${end}/${size}`;
    const held = await hold?.(url, begin, headers["Content-Length"]);
    if (answer.destroyed) return;
    if (typeof held === "number") {
      answer.writeHead(held).end();
      return;
    }
    bytes[url] = (bytes[url] ?? 0) + headers["Content-Length"];
    answer.writeHead(from === undefined ? 200 : 206, headers);
    if (request.method === "HEAD" || size === 0) answer.end();
    else createReadStream(path, { start: begin, end }).pipe(answer);
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  return {
    url: `http://127.0.0.1:${server.address().port}/token/`,
    requests,
    bytes,
    async end() {
      server.closeAllConnections();
      await new Promise((resolve) => server.close(resolve));
    },
  };
}
