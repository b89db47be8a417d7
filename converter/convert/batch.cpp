// batch.cpp - converts each scene in a process of its own: damage, lack of memory or a bug in one does not end the
// others.
// SPDX-License-Identifier: Apache-2.0
//
// The parent stays single-threaded, so that plain fork() is safe: it lists, waits, writes the state and prints. A child
// converts one scene and sends one line of JSON through a pipe. It gets a signal when its parent dies.
#include "batch.hpp"

#include <fmt/format.h>
#include <poll.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/signalfd.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstring>
#include <filesystem>
#include <map>
#include <new>
#include <nlohmann/json.hpp>
#include <span>
#include <stdexcept>
#include <utility>

#include "batch_state.hpp"
#include "console.hpp"
#include "convert_summary.hpp"
#include "rgs/file.hpp"
#include "scene_list.hpp"

namespace rgs {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;
using Clock = std::chrono::steady_clock;

constexpr const char* kSchema = "rgs-convert-scene/1";

std::string dump(const Json& json) {
  return json.dump(-1, ' ', true, Json::error_handler_t::replace);
}

Json error_json(const std::string& file, const Error& error) {
  const auto number = [](std::uint64_t value) { return value == Error::kNone ? Json() : Json(value); };
  return {{"code", errc_name(error.code)},
          {"file", file},
          {"offset", number(error.offset)},
          {"message", tool::describe(error)},
          {"hint", tool::hint(error)}};
}

Json failure_json(const Failure& failure) {
  return {{"status", "failed"},
          {"exit_code", exit_code(failure.error.code)},
          {"error", error_json(failure.file, failure.error)}};
}

// Sends the child's line, in full or not at all: it may be killed at any moment.
void send(int fd, std::string text) {
  text += '\n';
  for (std::string_view left = text; !left.empty();) {
    const ssize_t n = ::write(fd, left.data(), left.size());
    if (n < 0 && errno == EINTR) continue;
    if (n <= 0) return;
    left.remove_prefix(static_cast<std::size_t>(n));
  }
}

Json record_json(const BatchRecord& record) {
  return {{"input_path", record.input_path},
          {"input", record.input},
          {"made", record.made},
          {"input_stamp", record.input_stamp},
          {"made_stamp", record.made_stamp}};
}

// An input's name in records, which need not be UTF-8.
std::string full_path(const std::string& path) {
  std::error_code failed;
  const fs::path full = fs::absolute(path, failed);
  return tool::printable((failed ? fs::path(path) : full).lexically_normal().string());
}

Json output_exists(const BatchScene& scene) {
  return failure_json({scene.output_path,
                       {Errc::output_exists, Error::kNone,
                        "the output exists and was not made from this input here; move it away, or "
                        "pass --overwrite to replace it"}});
}

// Whether a file that cannot be read is damaged, and not of another kind or a newer version.
bool is_damage(Errc code) {
  switch (code) {
    case Errc::unsupported_version:
    case Errc::unknown_required:
    case Errc::unsupported_codec:
    case Errc::unsupported_feature:
    case Errc::limit_exceeded:
    case Errc::not_gaussian_splats: return false;
    default: return exit_code(code) == tool::kMalformed || exit_code(code) == tool::kIncomplete;
  }
}

bool exists(const BatchScene& scene) {
  std::error_code ignored;
  return fs::exists(scene.output_path, ignored);
}

// Removes what a killed process left of an output: NAME.tmp-XXXXXX, AtomicFile's temporary name.
void remove_unfinished(const std::string& output) {
  std::error_code failed;
  const fs::path place(follow_links(output));
  const std::string mark = place.filename().string() + ".tmp-";
  for (fs::directory_iterator it(place.parent_path(), failed), end; !failed && it != end; it.increment(failed)) {
    const std::string name = it->path().filename().string();
    std::error_code ignored;
    constexpr const char* kLetters = "abcdefghijklmnopqrstuvwxyz012345";
    if (name.size() == mark.size() + 6 && name.starts_with(mark) &&
        name.find_first_not_of(kLetters, mark.size()) == name.npos &&
        it->symlink_status(ignored).type() == fs::file_type::regular)
      fs::remove(it->path(), ignored);
  }
}

std::uint64_t bytes_of(const Json& summary, const char* side) {
  const auto found = summary.find(side);
  return found == summary.end() ? 0 : found->value("bytes", std::uint64_t{0});
}

std::string shard_name(const BatchOptions& options) {
  return options.n_shards == 1 ? "" : fmt::format("{}-of-{}", options.shard, options.n_shards);
}

class Batch {
 public:
  Batch(std::vector<BatchScene> scenes, const BatchOptions& options, const BatchConvert& convert, BatchState state)
      : scenes_(std::move(scenes)),
        lines_(scenes_.size()),
        options_(options),
        convert_(convert),
        state_(std::move(state)),
        progress_(options.quiet || text_lines() ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic) {}

