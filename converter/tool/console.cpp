// console.cpp - error reports, progress and number formats of the command-line programs.
// SPDX-License-Identifier: Apache-2.0
#include "console.hpp"

#include <fmt/format.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <nlohmann/json.hpp>
#include <system_error>

#include "info_escape.hpp"
#include "system.hpp"

namespace rgs::tool {
namespace {

constexpr auto kRedraw = std::chrono::milliseconds(100);
constexpr auto kLogLine = std::chrono::seconds(10);

std::string number(const Error& error, std::uint64_t value) {
  return error.code == Errc::checksum_mismatch ? fmt::format("{:016x}", value) : format_count(value);
}

constexpr std::size_t kLongestText = 8192;  // bytes; paths end at 4096

// The name by which the program was called, which can be anything.
std::string program() {
  return printable(program_name());
}

// errno of the first failed write to standard output or standard error; 0 if none failed.
std::atomic<int> g_output_error{0}, g_message_error{0};

void write(std::FILE* stream, std::string_view text, std::atomic<int>& failed) {
  errno = 0;
  if (std::fwrite(text.data(), 1, text.size(), stream) == text.size()) return;
  int none = 0;
  failed.compare_exchange_strong(none, errno != 0 ? errno : EIO);
}

struct Failpoint {
  std::string stage;
  std::uint64_t units = 0;
  int signal = 0;
};

const Failpoint& chosen_failpoint() {
  static const Failpoint read = [] {
    Failpoint point;
    const char* const value = std::getenv("RGS_FAILPOINT");
    const std::string_view text(value == nullptr ? "" : value);
    const std::size_t first = text.find(':'), second = text.find(':', first + 1);
    if (first == text.npos || second == text.npos) return point;
    point.stage = text.substr(0, first);
    std::from_chars(text.data() + first + 1, text.data() + second, point.units);
    std::from_chars(text.data() + second + 1, text.data() + text.size(), point.signal);
    return point;
  }();
  return read;
}

bool json_messages() {
  static const bool wanted = [] {
    const char* value = std::getenv("RGS_MESSAGES");
    return value != nullptr && std::string_view(value) == "json";
  }();
  return wanted;
}

// A line for a calling program: names unchanged, except for bytes that are not UTF-8.
std::string json_line(const char* kind, const nlohmann::ordered_json& value) {
  const nlohmann::ordered_json message{{kind, value}};
  return message.dump(-1, ' ', true, nlohmann::json::error_handler_t::replace) + "\n";
}

nlohmann::ordered_json known(std::uint64_t value) {
  return value == Error::kNone ? nlohmann::ordered_json(nullptr) : nlohmann::ordered_json(value);
}

}  // namespace

std::string error_message(std::string_view file, const Error& error, std::string_view message) {
  return json_line("error", {{"code", errc_name(error.code)},
                             {"file", file.empty() ? nlohmann::ordered_json(nullptr) : nlohmann::ordered_json(file)},
                             {"offset", known(error.offset)},
                             {"expected", known(error.expected)},
                             {"found", known(error.found)},
                             {"system", error.system},
                             {"message", message},
                             {"hint", hint(error)}});
}

int worse_exit_code(int a, int b) {
  for (const int code : {kInternal, kInputOutput, kUsage, kMalformed, kIncomplete, kGate})
    if (a == code || b == code) return code;
  return std::max(a, b);
}

std::string describe(const Error& error) {
  std::string text = error.what;
  // A record of a file is identified by Error::found, one of an array, which has no bytes, by Error::offset.
  constexpr std::string_view kRecord = "this index";
  const std::size_t at = text.find(kRecord);
  const bool is_record = at != text.npos, in_array = is_record && error.found == Error::kNone;
  const std::uint64_t index = in_array ? error.offset : error.found;
  if (is_record && index != Error::kNone) text.replace(at, kRecord.size(), "index " + number(error, index));
  if (!in_array && error.offset != Error::kNone) text = fmt::format("byte {}: ", error.offset) + text;
  const bool expected = error.expected != Error::kNone, found = !is_record && error.found != Error::kNone;
  if (expected && found) {
    text += fmt::format(" (expected {}, found {})", number(error, error.expected), number(error, error.found));
  } else if (expected) {
    text += fmt::format(" (expected {})", number(error, error.expected));
  } else if (found) {
    text += fmt::format(" (found {})", number(error, error.found));
  }
  if (error.system != 0) text += ": " + std::generic_category().message(error.system);
  return text;
}

const char* hint(const Error& error) {
  switch (error.system) {
#ifdef EDQUOT
    case EDQUOT:
#endif
    case ENOSPC: return "free some space or write to another disk";
    case EACCES:
    case EPERM: return "check the permissions of the file and its folder";
    case ENOENT: return "check the spelling; relative paths start at the current folder";
    case EAGAIN: return "raise the limits on processes and memory (Linux: ulimit -u, ulimit -v)";
    case EMFILE: return "raise the limit on open files (Linux: ulimit -n)";
    default: break;
  }
  switch (error.code) {
    case Errc::internal: return "this is a bug in the program; please report it with the command line";
    case Errc::truncated:
    case Errc::size_mismatch: return "the file is incomplete; copy or convert it again";
    case Errc::checksum_mismatch: return "the file is damaged; copy or convert it again";
    case Errc::limit_exceeded:
      if (std::string_view(error.what).find("max_expansion") == std::string_view::npos) return "";
      return "if you trust the file, allow more: --max-expansion RATIO or a size such as 8GB";
    case Errc::bad_magic: return "the file has another format; its content decides, not its name";
    case Errc::host_out_of_memory: return "raise the memory limit (Linux: ulimit -v), or use a machine with more";
    default: return "";
  }
}

int report(const std::string& file, const Error& error) {
  if (json_messages()) {
    print_error(error_message(file, error, describe(error)));
    return exit_code(error.code);
  }
  const char* advice = hint(error);
  std::string text = fmt::format("{}: {}{}{} [{}]\n", program(), printable(file), file.empty() ? "" : ": ",
                                 describe(error), errc_name(error.code));
  if (*advice != '\0') text += fmt::format("  hint: {}\n", advice);
  print_error(text);
  return exit_code(error.code);
}

int report_usage(std::string_view message) {
  if (json_messages()) {
    print_error(error_message({}, {.code = Errc::bad_argument}, message));
    return kUsage;
  }
  print_error(fmt::format("{0}: {1}\nRun {0} --help for usage.\n", program(), printable(message)));
  return kUsage;
}

int finish(int code) {
  flush();
  if (code != kSuccess && code != kGate) return code;
  if (const int error = g_output_error; error != 0) {
    return report("standard output",
                  {Errc::write_failed, Error::kNone, "cannot be written", Error::kNone, Error::kNone, error});
  }
  return g_message_error != 0 ? kInputOutput : code;
}

void print(std::string_view text) {
  write(stdout, text, g_output_error);
}

void print_to_pipe(std::string_view text) {
  write(stdout, text, g_output_error);
  flush();
  for (int closed : {EPIPE, EINVAL}) g_output_error.compare_exchange_strong(closed, 0);  // EINVAL: on Windows
}

void print_error(std::string_view text) {
  write(stderr, text, g_message_error);
}

void flush() {
  errno = 0;
  int none = 0;
  if (std::fflush(stdout) != 0) g_output_error.compare_exchange_strong(none, errno != 0 ? errno : EIO);
}

std::string printable(std::string_view text) {
  return escape_untrusted(text, false, kLongestText);
}

std::string format_bytes(std::uint64_t bytes) {
  constexpr std::array kUnits{"B", "kB", "MB", "GB", "TB", "PB", "EB"};
  double value = static_cast<double>(bytes);
  std::size_t unit = 0;
  for (; value >= 999.95 && unit + 1 < kUnits.size(); ++unit) value /= 1000;
  return unit == 0 ? fmt::format("{} B", bytes) : fmt::format("{:.1f} {}", value, kUnits[unit]);
}

std::string format_size_change(std::uint64_t before, std::uint64_t after) {
  if (before == after) return "same size";
  if (after == 0) return "empty";
  if (before == 0) return "larger than nothing";
  const double factor = static_cast<double>(before) / static_cast<double>(after);
  const std::string times = fmt::format("{:.2f}x", std::max(factor, 1 / factor));
  if (times == "1.00x") return "nearly the same size";
  return times + (factor > 1 ? " smaller" : " larger");
}

std::string format_count(std::uint64_t count) {
  std::string digits = std::to_string(count);
  for (std::size_t i = digits.size(); i > 3; i -= 3) digits.insert(i - 3, 1, ',');
  return digits;
}

std::string format_seconds(double seconds) {
  if (!(seconds >= 0)) return "?";
  if (seconds < 0.9995e-3) return fmt::format("{:.0f} us", seconds * 1e6);
  if (seconds < 0.9995) return fmt::format("{:.3g} ms", seconds * 1e3);
  if (seconds < 99.95) return fmt::format("{:.3g} s", seconds);
  const double whole = std::round(seconds), hours = std::floor(whole / 3600), minutes = std::floor(whole / 60);
  if (hours >= 1) return fmt::format("{:.0f} h {:02.0f} min", hours, minutes - hours * 60);
  return fmt::format("{:.0f} min {:02.0f} s", minutes, whole - minutes * 60);
}

Result<std::uint64_t> parse_count(std::string_view text) {
  const auto refused = make_error(Errc::bad_argument, Error::kNone, "not a count such as 250000, 200k or 1.5M");
  // Shifts decimal digits exactly: counts do not pass through floating point.
  int shift = 0;
  if (!text.empty()) {
    switch (text.back()) {
      case 'k':
      case 'K': shift = 3; break;
      case 'm':
      case 'M': shift = 6; break;
      case 'g':
      case 'G': shift = 9; break;
      default: break;
    }
    if (shift != 0) text.remove_suffix(1);
  }
  const std::size_t point = text.find('.');
  std::string digits(text.substr(0, point));
  std::string_view fraction = point == std::string_view::npos ? std::string_view() : text.substr(point + 1);
  if (digits.empty() || (point != std::string_view::npos && fraction.empty())) return refused;
  while (!fraction.empty() && fraction.back() == '0') fraction.remove_suffix(1);
  if (fraction.size() > static_cast<std::size_t>(shift)) return refused;
  digits += fraction;
  digits.append(static_cast<std::size_t>(shift) - fraction.size(), '0');
  std::uint64_t count = 0;
  const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), count);
  if (error != std::errc() || end != digits.data() + digits.size()) return refused;
  return count;
}

