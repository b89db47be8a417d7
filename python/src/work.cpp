// work.cpp - runs the work of calls from Python.
// SPDX-License-Identifier: Apache-2.0
#include "work.hpp"

#include <pthread.h>
#include <unistd.h>

#include <vector>

#include "bindings.hpp"
#include "console.hpp"

namespace py = pybind11;

namespace rgs::python {
namespace {

std::atomic<bool> g_has_threads{false}, g_lost_threads{false};

// Never destroyed: a forked process has the entries but not the threads. Guarded by the GIL.
struct Left {
  std::thread thread;
  std::shared_future<void> ended;
};
std::vector<Left>& left() {
  static auto& all = *new std::vector<Left>;
  return all;
}

void join_ended() {
  std::erase_if(left(), [](Left& each) {
    if (each.ended.wait_for(std::chrono::seconds(0)) != std::future_status::ready) return false;
    each.thread.join();
    return true;
  });
}

// Before the interpreter ends, so that no thread outlives what it uses. Another Ctrl-C ends the wait and the process.
void wait_for_threads() {
  if (g_lost_threads) return;
  for (join_ended(); !left().empty(); join_ended()) {
    {
      const std::shared_future<void> first = left().front().ended;  // a copy: other threads may add and remove entries
      const Unlocked unlocked;
      first.wait_for(std::chrono::milliseconds(50));
    }
    if (PyErr_CheckSignals() != 0) {
      for (Left& each : left()) each.thread.detach();
      left().clear();
      throw py::error_already_set();
    }
  }
}

bool is_finalizing() {
#if PY_VERSION_HEX >= 0x030D0000
  return Py_IsFinalizing() != 0;
#else
  return _Py_IsFinalizing() != 0;
#endif
}

// Python ends a thread by unwinding it. That stops here: it must not pass C++ frames and cannot be swallowed.
template <class Take>
auto take_lock(Take take) noexcept {
  try {
    return take();
  } catch (...) {
    for (;;) ::pause();
  }
}

void set_python_error(const Failure& failure) {
  const Error& e = failure.error;
  const auto number = [](std::uint64_t value) -> py::object {
    return value == Error::kNone ? py::object(py::none()) : py::object(py::int_(value));
  };
  py::object file = py::none();
  if (!failure.file.empty()) {
    file = py::reinterpret_steal<py::object>(
        PyUnicode_DecodeFSDefaultAndSize(failure.file.data(), static_cast<Py_ssize_t>(failure.file.size())));
  }
  const py::object error = py::module_::import("roofgs._errors")
                               .attr("make")(errc_name(e.code), tool::describe(e), tool::hint(e), file,
                                             number(e.offset), number(e.expected), number(e.found), e.system);
  PyErr_SetObject(py::type::handle_of(error).ptr(), error.ptr());
}

}  // namespace

Unlocked::~Unlocked() {
  take_lock([&] { PyEval_RestoreThread(state_); });
}

Locked::Locked() : state_(take_lock([] { return PyGILState_Ensure(); })) {}

void begin_work() {
  if (g_lost_threads) {
    refuse(Errc::unavailable,
           "this process was forked after roofgs had started threads, which a fork loses: start workers by 'spawn' or "
           "'forkserver', or load scenes in the workers alone");
  }
  g_has_threads = true;
}

bool lost_threads() {
  return g_lost_threads;
}

// Abandoned work may hold the last reference, on a thread without the GIL.
Progress::~Progress() {
  if (is_finalizing()) {  // the GIL is gone for good
    callback_.release();
    return;
  }
  const Locked locked;
  callback_ = py::object();
}

void Progress::begin(const char* stage, std::uint64_t total, const char* unit) {
  if (cancelled_) throw Cancelled();
  const std::scoped_lock lock(mutex_);
  stage_ = {stage, total, unit, 0};
  done_ = 0;
  open_ = true;
}

void Progress::finish() {
  const std::scoped_lock lock(mutex_);
  stage_.done = done_;
  if (open_) finished_.push_back(stage_);
  open_ = false;
}

StageObserver Progress::observer() {
  StageObserver observer;
  observer.begin = [this](const char* stage, std::uint64_t total, const char* unit) { begin(stage, total, unit); };
  observer.advance = [this](std::uint64_t units) {
    if (cancelled_) throw Cancelled();
    advance(units);
  };
  observer.finish = [this] { finish(); };
  return observer;
}

void Progress::report() {
  if (callback_.is_none()) return;
  std::deque<Stage> stages;
  {
    const std::scoped_lock lock(mutex_);
    stages.swap(finished_);
    if (open_) {
      stage_.done = done_;
      stages.push_back(stage_);
    }
  }
  for (const Stage& s : stages) callback_(s.name, s.done, s.total, s.unit);
}

void leave_behind(std::thread thread, std::future<void> ended) {
  join_ended();
  left().push_back({std::move(thread), std::move(ended)});
}

void bind_work(py::module_& module) {
  py::register_exception_translator([](std::exception_ptr pointer) {
    try {
      if (pointer) std::rethrow_exception(pointer);
    } catch (const Failure& failure) {
      try {
        set_python_error(failure);
      } catch (py::error_already_set& e) {
        e.restore();
      }
    }
  });
  ::pthread_atfork(nullptr, nullptr, [] { g_lost_threads = g_lost_threads || g_has_threads; });
  module.def("_wait_for_threads", &wait_for_threads);
  module.def("_begin_work", &begin_work);
  py::module_::import("atexit").attr("register")(module.attr("_wait_for_threads"));
}

}  // namespace rgs::python