  int run() {
    block_signals();
    std::uint64_t bytes = 0;
    for (std::size_t i = 0; i < scenes_.size(); ++i) {
      if (!settle_without_work(i)) {
        todo_.push_back(i);
        bytes += scenes_[i].bytes;
      }
    }
    // Start the largest first, so that no long one is left for the end.
    if (options_.jobs > 1)
      std::ranges::stable_sort(todo_,
                               [&](std::size_t a, std::size_t b) { return scenes_[a].bytes > scenes_[b].bytes; });
    progress_.begin("scenes", bytes, "B");
    work();
    progress_.finish();
    if (stopped_by_ != 0) return die();
    return finish();
  }

 private:
  struct Child {
    std::size_t scene = 0;
    int fd = -1;
    pid_t id = -1;
    std::string text;
  };

  // ---- checks without a process

  // Whether the existing output was made from this input and is unchanged since.
  bool is_ours(const BatchScene& scene) const {
    const std::string input_path = full_path(scene.input), stamp = stamp_of({&scene.output_path, 1});
    if (state_.was_begun(scene.output, input_path)) return true;
    std::vector<std::string> made;
    for (const BatchRecord& known : state_.find(scene.output)) {
      if (known.input_path != input_path) continue;
      if (known.made_stamp == stamp) return true;
      made.push_back(known.made);
    }
    if (made.empty()) return false;
    const auto now = describe_contents({&scene.output_path, 1});
    return now && std::ranges::find(made, *now) != made.end();
  }

  BatchRecord wanted(const BatchScene& scene) const {
    BatchRecord record;
    record.output = scene.output;
    record.tool = options_.tool, record.options = options_.options_hash;
    record.input_name = tool::printable(fs::path(scene.input).filename().string());
    record.input_path = full_path(scene.input);
    return record;
  }

  bool settle_without_work(std::size_t i) {
    const BatchScene& scene = scenes_[i];
    if (!scene.readable) {
      settle(i, failure_json({scene.name, scene.readable.error()}));
      return true;
    }
    if (options_.overwrite || (options_.check_output && exists(scene))) return false;
    const BatchRecord want = wanted(scene);
    const std::string input_stamp = stamp_of(tool::files_of_scene(scene.input)),
                      made_stamp = stamp_of({&scene.output_path, 1});
    for (const BatchRecord& known : state_.find(scene.output)) {
      if (!known.same_work(want) || input_stamp.empty() || known.input_stamp != input_stamp ||
          known.made_stamp != made_stamp)
        continue;
      settle(i, {{"status", "kept"}, {"exit_code", 0}, {"summary", Json::parse(known.summary, nullptr, false)}});
      return true;
    }
    // The rest requires reading: start() and convert().
    if (!exists(scene) || !state_.find(scene.output).empty() || state_.was_begun(scene.output, want.input_path))
      return false;
    settle(i, output_exists(scene));
    return true;
  }

  // ---- child

