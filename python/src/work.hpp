// work.hpp - how calls from Python run: errors as exceptions, no lock held, interrupts, progress, forked processes.
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

/// Gives Python's lock away for a scope, which must hold it. A thread that wants it back when the interpreter is at its end sleeps
/// until the process ends: Python before 3.14 would unwind it, which std::terminate() answers in a destructor. pybind11's
/// gil_scoped_release does not know that, nor does its gil_scoped_acquire.
class Unlocked {
 public:
  Unlocked() : state_(PyEval_SaveThread()) {}
  ~Unlocked();
  Unlocked(const Unlocked&) = delete;
  Unlocked& operator=(const Unlocked&) = delete;

 private:
  PyThreadState* state_;
};

/// Takes Python's lock for a scope, on any thread.
class Locked {
 public:
  Locked();
  ~Locked() { PyGILState_Release(state_); }
  Locked(const Locked&) = delete;
  Locked& operator=(const Locked&) = delete;

 private:
  PyGILState_STATE state_;
};

/// Before whatever may start threads, or wait for some. A process that was forked from one that had threads of the library has
/// none of them: Failure (unavailable).
void begin_work();
/// Whether this process is such a one. What would wait for threads there is left alone.
bool lost_threads();

/// Thrown by an observer of Progress in the midst of work that was given up; the work catches it.
struct GivenUp {};

/// Stages of some work, told to a Python function by the thread that waits for the work.
class Progress {
 public:
  /// `callback` may be None.
  explicit Progress(pybind11::object callback) : callback_(std::move(callback)) {}
  ~Progress();
  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  /// For the work's threads; throws GivenUp after cancel().
  StageObserver observer();
  void begin(const char* stage, std::uint64_t total, const char* unit);
  void advance(std::uint64_t units) { done_.fetch_add(units, std::memory_order_relaxed); }
  void cancel() { cancelled_ = true; }
  /// Calls the callback, with the lock of Python held: (stage, done, total, unit). total is 0 where nobody knows it.
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

/// Keeps a thread that nobody waits for until the interpreter ends. `ended` is ready when all that the thread does is done.
void leave_behind(std::thread thread, std::future<void> ended);

/// work(), which touches no Python object, on a thread of its own, while this one reports progress and looks for
/// signals (KeyboardInterrupt). One is raised once `cancel` is called and the work has ended; without `cancel` at
/// once, and the work, which must hold all that it uses, ends unheard.
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

/// run() without `cancel`; work that is left behind is asked to stop.
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