Result<std::uint64_t> parse_bytes(std::string_view text) {
  const auto refused = make_error(Errc::bad_argument, Error::kNone, "takes a size such as 8GB, below 16EiB");
  constexpr std::string_view kDigits = "0123456789", kSpaces = " \t\r\n", kPrefixes = "kKmMgGtTpPeE";
  const auto take = [&text](std::string_view which, std::size_t most = std::string_view::npos) {
    const std::string_view taken = text.substr(0, std::min(most, text.find_first_not_of(which)));
    text.remove_prefix(taken.size());
    return taken;
  };
  take(kSpaces);
  const std::string_view digits = take(kDigits);
  const bool has_point = !take(".", 1).empty();
  const std::string_view fraction = has_point ? take(kDigits) : std::string_view();
  take(kSpaces);
  std::uint64_t unit = 1;
  if (const std::string_view prefix = take(kPrefixes, 1); !prefix.empty()) {
    const std::uint64_t base = take("iI", 1).empty() ? 1000 : 1024;
    for (std::size_t i = 0; i <= kPrefixes.find(prefix) / 2; ++i) unit *= base;
  }
  take("bB", 1);
  take(kSpaces);
  if (!text.empty() || has_point == fraction.empty()) return refused;
  // Exact, from the last digit on: what a division drops is less than a byte and never makes up a whole one. `part`
  // stays below a unit, so ten times that, at most 10 * 2^60, fits.
  std::uint64_t part = 0;
  for (std::size_t i = fraction.size(); i-- > 0;) part = (static_cast<unsigned>(fraction[i] - '0') * unit + part) / 10;
  std::uint64_t whole = 0;
  const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), whole);  // an error if empty
  if (error != std::errc() || whole > (std::numeric_limits<std::uint64_t>::max() - part) / unit) return refused;
  return whole * unit + part;
}