  // Reads a touched or replaced file to see whether the work is done already; converts otherwise.
  Json convert(const BatchScene& scene, BatchShare share) {
    BatchRecord record = wanted(scene);
    const std::vector<std::string> files = tool::files_of_scene(scene.input);
    record.input_stamp = stamp_of(files);
    const auto input = describe_contents(files);
    if (!input) return failure_json({scene.name, input.error()});
    record.input = *input;
    if (!options_.overwrite) {
      record.made_stamp = stamp_of({&scene.output_path, 1});
      const auto made = describe_contents({&scene.output_path, 1});
      for (const BatchRecord& known : state_.find(scene.output)) {
        if (!made || !known.same_work(record) || known.input != *input || known.made != *made) continue;
        record.made = *made;
        record.input_path = known.input_path;  // a copy of the input does not take over the output
        return {{"status", "kept"},
                {"exit_code", 0},
                {"summary", Json::parse(known.summary, nullptr, false)},
                {"record", record_json(record)}};
      }
    }
    Json damage;
    if (options_.check_output && exists(scene)) {
      const Status whole = options_.check_output(scene.output_path);
      if (!whole && !is_damage(whole.error().code)) return failure_json({scene.output_path, whole.error()});
      if (!whole) damage = error_json(scene.output_path, whole.error());
      share.overwrite = share.overwrite || !whole;
    }
    if (!share.overwrite && exists(scene)) return output_exists(scene);
    if (share.unfinished && !state_.others_may_work()) remove_unfinished(scene.output_path);
    std::error_code failed;
    const fs::path folder = fs::path(scene.output_path).parent_path();
    fs::create_directories(folder, failed);
    if (failed)
      return failure_json(
          {folder.string(),
           {Errc::write_failed, Error::kNone, "cannot create the folder", Error::kNone, Error::kNone, failed.value()}});
    auto summary = convert_(scene, share);
    if (!summary) {
      Json json = failure_json(summary.error());
      // A point cloud or mesh among the scenes.
      if (!scene.named && summary.error().error.code == Errc::not_gaussian_splats) {
        json["status"] = "skipped";
        json["exit_code"] = 0;
      }
      return json;
    }
    record.made_stamp = stamp_of({&scene.output_path, 1});
    const auto made = describe_contents({&scene.output_path, 1});
    if (!made) return failure_json({scene.output_path, made.error()});
    record.made = *made;
    Json json{{"status", "converted"}, {"exit_code", 0}, {"summary", Json::parse(summary_json(*summary))}};
    if (!damage.is_null()) json["damaged_output"] = std::move(damage);
    // If the input was touched meanwhile, it may have changed before it was opened: without a record it is done again.
    if (stamp_of(files) == record.input_stamp) json["record"] = record_json(record);
    return json;
  }

  [[noreturn]] void be_child(std::size_t i, const BatchShare& share, int fd, pid_t parent) {
    state_.forget();
    ::prctl(PR_SET_PDEATHSIG, SIGTERM);
    ::sigprocmask(SIG_SETMASK, &usual_signals_, nullptr);
    if (::getppid() != parent) ::_exit(tool::kInternal);  // it died before PR_SET_PDEATHSIG
    const BatchScene& scene = scenes_[i];
    Json json;
    try {
      json = convert(scene, share);
    } catch (const std::bad_alloc&) {
      json = failure_json({scene.name, {Errc::host_out_of_memory, Error::kNone, "out of memory"}});
    } catch (const std::length_error&) {
      json = failure_json({scene.name, {Errc::host_out_of_memory, Error::kNone, "out of memory"}});
    } catch (const std::exception& e) {
      json = failure_json({scene.name, {Errc::internal, Error::kNone, e.what()}});
    }
    send(fd, dump(json));
    ::_exit(0);
  }

  // ---- parent

  void block_signals() {
    sigset_t ending;
    ::sigemptyset(&ending);
    for (const int signal_number : {SIGINT, SIGTERM, SIGHUP}) {
      struct sigaction now {};
      if (::sigaction(signal_number, nullptr, &now) == 0 && now.sa_handler != SIG_IGN)
        ::sigaddset(&ending, signal_number);
    }
    ::sigprocmask(SIG_BLOCK, &ending, &usual_signals_);
    signals_ = ::signalfd(-1, &ending, SFD_CLOEXEC | SFD_NONBLOCK);
    if (signals_ < 0) ::sigprocmask(SIG_SETMASK, &usual_signals_, nullptr);  // signals would be lost
  }

  void work() {
    std::size_t next = 0;
    // Starting may fail, so check before each.
    const auto may_start = [&] {
      return next < todo_.size() && stopped_by_ == 0 && (options_.keep_going || n_failed_ == 0);
    };
    while (!children_.empty() || may_start()) {
      while (may_start() && children_.size() < options_.jobs) {
        const auto at_once = static_cast<unsigned>(std::min<std::size_t>(options_.jobs, todo_.size()));
        start(todo_[next++], std::max(1U, options_.threads / at_once));
      }
      if (!children_.empty()) wait();
    }
    n_left_ = todo_.size() - next;
  }

