// batch_state.cpp - appends JSON lines by write(); a lock excludes a second program.
// SPDX-License-Identifier: Apache-2.0
#include "batch_state.hpp"

#include <dirent.h>
#include <fcntl.h>
#include <fmt/format.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <nlohmann/json.hpp>
#include <utility>

#include "console.hpp"
#include "rgs/checksum.hpp"
#include "rgs/file.hpp"

namespace rgs {
namespace {

using Json = nlohmann::ordered_json;

constexpr const char* kSchema = "rgs-convert-state/1";
constexpr std::string_view kName = ".rgs-convert", kEnding = ".jsonl";

tl::unexpected<Error> system_error(Errc code, const char* what) {
  return make_error(code, Error::kNone, what, Error::kNone, Error::kNone, errno);
}

std::vector<std::string> state_files(const std::string& folder) {
  std::vector<std::string> paths;
  if (DIR* const open = ::opendir(folder.c_str())) {
    while (const dirent* entry = ::readdir(open)) {
      const std::string_view name = entry->d_name;
      if (name.starts_with(kName) && name.ends_with(kEnding)) paths.push_back(folder + "/" + std::string(name));
    }
    ::closedir(open);
  }
  return paths;
}

// Names need not be UTF-8; escaping keeps different names different.
std::string key_of(const std::string& output) {
  return tool::printable(output);
}

std::string dump(const Json& json) {
  return json.dump(-1, ' ', true, Json::error_handler_t::replace);
}

}  // namespace

std::string stamp_of(std::span<const std::string> files) {
  std::string stamp;
  for (const std::string& path : files) {
    struct stat info {};
    if (::stat(path.c_str(), &info) != 0) return {};
    stamp += fmt::format("{}{} {} {}.{:09} {}.{:09}", stamp.empty() ? "" : ", ", info.st_size, info.st_ino,
                         info.st_mtim.tv_sec, info.st_mtim.tv_nsec, info.st_ctim.tv_sec, info.st_ctim.tv_nsec);
  }
  return stamp;
}

Result<std::string> describe_contents(std::span<const std::string> files) {
  constexpr std::size_t kPart = std::size_t{16} << 20;
  Hasher hash;
  std::uint64_t bytes = 0;
  for (const std::string& path : files) {
    const auto file = MappedFile::open(path);
    if (!file) return tl::unexpected(file.error());
    const auto all = file->bytes();
    if (files.size() > 1) {
      const std::string size = fmt::format("{}:", all.size());
      hash.update(std::as_bytes(std::span(size)));
    }
    for (std::size_t at = 0; at < all.size(); at += kPart)
      hash.update(all.subspan(at, std::min(kPart, all.size() - at)));
    if (const Status s = file->check_unchanged(); !s) return tl::unexpected(s.error());
    bytes += all.size();
  }
  return fmt::format("{} {:016x}", bytes, hash.digest());
}

std::vector<std::string> BatchState::files(const std::string& folder, const std::string& shard) {
  std::vector<std::string> paths{folder + "/" + std::string(kName) + (shard.empty() ? "" : "-" + shard) +
                                 std::string(kEnding)};
  for (std::string& path : state_files(folder))
    if (path != paths.front()) paths.push_back(std::move(path));
  return paths;
}

Result<BatchState> BatchState::open(const std::string& folder, const std::string& shard) {
  BatchState state;
  state.folder_ = folder;
  state.path_ = files(folder, shard).front();
  state.fd_ = ::open(state.path_.c_str(), O_RDWR | O_CREAT | O_APPEND | O_CLOEXEC, 0666);
  if (state.fd_ < 0) return system_error(Errc::open_failed, "cannot open the state file");
  struct flock lock {};
  lock.l_type = F_WRLCK;
  lock.l_whence = SEEK_SET;
  // File systems without locks go without: outputs appear complete or not at all in any case.
  state.locked_ = ::fcntl(state.fd_, F_SETLK, &lock) == 0;
  if (!state.locked_ && (errno == EACCES || errno == EAGAIN))
    return make_error(Errc::open_failed, Error::kNone,
                      "another rgs-convert is working on this folder; wait for it, or give each its own --shard");
  // Read through this descriptor: closing another one of the file would drop the lock.
  std::string text;
  char buffer[65536];
  for (off_t at = 0;;) {
    const ssize_t n = ::pread(state.fd_, buffer, sizeof buffer, at);
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) return system_error(Errc::read_failed, "cannot read the state file");
    if (n == 0) break;
    text.append(buffer, static_cast<std::size_t>(n));
    at += n;
  }
  state.read(state.path_, text);
  state.line_open_ = !text.empty() && text.back() != '\n';
  for (const std::string& path : state_files(folder)) {
    if (path == state.path_) continue;
    const auto file = MappedFile::open(path);
    if (!file) return tl::unexpected(file.error());
    state.read(path, {reinterpret_cast<const char*>(file->bytes().data()), file->bytes().size()});
  }
  return state;
}

BatchState::BatchState(BatchState&& other) noexcept
    : known_(std::move(other.known_)),
      folder_(std::move(other.folder_)),
      path_(std::move(other.path_)),
      fd_(std::exchange(other.fd_, -1)),
      locked_(other.locked_),
      line_open_(other.line_open_) {}

