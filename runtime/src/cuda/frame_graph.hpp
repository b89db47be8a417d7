// frame_graph.hpp - a frame's launches as one CUDA graph.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_runtime_api.h>

#include "cuda/cuda_objects.hpp"
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
  ~FrameGraph() { discard(); }

  /// Takes what record(s) enqueues on the stream s that it is given. record() returns a Status and does not wait,
  /// allocate or free. Errors: those of record(), device_failed.
  template <class Record>
  Status capture(const Record& record) {
    if (const auto ok = begin(); !ok) return ok;
    const Status recorded = record(capture_.get());
    cudaGraph_t graph = nullptr;
    Status ok = device_status(cudaStreamEndCapture(capture_.get(), &graph), "a frame could not be captured");
    if (!recorded) ok = recorded;
    if (ok) ok = adopt(graph);
    if (graph != nullptr) cudaGraphDestroy(graph);
    return ok;
  }

  /// Enqueues what was captured last, without an error, on `stream`. Errors: device_failed.
  Status launch(cudaStream_t stream) {
    const Status ok = device_status(cudaGraphLaunch(graph_, stream), "a frame's graph could not be launched");
    return ok ? launched_.record(stream) : ok;
  }

 private:
  Status begin() {
    Status ok;
    // Not the caller's stream: that may be the default one, which cannot be captured.
    if (capture_.get() == nullptr) ok = capture_.create();
    if (ok && launched_.get() == nullptr) ok = launched_.create();
    // Relaxed: other threads, and the loading of a kernel on its first launch, may do as they like.
    if (ok) {
      ok = device_status(cudaStreamBeginCapture(capture_.get(), cudaStreamCaptureModeRelaxed),
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
    cudaEventSynchronize(launched_.get());  // it may still be at work
    cudaGraphExecDestroy(graph_);
    graph_ = nullptr;
  }

  OwnedStream capture_;
  Event launched_;
  cudaGraphExec_t graph_ = nullptr;
};

}  // namespace rgs::detail
