// servers.mjs - nginx and tests/support/hostile_server.py on 127.0.0.1.
// SPDX-License-Identifier: Apache-2.0
import { spawn } from "node:child_process";
import { existsSync, mkdirSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { createServer } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";
import { fileURLToPath } from "node:url";

/** Skips a test for lack of a program, or fails it where RGS_REQUIRE_TOOLS says that all are installed. */
export function skip(t, why) {
  if ((process.env.RGS_REQUIRE_TOOLS ?? "0") !== "0") throw new Error(`RGS_REQUIRE_TOOLS is set, but ${why}`);
  t.skip(why);
}

export const kNginx = "/usr/sbin/nginx";
export const hasNginx = existsSync(kNginx);

function freePort() {
  return new Promise((resolve, reject) => {
    const server = createServer();
    server.on("error", reject);
    server.listen(0, "127.0.0.1", () => {
      const { port } = server.address();
      server.close(() => resolve(port));
    });
  });
}

function ended(child) {
  return new Promise((resolve) => {
    if (child.exitCode !== null || child.signalCode !== null) resolve();
    else child.once("exit", resolve);
  });
}

/** Serves a folder. `files`: where to put files; `directives` go into its server block. */
export async function startNginx(directives = "") {
  const folder = mkdtempSync(join(tmpdir(), "rgs-web-nginx-"));
  const files = join(folder, "files");
  mkdirSync(files);
  for (;;) {
    const port = await freePort();
    writeFileSync(
      join(folder, "nginx.conf"),
      `daemon off; master_process off; pid ${folder}/pid; error_log ${folder}/error.log;
       ${process.getuid() === 0 ? "user root;" : ""}
       events {}
       http {
         types { text/html html; text/javascript js; application/wasm wasm; }
         access_log ${folder}/access.log combined; client_body_temp_path ${folder}/t; proxy_temp_path ${folder}/t;
         fastcgi_temp_path ${folder}/t; uwsgi_temp_path ${folder}/t; scgi_temp_path ${folder}/t;
         server { listen 127.0.0.1:${port}; root ${files}; ${directives} }
       }`,
    );
    const child = spawn(kNginx, ["-c", join(folder, "nginx.conf"), "-e", join(folder, "error.log")], { stdio: "ignore" });
    const url = `http://127.0.0.1:${port}`;
    while (child.exitCode === null) {
      const answers = await fetch(url).then((answer) => answer.text(), () => null);
      if (answers === null) {
        await new Promise(setImmediate);
        continue;
      }
      return {
        url,
        files,
        log: () => readFileSync(join(folder, "access.log"), "utf8"),
        async end() {
          child.kill("SIGTERM");
          await ended(child);
          rmSync(folder, { recursive: true });
        },
      };
    }
    // Another process may take a port that was free.
    const why = readFileSync(join(folder, "error.log"), "utf8");
    if (/Address already in use/.test(why)) continue;
    rmSync(folder, { recursive: true });
    throw new Error(`nginx does not start: ${why}`);
  }
}

/** The server that does everything wrong: its addresses are explained in its head. */
export async function startHostileServer() {
  const script = fileURLToPath(new URL("../../../tests/support/hostile_server.py", import.meta.url));
  const child = spawn(process.env.RGS_PYTHON ?? "/usr/bin/python3", ["-B", script], { stdio: ["ignore", "pipe", "inherit"] });
  const lines = [];
  const waiting = new Map();
  /** The first line with this text. */
  const arrival = (text) => new Promise((resolve) => waiting.set(text, resolve));
  const first = arrival("port ");
  createInterface({ input: child.stdout }).on("line", (line) => {
    lines.push(line);
    for (const [text, resolve] of waiting) if (line.includes(text)) resolve(line);
  });
  const port = (await first).split(" ")[1];
  const url = (path) => `http://127.0.0.1:${port}${path}`;
  let nMarks = 0;
  return {
    url,
    /** How many with this text there have been. An answer may be here before the server's line is: a last request's line comes behind all. */
    async requests(text) {
      const mark = `/plain?mark=${(nMarks += 1)}`;
      const marked = arrival(`${mark} `);
      await (await fetch(url(mark))).arrayBuffer();
      await marked;
      return lines.filter((line) => line.startsWith("GET ") && line.includes(text)).length;
    },
    async end() {
      child.kill("SIGTERM");
      await ended(child);
    },
  };
}