  void start(std::size_t i, unsigned threads) {
    int ends[2] = {-1, -1};
    const BatchScene& scene = scenes_[i];
    const bool is_there = exists(scene);
    const BatchShare share{threads, options_.overwrite || (is_there && is_ours(scene)), state_.was_begun(scene.output)};
    // What a killed process leaves here is ours to replace; a foreign file is only compared.
    if (share.overwrite || !is_there) {
      const Status begun = state_.begin(scene.output, full_path(scene.input), options_.sync);
      if (!begun) return settle(i, failure_json({state_.path(), begun.error()}));
    }
    const pid_t parent = ::getpid();
    if (::pipe(ends) != 0) return cannot_start(i, errno);
    tool::flush();
    const pid_t id = ::fork();
    if (id == 0) {
      ::close(ends[0]);
      be_child(i, share, ends[1], parent);
    }
    const int forked = errno;
    ::close(ends[1]);
    if (id < 0) {
      ::close(ends[0]);
      return cannot_start(i, forked);
    }
    children_.push_back({i, ends[0], id, {}});
  }

  void cannot_start(std::size_t i, int why) {
    note(state_.cancel(scenes_[i].output));
    settle(i, failure_json({scenes_[i].name,
                            {Errc::host_out_of_memory, Error::kNone, "cannot start a process for it", Error::kNone,
                             Error::kNone, why}}));
  }

  void wait() {
    std::vector<pollfd> polled{{signals_, POLLIN, 0}};
    for (const Child& child : children_) polled.push_back({child.fd, POLLIN, 0});
    if (::poll(polled.data(), polled.size(), -1) < 0) return;
    if (polled[0].revents != 0) {
      signalfd_siginfo info{};
      if (::read(signals_, &info, sizeof info) == sizeof info) {
        stopped_by_ = static_cast<int>(info.ssi_signo);
        for (const Child& child : children_) {
          ::kill(child.id, stopped_by_);
          ::kill(child.id, SIGCONT);  // one that is stopped would not hear it
        }
      }
    }
    std::vector<Child> open;
    for (std::size_t k = 0; k < children_.size(); ++k) {
      Child& child = children_[k];
      if (polled[k + 1].revents == 0 || read(child)) open.push_back(std::move(child));
    }
    std::swap(children_, open);
  }

  // Returns false once the child is gone.
  bool read(Child& child) {
    char buffer[65536];
    const ssize_t n = ::read(child.fd, buffer, sizeof buffer);
    if (n > 0) child.text.append(buffer, static_cast<std::size_t>(n));
    if (n > 0 || (n < 0 && errno == EINTR)) return true;
    ::close(child.fd);
    int status = 0;
    while (::waitpid(child.id, &status, 0) < 0 && errno == EINTR) {
    }
    Json json = Json::parse(child.text, nullptr, false);
    if (!json.is_object()) {
      if (stopped_by_ != 0) return false;
      json = failure_json({scenes_[child.scene].name, death(status)});
    } else if (json.contains("error")) {
      note(state_.cancel(scenes_[child.scene].output));
    }
    settle(child.scene, std::move(json));
    progress_.advance(scenes_[child.scene].bytes);
    return false;
  }

  static Error death(int status) {
    if (WIFEXITED(status) && WEXITSTATUS(status) == exit_code(Errc::read_failed))
      return {Errc::read_failed, Error::kNone, "the file shrank or became unreadable while it was read"};
    if (WIFSIGNALED(status) && WTERMSIG(status) == SIGKILL)
      return {Errc::host_out_of_memory, Error::kNone,
              "its process was killed (signal 9): by a user, or by the system for lack of memory"};
    return {Errc::internal, Error::kNone,
            "its process ended without a report; the number is the signal's, or its exit code", Error::kNone,
            static_cast<std::uint64_t>(WIFSIGNALED(status) ? WTERMSIG(status) : WEXITSTATUS(status))};
  }

  // Keeps the first error of the state file; conversion goes on.
  void note(const Status& written) {
    if (!written && state_error_.code != Errc::write_failed) state_error_ = written.error();
  }

  // ---- lines

