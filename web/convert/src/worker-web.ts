// worker-web.ts - the worker in browsers.
// SPDX-License-Identifier: Apache-2.0
import { answer, Failure, type Job } from "./conversion.js";

interface Scope {
  onmessage: ((event: { data: Job }) => void) | null;
  postMessage(message: unknown): void;
}
const scope = self as unknown as Scope;

async function load(): Promise<WebAssembly.Module> {
  const unavailable = (why: unknown): never => {
    throw new Failure({ code: "unavailable", text: `rgs.wasm: ${String(why)}` });
  };
  const found = await fetch(new URL("./rgs.wasm", import.meta.url)).catch(unavailable);
  if (!found.ok) unavailable(`HTTP ${found.status}`);
  // Not compileStreaming(): many servers send the wrong type.
  return WebAssembly.compile(await found.arrayBuffer());
}

scope.onmessage = ({ data }) => void answer(data, load, (message) => scope.postMessage(message));
