// batch_plan.cpp - plans folders through list_scenes(), and lists line by line.
// SPDX-License-Identifier: Apache-2.0
#include "batch_plan.hpp"

#include <fmt/format.h>

#include <cerrno>
#include <cstdio>
#include <filesystem>
#include <map>
#include <memory>
#include <span>
#include <string_view>
#include <utility>

#include "batch_state.hpp"
#include "console.hpp"
#include "input_files.hpp"
#include "rgs/checksum.hpp"
#include "scene_list.hpp"

namespace rgs {
namespace {

namespace fs = std::filesystem;

tl::unexpected<int> usage(const std::string& message) {
  return tl::unexpected(tool::report_usage(message));
}

tl::unexpected<int> unusable(const std::string& file, const Error& error) {
  return tl::unexpected(tool::report(file, error));
}

// Relative to the output folder, so that an output has one name in the state.
std::string normal(const std::string& name) {
  return fs::path(name).lexically_normal().string();
}

void complete(BatchScene& scene, const std::string& out) {
  scene.output = normal(scene.output);
  scene.output_path = (fs::path(out) / scene.output).string();
}

Result<std::string> read_text(const std::string& path) {
  const bool is_stdin = path == "-";
  const std::unique_ptr<std::FILE, void (*)(std::FILE*)> file(is_stdin ? stdin : std::fopen(path.c_str(), "rbe"),
                                                              [](std::FILE* f) {
                                                                if (f != nullptr && f != stdin) std::fclose(f);
                                                              });
  if (file == nullptr)
    return make_error(Errc::open_failed, Error::kNone, "cannot open file", Error::kNone, Error::kNone, errno);
  std::string text;
  char buffer[65536];
  while (const std::size_t n = std::fread(buffer, 1, sizeof buffer, file.get())) text.append(buffer, n);
  if (std::ferror(file.get()) != 0)
    return make_error(Errc::read_failed, Error::kNone, "cannot read file", Error::kNone, Error::kNone, errno);
  return text;
}

std::string output_of(const std::string& name, SplatFormat to) {
  return tool::scene_stem(name) + "." + format_name(to);
}

// Keeps the folders of a relative path; others would leave the output folder.
std::string name_inside(const std::string& input) {
  const fs::path path = fs::path(input).lexically_normal();
  return path.is_absolute() || *path.begin() == ".." ? path.filename().string() : path.string();
}

std::uint64_t bytes_of(const std::string& input) {
  std::uint64_t bytes = 0;
  for (const std::string& file : tool::files_of_scene(input)) {
    std::error_code failed;
    const std::uintmax_t size = fs::file_size(file, failed);
    if (!failed) bytes += size;
  }
  return bytes;
}

tl::expected<BatchPlan, int> plan_list(const std::string& list, const std::string& folder, const std::string& out,
                                       SplatFormat to) {
  const auto lines = lines_of(list);
  if (!lines) return unusable(list, lines.error());
  BatchPlan plan;
  for (std::size_t number = 1; number <= lines->size(); ++number) {
    const std::string_view line = (*lines)[number - 1];
    if (line.empty()) continue;
    const std::string where = fmt::format("{}, line {}: ", list, number);
    const std::size_t tab = line.find('\t');
    const std::string input(line.substr(0, tab));
    const std::string output(tab == line.npos ? std::string_view() : line.substr(tab + 1));
    if (input.empty()) return usage(where + "no input before the tab");
    if (tab != line.npos && output.empty()) return usage(where + "no output after the tab");
    if (line.find('\0') != line.npos) return usage(where + "a zero byte; separate names by line ends");
    if (output.find('\t') != output.npos) return usage(where + "more than one tab");
    if (output.empty() && to == SplatFormat::unknown)
      return usage(where + "no output is named; pass --to rgs, ply, spz, ...");
    BatchScene scene;
    scene.name = input;
    scene.input = folder.empty() ? input : (fs::path(folder) / input).string();
    scene.output = output.empty() ? output_of(name_inside(input), to) : output;
    scene.bytes = bytes_of(scene.input);
    scene.named = true;
    complete(scene, out);
    plan.scenes.push_back(std::move(scene));
  }
  return plan;
}

}  // namespace

Result<std::vector<std::string>> lines_of(const std::string& list) {
  const auto text = read_text(list);
  if (!text) return tl::unexpected(text.error());
  std::vector<std::string> lines;
  std::string_view left = *text;
  if (left.starts_with("\xEF\xBB\xBF")) left.remove_prefix(3);
  while (!left.empty()) {
    const std::size_t end = std::min(left.find('\n'), left.size());
    std::string_view line = left.substr(0, end);
    left.remove_prefix(std::min(end + 1, left.size()));
    if (line.ends_with('\r')) line.remove_suffix(1);
    lines.emplace_back(line);
  }
  return lines;
}

tl::expected<BatchPlan, int> plan_batch(const std::string& list, const std::string& folder, const std::string& out,
                                        SplatFormat to) {
  std::error_code ignored;
  if (fs::exists(out, ignored) && !fs::is_directory(out, ignored))
    return unusable(out, {Errc::output_unusable, Error::kNone, "many scenes need an output folder"});
  if (!list.empty()) return plan_list(list, folder, out, to);
  if (fs::equivalent(folder, out, ignored))
    return usage("the input folder is also the output folder; name another, which may lie inside it");
  auto listed = tool::list_scenes(folder, {out});
  if (!listed) return unusable(folder, listed.error());
  BatchPlan plan;
  plan.n_others = listed->n_others;
  plan.refused = std::move(listed->refused);
  for (tool::ListedScene& found : listed->scenes) {
    BatchScene scene;
    scene.name = found.name;
    scene.input = found.path;
    scene.bytes = found.bytes;
    scene.readable = found.readable;
    // An unreadable folder has no output that could clash.
    const bool is_folder = !scene.readable && format_of_name(found.name) == SplatFormat::unknown;
    scene.output = is_folder ? found.name + "/" : output_of(found.name, to);
    complete(scene, out);
    plan.scenes.push_back(std::move(scene));
  }
  return plan;
}

std::string outputs_that_clash(const BatchPlan& plan, const std::string& out) {
  std::map<std::string, const BatchScene*> taken;
  for (const BatchScene& scene : plan.scenes) {
    const auto [place, is_new] = taken.emplace(normal(scene.output_path), &scene);
    if (!is_new)
      return fmt::format(
          "{} and {} would both become {} in {}; convert one of them separately, or name outputs in a --list",
          place->second->name, scene.name, scene.output, out);
  }
  return {};
}

Result<std::string> options_hash(const std::string& given, const std::string& cameras) {
  tool::InputFiles files;
  files.add_cameras(cameras);
  const auto contents = describe_contents(files.paths());
  if (!contents) return tl::unexpected(contents.error());
  const std::string text = given + *contents;
  return fmt::format("{:016x}", xxh3(std::as_bytes(std::span(text))));
}

}  // namespace rgs
