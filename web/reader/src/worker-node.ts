// worker-node.ts - the worker thread in Node.
// SPDX-License-Identifier: Apache-2.0
import { readFile } from "node:fs/promises";
import { parentPort, type TransferListItem } from "node:worker_threads";
import { Service, type Request } from "./service.js";

if (!parentPort) throw new Error("worker-node.js runs in a worker thread");
const port = parentPort;

async function load(): Promise<WebAssembly.Module> {
  return WebAssembly.compile(await readFile(new URL("./rgs.wasm", import.meta.url)));
}

const service = new Service(load, (answer, transfer) => port.postMessage(answer, transfer as TransferListItem[]));
port.on("message", (request: Request) => service.receive(request));
