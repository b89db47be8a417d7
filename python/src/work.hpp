// work.hpp - runs the work of calls from Python: errors as exceptions, the GIL released, interrupts, progress, forks.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/pybind11.h>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <deque>
#include <functional>
#include <future>
#include <memory>
#include <mutex>
#include <stop_token>
#include <string>
#include <thread>
#include <type_traits>
#include <utility>

#include "convert.hpp"
#include "rgs/result.hpp"

namespace rgs::python {

/// An error on its way to Python, where it becomes a roofgs.Error.
struct Failure {
  Error error;
  std::string file;  ///< as the file system spells it; may be empty
};

template <class T>
T take(Result<T>&& result, const std::string& file = {}) {
  if (!result) throw Failure{result.error(), file};
  if constexpr (!std::is_void_v<T>) return *std::move(result);
}
[[noreturn]] inline void refuse(Errc code, const char* what, const std::string& file = {}) {
  throw Failure{{.code = code, .what = what}, file};
}

/// Releases the GIL for a scope that holds it. A thread that wants it back while the interpreter ends sleeps until the process
/// ends: Python before 3.14 would unwind it, which in a destructor is std::terminate(). pybind11's gil_scoped_release and
/// gil_scoped_acquire do not handle that.
class Unlocked {
 public:
  Unlocked() : state_(PyEval_SaveThread()) {}
  ~Unlocked();
  Unlocked(const Unlocked&) = delete;
  Unlocked& operator=(const Unlocked&) = delete;

 private:
  PyThreadState* state_;
};

/// Acquires the GIL for a scope, on any thread.
class Locked {
 public:
  Locked();
  ~Locked() { PyGILState_Release(state_); }
  Locked(const Locked&) = delete;
  Locked& operator=(const Locked&) = delete;

 private:
  PyGILState_STATE state_;
};

/// Call before starting or waiting for threads. A fork of a process with library threads has lost them: Failure (unavailable).
void begin_work();
/// Whether this process is such a fork, in which nothing may wait for threads.
bool lost_threads();

/// Thrown out of a progress observer when the work is cancelled; the work catches it.
struct Cancelled {};

/// Reports stages of work to a Python function, on the thread that waits for the work.
class Progress {
 public:
  /// `callback` may be None.
  explicit Progress(pybind11::object callback) : callback_(std::move(callback)) {}
  ~Progress();
  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  /// For the work's threads; throws Cancelled after cancel().
  StageObserver observer();
  void begin(const char* stage, std::uint64_t total, const char* unit);
  void advance(std::uint64_t units) { done_.fetch_add(units, std::memory_order_relaxed); }
  void cancel() { cancelled_ = true; }
  /// Calls the callback with the GIL held: (stage, done, total, unit). total is 0 if unknown.
  void report();

 private:
  struct Stage {
    const char* name;
    std::uint64_t total;
    const char* unit;
    std::uint64_t done;
  };
  void finish();

  pybind11::object callback_;
  std::atomic<bool> cancelled_{false};
  std::atomic<std::uint64_t> done_{0};
  std::mutex mutex_;  // of the following
  Stage stage_{"", 0, "", 0};
  bool open_ = false;
  std::deque<Stage> finished_;
};

/// Keeps a detached thread until the interpreter ends. `ended` is ready when the thread has finished.
void leave_behind(std::thread thread, std::future<void> ended);

/// Runs work(), which touches no Python object, on a thread of its own, while this thread reports progress and handles signals
/// (KeyboardInterrupt). An interrupt calls `cancel`, waits for the work and raises. Without `cancel` it raises at once; the
/// abandoned work must own all that it uses.
template <class Work>
auto run(Work work, const std::shared_ptr<Progress>& progress, const std::function<void()>& cancel) {
  begin_work();
  using Value = decltype(work());
  std::packaged_task<Value()> task(std::move(work));
  std::future<Value> future = task.get_future();
  std::promise<void> over;
  std::future<void> ended = over.get_future();
  std::thread thread([task = std::move(task), over = std::move(over)]() mutable {
    std::exchange(task, {})();  // and what it holds goes
    over.set_value();
  });
  const auto wait = [&](std::chrono::milliseconds time) {
    const Unlocked unlocked;
    return future.wait_for(time) == std::future_status::ready;
  };
  try {
    while (!wait(std::chrono::milliseconds(50))) {
      if (progress) progress->report();
      if (PyErr_CheckSignals() != 0) throw pybind11::error_already_set();
    }
  } catch (...) {
    if (cancel) {
      cancel();
      const Unlocked unlocked;
      thread.join();
    } else {
      leave_behind(std::move(thread), std::move(ended));
    }
    throw;
  }
  thread.join();
  if (progress) progress->report();
  return future.get();
}

/// run() without `cancel`; abandoned work is asked to stop.
template <class Work>
auto run_stoppable(Work work, const std::shared_ptr<Progress>& progress, std::stop_source stop) {
  try {
    return run(std::move(work), progress, {});
  } catch (const pybind11::error_already_set&) {
    stop.request_stop();
    throw;
  }
}

}  // namespace rgs::python
