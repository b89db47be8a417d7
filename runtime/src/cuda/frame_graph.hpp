// frame_graph.hpp - a frame's launches as one CUDA graph.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_runtime_api.h>

#include "cuda/device_buffer.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// Captures what a frame launches, and launches it at once. Every frame is captured anew, which takes the host some
/// microseconds and cannot miss a change of camera, size, scene or buffers; the graph that was instantiated before
/// takes over the new arguments, unless other kernels follow each other than then.
class FrameGraph {
 public:
  FrameGraph() = default;
  FrameGraph(const FrameGraph&) = delete;
  FrameGraph& operator=(const FrameGraph&) = delete;
  ~FrameGraph() {
    discard();
    if (launched_ != nullptr) cudaEventDestroy(launched_);
    if (capture_ != nullptr) cudaStreamDestroy(capture_);
  }

  /// Takes what record(s) enqueues on the stream s that it is given. record() returns a Status and does not wait,
  /// allocate or free. Errors: those of record(), device_failed.
  template <class Record>
  Status capture(const Record& record) {
    if (const auto ok = begin(); !ok) return ok;
    const Status recorded = record(capture_);
    cudaGraph_t graph = nullptr;
    Status ok = device_status(cudaStreamEndCapture(capture_, &graph), "a frame could not be captured");
    if (!recorded) ok = recorded;
    if (ok) ok = adopt(graph);
    if (graph != nullptr) cudaGraphDestroy(graph);
    return ok;
  }

  /// Enqueues what was captured last, without an error, on `stream`. Errors: device_failed.
  Status launch(cudaStream_t stream) {
    const Status ok = device_status(cudaGraphLaunch(graph_, stream), "a frame's graph could not be launched");
    if (!ok) return ok;
    return device_status(cudaEventRecord(launched_, stream), "an event could not be recorded");
  }

 private:
  Status begin() {
    Status ok;
    // Not the caller's stream: that may be the default one, which cannot be captured.
    if (capture_ == nullptr) {
      ok = device_status(cudaStreamCreateWithFlags(&capture_, cudaStreamNonBlocking), "a stream could not be made");
    }
    if (ok && launched_ == nullptr) {
      ok = device_status(cudaEventCreateWithFlags(&launched_, cudaEventDisableTiming), "an event could not be made");
    }
    // Relaxed: other threads, and the loading of a kernel on its first launch, may do as they like.
    if (ok) {
      ok = device_status(cudaStreamBeginCapture(capture_, cudaStreamCaptureModeRelaxed),
                         "a frame could not be captured");
    }
    return ok;
  }

  Status adopt(cudaGraph_t graph) {
    if (graph_ != nullptr) {
      cudaGraphExecUpdateResultInfo result{};
      if (cudaGraphExecUpdate(graph_, graph, &result) == cudaSuccess) return {};
      cudaGetLastError();  // it is no error of later calls
      discard();
    }
    return device_status(cudaGraphInstantiate(&graph_, graph, 0), "a frame's graph could not be instantiated");
  }

  void discard() {
    if (graph_ == nullptr) return;
    cudaEventSynchronize(launched_);  // it may still be at work
    cudaGraphExecDestroy(graph_);
    graph_ = nullptr;
  }

  cudaStream_t capture_ = nullptr;
  cudaEvent_t launched_ = nullptr;
  cudaGraphExec_t graph_ = nullptr;
};

}  // namespace rgs::detail
