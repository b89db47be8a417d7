// lcc.cpp - LCC and LCC2 of XGRIDS (github.com/xgrids, LCCWhitepaper and LCC2Whitepaper): JSON, and files beside it.
//
// LCC has all levels of detail, the finest first, in the same files:
//   index.bin   for each cell i16 x, y, then for each level u32 Gaussians, u64 offset in data.bin, u32 bytes there
//   data.bin    0 f32 mean [3]   12 u8 red, green, blue, opacity   16 u16 scale [3]   22 u32 rotation   26 u16 normal [3]
//   shcoef.bin  at twice the offset u32 coefficient [15], u32 unused; red 11 bits, green 10, blue 11
// Rotations are the smallest three of x, y, z, w, 10 bits each, below the index of the largest; scales (activated) and
// harmonics lie between the JSON's bounds.
//
// LCC2 has a tree whose nodes name chunks, SOG or SPZ: at depth 1 those of the coarsest level, at depth totalLevels
// those of the finest. Chunks are in LCC's frame, whatever their format says.
// SPDX-License-Identifier: Apache-2.0
#include "lcc.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <utility>
#include <vector>

#include "json_member.hpp"
#include "level_choice.hpp"
#include "pieces.hpp"
#include "quantised.hpp"
#include "rgs/quantize.hpp"
#include "rgs/splat_edit.hpp"
#include "rgs/utf8_path.hpp"
#include "signature.hpp"
#include "sog.hpp"
#include "spz.hpp"