Result<ImageSize> parse_size(std::string_view text) {
  ImageSize size;
  const char *first = text.data(), *last = first + text.size();
  const auto width = std::from_chars(first, last, size.width);
  if (width.ec == std::errc() && width.ptr != last && (*width.ptr == 'x' || *width.ptr == 'X')) {
    const auto height = std::from_chars(width.ptr + 1, last, size.height);
    constexpr int kMaxSide = 65536;
    if (height.ec == std::errc() && height.ptr == last && size.width >= 1 && size.height >= 1 &&
        size.width <= kMaxSide && size.height <= kMaxSide)
      return size;
  }
  return make_error(Errc::bad_argument, Error::kNone, "not an image size such as 1920x1080 (sides 1 to 65536)");
}

void failpoint(const char* stage) {
  const Failpoint& chosen = chosen_failpoint();
  if (chosen.stage == stage && chosen.units == 0) ::raise(chosen.signal);
}

Progress::Progress(Mode mode)
    : quiet_(mode == Mode::quiet), json_(json_messages()), terminal_(!json_ && ::isatty(STDERR_FILENO) != 0) {}

Progress::~Progress() {
  if (open_ && terminal_ && !quiet_) print_error("\r\x1b[K");
}

std::string Progress::amount(double units) const {
  if (std::string_view(unit_) == "B") return format_bytes(static_cast<std::uint64_t>(units));
  if (units < 1e5)
    return units < 10 && units != std::floor(units) ? fmt::format("{:.2f} {}", units, unit_)
                                                    : fmt::format("{:.0f} {}", units, unit_);
  return units < 1e6 ? fmt::format("{:.0f}k {}", units / 1e3, unit_) : fmt::format("{:.2f}M {}", units / 1e6, unit_);
}

