// streamed_sog.cpp - reads streamed SOG (developer.playcanvas.com, "The Streamed SOG Format", version 1).
//
// lod-meta.json has a tree, whose leaves are regions. A region has a run of Gaussians at each level of detail (0 is the
// finest): "lods": {"0": {"file", "offset", "count"}, ...}. A file is an unzipped SOG, by its index in "filenames". All
// its Gaussians belong to runs.
// SPDX-License-Identifier: Apache-2.0
#include "streamed_sog.hpp"

#include <algorithm>
#include <charconv>
#include <map>
#include <memory>
#include <nlohmann/json.hpp>
#include <numeric>
#include <optional>
#include <set>
#include <string_view>
#include <utility>
#include <vector>

#include "json_member.hpp"
#include "level_choice.hpp"
#include "pieces.hpp"
#include "quantised.hpp"
#include "rgs/splat_edit.hpp"
#include "signature.hpp"
#include "sog.hpp"
#include "zip_archive.hpp"

namespace rgs::detail {
namespace {

using nlohmann::json;
using Bytes = std::vector<std::byte>;

constexpr std::string_view kMetaName = "lod-meta.json";
constexpr std::uint64_t kMaxMetaBytes = std::uint64_t{1} << 25;  // 200 bytes a region; parsed many times as large
constexpr std::uint64_t kBytesInImages = 20;                     // of a Gaussian: five pixels

struct Run {
  std::uint64_t file = 0, offset = 0, count = 0, level = 0;
  bool wanted = false;
  std::uint32_t node = 0;
};

struct Meta {
  std::uint64_t n_levels = 0;
  std::vector<std::string> filenames;
  std::string environment;
  std::vector<Run> runs;  // by file and offset
  std::vector<LevelTree::Node> nodes;
};

tl::unexpected<Error> bad_meta(const char* what) {
  return make_error(Errc::bad_syntax, 0, what);
}

std::optional<std::uint64_t> whole(const json* value) {
  // Larger numbers are none of Gaussians; their sums do not overflow.
  constexpr std::uint64_t kMost = std::uint64_t{1} << 32;
  if (value == nullptr || !value->is_number_unsigned() || value->get<std::uint64_t>() > kMost) return std::nullopt;
  return value->get<std::uint64_t>();
}

std::string folder_of(const std::string& name) {
  const std::size_t slash = name.rfind('/');
  return slash == name.npos ? "" : name.substr(0, slash + 1);
}

// Whether a relative path stays below its folder and has one spelling.
bool is_inside(const std::string& path) {
  for (std::size_t first = 0; first <= path.size();) {
    const std::size_t end = std::min(path.find('/', first), path.size());
    if (!is_beside(path.substr(first, end - first))) return false;
    first = end + 1;
  }
  return true;
}

Status read_filenames(const json& root, Meta& meta) {
  const json* names = json_member(root, "filenames");
  if (names == nullptr || !names->is_array()) return bad_meta("lod-meta.json: filenames is not an array");
  std::set<std::string> folders;  // of each SOG its own, so that what is read is within the scene's size
  for (const json& name : *names) {
    if (!name.is_string() || !is_inside(name.get_ref<const std::string&>()))
      return bad_meta("lod-meta.json: filenames holds something else than paths below its folder");
    meta.filenames.push_back(name.get<std::string>());
    if (!folders.insert(folder_of(meta.filenames.back())).second)
      return bad_meta("lod-meta.json: two filenames are in one folder");
  }
  const json* environment = json_member(root, "environment");
  if (environment != nullptr && environment->is_string()) meta.environment = environment->get<std::string>();
  return {};
}

// Appends the region's runs and marks the wanted one.
Status read_region(const json& lods, std::uint64_t wanted, Meta& meta) {
  if (!lods.is_object()) return bad_meta("lod-meta.json: lods of a region is not an object");
  std::map<std::uint64_t, Run> runs;
  for (const auto& [key, stated] : lods.items()) {
    Run run;
    const auto [end, error] = std::from_chars(key.data(), key.data() + key.size(), run.level);
    const auto file = whole(json_member(stated, "file")), offset = whole(json_member(stated, "offset")),
               count = whole(json_member(stated, "count"));
    if (error != std::errc() || end != key.data() + key.size() || run.level >= meta.n_levels || !file ||
        *file >= meta.filenames.size() || !offset || !count)
      return bad_meta("lod-meta.json: a region's level is none, or its file, offset or count");
    run.file = *file, run.offset = *offset, run.count = *count;
    if (run.count != 0 && !runs.emplace(run.level, run).second)
      return bad_meta("lod-meta.json: a region has one level twice");
  }
  if (runs.empty()) return {};
  auto chosen = runs.upper_bound(wanted);
  if (chosen != runs.begin()) --chosen;
  chosen->second.wanted = true;
  std::uint32_t parent = LevelTree::kNoParent;
  for (auto run = runs.rbegin(); run != runs.rend(); ++run) {
    meta.nodes.push_back({static_cast<std::uint32_t>(run->first), parent, run->second.count});
    run->second.node = parent = static_cast<std::uint32_t>(meta.nodes.size() - 1);
    meta.runs.push_back(run->second);
  }
  return {};
}

Result<Meta> parse_meta(std::span<const std::byte> bytes, const ReadOptions& options) {
  if (bytes.size() > kMaxMetaBytes) return make_error(Errc::limit_exceeded, 0, "lod-meta.json is longer than 32 MiB");
  const std::string_view text = text_of(bytes);
  const json root = json::parse(text.begin(), text.end(), nullptr, false);
  if (!root.is_object()) return bad_meta("lod-meta.json is not a JSON object");
  if (const json* version = json_member(root, "version"); version != nullptr && whole(version) != std::uint64_t{1})
    return make_error(Errc::unsupported_version, 0, "lod-meta.json: the version is not 1");
  const auto n_levels = whole(json_member(root, "lodLevels"));
  if (!n_levels || *n_levels == 0) return bad_meta("lod-meta.json: no number of levels (lodLevels)");
  Meta meta;
  meta.n_levels = *n_levels;
  const std::uint64_t wanted = options.level_of_detail.value_or(0);
  if (Status s = check_level(meta.n_levels, options); !s) return tl::unexpected(s.error());
  if (Status s = read_filenames(root, meta); !s) return tl::unexpected(s.error());
  const json* tree = json_member(root, "tree");
  std::vector<const json*> nodes{tree};  // not by recursion: depth is the file's
  while (!nodes.empty()) {
    const json* node = nodes.back();
    nodes.pop_back();
    if (node == nullptr || !node->is_object()) return bad_meta("lod-meta.json: a node of the tree is not an object");
    if (const json* lods = json_member(*node, "lods")) {
      if (Status s = read_region(*lods, wanted, meta); !s) return tl::unexpected(s.error());
    } else if (const json* children = json_member(*node, "children")) {
      if (!children->is_array()) return bad_meta("lod-meta.json: children of a node is not an array");
      for (auto child = children->rbegin(); child != children->rend(); ++child) nodes.push_back(&*child);
    }
  }
  if (const json* counts = json_member(root, "counts")) {
    std::map<std::uint64_t, std::uint64_t> of_level;
    for (const Run& run : meta.runs) of_level[run.level] += run.count;
    if (!counts->is_array() || counts->size() != meta.n_levels)
      return bad_meta("lod-meta.json: counts is not an array of lodLevels numbers");
    for (std::uint64_t level = 0; level < meta.n_levels; ++level) {
      const auto stated = whole(&(*counts)[level]);
      if (!stated || *stated != of_level[level])
        return make_error(Errc::size_mismatch, 0, "lod-meta.json: counts differ from those of the regions",
                          stated.value_or(Error::kNone), of_level[level]);
    }
  }
  std::ranges::stable_sort(meta.runs, {}, [](const Run& run) { return std::pair(run.file, run.offset); });
  return meta;
}

// ---- SOGs -----------------------------------------------------------------------------------------------------------

// `runs`: all of a file, by offset. Errors: bad_value (they overlap), size_mismatch (they leave Gaussians out).
Status check_runs(std::span<const Run> runs, std::uint64_t n) {
  std::uint64_t end = 0;
  for (const Run& run : runs) {
    if (run.offset < end)
      return make_error(Errc::bad_value, 0, "lod-meta.json: two regions hold the same Gaussians", end, run.offset);
    if (run.offset > end) break;
    end += run.count;
  }
  if (end != n)
    return make_error(Errc::size_mismatch, 0, "a SOG's Gaussians are not those that lod-meta.json counts", end, n);
  return {};
}

// Whether so many Gaussians are allowed. `stored`: bytes of the whole scene, 0 if unknown.
Status check_size(const Meta& meta, bool wanted_only, std::uint64_t stored, const DecodeLimits& limits) {
  std::uint64_t n = 0;
  for (const Run& run : meta.runs) n += run.wanted || !wanted_only ? run.count : 0;
  if (n > limits.max_gaussians)
    return make_error(Errc::limit_exceeded, 0, "more Gaussians than the caller allows", limits.max_gaussians, n);
  return stored == 0 ? Status() : check_expansion(kBytesInImages * n, stored, 0, limits);
}

// Decodes the SOGs with runs that are wanted, or all, one at a time. `fetch` returns a file by its path beside
// lod-meta.json.
using VisitSog = std::function<Status(std::span<const Run> runs, SplatFile& sog)>;
Status each_sog(const Meta& meta, bool wanted_only, const FetchFile& fetch, const DecodeLimits& limits,
                const VisitSog& visit) {
  for (auto first = meta.runs.begin(); first != meta.runs.end();) {
    const auto last = std::find_if(first, meta.runs.end(), [&](const Run& run) { return run.file != first->file; });
    const std::span<const Run> of_file(first, last);
    first = last;
    if (wanted_only && std::ranges::none_of(of_file, &Run::wanted)) continue;
    const std::string& name = meta.filenames[of_file.front().file];
    std::uint64_t bytes = 0;
    const auto fetch_counted = [&](const std::string& path) {
      auto file = fetch(path);
      if (file) bytes += file->size();
      return file;
    };
    const auto sog_meta = fetch_counted(name);
    if (!sog_meta) return tl::unexpected(sog_meta.error());
    auto sog =
        decode_sog_files(*sog_meta, [&](const std::string& image) { return fetch_counted(folder_of(name) + image); },
                         {.limits = limits});
    if (!sog) return tl::unexpected(sog.error());
    sog->bytes = bytes;
    if (Status s = check_runs(of_file, sog->cloud.size()); !s) return s;
    if (Status s = visit(of_file, *sog); !s) return s;
  }
  return {};
}

SplatFile file_of(const Meta& meta, const ReadOptions& options) {
  SplatFile file;
  file.format = SplatFormat::ssog;
  file.n_levels = static_cast<std::uint32_t>(std::min<std::uint64_t>(meta.n_levels, ~std::uint32_t{0}));
  file.finest = options.level_of_detail.value_or(0) == 0;
  return file;
}

void note_environment(const Meta& meta, SplatFile& file) {
  if (!meta.environment.empty()) file.unused.emplace_back("the environment, a SOG of its own");
}

Result<SplatFile> decode_scene(std::span<const std::byte> bytes, const FetchFile& fetch, std::uint64_t stored,
                               const ReadOptions& options) {
  const auto meta = parse_meta(bytes, options);
  if (!meta) return tl::unexpected(meta.error());
  if (const Status s = check_size(*meta, true, stored, options.limits); !s) return tl::unexpected(s.error());
  SplatFile file = file_of(*meta, options);
  bool is_first = true;
  const Status status =
      each_sog(*meta, true, fetch, options.limits, [&](std::span<const Run> of_file, SplatFile& sog) -> Status {
        if (!std::ranges::all_of(of_file, &Run::wanted)) {
          std::vector<std::uint64_t> kept;
          for (const Run& run : of_file) {
            const std::size_t before = kept.size();
            kept.resize(before + (run.wanted ? run.count : 0));
            std::iota(kept.begin() + static_cast<std::ptrdiff_t>(before), kept.end(), run.offset);
          }
          keep_splats(sog.cloud, kept);
        }
        if (std::exchange(is_first, false)) file.aa_mode = sog.aa_mode;
        file.bytes += stored != 0 ? 0 : sog.bytes;
        append_splats(file.cloud, sog.cloud);
        return hand_over(file, options);
      });
  if (!status) return tl::unexpected(status.error());
  if (meta->n_levels > 1 && !options.level_of_detail) file.unused.emplace_back("levels of detail but the finest");
  note_environment(*meta, file);
  return file;
}

Result<LevelTree> levels_of(std::span<const std::byte> bytes, const FetchFile& fetch, std::uint64_t stored,
                            const ReadOptions& options) {
  auto parsed = parse_meta(bytes, options);
  if (!parsed) return tl::unexpected(parsed.error());
  if (const Status s = check_size(*parsed, false, stored, options.limits); !s) return tl::unexpected(s.error());
  LevelTree tree;
  tree.nodes = std::move(parsed->nodes);
  tree.file = file_of(*parsed, options);
  note_environment(*parsed, tree.file);
  const auto meta = std::make_shared<const Meta>(std::move(*parsed));
  tree.file.bytes = stored != 0 ? stored : bytes.size();
  tree.read = [meta, fetch, stored, limits = options.limits](const LevelTree::Visit& visit) {
    return each_sog(*meta, false, fetch, limits, [&](std::span<const Run> runs, SplatFile& sog) -> Status {
      for (const Run& run : runs) {
        SplatFile piece;
        piece.bytes = stored != 0 || &run != &runs.front() ? 0 : sog.bytes;
        piece.aa_mode = sog.aa_mode;
        piece.cloud.resize(run.count, sog.cloud.sh_degree);
        for (std::uint64_t i = 0; i < run.count; ++i) piece.cloud.set(i, sog.cloud.view().splat(run.offset + i));
        if (Status s = visit(run.node, std::move(piece)); !s) return s;
      }
      return {};
    });
  };
  return tree;
}

FetchFile fetch_beside(const std::string& folder) {
  return [folder](const std::string& name) {
    std::uint64_t total = 0;
    return fetch_from(folder, total)(name);
  };
}

// lod-meta.json in a zip archive, and how to fetch what lies beside it. `bytes` must outlive the result.
struct Zipped {
  Bytes meta;
  FetchFile fetch;
};
Result<Zipped> open_zipped(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  auto opened = ZipArchive::open(bytes);
  if (!opened) return tl::unexpected(opened.error());
  const auto archive = std::make_shared<const ZipArchive>(std::move(*opened));
  const std::string name = archive->holds(std::string(kMetaName)) ? std::string(kMetaName)
                                                                  : archive->name_ending("/" + std::string(kMetaName));
  const FetchFile fetch = [archive, limits, folder = folder_of(name)](const std::string& path) {
    return archive->read(folder + path, limits,
                         "the streamed SOG lacks lod-meta.json or a file that it or a meta.json names");
  };
  auto meta = fetch(name.substr(folder_of(name).size()));
  if (!meta) return tl::unexpected(meta.error());
  return Zipped{std::move(*meta), fetch};
}

}  // namespace

bool is_streamed_sog_meta(std::span<const std::byte> bytes) {
  return is_json_with(bytes, "\"lodLevels\"");
}

bool is_streamed_sog(std::span<const std::byte> bytes) {
  constexpr std::size_t kDirectory = std::size_t{1} << 20;  // at the archive's end: 2,000 SOGs
  const std::string_view text = text_of(bytes);
  return is_streamed_sog_meta(bytes) || is_zip_with(bytes, kMetaName) ||
         (is_zip(bytes) && text.substr(text.size() - std::min(text.size(), kDirectory)).find(kMetaName) != text.npos);
}

Result<SplatFile> decode_streamed_sog(std::span<const std::byte> bytes, const ReadOptions& options) {
  const auto zipped = open_zipped(bytes, options.limits);
  if (!zipped) return tl::unexpected(zipped.error());
  return decode_scene(zipped->meta, zipped->fetch, bytes.size(), options);
}

Result<SplatFile> decode_streamed_sog_folder(std::span<const std::byte> bytes, const std::string& folder,
                                             const ReadOptions& options) {
  auto file = decode_scene(bytes, fetch_beside(folder), 0, options);
  if (file) file->bytes += bytes.size();
  return file;
}

Result<LevelTree> open_streamed_sog_levels(std::span<const std::byte> bytes, const std::string& folder,
                                           const ReadOptions& options) {
  if (!is_streamed_sog_meta(bytes)) {
    const auto zipped = open_zipped(bytes, options.limits);
    if (!zipped) return tl::unexpected(zipped.error());
    return levels_of(zipped->meta, zipped->fetch, bytes.size(), options);
  }
  return levels_of(bytes, fetch_beside(folder), 0, options);
}

}  // namespace rgs::detail
