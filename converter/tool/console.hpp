// console.hpp - shared by the command-line programs: start and end, error reports, progress and number formats.
// SPDX-License-Identifier: Apache-2.0
//
// Standard output is for results (parseable with --json); reports and progress go to standard error. Text from a
// command line or a file is escaped (info_escape.hpp) before it is printed on either.
//
// With RGS_MESSAGES=json in the environment, errors and progress are lines of JSON on standard error, for calling
// programs: {"error": {code, file, offset, expected, found, system, message, hint}}, null for absent numbers, and
// {"progress": {stage, done, total, unit}}. Other lines may come between them.
//
// For tests: with RGS_FAILPOINT=STAGE:UNITS:SIGNAL in the environment a process sends itself this signal once STAGE has done
// UNITS (0: at its beginning). SIGSTOP holds it there until SIGCONT.
#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <mutex>
#include <string>
#include <string_view>

#include "rgs/result.hpp"

namespace rgs::tool {

/// Exit codes of every program; a failure's code follows from its class, see Errc.
enum ExitCode : int {
  kSuccess = 0,
  kInternal = 1,
  kUsage = 2,
  kInputOutput = 3,
  kMalformed = 4,
  kGate = 5,
  kIncomplete = 6
};

/// The more telling of two exit codes, for runs over many scenes: 1 (the program), 3 (the machine), 2 (the command), 4
/// (an input), 6 (incomplete), 5 (a condition), 0.
int worse_exit_code(int a, int b);

/// `error` as one line: byte offset, what is wrong, expected and found, the system's reason.
std::string describe(const Error& error);
/// What the user can do about it; empty if the error's text says it.
const char* hint(const Error& error);
/// The line of RGS_MESSAGES=json for an error, where `message` is describe(error) or a text of its own. `file` may be empty.
std::string error_message(std::string_view file, const Error& error, std::string_view message);
/// Prints `PROGRAM: FILE: ERROR` and, if there is one, a hint. Returns the exit code. `file` may be empty; it is escaped.
int report(const std::string& file, const Error& error);
/// Prints `PROGRAM: MESSAGE`, escaped, and how to get help. Returns kUsage.
int report_usage(std::string_view message);
/// Runs a program's body. Before it: reserves the numbers of closed standard streams; makes signals remove unfinished
/// outputs, see remove_temporaries_on_signal(). After it: success and a failed gate become kInputOutput if standard
/// output or standard error could not be written. Prints escaping exceptions: out of memory or of threads becomes
/// kInputOutput, a bug kInternal. Where fewer threads can be started than the machine has, oneTBB gets fewer.
int run(const std::function<int()>& body);
/// Flushes all output. Returns `code`, or kInputOutput for a success or a failed gate whose output could not be written.
int finish(int code);

/// Write to standard output and standard error; never throw. run() checks that all was written. Names in `text` must be
/// escaped.
void print(std::string_view text);
/// print() for a program that ignores SIGPIPE: a reader that closes the pipe early (head) is no failure.
void print_to_pipe(std::string_view text);
void print_error(std::string_view text);
/// Flushes, before another program writes to the same streams.
void flush();
/// A name or value from outside as part of a line: escape_untrusted(), with a limit long enough for paths.
std::string printable(std::string_view text);

/// "193.1 MB", decimal units as file managers and disks count.
std::string format_bytes(std::uint64_t bytes);
/// The change of a size: "4.87x smaller", "1.67x larger", "nearly the same size" (1.00x), "same size", "empty".
std::string format_size_change(std::uint64_t before, std::uint64_t after);
/// "778,812".
std::string format_count(std::uint64_t count);
/// "812 us", "35.2 ms", "1.25 s", "3 min 07 s".
std::string format_seconds(double seconds);

/// A count with an optional decimal part and suffix k, M or G (powers of 1000, case-insensitive): 250000, 200k, 1.5M.
/// bad_argument for anything else, a fraction of one, or above 2^64 - 1.
Result<std::uint64_t> parse_count(std::string_view text);
/// A size in bytes: 4096, 8GB, 3.5 MiB, 512k. A unit's B and case do not matter: kB to EB are powers of 1000, KiB to
/// EiB of 1024. Exact, rounded down to whole bytes. bad_argument for anything else, or above 2^64 - 1.
Result<std::uint64_t> parse_bytes(std::string_view text);
/// An image size "1920x1080"; both sides 1..65536, else bad_argument.
struct ImageSize {
  int width = 0, height = 0;
};
Result<ImageSize> parse_size(std::string_view text);

/// Sends this process the signal of RGS_FAILPOINT if that names `stage` at 0 units. Progress::begin() calls it.
void failpoint(const char* stage);

/// Progress of a program's stages on standard error. On a terminal it redraws one line with bar, rate and remaining
/// time; elsewhere (logs, pipes) each finished stage prints a line, and long ones report every ten seconds.
/// advance() may be called from several threads; begin() and finish() from one.
class Progress {
 public:
  enum class Mode { automatic, quiet };
  explicit Progress(Mode mode = Mode::automatic);
  /// Ends an open stage without reporting it (an error is about to be printed).
  ~Progress();
  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  /// Starts a stage of `total` units; 0 if unknown. The unit "B" is printed as bytes. Texts must outlive the stage.
  void begin(const char* stage, std::uint64_t total, const char* unit);
  void advance(std::uint64_t units);
  void finish();

 private:
  using Clock = std::chrono::steady_clock;
  void draw(Clock::time_point now);
  Clock::duration between_draws() const;
  std::string amount(double units) const;

  bool quiet_ = false, json_ = false, terminal_ = false, open_ = false;
  const char* stage_ = "";
  const char* unit_ = "";
  std::uint64_t total_ = 0;
  std::uint64_t fails_at_ = 0;  // units, by RGS_FAILPOINT; 0: at none
  Clock::time_point start_{};
  std::atomic<std::uint64_t> done_{0};
  std::atomic<Clock::rep> next_draw_{0};  // time since epoch; the thread that advances it draws
  std::mutex drawing_;
};

}  // namespace rgs::tool
