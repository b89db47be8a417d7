// run.cpp - start and end of the command-line programs, also where memory or threads are scarce.
// SPDX-License-Identifier: Apache-2.0
#include <tbb/global_control.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <new>
#include <stdexcept>
#include <string>
#include <string_view>
#include <thread>

#include "console.hpp"
#include "rgs/file.hpp"
#include "startable_threads.hpp"
#include "system.hpp"

namespace rgs::tool {
namespace {

int report_out_of_memory() {
  return report({}, {.code = Errc::host_out_of_memory, .what = "out of memory"});
}

// errno of a thread that could not be started, 0 for any other exception. Only its text says so: oneTBB throws its own.
int thread_error(const std::exception& e) {
  const std::string_view what = e.what();
  for (const int error : {EAGAIN, ENOMEM})
    if (what.find(error_text(error)) != what.npos) return error;
  return 0;
}

int guarded(const std::function<int()>& body) {
  try {
    return body();
  } catch (const std::bad_alloc&) {
    return report_out_of_memory();
  } catch (const std::length_error&) {  // of a container that cannot grow so far
    return report_out_of_memory();
  } catch (const std::exception& e) {
    if (const int error = thread_error(e); error != 0)
      return report({}, {.code = Errc::host_out_of_memory, .what = "cannot start a thread", .system = error});
    const std::string what = printable(e.what());
    return report({}, {.code = Errc::internal, .what = what.c_str()});
  }
}

// For exceptions that nothing can catch, of oneTBB's own threads. Allocates nothing.
void end_for_lack() {
  try {
    if (std::current_exception()) throw;
  } catch (const std::exception& e) {
    if (thread_error(e) != 0 || dynamic_cast<const std::bad_alloc*>(&e) != nullptr) {
      static constexpr std::string_view kText =
          ": too few threads or too little memory to run [host_out_of_memory]\n"
          "  hint: raise the limits on processes and memory (Linux: ulimit -u, ulimit -v)\n";
      for (const std::string_view part : {std::string_view(program_name()), kText})
        if (::write(STDERR_FILENO, part.data(), static_cast<unsigned>(part.size())) < 0) break;
      ::_exit(kInputOutput);
    }
  } catch (...) {
  }
  std::abort();
}

}  // namespace

int run(const std::function<int()>& body) {
  std::set_terminate(end_for_lack);
  prepare_standard_streams();
  remove_temporaries_on_signal();
  return finish(guarded([&body] {
    // Where threads are scarce, oneTBB uses half of them and leaves the others to readers and writers. Once it fails to
    // start one it has no way back. The limit is never lifted: that would start threads.
    const unsigned wanted = std::max(1U, std::thread::hardware_concurrency()) - 1, n = startable_threads(wanted);
    [[maybe_unused]] static const tbb::global_control* few = nullptr;
    if (n < wanted) few = new tbb::global_control(tbb::global_control::max_allowed_parallelism, 1 + n / 2);
    return body();
  }));
}

}  // namespace rgs::tool