  bool text_lines() const { return !options_.json && options_.report.empty() && ::isatty(STDOUT_FILENO) == 1; }

  void settle(std::size_t i, Json result) {
    const BatchScene& scene = scenes_[i];
    const std::string status = result.value("status", "failed");
    const int code = result.value("exit_code", static_cast<int>(tool::kInternal));
    if (const auto found = result.find("record"); found != result.end()) {
      BatchRecord record = wanted(scene);
      const auto text = [&](const char* key) { return found->value(key, std::string()); };
      record.input_path = text("input_path");
      record.input = text("input"), record.made = text("made");
      record.input_stamp = text("input_stamp"), record.made_stamp = text("made_stamp");
      record.summary = result["summary"].dump();
      note(state_.add(std::move(record)));
    }
    Json line{{"schema", kSchema}, {"input_path", scene.name}, {"output_path", scene.output}};
    for (const char* key : {"status", "exit_code", "error", "damaged_output"})
      if (const auto found = result.find(key); found != result.end()) line[key] = *found;
    Json summary = result.value("summary", Json::object());
    if (summary.is_object()) {
      summary.erase("schema");
      line.update(summary);
      read_bytes_ += bytes_of(summary, "source");
      made_bytes_ += bytes_of(summary, "output");
    }
    worst_ = tool::worse_exit_code(worst_, code);
    if (status == "failed") ++n_failed_;
    if (status == "skipped") ++n_skipped_;
    if (status == "kept") ++n_kept_;
    if (status == "converted") ++n_converted_;
    if (line.contains("damaged_output")) ++n_damaged_;
    if (result.contains("error") && (status == "failed" || !options_.quiet)) {
      const Json& error = result["error"];
      const std::string hint = error.value("hint", "");
      tool::print_error(fmt::format("rgs-convert: {}: {}{} [{}]\n{}", tool::printable(error.value("file", "")),
                                    status == "skipped" ? "not a scene, skipped: " : "",
                                    tool::printable(error.value("message", "")), error.value("code", ""),
                                    hint.empty() ? "" : "  hint: " + hint + "\n"));
    }
    const std::string text = dump(line) + "\n";
    if (!options_.report.empty()) {
      lines_[i] = text;
    } else if (!text_lines()) {
      tool::print(text);
      tool::flush();
    } else if (status != "failed" && !options_.quiet) {
      tool::print(fmt::format("{} -> {}: {}{}\n", tool::printable(scene.name), tool::printable(scene.output), status,
                              status == "skipped" ? ""
                                                  : ", " + tool::format_size_change(bytes_of(summary, "source"),
                                                                                    bytes_of(summary, "output"))));
      tool::flush();
    }
  }

  int finish() {
    if (!options_.report.empty()) {
      std::string text;
      for (const std::string& line : lines_) text += line;
      auto file = AtomicFile::create(options_.report, {.overwrite = true, .sync = false});
      Status done = file ? file->write_at(0, std::as_bytes(std::span(text))) : Status(tl::unexpected(file.error()));
      if (done) done = file->commit().map([](double) {});
      if (!done) worst_ = tool::worse_exit_code(worst_, tool::report(options_.report, done.error()));
    }
    if (state_error_.code == Errc::write_failed) {
      worst_ = tool::worse_exit_code(worst_, tool::report(state_.path(), state_error_));
      tool::print_error("  scenes converted since then will be converted again\n");
    }
    if (!options_.quiet) tool::print_error(summary());
    return worst_;
  }

  std::string summary() const {
    const auto count = [](std::uint64_t n, const char* what) {
      return n == 0 ? std::string() : fmt::format(", {} {}", tool::format_count(n), what);
    };
    const std::string shard =
        options_.n_shards == 1 ? "" : fmt::format("shard {} of {}: ", options_.shard, options_.n_shards);
    return fmt::format("rgs-convert: {}{} scenes: {} converted{}{}{}{}{}{}, {} -> {}, in {}\n", shard,
                       tool::format_count(scenes_.size()), tool::format_count(n_converted_),
                       count(n_damaged_, "of them in place of damaged outputs"), count(n_kept_, "kept (already done)"),
                       count(n_failed_, "failed"), count(n_skipped_, "skipped (no Gaussian splats)"),
                       count(n_left_, "not begun"), count(options_.n_others, "other files ignored"),
                       tool::format_bytes(read_bytes_), tool::format_bytes(made_bytes_),
                       tool::format_seconds(std::chrono::duration<double>(Clock::now() - start_).count()));
  }

