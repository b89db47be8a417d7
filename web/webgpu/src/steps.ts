// steps.ts - kernels with what they read and write, in the order in which a frame runs them.
// SPDX-License-Identifier: Apache-2.0
import { kBlend, kShow } from "./shaders/blend.js";
import { cullOf } from "./shaders/cull.js";
import { kCount, kEmit, kRanges } from "./shaders/lists.js";
import type { Layout } from "./shaders/math.js";
import { projectOf } from "./shaders/project.js";
import { kScan, kSortItems, planOf } from "./shaders/scan.js";
import { kHistogram, kScatter } from "./shaders/sort.js";

/** Of the buffer of numbers of workgroups: three by three words, kDispatch. */
export const kDispatchBytes = 36;

export interface Step {
  readonly pipeline: GPUComputePipeline;
  readonly group: GPUBindGroup;
  /** Numbers along x and y, or where the device finds them. */
  readonly workgroups: readonly number[] | number;
}

type Resource = GPUBuffer | GPUTextureView;
export type Pair = readonly [GPUBuffer, GPUBuffer];

function pipelineOf(device: GPUDevice, label: string, code: string): GPUComputePipelineDescriptor {
  return { label, layout: "auto", compute: { module: device.createShaderModule({ label, code }) } };
}

/** Resources in the order of their bindings. */
export function bind(device: GPUDevice, pipeline: GPUComputePipeline | GPURenderPipeline, resources: readonly Resource[]): GPUBindGroup {
  const entries = resources.map((resource, binding) => ({ binding, resource: "size" in resource ? { buffer: resource } : resource }));
  return device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries });
}

export function run(pass: GPUComputePassEncoder, steps: readonly Step[], indirect: GPUBuffer): void {
  for (const { pipeline, group, workgroups } of steps) {
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, group);
    if (typeof workgroups === "number") pass.dispatchWorkgroupsIndirect(indirect, workgroups);
    else pass.dispatchWorkgroups(workgroups[0] as number, workgroups[1] ?? 1);
  }
}

export class Kernels {
  private readonly passes = new Map<string, GPUBuffer>();
  /** Those that depend on what is drawn, made when they are first needed. */
  private readonly computes = new Map<string, GPUComputePipeline>();
  private readonly shows = new Map<GPUTextureFormat, GPURenderPipeline>();

  private constructor(
    readonly device: GPUDevice,
    private readonly cullStored: GPUComputePipeline,
    readonly scan: GPUComputePipeline,
    readonly planVisible: GPUComputePipeline,
    readonly planEntries: GPUComputePipeline,
    readonly histogram: GPUComputePipeline,
    readonly scatter: GPUComputePipeline,
    readonly count: GPUComputePipeline,
    readonly emit: GPUComputePipeline,
    readonly ranges: GPUComputePipeline,
    readonly blend: GPUComputePipeline,
  ) {}

  static async create(device: GPUDevice): Promise<Kernels> {
    const make = (label: string, code: string): Promise<GPUComputePipeline> => device.createComputePipelineAsync(pipelineOf(device, label, code));
    return new Kernels(
      device,
      ...(await Promise.all([
        make("cull", cullOf("stored")),
        make("scan", kScan),
        make("plan", planOf(0)),
        make("plan", planOf(1)),
        make("histogram", kHistogram),
        make("scatter", kScatter),
        make("count", kCount),
        make("emit", kEmit),
        make("ranges", kRanges),
        make("blend", kBlend),
      ])),
    );
  }

  cull(layout: Layout): GPUComputePipeline {
    return layout === "stored" ? this.cullStored : this.compute(`cull ${layout}`, () => cullOf(layout));
  }

  project(layout: Layout, shDegree: number): GPUComputePipeline {
    return this.compute(`project ${layout} ${shDegree}`, () => projectOf(layout, shDegree));
  }

  show(format: GPUTextureFormat): GPURenderPipeline {
    let pipeline = this.shows.get(format);
    if (!pipeline) {
      const module = this.device.createShaderModule({ label: "show", code: kShow });
      pipeline = this.device.createRenderPipeline({ layout: "auto", vertex: { module }, fragment: { module, targets: [{ format }] } });
      this.shows.set(format, pipeline);
    }
    return pipeline;
  }

  private compute(label: string, code: () => string): GPUComputePipeline {
    let pipeline = this.computes.get(label);
    if (!pipeline) {
      pipeline = this.device.createComputePipeline(pipelineOf(this.device, label, code()));
      this.computes.set(label, pipeline);
    }
    return pipeline;
  }

  /** `Pass` in shaders/scan.ts. */
  pass(...numbers: [counter: number, per: number, shift: number, first: number]): GPUBuffer {
    let buffer = this.passes.get(numbers.join());
    if (!buffer) {
      buffer = this.device.createBuffer({ size: 16, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
      this.device.queue.writeBuffer(buffer, 0, Uint32Array.from(numbers));
      this.passes.set(numbers.join(), buffer);
    }
    return buffer;
  }
}

export class Steps {
  readonly list: Step[] = [];

  constructor(
    private readonly kernels: Kernels,
    private readonly buffers: { readonly counters: GPUBuffer; readonly totals: GPUBuffer; readonly histogram: GPUBuffer },
  ) {}

  add(pipeline: GPUComputePipeline, workgroups: Step["workgroups"], ...resources: Resource[]): void {
    this.list.push({ pipeline, group: bind(this.kernels.device, pipeline, resources), workgroups });
  }

  /** Exclusive sums of rows of ceil(counter / per) values, and their totals. */
  sums(counter: number, per: number, values: GPUBuffer, nRows = 1): void {
    const { counters, totals } = this.buffers;
    this.add(this.kernels.scan, [nRows], this.kernels.pass(counter, per, 0, 0), counters, values, totals);
  }

  /** By the lower `bits`. `isNumbered`: values are places. Returns which of both buffers has the result. */
  sort(counter: number, workgroups: number, bits: number, keys: Pair, values: Pair, isNumbered: boolean): 0 | 1 {
    const { counters, totals, histogram } = this.buffers;
    let from: 0 | 1 = 0;
    for (let shift = 0; shift < bits; shift += 8) {
      const to: 0 | 1 = from === 0 ? 1 : 0;
      const pass = this.kernels.pass(counter, kSortItems, shift, Number(isNumbered && shift === 0));
      this.add(this.kernels.histogram, workgroups, pass, counters, keys[from], histogram);
      this.sums(counter, kSortItems, histogram, 256);
      this.add(this.kernels.scatter, workgroups, pass, counters, keys[from], values[from], histogram, totals, keys[to], values[to]);
      from = to;
    }
    return from;
  }
}
