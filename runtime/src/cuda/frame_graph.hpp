// frame_graph.hpp - a frame's launches as one graph.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/cuda_objects.hpp"

namespace rgs::detail {

/// A graph of work. Null, or owned.
class Graph {
 public:
  Graph() = default;
  Graph(const Graph&) = delete;
  Graph& operator=(const Graph&) = delete;
  ~Graph() {
    if (graph_ != nullptr) cudaGraphDestroy(graph_);
  }
  cudaGraph_t get() const { return graph_; }
  cudaGraph_t* put() { return &graph_; }

 private:
  cudaGraph_t graph_ = nullptr;
};

/// A graph made ready to run. It takes a new graph of the same shape at little cost.
class RunnableGraph {
 public:
  RunnableGraph() = default;
  RunnableGraph(const RunnableGraph&) = delete;
  RunnableGraph& operator=(const RunnableGraph&) = delete;
  ~RunnableGraph() { clear(); }

  /// Queues the graph's work. Errors: device_failed.
  Status launch(const Graph& graph, cudaStream_t stream) {
    cudaGraphExecUpdateResultInfo info{};
    if (exec_ != nullptr && cudaGraphExecUpdate(exec_, graph.get(), &info) != cudaSuccess) {
      cudaGetLastError();
      clear();
    }
    Status ok;
    if (exec_ == nullptr) {
      ok = device_status(cudaGraphInstantiate(&exec_, graph.get(), cudaGraphInstantiateFlagUseNodePriority),
                         "a frame's graph could not be made");
    }
    return ok ? device_status(cudaGraphLaunch(exec_, stream), "a frame's graph could not be launched") : ok;
  }

 private:
  void clear() {
    if (exec_ != nullptr) cudaGraphExecDestroy(exec_);
    exec_ = nullptr;
  }

  cudaGraphExec_t exec_ = nullptr;
};

}  // namespace rgs::detail