  // Children are gone and have removed unfinished files; this process now dies by the signal it received.
  int die() {
    if (!options_.quiet)
      tool::print_error(fmt::format(
          "rgs-convert: interrupted after {} of {} scenes; run the same command to continue\n",
          tool::format_count(n_converted_ + n_kept_ + n_failed_ + n_skipped_), tool::format_count(scenes_.size())));
    tool::flush();
    ::raise(stopped_by_);
    ::sigprocmask(SIG_SETMASK, &usual_signals_, nullptr);
    return tool::kInternal;
  }

  std::vector<BatchScene> scenes_;
  std::vector<std::string> lines_;  // [scene] for the report
  const BatchOptions& options_;
  const BatchConvert& convert_;
  BatchState state_;
  tool::Progress progress_;
  std::vector<std::size_t> todo_;
  std::vector<Child> children_;
  sigset_t usual_signals_{};
  int signals_ = -1, stopped_by_ = 0, worst_ = tool::kSuccess;
  std::uint64_t n_failed_ = 0, n_skipped_ = 0, n_kept_ = 0, n_converted_ = 0, n_damaged_ = 0, n_left_ = 0;
  std::uint64_t read_bytes_ = 0, made_bytes_ = 0;
  Error state_error_;
  Clock::time_point start_ = Clock::now();
};

}  // namespace

std::vector<BatchScene> scenes_of_shard(std::vector<BatchScene> scenes, unsigned shard, unsigned n_shards) {
  if (n_shards == 1) return scenes;
  std::vector<std::size_t> order(scenes.size());
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = i;
  std::ranges::sort(order, [&](std::size_t a, std::size_t b) {
    const BatchScene &x = scenes[a], &y = scenes[b];
    return x.bytes != y.bytes ? x.bytes > y.bytes : x.output != y.output ? x.output < y.output : a < b;
  });
  // Even a tiny file costs something.
  constexpr std::uint64_t kEach = 1 << 16;
  using Load = std::pair<std::uint64_t, unsigned>;
  std::vector<Load> loads;  // a heap, the least loaded first
  for (unsigned i = 1; i <= n_shards; ++i) loads.emplace_back(0, i);
  std::vector<bool> chosen(scenes.size());
  for (const std::size_t i : order) {
    std::ranges::pop_heap(loads, std::greater<Load>());
    loads.back().first += scenes[i].bytes + kEach;
    chosen[i] = loads.back().second == shard;
    std::ranges::push_heap(loads, std::greater<Load>());
  }
  std::vector<BatchScene> own;
  for (std::size_t i = 0; i < scenes.size(); ++i)
    if (chosen[i]) own.push_back(std::move(scenes[i]));
  return own;
}

Status check_report(const std::string& path, bool overwrite) {
  const auto earlier = MappedFile::open(path);
  if (earlier) {
    const std::string start = fmt::format("{{\"schema\":\"{}\"", kSchema);
    const auto bytes = earlier->bytes();
    overwrite = overwrite || bytes.empty() ||
                std::string_view(reinterpret_cast<const char*>(bytes.data()), bytes.size()).starts_with(start);
  }
  return AtomicFile::create(path, {.overwrite = overwrite, .sync = false}).map([](const AtomicFile&) {});
}

std::vector<std::string> state_files(const std::string& out, const BatchOptions& options) {
  return BatchState::files(out, shard_name(options));
}

int make_folder(const std::string& path) {
  std::error_code failed;
  fs::create_directories(path, failed);
  if (!failed) return tool::kSuccess;
  return tool::report(
      path, {Errc::write_failed, Error::kNone, "cannot create the folder", Error::kNone, Error::kNone, failed.value()});
}

int run_batch(std::vector<BatchScene> scenes, const BatchOptions& options, const BatchConvert& convert) {
  if (const int code = make_folder(options.out); code != tool::kSuccess) return code;
  auto state = BatchState::open(options.out, shard_name(options));
  if (!state) return tool::report(options.out, state.error());
  return Batch(std::move(scenes), options, convert, std::move(*state)).run();
}

}  // namespace rgs
