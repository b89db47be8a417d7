// lines.ts - lines over a picture of WebGPU.
// SPDX-License-Identifier: Apache-2.0
import type { Pinhole } from "@roofgs/webgpu";
import { add, axisOf, dot } from "./cameras.js";
import { kBoxColour } from "./renderer.js";

const kCode = /* wgsl */ `
@vertex
fn end(@location(0) at: vec4f) -> @builtin(position) vec4f {
  return at;
}
@fragment
fn colour() -> @location(0) vec4f {
  return vec4f(${kBoxColour.join()}, 1.0);
}
`;

/** A point of the world in clip coordinates: w is its depth. */
function project(point: readonly number[], { width, height, fx, fy, cx = width / 2, cy = height / 2, position, rotation }: Pinhole): number[] {
  const from = add(point, position, -1);
  const [x, y, z] = [0, 1, 2].map((column) => dot(axisOf(rotation, column), from)) as [number, number, number];
  return [(2 * (fx * x + cx * z)) / width - z, z - (2 * (fy * y + cy * z)) / height, 0.5 * z, z];
}

export class Lines {
  private readonly pipeline: GPURenderPipeline;

  constructor(
    private readonly device: GPUDevice,
    format: GPUTextureFormat,
  ) {
    const module = device.createShaderModule({ label: "lines", code: kCode });
    this.pipeline = device.createRenderPipeline({
      layout: "auto",
      vertex: { module, buffers: [{ arrayStride: 16, attributes: [{ shaderLocation: 0, offset: 0, format: "float32x4" }] }] },
      fragment: { module, targets: [{ format }] },
      primitive: { topology: "line-list" },
    });
  }

  /** `ends`: of each line, world. */
  draw(view: GPUTextureView, ends: readonly (readonly number[])[], pinhole: Pinhole): void {
    const { device } = this;
    const corners = Float32Array.from(ends.flatMap((end) => project(end, pinhole)));
    const buffer = device.createBuffer({ size: corners.byteLength, usage: GPUBufferUsage.VERTEX | GPUBufferUsage.COPY_DST });
    device.queue.writeBuffer(buffer, 0, corners);
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "load", storeOp: "store" }] });
    pass.setPipeline(this.pipeline);
    pass.setVertexBuffer(0, buffer);
    pass.draw(ends.length);
    pass.end();
    device.queue.submit([encoder.finish()]);
    buffer.destroy();
  }
}