namespace rgs::detail {
namespace {

using nlohmann::json;
using Bytes = std::span<const std::byte>;

constexpr std::uint64_t kMaxJsonBytes = std::uint64_t{1} << 24;  // a node of LCC2 takes 0.4 kB
constexpr std::uint64_t kRecordBytes = 32, kHarmonicsBytes = 64, kCellBytes = 4, kLevelBytes = 16;

tl::unexpected<Error> bad_json(const char* what) {
  return make_error(Errc::bad_syntax, 0, what);
}

Result<json> parse_json(Bytes bytes) {
  if (bytes.size() > kMaxJsonBytes) return make_error(Errc::limit_exceeded, 0, "the JSON is longer than 16 MiB");
  json root = json::parse(text_of(bytes), nullptr, false);
  if (!root.is_object()) return bad_json("the .lcc or .lcc2 is not a JSON object");
  return root;
}

std::optional<std::uint64_t> whole(const json* value) {
  return value != nullptr && value->is_number_unsigned() ? std::optional(value->get<std::uint64_t>()) : std::nullopt;
}

std::optional<std::array<double, 3>> three(const json* array) {
  if (array == nullptr || !array->is_array() || array->size() != 3) return std::nullopt;
  std::array<double, 3> numbers{};
  for (std::size_t i = 0; i < 3; ++i) {
    if (!(*array)[i].is_number()) return std::nullopt;
    numbers[i] = (*array)[i].get<double>();
  }
  return numbers;
}

// What the fields `offset`, `shift`, `scale` and `epsg` say, and no viewer applies.
void note_georeference(const json& root, std::vector<std::string>& unused) {
  for (const char* name : {"offset", "shift", "scale"}) {
    const auto stated = three(json_member(root, name));
    if (!stated || *stated == std::array<double, 3>{} || *stated == std::array<double, 3>{1, 1, 1}) continue;
    unused.push_back(std::string(name) + " " + std::to_string((*stated)[0]) + ", " + std::to_string((*stated)[1]) +
                     ", " + std::to_string((*stated)[2]));
  }
  const auto code = whole(json_member(root, "epsg"));
  if (code && *code != 0) unused.push_back("coordinate reference system EPSG:" + std::to_string(*code));
}

void note_levels(std::uint64_t n_levels, const ReadOptions& options, SplatFile& file) {
  file.n_levels = static_cast<std::uint32_t>(std::min<std::uint64_t>(n_levels, ~std::uint32_t{0}));
  file.finest = options.level_of_detail.value_or(0) == 0;
  if (n_levels > 1 && !options.level_of_detail)
    file.unused.insert(file.unused.begin(), std::to_string(n_levels - 1) + " coarser levels of detail");
}

SplatFile file_of(SplatFormat format) {
  SplatFile file;
  file.format = format;
  file.axes = kAxesLcc;
  return file;
}

// ---- LCC ------------------------------------------------------------------------------------------------------------

struct Bounds {
  std::array<double, 3> low{}, high{};
  double value(std::size_t k, std::uint32_t code, std::uint32_t max_code) const {
    const double t = static_cast<double>(code) / max_code;
    return (1 - t) * low[k] + t * high[k];
  }
};

std::optional<Bounds> bounds_of(const json& root, const char* name) {
  const json* attributes = json_member(root, "attributes");
  if (attributes == nullptr || !attributes->is_array()) return std::nullopt;
  for (const json& attribute : *attributes) {
    const json* its_name = json_member(attribute, "name");
    if (its_name == nullptr || *its_name != name) continue;
    const auto low = three(json_member(attribute, "min")), high = three(json_member(attribute, "max"));
    return low && high ? std::optional(Bounds{*low, *high}) : std::nullopt;
  }
  return std::nullopt;
}

struct Meta {
  std::uint64_t n_levels = 0;
  std::vector<std::uint64_t> n;  // of each level
  Bounds scale;
  std::optional<Bounds> sh;
};

Result<Meta> parse_meta(const json& root) {
  Meta meta;
  const json* splats = json_member(root, "splats");
  for (std::size_t i = 0; splats != nullptr && splats->is_array() && i < splats->size(); ++i) {
    const auto n = whole(&(*splats)[i]);
    if (!n) break;
    meta.n.push_back(*n);
  }
  const auto n_levels = whole(json_member(root, "totalLevel"));
  if (meta.n.empty() || !n_levels || *n_levels == 0) return bad_json("the .lcc lacks totalLevel or splats");
  meta.n_levels = *n_levels;
  if (const json* encoding = json_member(root, "encoding"); encoding != nullptr && *encoding != "COMPRESS")
    return make_error(Errc::unsupported_feature, 0, "the .lcc has another encoding than COMPRESS");
  const auto scale = bounds_of(root, "scale");
  if (!scale) return bad_json("the .lcc lacks bounds of the attribute scale");
  meta.scale = *scale;
  // Before version 4 nothing says whether there are harmonics; without, their bounds are 0 and 1.
  const json* type = json_member(root, "fileType");
  meta.sh = bounds_of(root, "shcoef");
  const bool is_stub =
      meta.sh && meta.sh->low == std::array<double, 3>{0, 0, 0} && meta.sh->high == std::array<double, 3>{1, 1, 1};
  if (type != nullptr && *type == "Quality") {
    if (!meta.sh) return bad_json("the .lcc lacks bounds of the attribute shcoef");
  } else if (is_stub || (type != nullptr && *type == "Portable")) {
    meta.sh.reset();
  }
  return meta;
}

struct Lcc {
  Meta meta;
  Bytes index, data, harmonics;
  SplatFile file;  // without Gaussians
};

// Gaussians of a cell's level.
struct Run {
  std::uint64_t cell = 0, n = 0, offset = 0, level = 0;
};

Result<std::vector<Run>> find_runs(const Lcc& lcc, std::uint64_t level) {
  const auto& [meta, index, data, harmonics, file] = lcc;
  const bool is_stated = level < meta.n.size();  // some state the finest alone
  const std::uint64_t wanted = is_stated ? meta.n[level] : 0;
  if (wanted > data.size() / kRecordBytes) {
    return make_error(Errc::truncated, data.size(), "data.bin is shorter than one level", kRecordBytes * wanted,
                      data.size());
  }
  if (meta.n_levels > index.size() / kLevelBytes && !index.empty()) {
    return make_error(Errc::truncated, index.size(), "index.bin ends inside its first cell", meta.n_levels,
                      index.size() / kLevelBytes);
  }
  const std::uint64_t cell_bytes = kCellBytes + kLevelBytes * (index.empty() ? 1 : meta.n_levels);
  if (index.size() % cell_bytes != 0) {
    return make_error(Errc::truncated, index.size(), "index.bin ends inside a cell", cell_bytes,
                      index.size() % cell_bytes);
  }
  std::vector<Run> runs;
  std::uint64_t n = 0;
  for (std::uint64_t cell = 0; cell < index.size() / cell_bytes; ++cell) {
    const std::uint64_t at = cell * cell_bytes + kCellBytes + kLevelBytes * level;
    const Run run{cell, load<std::uint32_t>(index, at), load<std::uint64_t>(index, at + 4), level};
    if (run.n == 0) continue;
    const std::uint64_t bytes = load<std::uint32_t>(index, at + 12);
    if (bytes < kRecordBytes * run.n) {
      return make_error(Errc::bad_header, at + 12, "index.bin: a cell has fewer bytes than its Gaussians",
                        kRecordBytes * run.n, bytes);
    }
    if (run.offset > data.size() || kRecordBytes * run.n > data.size() - run.offset) {
      return make_error(Errc::truncated, at + 4, "index.bin: a cell ends past the end of data.bin", data.size(),
                        run.offset);
    }
    if (meta.sh && (2 * run.offset > harmonics.size() || kHarmonicsBytes * run.n > harmonics.size() - 2 * run.offset)) {
      return make_error(Errc::truncated, at + 4, "index.bin: a cell ends past the end of shcoef.bin", harmonics.size(),
                        2 * run.offset);
    }
    n += run.n;  // 32 bits each
    runs.push_back(run);
  }
  if (is_stated ? n != wanted : n > data.size() / kRecordBytes) {
    return make_error(Errc::size_mismatch, index.size(),
                      "index.bin has another number of Gaussians of a level than the .lcc", wanted, n);
  }
  return runs;
}

// Gaussian i of a run.
Splat read_record(const Lcc& lcc, const Run& run, std::uint64_t i) {
  const Meta& meta = lcc.meta;
  const Bytes record = lcc.data.subspan(run.offset + kRecordBytes * i, kRecordBytes);
  const Bytes harmonics =
      meta.sh ? lcc.harmonics.subspan(2 * run.offset + kHarmonicsBytes * i, kHarmonicsBytes) : Bytes();
  Splat s;
  for (std::size_t k = 0; k < 3; ++k) {
    s.mean[k] = load<float>(record, 4 * k);
    s.sh[k] = dc_from_colour(load_u8(record, 12 + k) / 255.0);
    const double scale = meta.scale.value(k, load<std::uint16_t>(record, 16 + 2 * k), 65535);
    s.log_scale[k] = log_from_scale(static_cast<float>(scale), 0);
  }
  s.opacity_logit = logit_from_opacity(static_cast<float>(load_u8(record, 15)) / 255.F);
  const auto code = load<std::uint32_t>(record, 22);
  SmallestThree rotation;
  rotation.largest = code >> 30;
  for (std::uint32_t k = 0; k < 3; ++k) rotation.rest[k] = ((code >> 10 * k & 1023) / 1023.0 * 2 - 1) * kRootHalf;
  float q[4];  // x, y, z, w
  from_smallest_three(rotation, q);
  for (std::size_t k = 0; k < 4; ++k) s.rotation[k] = q[(k + 3) % 4];
  for (std::size_t k = 0; k < 15 && meta.sh; ++k) {
    const auto packed = load<std::uint32_t>(harmonics, 4 * k);
    s.sh[3 * k + 3] = static_cast<float>(meta.sh->value(0, packed & 2047, 2047));
    s.sh[3 * k + 4] = static_cast<float>(meta.sh->value(1, packed >> 11 & 1023, 1023));
    s.sh[3 * k + 5] = static_cast<float>(meta.sh->value(2, packed >> 21, 2047));
  }
  return s;
}

Status check_count(std::uint64_t n, const DecodeLimits& limits) {
  if (n <= limits.max_gaussians) return {};
  return make_error(Errc::limit_exceeded, 0, "more Gaussians than the caller allows", limits.max_gaussians, n);
}

Result<Lcc> open_lcc(Bytes bytes, const FetchBeside& fetch) {
  const auto root = parse_json(bytes);
  if (!root) return tl::unexpected(root.error());
  auto meta = parse_meta(*root);
  if (!meta) return tl::unexpected(meta.error());
  // Linux tells Index.bin, as the white paper writes, from index.bin, as the files are called.
  const auto open = [&](std::string name, const char* missing) -> Result<Bytes> {
    auto file = fetch(name);
    name[0] = static_cast<char>(name[0] - 'a' + 'A');
    if (!file) file = fetch(name);
    if (!file) {
      Error error = file.error();
      error.what = missing;
      return tl::unexpected(error);
    }
    return file;
  };
  const auto index = open("index.bin", "cannot open index.bin beside the .lcc");
  if (!index) return tl::unexpected(index.error());
  const auto data = open("data.bin", "cannot open data.bin beside the .lcc");
  if (!data) return tl::unexpected(data.error());
  const auto harmonics =
      meta->sh ? open("shcoef.bin", "cannot open shcoef.bin beside the .lcc") : Result<Bytes>(Bytes());
  if (!harmonics) return tl::unexpected(harmonics.error());
  Lcc lcc{std::move(*meta), *index, *data, *harmonics, file_of(SplatFormat::lcc)};
  if (open("environment.bin", "")) lcc.file.unused.emplace_back("environment");
  if (open("collision.lci", "")) lcc.file.unused.emplace_back("collision mesh");
  note_georeference(*root, lcc.file.unused);
  return lcc;
}

struct Cells {
  std::vector<std::vector<Run>> runs;  // of each cell the levels that it has, the finest first
  std::uint64_t n = 0;
  std::uint64_t n_dropped = 0;  // Gaussians of cells without the finest level, which have no place in the scene
};

// The `n_levels` finest.
Result<Cells> find_cells(const Lcc& lcc, std::uint64_t n_levels) {
  Cells cells;
  for (std::uint64_t level = 0; level < n_levels && (level == 0 || cells.n != 0); ++level) {
    const auto runs = find_runs(lcc, level);
    if (!runs) {
      Error error = runs.error();
      if (level > 0)
        error.what = "a coarser level of the .lcc is cut off or contradicts it; the finest is read alone or with --lod";
      return tl::unexpected(error);
    }
    for (const Run& run : *runs) {
      if (level == 0) cells.runs.resize(run.cell + 1);
      const bool has_place = run.cell < cells.runs.size() && (level == 0 || !cells.runs[run.cell].empty());
      if (has_place) cells.runs[run.cell].push_back(run);
      (has_place ? cells.n : cells.n_dropped) += run.n;
    }
  }
  return cells;
}

// ---- LCC2 -----------------------------------------------------------------------------------------------------------

struct Tree {
  std::vector<std::string> files;
  std::uint64_t n_levels = 0;
  std::optional<std::uint64_t> environment;  // index of its file
  SplatFormat chunks = SplatFormat::sog;
};

// Empty if the name leaves the folder; one spelling for each file.
std::string path_within(std::string name, bool legacy) {
  if (legacy) {  // "/data/3dgs/0" is data/3dgs/0.sog
    if (name.starts_with('/')) name.erase(0, 1);
    if (!name.ends_with(".sog")) name += ".sog";
  }
  const auto path = detail::path_of(name).lexically_normal();
  const bool stays = !path.empty() && !path.has_root_path() && path.begin()->string() != ".." && path.has_filename() &&
                     name.find('\\') == std::string::npos && name.find('\0') == std::string::npos;
  return stays && path != "." ? path.generic_string() : std::string();
}

Result<Tree> parse_tree(const json& root, const json& top) {
  Tree tree;
  const bool legacy = json_member(root, "lod_3dgs_info") != nullptr;
  const auto n_levels = whole(json_member(root, legacy ? "lod_level" : "totalLevels"));
  const json* files = json_member(top, legacy ? "files" : "splatFiles");
  if (!n_levels || *n_levels == 0 || files == nullptr || !files->is_array())
    return bad_json("the .lcc2 lacks totalLevels or root.splatFiles");
  tree.n_levels = *n_levels;
  const json* type = json_member(root, "splatType");
  if (type != nullptr && !legacy && *type != ".sog") {
    if (*type != ".spz") {
      return make_error(
          Errc::unsupported_feature, 0,
          "an .lcc2 of other chunks than .sog and .spz is not read: convert the files in its data folder");
    }
    tree.chunks = SplatFormat::spz;
  }
  for (const json& name : *files) {
    tree.files.push_back(path_within(name.is_string() ? name.get<std::string>() : std::string(), legacy));
    if (tree.files.back().empty()) return bad_json("a name in root.splatFiles is no path inside the folder");
  }
  const json* data = json_member(top, "data");
  const json* environment = data != nullptr ? json_member(*data, "env") : nullptr;
  if (environment != nullptr) tree.environment = whole(json_member(*environment, "name"));
  return tree;
}

// Gaussians of a node: a run of a chunk's.
struct Part {
  std::uint64_t file = 0, start = 0;
  std::optional<std::uint64_t> count;  // if the node says how many; not 0
  std::uint64_t level = 0;
  std::uint32_t parent = LevelTree::kNoParent;  // the next part above
  bool has_finest = false;                      // is of the finest level, or above one that is
};

struct Lcc2 {
  Tree tree;
  std::vector<Part> parts;  // parents come before those below them
  SplatFile file;           // without Gaussians
};

Result<std::vector<Part>> find_parts(const json& top, const Tree& tree, std::uint64_t& n_coarser) {
  struct Open {
    const json* node = nullptr;
    std::uint64_t depth = 0;
    std::uint32_t parent = LevelTree::kNoParent;
  };
  std::vector<Part> parts;
  bool has_finest = false;
  std::vector<Open> open{{&top}};
  while (!open.empty()) {
    auto [node, depth, parent] = open.back();
    open.pop_back();
    const json* children = depth < tree.n_levels ? json_member(*node, "child") : nullptr;
    const bool has_children = children != nullptr && children->is_structured() && !children->empty();
    const json* data = json_member(*node, "data");
    const json* splats = data != nullptr && depth > 0 ? json_member(*data, "3dgs") : nullptr;
    if (splats != nullptr && !splats->is_null()) {
      const auto file = whole(json_member(*splats, "name")), count = whole(json_member(*splats, "count"));
      const bool is_finest = depth == tree.n_levels, is_known = file && *file < tree.files.size();
      if (is_finest && !is_known) {
        return make_error(Errc::bad_value, 0, "a node of the .lcc2 names a chunk that root.splatFiles lacks",
                          tree.files.size(), file.value_or(Error::kNone));
      }
      if (is_known && file != tree.environment) {
        has_finest = has_finest || is_finest;
        n_coarser += !is_finest && !has_children ? 1 : 0;
        if (count != std::uint64_t{0}) {
          const auto start = whole(json_member(*splats, "start"));
          parts.push_back({*file, start.value_or(0), count, tree.n_levels - depth, parent, is_finest});
          parent = static_cast<std::uint32_t>(parts.size() - 1);
        }
      }
    }
    if (!has_children) continue;
    for (const json& child : *children) open.push_back({&child, depth + 1, parent});
  }
  if (!has_finest) return bad_json("the .lcc2 has no chunks of its finest level");
  for (std::size_t i = parts.size(); i-- > 0;) {
    if (parts[i].has_finest && parts[i].parent != LevelTree::kNoParent) parts[parts[i].parent].has_finest = true;
  }
  return parts;
}

Result<Lcc2> open_lcc2(Bytes bytes) {
  const auto root = parse_json(bytes);
  if (!root) return tl::unexpected(root.error());
  static const json none;
  const json* stated = json_member(*root, "root");
  const json& top = stated != nullptr ? *stated : none;
  auto tree = parse_tree(*root, top);
  if (!tree) return tl::unexpected(tree.error());
  std::uint64_t n_coarser = 0;
  auto parts = find_parts(top, *tree, n_coarser);
  if (!parts) return tl::unexpected(parts.error());
  Lcc2 lcc2{std::move(*tree), std::move(*parts), file_of(SplatFormat::lcc2)};
  std::vector<std::string>& unused = lcc2.file.unused;
  if (n_coarser != 0) unused.push_back(std::to_string(n_coarser) + " nodes that have only coarser levels");
  if (lcc2.tree.environment) unused.emplace_back("environment");
  if (const json* meshes = json_member(top, "meshFiles"); meshes != nullptr && !meshes->empty())
    unused.emplace_back("meshes");
  note_georeference(*root, unused);
  return lcc2;
}

// Parts of each chunk, by the Gaussians with which they begin.
using PartsByFile = std::map<std::uint64_t, std::vector<std::uint32_t>>;
PartsByFile by_file(const Lcc2& lcc2) {
  PartsByFile of_file;
  for (std::uint32_t i = 0; i < lcc2.parts.size(); ++i) of_file[lcc2.parts[i].file].push_back(i);
  for (auto& [file, parts] : of_file)
    std::ranges::stable_sort(parts, {}, [&](std::uint32_t i) { return lcc2.parts[i].start; });
  return of_file;
}

// How many Gaussians parts of a chunk hold that follow one another; nullopt: they do not.
std::optional<std::uint64_t> count_runs(const Lcc2& lcc2, std::span<const std::uint32_t> parts) {
  constexpr std::uint64_t kMost = std::uint64_t{1} << 32;
  std::uint64_t end = 0;
  for (const std::uint32_t i : parts) {
    if (lcc2.parts[i].start != end || lcc2.parts[i].count.value_or(kMost) >= kMost - end) return std::nullopt;
    end += *lcc2.parts[i].count;
  }
  return end;
}

// Decodes chunks of which parts are wanted, one at a time, in their order. `visit` gets all parts of a chunk.
using VisitChunk = std::function<Status(std::span<const std::uint32_t> parts, SplatFile& chunk)>;
Status each_chunk(const Lcc2& lcc2, const std::vector<bool>& wanted, const FetchBeside& fetch,
                  const DecodeLimits& limits, const VisitChunk& visit) {
  std::set<std::string> names;
  const bool is_spz = lcc2.tree.chunks == SplatFormat::spz;
  ReadOptions options{.limits = limits, .format = lcc2.tree.chunks, .keep_axes = true};
  for (const auto& [file, parts] : by_file(lcc2)) {
    if (std::ranges::none_of(parts, [&](std::uint32_t i) { return wanted[i]; })) continue;
    if (!names.insert(lcc2.tree.files[file]).second)
      return make_error(Errc::bad_value, 0, "root.splatFiles names a chunk twice", Error::kNone, file);
    const auto bytes = fetch(lcc2.tree.files[file]);
    if (!bytes) {
      Error error = bytes.error();
      error.what = "cannot open a chunk that root.splatFiles names";
      return tl::unexpected(error);
    }
    // A georeference of an SPZ does not move it: that of the .lcc2 speaks for all.
    auto chunk = is_spz ? decode_spz(*bytes, options, false) : decode_sog(*bytes, options);
    if (!chunk) return tl::unexpected(chunk.error());
    chunk->bytes = bytes->size();
    options.limits.max_gaussians -= chunk->cloud.size();
    if (Status s = visit(parts, *chunk); !s) return s;
  }
  return {};
}

tl::unexpected<Error> another_count(std::uint64_t stated, std::uint64_t n) {
  return make_error(Errc::size_mismatch, 0, "a chunk has another number of Gaussians than its nodes", stated, n);
}

}  // namespace

bool is_lcc(std::span<const std::byte> bytes) {
  return is_json_with(bytes, "\"cellLengthX\"");
}

bool is_lcc2(std::span<const std::byte> bytes) {
  return is_json_with(bytes, "\"lodSplats\"") || is_json_with(bytes, "\"lod_3dgs_info\"");
}

Result<SplatFile> decode_lone_lcc(std::span<const std::byte>, const DecodeLimits&) {
  return make_error(Errc::unsupported_feature, 0, "an .lcc or .lcc2 without the files beside it: name the file");
}

Result<SplatFile> decode_lcc(std::span<const std::byte> bytes, const FetchBeside& fetch, const ReadOptions& options) {
  auto lcc = open_lcc(bytes, fetch);
  if (!lcc) return tl::unexpected(lcc.error());
  if (Status s = check_level(lcc->meta.n_levels, options); !s) return tl::unexpected(s.error());
  auto cells = find_cells(*lcc, options.level_of_detail.value_or(0) + std::uint64_t{1});
  if (!cells) return tl::unexpected(cells.error());
  std::erase_if(cells->runs, [](const std::vector<Run>& cell) { return cell.empty(); });
  std::uint64_t n = 0;
  for (const std::vector<Run>& cell : cells->runs) n += cell.back().n;
  if (Status s = check_count(n, options.limits); !s) return tl::unexpected(s.error());
  SplatFile file = std::move(lcc->file);
  PieceFiller filler(file, n, lcc->meta.sh ? 3 : 0, options);
  for (const std::vector<Run>& cell : cells->runs) {
    for (std::uint64_t i = 0; i < cell.back().n; ++i) {
      if (const Status s = filler.add(read_record(*lcc, cell.back(), i)); !s) return tl::unexpected(s.error());
    }
  }
  note_levels(lcc->meta.n_levels, options, file);
  return file;
}

Result<LevelTree> open_lcc_levels(std::span<const std::byte> bytes, const FetchBeside& fetch,
                                  const DecodeLimits& limits) {
  const auto lcc = open_lcc(bytes, fetch);
  if (!lcc) return tl::unexpected(lcc.error());
  const auto cells = find_cells(*lcc, lcc->meta.n_levels);
  if (!cells) return tl::unexpected(cells.error());
  if (Status s = check_count(cells->n, limits); !s) return tl::unexpected(s.error());
  LevelTree tree;
  tree.file = lcc->file;
  tree.file.n_levels = static_cast<std::uint32_t>(lcc->meta.n_levels);
  if (cells->n_dropped != 0)
    tree.file.unused.push_back(std::to_string(cells->n_dropped) + " Gaussians of cells without a finest level");
  std::vector<Run> all;
  for (const std::vector<Run>& cell : cells->runs) {
    for (auto run = cell.rbegin(); run != cell.rend(); ++run) {
      const auto parent = run == cell.rbegin() ? LevelTree::kNoParent : static_cast<std::uint32_t>(all.size() - 1);
      tree.nodes.push_back({static_cast<std::uint32_t>(run->level), parent, run->n});
      all.push_back(*run);
    }
  }
  tree.read = [lcc = *lcc, all](const LevelTree::Visit& visit) -> Status {
    for (std::uint32_t node = 0; node < all.size(); ++node) {
      SplatFile piece;
      piece.cloud.resize(all[node].n, lcc.meta.sh ? 3 : 0);
      for (std::uint64_t i = 0; i < all[node].n; ++i) piece.cloud.set(i, read_record(lcc, all[node], i));
      if (Status s = visit(node, std::move(piece)); !s) return s;
    }
    return {};
  };
  return tree;
}

Result<SplatFile> decode_lcc2(std::span<const std::byte> bytes, const FetchBeside& fetch, const ReadOptions& options) {
  const auto lcc2 = open_lcc2(bytes);
  if (!lcc2) return tl::unexpected(lcc2.error());
  const auto& parts = lcc2->parts;
  if (Status s = check_level(lcc2->tree.n_levels, options); !s) return tl::unexpected(s.error());
  const std::uint64_t level = options.level_of_detail.value_or(0);
  std::vector<bool> wanted;
  for (const Part& part : parts) {
    const bool is_highest = part.parent == LevelTree::kNoParent || parts[part.parent].level > level;
    wanted.push_back(part.has_finest && part.level <= level && is_highest);
  }
  SplatFile file = lcc2->file;
  bool is_first = true;
  const Status status = each_chunk(
      *lcc2, wanted, fetch, options.limits, [&](std::span<const std::uint32_t> of_chunk, SplatFile& chunk) -> Status {
        const std::uint64_t n = chunk.cloud.size();
        std::optional<std::uint64_t> stated = 0;  // by wanted ones, which may share it with others
        for (const std::uint32_t i : of_chunk)
          if (wanted[i]) stated = stated && parts[i].count ? std::optional(*stated + *parts[i].count) : std::nullopt;
        if (stated && *stated != n) {
          if (count_runs(*lcc2, of_chunk) != n) return another_count(*stated, n);
          std::vector<std::uint64_t> kept;
          for (const std::uint32_t i : of_chunk)
            for (std::uint64_t k = 0; k < *parts[i].count && wanted[i]; ++k) kept.push_back(parts[i].start + k);
          keep_splats(chunk.cloud, kept);
        }
        if (std::exchange(is_first, false)) file.aa_mode = chunk.aa_mode;
        append_splats(file.cloud, chunk.cloud);
        return hand_over(file, options);
      });
  if (!status) return tl::unexpected(status.error());
  note_levels(lcc2->tree.n_levels, options, file);
  return file;
}

Result<LevelTree> open_lcc2_levels(std::span<const std::byte> bytes, const FetchBeside& fetch,
                                   const DecodeLimits& limits) {
  auto opened = open_lcc2(bytes);
  if (!opened) return tl::unexpected(opened.error());
  const auto lcc2 = std::make_shared<const Lcc2>(std::move(*opened));
  LevelTree tree;
  tree.file = lcc2->file;
  tree.file.n_levels = static_cast<std::uint32_t>(std::min<std::uint64_t>(lcc2->tree.n_levels, ~std::uint32_t{0}));
  std::vector<std::uint32_t> node_of(lcc2->parts.size(), LevelTree::kNoParent);
  std::vector<bool> wanted;
  std::uint64_t n = 0;
  for (const Part& part : lcc2->parts) wanted.push_back(part.has_finest);
  for (const auto& [file, parts] : by_file(*lcc2)) {
    const bool is_wanted = std::ranges::any_of(parts, [&](std::uint32_t i) { return wanted[i]; });
    const auto of_file = count_runs(*lcc2, parts);
    if (is_wanted && !of_file) return tree;  // which Gaussians are whose is not known
    n += is_wanted ? *of_file : 0;
    if (Status s = check_count(n, limits); !s) return tl::unexpected(s.error());
  }
  for (std::size_t i = 0; i < wanted.size(); ++i) {
    if (!wanted[i]) continue;
    const Part& part = lcc2->parts[i];
    const std::uint32_t parent = part.parent == LevelTree::kNoParent ? part.parent : node_of[part.parent];
    node_of[i] = static_cast<std::uint32_t>(tree.nodes.size());
    tree.nodes.push_back({static_cast<std::uint32_t>(part.level), parent, *part.count});
  }
  tree.read = [lcc2, node_of, wanted, fetch, limits](const LevelTree::Visit& visit) {
    const auto visit_parts = [&](std::span<const std::uint32_t> parts, SplatFile& chunk) -> Status {
      const auto stated = count_runs(*lcc2, parts);
      if (stated != chunk.cloud.size()) return another_count(stated.value_or(Error::kNone), chunk.cloud.size());
      for (const std::uint32_t i : parts) {
        if (!wanted[i]) continue;
        SplatFile piece;
        piece.bytes = std::exchange(chunk.bytes, 0);
        piece.aa_mode = chunk.aa_mode;
        piece.cloud.resize(*lcc2->parts[i].count, chunk.cloud.sh_degree);
        for (std::uint64_t k = 0; k < piece.cloud.size(); ++k)
          piece.cloud.set(k, chunk.cloud.view().splat(lcc2->parts[i].start + k));
        if (Status s = visit(node_of[i], std::move(piece)); !s) return s;
      }
      return {};
    };
    return each_chunk(*lcc2, wanted, fetch, limits, visit_parts);
  };
  return tree;
}

}  // namespace rgs::detail
