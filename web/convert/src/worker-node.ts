// worker-node.ts - the worker thread in Node.
// SPDX-License-Identifier: Apache-2.0
import { readFile } from "node:fs/promises";
import { parentPort } from "node:worker_threads";
import { answer, type Job } from "./conversion.js";

if (!parentPort) throw new Error("worker-node.js runs in a worker thread");
const port = parentPort;

async function load(): Promise<WebAssembly.Module> {
  return WebAssembly.compile(await readFile(new URL("./rgs.wasm", import.meta.url)));
}

port.on("message", (job: Job) => void answer(job, load, (message) => port.postMessage(message)));