void Progress::begin(const char* stage, std::uint64_t total, const char* unit) {
  stage_ = stage;
  unit_ = unit;
  total_ = total;
  done_ = 0;
  open_ = true;
  start_ = Clock::now();
  next_draw_ = (start_ + between_draws()).time_since_epoch().count();
  fails_at_ = chosen_failpoint().stage == stage ? chosen_failpoint().units : 0;
  if (json_ && !quiet_) draw(start_);
  failpoint(stage);
}

Progress::Clock::duration Progress::between_draws() const {
  return terminal_ || json_ ? Clock::duration(kRedraw) : Clock::duration(kLogLine);
}

void Progress::advance(std::uint64_t units) {
  const std::uint64_t before = done_.fetch_add(units, std::memory_order_relaxed);
  if (before < fails_at_ && fails_at_ <= before + units) ::raise(chosen_failpoint().signal);
  if (quiet_) return;
  const auto now = Clock::now();
  auto due = next_draw_.load(std::memory_order_relaxed);
  if (now.time_since_epoch().count() < due) return;
  const auto next = (now + between_draws()).time_since_epoch();
  if (!next_draw_.compare_exchange_strong(due, next.count(), std::memory_order_relaxed)) return;
  const std::lock_guard lock(drawing_);
  draw(now);
}

void Progress::draw(Clock::time_point now) {
  if (json_) {
    print_error(json_line("progress", {{"stage", stage_}, {"done", done_.load()}, {"total", total_}, {"unit", unit_}}));
    return;
  }
  const double seconds = std::chrono::duration<double>(now - start_).count();
  const double done = static_cast<double>(done_.load(std::memory_order_relaxed));
  const double rate = seconds > 0 ? done / seconds : 0;
  std::string line = fmt::format("{:<12} ", stage_);
  if (total_ > 0) {
    const double part = std::min(done / static_cast<double>(total_), 1.0);
    constexpr int kBar = 24;
    const int filled = static_cast<int>(part * kBar);
    if (terminal_) line += fmt::format("[{:=>{}}{: >{}}] ", "", filled, "", kBar - filled);
    line += fmt::format("{:3.0f}%  ", part * 100);
  }
  line += fmt::format("{}  {}/s", amount(done), amount(rate));
  if (total_ > 0 && rate > 0)
    line += fmt::format("  {} left", format_seconds(std::max(static_cast<double>(total_) - done, 0.0) / rate));
  print_error(fmt::format("{}{}{}", terminal_ ? "\r" : "", line, terminal_ ? "\x1b[K" : "\n"));
}

void Progress::finish() {
  if (!open_) return;
  open_ = false;
  if (quiet_) return;
  if (json_) return draw(Clock::now());
  const double seconds = std::chrono::duration<double>(Clock::now() - start_).count();
  const double done = static_cast<double>(done_.load());
  const std::string units = *unit_ == '\0' ? "" : amount(done) + " in ";  // a stage without units shows its time alone
  print_error(fmt::format("{}{:<12} {}{}{}\n", terminal_ ? "\r" : "", stage_, units, format_seconds(seconds),
                          terminal_ ? "\x1b[K" : ""));
}

}  // namespace rgs::tool