BatchState::~BatchState() {
  forget();
}

void BatchState::forget() {
  if (fd_ >= 0) ::close(std::exchange(fd_, -1));
}

// Skips lines that are foreign, damaged or cut off.
void BatchState::read(const std::string& path, std::string_view text) {
  while (!text.empty()) {
    const std::size_t end = text.find('\n');
    if (end == text.npos) return;
    const Json line = Json::parse(text.substr(0, end), nullptr, false);
    text.remove_prefix(end + 1);
    if (!line.is_object()) continue;
    const auto string = [](const Json& at, const char* key) {
      const auto found = at.find(key);
      return found != at.end() && found->is_string() ? found->get<std::string>() : std::string();
    };
    const std::string output = string(line, "output");
    if (string(line, "schema") != kSchema || output.empty()) continue;
    Known& known = known_[output];
    if (const auto begun = line.find("begun"); begun != line.end()) {
      // One shard's end says nothing about another's begin.
      if (*begun == true) {
        known.begun[path] = string(line, "input_path");
      } else {
        known.begun.erase(path);
      }
      continue;
    }
    BatchRecord record;
    record.output = output;
    record.tool = string(line, "tool"), record.options = string(line, "options");
    record.input_name = string(line, "input_name"), record.input_path = string(line, "input_path");
    record.input = string(line, "input"), record.made = string(line, "made");
    record.input_stamp = string(line, "input_stamp"), record.made_stamp = string(line, "made_stamp");
    if (const auto summary = line.find("summary"); summary != line.end()) record.summary = summary->dump();
    if (record.input.empty() || record.made.empty()) continue;
    known.begun.erase(path);
    known.records.push_back(std::move(record));
  }
}

std::span<const BatchRecord> BatchState::find(const std::string& output) const {
  const auto found = known_.find(key_of(output));
  return found == known_.end() ? std::span<const BatchRecord>() : found->second.records;
}

bool BatchState::was_begun(const std::string& output, const std::string& input_path) const {
  const auto found = known_.find(key_of(output));
  return found != known_.end() &&
         std::ranges::any_of(found->second.begun, [&](const auto& begun) { return begun.second == input_path; });
}

bool BatchState::was_begun(const std::string& output) const {
  const auto found = known_.find(key_of(output));
  return found != known_.end() && !found->second.begun.empty();
}

bool BatchState::others_may_work() const {
  if (!locked_) return true;
  for (const std::string& path : state_files(folder_)) {
    if (path == path_) continue;
    const int fd = ::open(path.c_str(), O_RDONLY | O_CLOEXEC);
    struct flock lock {};
    lock.l_type = F_WRLCK;
    lock.l_whence = SEEK_SET;
    const bool is_free = fd >= 0 && ::fcntl(fd, F_GETLK, &lock) == 0 && lock.l_type == F_UNLCK;
    if (fd >= 0) ::close(fd);
    if (!is_free) return true;
  }
  return false;
}

Status BatchState::append(std::string line) {
  line += '\n';
  // A line that a full disk cut off stays on its own.
  if (line_open_) line.insert(line.begin(), '\n');
  std::size_t done = 0;
  while (done < line.size()) {
    const ssize_t n = ::write(fd_, line.data() + done, line.size() - done);
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) {
      line_open_ = line_open_ || done != 0;
      return system_error(Errc::write_failed, "cannot write the state file");
    }
    done += static_cast<std::size_t>(n);
  }
  line_open_ = false;
  return {};
}

Status BatchState::begin(const std::string& output, const std::string& input_path, bool sync) {
  Known& known = known_[key_of(output)];
  if (const auto begun = known.begun.find(path_); begun != known.begun.end() && begun->second == input_path) return {};
  const Json line{{"schema", kSchema}, {"output", key_of(output)}, {"begun", true}, {"input_path", input_path}};
  if (const Status s = append(dump(line)); !s) return s;
  if (sync && ::fdatasync(fd_) != 0) return system_error(Errc::write_failed, "cannot write the state file");
  known.begun[path_] = input_path;
  return {};
}

Status BatchState::cancel(const std::string& output) {
  Known& known = known_[key_of(output)];
  if (known.begun.erase(path_) == 0) return {};
  return append(dump({{"schema", kSchema}, {"output", key_of(output)}, {"begun", false}}));
}

Status BatchState::add(BatchRecord record) {
  const Json line{{"schema", kSchema},
                  {"output", key_of(record.output)},
                  {"tool", record.tool},
                  {"options", record.options},
                  {"input_name", record.input_name},
                  {"input_path", record.input_path},
                  {"input", record.input},
                  {"made", record.made},
                  {"input_stamp", record.input_stamp},
                  {"made_stamp", record.made_stamp},
                  {"summary", Json::parse(record.summary, nullptr, false)}};
  Known& known = known_[key_of(record.output)];
  const Status written = append(dump(line));
  known.begun.erase(path_);
  known.records.push_back(std::move(record));
  return written;
}

}  // namespace rgs
