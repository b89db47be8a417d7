// worker-web.ts - the worker in browsers.
// SPDX-License-Identifier: Apache-2.0
import { Service, type Request } from "./service.js";

interface Scope {
  onmessage: ((event: { data: Request }) => void) | null;
  postMessage(message: unknown, transfer: Transferable[]): void;
}
const scope = self as unknown as Scope;

async function load(): Promise<WebAssembly.Module> {
  const answer = await fetch(new URL("./rgs.wasm", import.meta.url));
  if (!answer.ok) throw new Error(`rgs.wasm: HTTP ${answer.status}`);
  // Not compileStreaming(): many servers send the wrong type, and the file is small.
  return WebAssembly.compile(await answer.arrayBuffer());
}

const service = new Service(load, (answer, transfer) => scope.postMessage(answer, transfer));
scope.onmessage = (event) => service.receive(event.data);
