// rad.cpp - reads .rad of Spark 2 (github.com/sparkjsdev/spark, rust/spark-lib), version 1.
//
//   file    "RAD0"  u32 bytes of JSON  JSON  zeros up to a multiple of 8  chunks, or their names: .radc beside the file
//   chunk   "RADC"  u32 bytes of JSON  JSON  zeros up to a multiple of 8  u64 bytes of properties  properties
// A property is an array [dimension, Gaussian] of a chunk's Gaussians, filled to a multiple of 8 bytes, and usually a
// raw deflate stream, which the JSON calls "gz". Encodings, between "min" and "max" of the JSON:
//   f32, f16, u32, u16    numbers; f32_lebytes, f16_lebytes: all lowest bytes first, then the next
//   r8, s8                u8 / 255 from min to max, i8 / 127 of max; r8_delta, s8_delta: differences along a dimension
//   ln_f16, ln_0r8        logarithms; 0: a scale of 0, 1 to 255 from min to max
//   oct88r8               [Gaussian, 3] u8 axis of rotation on an octahedron [2], angle / pi
// Rotations of f32 and f16 are x, y and z of quaternions whose w is not negative. An alpha above 1 is a Gaussian of a
// wider profile, see widen(). child_count and child_start name each Gaussian's children, a run counted over the file.
// Harmonics may be a palette in the first chunk (sh1_code to sh3_code), and sh_label the index of each Gaussian's.
// SPDX-License-Identifier: Apache-2.0
#include "rad.hpp"

#include <zlib.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <nlohmann/json.hpp>
#include <numbers>
#include <numeric>
#include <optional>
#include <utility>

#include "json_member.hpp"
#include "level_choice.hpp"
#include "quantised.hpp"
#include "rgs/page.hpp"
#include "rgs/quantize.hpp"
#include "signature.hpp"
#include "sog.hpp"

namespace rgs::detail {
namespace {

using nlohmann::json;
using Bytes = std::span<const std::byte>;

constexpr std::uint64_t kMaxJsonBytes = std::uint64_t{1} << 24;  // a chunk takes 60 bytes; Spark reads 2^20
constexpr std::uint64_t kBeforeJson = 8, kBeforeProperties = 8;
constexpr std::uint64_t kNone = std::numeric_limits<std::uint32_t>::max();

constexpr std::uint64_t padded(std::uint64_t bytes) {
  return (bytes + 7) & ~std::uint64_t{7};
}

// ---- properties -----------------------------------------------------------------------------------------------------

enum Encoding : std::uint8_t {
  f32,
  f16,
  f32_lebytes,
  f16_lebytes,
  r8,
  r8_delta,
  s8,
  s8_delta,
  ln_0r8,
  ln_f16,
  oct88r8,
  u16,
  u32,
  kEncodings
};
struct EncodingKind {
  std::string_view name;
  std::uint64_t bytes;
};
constexpr EncodingKind kEncodingKinds[kEncodings] = {
    {"f32", 4},      {"f16", 2},    {"f32_lebytes", 4}, {"f16_lebytes", 2}, {"r8", 1},  {"r8_delta", 1}, {"s8", 1},
    {"s8_delta", 1}, {"ln_0r8", 1}, {"ln_f16", 2},      {"oct88r8", 1},     {"u16", 2}, {"u32", 4}};

enum Property : std::uint8_t {
  center,
  alpha,
  rgb,
  scales,
  orientation,
  sh1,
  sh2,
  sh3,
  sh1_code,
  sh2_code,
  sh3_code,
  sh_label,
  child_count,
  child_start,
  kProperties
};
constexpr unsigned one_of(auto... encodings) {
  return ((1U << encodings) | ...);
}
constexpr unsigned kOfHarmonics = one_of(f32, f16, r8, r8_delta, s8, s8_delta);
struct PropertyKind {
  std::string_view name;
  std::uint64_t dimensions;
  unsigned encodings;  // that Spark reads
};
constexpr PropertyKind kPropertyKinds[kProperties] = {
    {"center", 3, one_of(f32, f16, f32_lebytes, f16_lebytes)},
    {"alpha", 1, one_of(f32, f16, r8)},
    {"rgb", 3, one_of(f32, f16, r8, r8_delta)},
    {"scales", 3, one_of(f32, ln_f16, ln_0r8)},
    {"orientation", 3, one_of(f32, f16, oct88r8)},
    {"sh1", 9, kOfHarmonics},
    {"sh2", 15, kOfHarmonics},
    {"sh3", 21, kOfHarmonics},
    {"sh1_code", 9, kOfHarmonics},
    {"sh2_code", 15, kOfHarmonics},
    {"sh3_code", 21, kOfHarmonics},
    {"sh_label", 1, one_of(u16, u32)},
    {"child_count", 1, one_of(u16)},
    {"child_start", 1, one_of(u32)},
};

// The index of a name in such a table; none if it is not there.
template <class Kind, std::size_t n>
std::optional<std::size_t> index_of(const Kind (&kinds)[n], const json* name) {
  if (name == nullptr || !name->is_string()) return std::nullopt;
  const auto* found = std::ranges::find(kinds, name->get_ref<const std::string&>(), &Kind::name);
  return found == std::end(kinds) ? std::nullopt : std::optional<std::size_t>(found - std::begin(kinds));
}

struct Stored {
  Property property = center;
  Encoding encoding = f32;
  bool deflated = false;
  std::uint64_t offset = 0, bytes = 0;  // in the file that holds the chunk
  std::uint64_t rows = 0;
  float low = 0, high = 0;

  std::uint64_t decoded_bytes() const {
    return rows * kPropertyKinds[property].dimensions * kEncodingKinds[encoding].bytes;
  }
};

// The decoded numbers of a property.
class Values {
 public:
  Values(const Stored& stored, std::vector<std::byte> bytes) : stored_(stored), bytes_(std::move(bytes)) {
    if (stored.encoding != r8_delta && stored.encoding != s8_delta) return;
    for (std::uint64_t i = 0; i < bytes_.size(); ++i) {
      if (i % stored.rows == 0) continue;  // each dimension begins anew
      bytes_[i] = static_cast<std::byte>(load_u8(bytes_, i - 1) + load_u8(bytes_, i));
    }
  }

  float number(std::uint64_t row, std::uint64_t dimension) const {
    const std::uint64_t i = dimension * stored_.rows + row, n = bytes_.size() / kEncodingKinds[stored_.encoding].bytes;
    const auto byte = [&](std::uint64_t plane) { return std::uint32_t{load_u8(bytes_, plane * n + i)}; };
    switch (stored_.encoding) {
      case f32: return load<float>(bytes_, 4 * i);
      case f16:
      case ln_f16: return float_from_half(load<std::uint16_t>(bytes_, 2 * i));
      case f32_lebytes: return std::bit_cast<float>(byte(0) | byte(1) << 8 | byte(2) << 16 | byte(3) << 24);
      case f16_lebytes: return float_from_half(static_cast<std::uint16_t>(byte(0) | byte(1) << 8));
      case r8:
      case r8_delta: return between(static_cast<float>(byte(0)) / 255);
      case s8:
      case s8_delta: return static_cast<float>(static_cast<std::int8_t>(byte(0))) / 127 * stored_.high;
      case ln_0r8:
        return byte(0) == 0 ? -std::numeric_limits<float>::infinity()
                            : between((static_cast<float>(byte(0)) - 1) / 254);
      default: return 0;
    }
  }
  std::uint32_t index(std::uint64_t row) const {
    return stored_.encoding == u16 ? load<std::uint16_t>(bytes_, 2 * row) : load<std::uint32_t>(bytes_, 4 * row);
  }
  float log_scale(std::uint64_t row, std::uint64_t dimension) const {
    const float value = number(row, dimension);
    if (stored_.encoding == f32) return log_from_scale(value, 0);
    return value == -std::numeric_limits<float>::infinity() ? log_from_scale(0, 0) : value;
  }
  std::array<float, 4> rotation(std::uint64_t row) const {
    if (stored_.encoding == oct88r8)
      return decode_octahedral({load_u8(bytes_, 3 * row), load_u8(bytes_, 3 * row + 1), load_u8(bytes_, 3 * row + 2)});
    const float x = number(row, 0), y = number(row, 1), z = number(row, 2);
    return {x, y, z, std::sqrt(std::max(0.F, 1 - x * x - y * y - z * z))};
  }
  std::uint64_t rows() const { return stored_.rows; }

 private:
  float between(float t) const { return stored_.low + t * (stored_.high - stored_.low); }

  Stored stored_;
  std::vector<std::byte> bytes_;
};

Result<Values> read_values(Bytes file, const Stored& stored) {
  const Bytes from = file.subspan(stored.offset, stored.bytes);
  std::vector<std::byte> bytes(stored.decoded_bytes());
  if (!stored.deflated) {
    std::ranges::copy(from, bytes.begin());
    return Values(stored, std::move(bytes));
  }
  z_stream stream{};
  constexpr int kRawDeflate = -15;
  if (inflateInit2(&stream, kRawDeflate) != Z_OK) throw std::bad_alloc();
  stream.next_in = reinterpret_cast<Bytef*>(const_cast<std::byte*>(from.data()));  // zlib does not write there
  stream.avail_in = static_cast<uInt>(from.size());
  stream.next_out = reinterpret_cast<Bytef*>(bytes.data());
  stream.avail_out = static_cast<uInt>(bytes.size());
  const int code = inflate(&stream, Z_FINISH);
  const bool whole = code == Z_STREAM_END && stream.avail_in == 0 && stream.avail_out == 0;
  inflateEnd(&stream);
  if (code == Z_MEM_ERROR) throw std::bad_alloc();
  if (!whole)
    return make_error(Errc::bad_value, stored.offset, "a property is damaged, or its Gaussians are not the chunk's");
  return Values(stored, std::move(bytes));
}

// ---- JSON -----------------------------------------------------------------------------------------------------------

std::optional<std::uint64_t> whole(const json* value) {
  // Larger numbers are none of a file; their sums do not overflow.
  constexpr std::uint64_t kMost = std::uint64_t{1} << 48;
  if (value == nullptr || !value->is_number_unsigned() || value->get<std::uint64_t>() > kMost) return std::nullopt;
  return value->get<std::uint64_t>();
}

// The JSON of a file or chunk that begins at `at`.
struct Head {
  json root;
  std::uint64_t end = 0;  // of the zeros behind it
};
Result<Head> read_head(Bytes file, std::uint64_t at, std::string_view magic) {
  if (file.size() - at < kBeforeJson)
    return make_error(Errc::truncated, at, "the file ends inside a header", kBeforeJson, file.size() - at);
  if (!text_of(file.subspan(at)).starts_with(magic))
    return make_error(Errc::bad_magic, at, "a chunk of the .rad does not begin with RADC");
  const std::uint64_t bytes = load<std::uint32_t>(file, at + 4), from = at + kBeforeJson;
  if (bytes > kMaxJsonBytes)
    return make_error(Errc::limit_exceeded, at + 4, "the JSON is longer than 16 MiB", kMaxJsonBytes, bytes);
  if (padded(bytes) > file.size() - from)
    return make_error(Errc::truncated, at + 4, "the file ends inside its JSON", padded(bytes), file.size() - from);
  Head head{json::parse(text_of(file.subspan(from, bytes)), nullptr, false), from + padded(bytes)};
  if (!head.root.is_object()) return make_error(Errc::bad_syntax, from, "the JSON of the .rad is not an object");
  if (whole(json_member(head.root, "version")) != std::uint64_t{1})
    return make_error(Errc::unsupported_version, from, "the version of the .rad or of a chunk is not 1");
  return head;
}

struct Piece {  // a chunk as the file lists it
  std::uint64_t offset = 0, bytes = 0;
  std::string name;  // of its own file; empty: in this one
};

struct Meta {
  std::uint64_t n = 0, n_codes = 0;
  int sh_degree = 0;
  bool tree = false;
  std::vector<Piece> pieces;
};

Result<Meta> parse_meta(Bytes bytes, const DecodeLimits& limits) {
  const auto head = read_head(bytes, 0, kRadMagic);
  if (!head) return tl::unexpected(head.error());
  const json& root = head->root;
  const auto bad = [](const char* what) { return make_error(Errc::bad_syntax, kBeforeJson, what); };
  if (const json* type = json_member(root, "type"); type == nullptr || *type != "gsplat")
    return make_error(Errc::unsupported_feature, kBeforeJson,
                      "a .rad of another type than gsplat is not read: convert the scene that it was made from");
  const auto n = whole(json_member(root, "count"));
  const json* chunks = json_member(root, "chunks");
  if (!n || chunks == nullptr || !chunks->is_array()) return bad("the .rad lacks count or chunks");
  Meta meta;
  meta.n = *n;
  if (meta.n > limits.max_gaussians || meta.n >= kNone)
    return make_error(Errc::limit_exceeded, kBeforeJson, "more Gaussians than the caller allows", limits.max_gaussians,
                      meta.n);
  if (const json* degree = json_member(root, "maxSh"); degree != nullptr && !degree->is_null()) {
    if (whole(degree).value_or(kNone) > kMaxShDegree)
      return make_error(Errc::unsupported_feature, kBeforeJson, "the SH degree is not 0 to 3");
    meta.sh_degree = degree->get<int>();
  }
  const json* tree = json_member(root, "lodTree");
  meta.tree = tree != nullptr && *tree == true;
  meta.n_codes = whole(json_member(root, "shCodeCount")).value_or(0);
  std::uint64_t next = head->end;
  for (const json& chunk : *chunks) {
    const auto offset = whole(json_member(chunk, "offset")), size = whole(json_member(chunk, "bytes"));
    const json* name = json_member(chunk, "filename");
    if (!offset || !size) return bad("a chunk of the .rad lacks offset or bytes");
    Piece piece{0, *size, name != nullptr && name->is_string() ? name->get<std::string>() : std::string()};
    if (name != nullptr && name->is_string()) {
      if (!is_beside(piece.name) || !piece.name.ends_with(".radc"))
        return bad("the filename of a chunk is not that of a .radc beside the .rad");
    } else {
      piece.offset = head->end + *offset;
      if (piece.offset != next)
        return make_error(Errc::bad_header, kBeforeJson, "chunks of the .rad overlap, or leave bytes between them",
                          next - head->end, *offset);
      if (piece.bytes > bytes.size() - piece.offset)
        return make_error(Errc::truncated, bytes.size(), "the file ends inside a chunk", piece.offset + piece.bytes,
                          bytes.size());
      next += piece.bytes;
    }
    meta.pieces.push_back(std::move(piece));
  }
  if (next != bytes.size())
    return make_error(Errc::trailing_bytes, next, "bytes after the last chunk", next, bytes.size());
  return meta;
}

// ---- chunks ---------------------------------------------------------------------------------------------------------

struct Chunk {
  std::uint64_t n = 0;
  std::array<std::optional<Stored>, kProperties> properties;
};

Result<Stored> parse_property(const json& json_of_it, std::uint64_t n, const Meta& meta, std::uint64_t at) {
  const auto property = index_of(kPropertyKinds, json_member(json_of_it, "property"));
  const auto encoding = index_of(kEncodingKinds, json_member(json_of_it, "encoding"));
  const json* compression = json_member(json_of_it, "compression");
  const bool compressed = compression != nullptr && !compression->is_null();
  if (!property || !encoding || (kPropertyKinds[*property].encodings >> *encoding & 1) == 0 ||
      (compressed && *compression != "gz"))
    return make_error(Errc::unsupported_feature, at,
                      "a property of the .rad, its encoding or compression is none of Spark 2.2: convert the scene "
                      "that it was made from, or update this program");
  const auto bytes = whole(json_member(json_of_it, "bytes"));
  if (!bytes) return make_error(Errc::bad_syntax, at, "a property of the .rad lacks its bytes");
  Stored stored;
  stored.property = static_cast<Property>(*property);
  stored.encoding = static_cast<Encoding>(*encoding);
  stored.deflated = compressed;
  stored.bytes = *bytes;
  const bool is_palette = stored.property >= sh1_code && stored.property <= sh3_code;
  stored.rows = is_palette && meta.n_codes != 0 ? meta.n_codes : n;
  if (std::max(stored.bytes, stored.decoded_bytes()) > std::numeric_limits<std::uint32_t>::max())
    return make_error(Errc::limit_exceeded, at, "a property of a chunk of the .rad has 4 GiB or more",
                      std::numeric_limits<std::uint32_t>::max(), std::max(stored.bytes, stored.decoded_bytes()));
  if (!stored.deflated && stored.bytes != stored.decoded_bytes())
    return make_error(Errc::size_mismatch, at, "a property's bytes are not those of the chunk's Gaussians",
                      stored.decoded_bytes(), stored.bytes);
  const auto bound = [&](const char* name, float& value) {
    const json* stated = json_member(json_of_it, name);
    if (stated == nullptr || !stated->is_number()) return false;
    value = static_cast<float>(stated->get<double>());
    return std::isfinite(value);
  };
  const bool signed_codes = stored.encoding == s8 || stored.encoding == s8_delta;
  const bool codes = signed_codes || stored.encoding == r8 || stored.encoding == r8_delta || stored.encoding == ln_0r8;
  if (codes && (!bound("max", stored.high) || (!signed_codes && !bound("min", stored.low))))
    return make_error(Errc::bad_syntax, at, "a property of the .rad lacks the bounds of its codes");
  return stored;
}

// `file` holds a chunk at piece.offset, whose first Gaussian is `base`.
Result<Chunk> parse_chunk(Bytes file, const Piece& piece, std::uint64_t base, const Meta& meta) {
  const Bytes up_to_end = file.first(piece.offset + piece.bytes);
  const auto head = read_head(up_to_end, piece.offset, kRadChunkMagic);
  if (!head) return tl::unexpected(head.error());
  const std::uint64_t at = piece.offset + kBeforeJson;
  const auto stated_base = whole(json_member(head->root, "base")), n = whole(json_member(head->root, "count"));
  const json* properties = json_member(head->root, "properties");
  if (!stated_base || !n || properties == nullptr || !properties->is_array())
    return make_error(Errc::bad_syntax, at, "a chunk of the .rad lacks base, count or properties");
  if (*stated_base != base || *n == 0 || *n > meta.n - base)
    return make_error(Errc::bad_header, at, "Gaussians of a chunk do not follow those of the one before, or are none",
                      base, *stated_base);
  if (up_to_end.size() - head->end < kBeforeProperties)
    return make_error(Errc::truncated, head->end, "a chunk of the .rad ends before its properties");
  const std::uint64_t payload = load<std::uint64_t>(file, head->end), first = head->end + kBeforeProperties;
  if (payload != up_to_end.size() - first)
    return make_error(Errc::size_mismatch, head->end, "a chunk's properties have other bytes than the .rad lists",
                      up_to_end.size() - first, payload);
  Chunk chunk{*n, {}};
  std::uint64_t next = first;
  for (const json& property : *properties) {
    auto stored = parse_property(property, *n, meta, at);
    if (!stored) return tl::unexpected(stored.error());
    if (whole(json_member(property, "offset")) != next - first)
      return make_error(Errc::bad_header, at, "properties of a chunk overlap, or leave bytes between them",
                        next - first);
    if (padded(stored->bytes) > up_to_end.size() - next)
      return make_error(Errc::truncated, next, "a property ends past the end of its chunk", padded(stored->bytes),
                        up_to_end.size() - next);
    stored->offset = next;
    next += padded(stored->bytes);
    auto& place = chunk.properties[stored->property];
    if (place) return make_error(Errc::bad_header, at, "a chunk has a property twice");
    place = *stored;
  }
  if (next != up_to_end.size()) return make_error(Errc::trailing_bytes, next, "bytes after a chunk's last property");
  const auto has = [&](int property) { return chunk.properties[static_cast<std::size_t>(property)].has_value(); };
  bool complete = has(center) && has(alpha) && has(rgb) && has(scales) && has(orientation) &&
                  (!meta.tree || (has(child_count) && has(child_start)));
  for (int d = 0; d < meta.sh_degree; ++d) complete = complete && (has(sh1 + d) || has(sh_label));
  if (!complete) return make_error(Errc::missing_section, at, "a chunk lacks a property that all have");
  return chunk;
}

// ---- tree -----------------------------------------------------------------------------------------------------------

struct Node {
  std::uint32_t first_child = 0, parent = kNone;
  std::uint32_t height = 0;  // above the deepest leaf below it
  std::uint16_t n_children = 0, n_open = 0;
};

// Fills in parents and heights; returns the number of levels. Errors: bad_value.
Result<std::uint32_t> settle_tree(std::vector<Node>& nodes) {
  std::vector<std::uint32_t> done;
  for (std::uint32_t i = 0; i < nodes.size(); ++i) {
    Node& node = nodes[i];
    node.n_open = node.n_children;
    if (node.n_children == 0) {
      done.push_back(i);
      continue;
    }
    if (node.n_children > nodes.size() - std::min<std::uint64_t>(nodes.size(), node.first_child))
      return make_error(Errc::bad_value, kBeforeJson, "children of a Gaussian of the .rad are beyond its last",
                        nodes.size(), std::uint64_t{node.first_child} + node.n_children);
    for (std::uint32_t c = node.first_child; c < node.first_child + node.n_children; ++c) {
      if (nodes[c].parent != kNone)
        return make_error(Errc::bad_value, kBeforeJson, "a Gaussian of the .rad is a child of two", Error::kNone, c);
      nodes[c].parent = i;
    }
  }
  std::uint32_t highest = 0;
  for (std::size_t k = 0; k < done.size(); ++k) {
    const Node& node = nodes[done[k]];
    highest = std::max(highest, node.height);
    if (node.parent == kNone) continue;
    Node& parent = nodes[node.parent];
    parent.height = std::max(parent.height, node.height + 1);
    if (--parent.n_open == 0) done.push_back(node.parent);
  }
  if (done.size() != nodes.size())
    return make_error(Errc::bad_value, kBeforeJson, "a Gaussian of the .rad is below itself");
  return highest + 1;
}

// Cuts by height, the finest first, of which each has at most half the Gaussians of the one before, but more than one.
std::vector<std::uint32_t> halving_cuts(const std::vector<Node>& nodes, std::uint32_t n_levels) {
  std::vector<std::int64_t> n(n_levels + 1);  // of each cut, as the difference from the one before
  for (const Node& node : nodes) {
    ++n[node.height];
    --n[node.parent == kNone ? n_levels : nodes[node.parent].height];
  }
  std::partial_sum(n.begin(), n.end(), n.begin());
  std::vector<std::uint32_t> cuts{0};
  for (std::uint32_t height = 1; height < n_levels; ++height)
    if (n[height] > 1 && n[height] <= n[cuts.back()] / 2) cuts.push_back(height);
  return cuts;
}

using Rows = std::vector<std::uint32_t>;
constexpr std::uint64_t kMostRows = std::uint64_t{lod::kPageChunks} * 256;  // of a part: a page of usual chunks

// Cuts rows into as few parts of nearly the same size as hold at most kMostRows each: cells of a k-d tree.
void cut_apart(const SplatCloud& cloud, std::span<std::uint32_t> rows, const auto& put) {
  const std::uint64_t n_parts = (rows.size() + kMostRows - 1) / kMostRows;
  if (n_parts <= 1) return put(Rows(rows.begin(), rows.end()));
  constexpr float kLowest = std::numeric_limits<float>::lowest();  // also for what is no number, which has no order
  const auto at = [&](std::uint32_t row, std::size_t axis) {
    const float x = cloud.mean[3 * std::size_t{row} + axis];
    return std::isfinite(x) ? x : kLowest;
  };
  std::size_t axis = 0;
  float widest = -1;
  for (std::size_t k = 0; k < 3; ++k) {
    float low = -kLowest, high = kLowest;
    for (const std::uint32_t row : rows) low = std::min(low, at(row, k)), high = std::max(high, at(row, k));
    if (high - low > widest) axis = k, widest = high - low;
  }
  const std::uint64_t n_first = rows.size() * (n_parts / 2) / n_parts;
  std::ranges::nth_element(rows, rows.begin() + static_cast<std::ptrdiff_t>(n_first), {},
                           [&](std::uint32_t row) { return std::pair(at(row, axis), row); });
  cut_apart(cloud, rows.first(n_first), put);
  cut_apart(cloud, rows.subspan(n_first), put);
}

// Gaussians of each of the nodes that it appends: those of the coarsest cut, then those below them on the next finer.
std::vector<Rows> parts_of(const std::vector<Node>& tree, const std::vector<std::uint32_t>& cuts,
                           const SplatCloud& cloud, std::vector<LevelTree::Node>& nodes) {
  std::vector<Rows> parts;
  const auto add = [&](Rows rows, std::size_t level, std::uint32_t parent) {
    cut_apart(cloud, rows, [&](Rows part) {
      std::size_t own = level;  // not that of a coarser cut that would be the same
      const auto is_finer = [&](std::uint32_t row) { return tree[row].height <= cuts[own - 1]; };
      while (own > 0 && std::ranges::all_of(part, is_finer)) --own;
      nodes.push_back({static_cast<std::uint32_t>(own), parent, part.size()});
      parts.push_back(std::move(part));
    });
  };
  Rows top;
  for (std::uint32_t i = 0; i < tree.size(); ++i)
    if (tree[i].height <= cuts.back() && (tree[i].parent == kNone || tree[tree[i].parent].height > cuts.back()))
      top.push_back(i);
  add(std::move(top), cuts.size() - 1, LevelTree::kNoParent);
  for (std::uint32_t i = 0; i < parts.size(); ++i) {
    if (nodes[i].level == 0) continue;
    const std::size_t level = nodes[i].level - 1;
    Rows open = parts[i], finer;
    while (!open.empty()) {
      const std::uint32_t row = open.back();
      open.pop_back();
      if (tree[row].height <= cuts[level]) {
        finer.push_back(row);
      } else {
        for (std::uint32_t k = 0; k < tree[row].n_children; ++k) open.push_back(tree[row].first_child + k);
      }
    }
    add(std::move(finer), level, i);
  }
  return parts;
}

// Spark's profile of an alpha a above 1 is 1 - (1 - exp(-r^2 / 2))^w. Its `lodInflate` draws the same as a Gaussian
// whose opacity is 1 and whose scales are w^(1/3) times as large: this is its logarithm.
float widen(float alpha) {
  const float a = std::min(4 * alpha - 3, 5.F);
  return (a * a - 1) / (3 * std::numbers::e_v<float>);
}

// ---- scene ----------------------------------------------------------------------------------------------------------

class Reader {
 public:
  Reader(Bytes bytes, const FetchFile& fetch, const ReadOptions& options)
      : bytes_(bytes), fetch_(fetch), options_(options) {}

  Result<SplatFile> read() {
    if (Status s = open(); !s) return tl::unexpected(s.error());
    if (options_.level_of_detail && !meta_.tree)
      return make_error(Errc::bad_argument, Error::kNone, "no levels of detail are read from this file");
    SplatFile file;
    if (Status s = choose(file); !s) return tl::unexpected(s.error());
    if (Status s = decode_kept(); !s) return tl::unexpected(s.error());
    file.cloud = std::move(cloud_);
    return file;
  }

  // Nodes are the parts of halving_cuts(), of which finer ones replace the one that their Gaussians are below. All
  // Gaussians stay in memory.
  Result<LevelTree> levels() {
    if (Status s = open(); !s) return tl::unexpected(s.error());
    LevelTree tree;
    tree.file.format = SplatFormat::rad;
    if (!meta_.tree) return tree;
    const auto n_levels = settle_tree(nodes_);
    if (!n_levels) return tl::unexpected(n_levels.error());
    tree.file.n_levels = *n_levels;
    kept_.resize(meta_.n);
    std::iota(kept_.begin(), kept_.end(), 0U);
    if (Status s = decode_kept(); !s) return tl::unexpected(s.error());
    const auto cloud = std::make_shared<const SplatCloud>(std::move(cloud_));
    const auto parts = parts_of(nodes_, halving_cuts(nodes_, *n_levels), *cloud, tree.nodes);
    std::vector<std::uint32_t> places(meta_.n);  // of leaves, among those that read() returns
    for (std::uint32_t i = 0, n_leaves = 0; i < meta_.n; ++i) places[i] = nodes_[i].n_children == 0 ? n_leaves++ : 0;
    tree.read = [cloud, parts, places](const LevelTree::Visit& visit) -> Status {
      for (std::uint32_t node = 0; node < parts.size(); ++node) {
        SplatFile piece;
        piece.cloud.resize(parts[node].size(), cloud->sh_degree);
        for (std::size_t i = 0; i < parts[node].size(); ++i) {
          piece.cloud.set(i, cloud->view().splat(parts[node][i]));
          piece.source_index.push_back(places[parts[node][i]]);
        }
        if (Status s = visit(node, std::move(piece)); !s) return s;
      }
      return {};
    };
    return tree;
  }

 private:
  // What the file unfolds to and its tree, before memory for the scene.
  Status open() {
    auto meta = parse_meta(bytes_, options_.limits);
    if (!meta) return tl::unexpected(meta.error());
    meta_ = std::move(*meta);
    stored_ = bytes_.size();
    return for_each_chunk([&](Bytes file, const Chunk& chunk) { return look_at(file, chunk); });
  }

  Status decode_kept() {
    cloud_.resize(kept_.size(), meta_.sh_degree);
    return for_each_chunk([&](Bytes from, const Chunk& chunk) { return decode(from, chunk); });
  }

  Status for_each_chunk(const auto& visit) {
    base_ = 0;
    for (const Piece& piece : meta_.pieces) {
      std::vector<std::byte> beside;
      Bytes file = bytes_;
      if (!piece.name.empty()) {
        auto fetched = fetch_(piece.name);
        if (!fetched) {
          Error error = fetched.error();
          if (error.code != Errc::unsupported_feature) error.what = "cannot open a .radc that the .rad names";
          return tl::unexpected(error);
        }
        beside = std::move(*fetched);
        file = beside;
        if (file.size() != piece.bytes)
          return make_error(Errc::size_mismatch, file.size(), "a .radc has other bytes than the .rad lists",
                            piece.bytes, file.size());
      }
      const auto chunk = parse_chunk(file, piece, base_, meta_);
      if (!chunk) return tl::unexpected(chunk.error());
      if (Status s = visit(file, *chunk); !s) return s;
      base_ += chunk->n;
    }
    if (base_ != meta_.n)
      return make_error(Errc::size_mismatch, kBeforeJson, "the chunks hold another number of Gaussians than the .rad",
                        meta_.n, base_);
    return {};
  }

  Status look_at(Bytes file, const Chunk& chunk) {
    if (file.data() != bytes_.data()) stored_ += file.size();
    if (stored_ > options_.limits.max_file_bytes)
      return make_error(Errc::limit_exceeded, 0, "the file is larger than the caller allows",
                        options_.limits.max_file_bytes, stored_);
    for (const auto& property : chunk.properties) decoded_ += property ? property->decoded_bytes() : 0;
    // A label takes two bytes, but stands for a row of each palette.
    for (int d = 0; d < meta_.sh_degree; ++d) {
      const auto degree = static_cast<std::size_t>(sh1 + d);
      if (!chunk.properties[degree]) decoded_ += chunk.n * kPropertyKinds[degree].dimensions;
    }
    if (Status s = check_expansion(decoded_, stored_, kBeforeJson, options_.limits); !s) return s;
    if (!meta_.tree) return {};
    const auto count = read_values(file, *chunk.properties[child_count]);
    if (!count) return tl::unexpected(count.error());
    const auto start = read_values(file, *chunk.properties[child_start]);
    if (!start) return tl::unexpected(start.error());
    for (std::uint64_t i = 0; i < chunk.n; ++i) {
      Node& node = nodes_.emplace_back();
      node.n_children = static_cast<std::uint16_t>(count->index(i));
      node.first_child = start->index(i);
    }
    return {};
  }

  // Which Gaussians are read.
  Status choose(SplatFile& file) {
    const std::uint32_t wanted = options_.level_of_detail.value_or(0);
    if (meta_.tree) {
      const auto n_levels = settle_tree(nodes_);
      if (!n_levels) return tl::unexpected(n_levels.error());
      file.n_levels = *n_levels;
      file.finest = wanted == 0;
      if (Status s = check_level(*n_levels, options_); !s) return s;
      if (*n_levels > 1 && !options_.level_of_detail) file.unused.emplace_back("levels of detail but the finest");
    }
    for (std::uint32_t i = 0; i < meta_.n; ++i) {
      const bool keep = !meta_.tree || (nodes_[i].height <= wanted &&
                                        (nodes_[i].parent == kNone || nodes_[nodes_[i].parent].height > wanted));
      if (keep) kept_.push_back(i);
    }
    nodes_ = {};
    return {};
  }

  Status decode(Bytes file, const Chunk& chunk) {
    const std::uint64_t first = written_;
    while (written_ < kept_.size() && kept_[written_] < base_ + chunk.n) ++written_;
    // put(i, row, values) for each Gaussian i of the scene.
    const auto each = [&](const std::optional<Stored>& stored, const auto& put) -> Status {
      if (!stored) return {};
      const auto values = read_values(file, *stored);
      if (!values) return tl::unexpected(values.error());
      for (std::uint64_t i = first; i < written_; ++i) {
        if (Status s = put(i, kept_[i] - base_, *values); !s) return s;
      }
      return {};
    };
    const auto& properties = chunk.properties;
    const auto three = [](std::vector<float>& to, const auto& value) {
      return [&to, value](std::uint64_t i, std::uint64_t row, const Values& v) -> Status {
        for (std::uint64_t k = 0; k < 3; ++k) to[3 * i + k] = value(v, row, k);
        return {};
      };
    };
    Status s =
        each(properties[center],
             three(cloud_.mean, [](const Values& v, std::uint64_t row, std::uint64_t k) { return v.number(row, k); }));
    if (s)
      s = each(properties[scales], three(cloud_.log_scale, [](const Values& v, std::uint64_t row, std::uint64_t k) {
                 return v.log_scale(row, k);
               }));
    if (s)
      s = each(properties[orientation], [&](std::uint64_t i, std::uint64_t row, const Values& v) -> Status {
        const std::array<float, 4> xyzw = v.rotation(row);
        for (std::uint64_t k = 0; k < 4; ++k) cloud_.rotation[4 * i + k] = xyzw[(k + 3) % 4];
        return {};
      });
    if (s)
      s = each(properties[alpha], [&](std::uint64_t i, std::uint64_t row, const Values& v) -> Status {
        const float value = v.number(row, 0);
        cloud_.opacity_logit[i] = logit_from_opacity(value);
        for (std::uint64_t k = 0; k < 3 && value > 1; ++k) cloud_.log_scale[3 * i + k] += widen(value);
        return {};
      });
    const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(meta_.sh_degree));
    if (s)
      s = each(properties[rgb], [&](std::uint64_t i, std::uint64_t row, const Values& v) -> Status {
        for (std::uint64_t c = 0; c < 3; ++c)
          cloud_.sh[floats * i + c] = dc_from_colour(static_cast<double>(v.number(row, c)));
        return {};
      });
    for (int d = 0; d < meta_.sh_degree && s; ++d) {
      const auto degree = static_cast<std::size_t>(d);
      const auto at = static_cast<std::uint64_t>(3 * sh_coefficients(d));
      const std::uint64_t n = kPropertyKinds[sh1 + degree].dimensions;
      const auto copy = [&](std::uint64_t i, std::uint64_t row, const Values& v) {
        for (std::uint64_t k = 0; k < n; ++k) cloud_.sh[floats * i + at + k] = v.number(row, k);
      };
      const auto& codes = properties[sh1_code + degree];
      if (codes) {
        auto palette = read_values(file, *codes);
        if (!palette) return tl::unexpected(palette.error());
        palettes_[degree] = std::move(*palette);
      }
      if (properties[sh1 + degree]) {
        s = each(properties[sh1 + degree], [&](std::uint64_t i, std::uint64_t row, const Values& v) -> Status {
          copy(i, row, v);
          return {};
        });
        continue;
      }
      const auto& palette = palettes_[degree];
      s = each(properties[sh_label], [&](std::uint64_t i, std::uint64_t row, const Values& labels) -> Status {
        const std::uint64_t label = labels.index(row);
        if (!palette || label >= palette->rows())
          return make_error(Errc::bad_value, properties[sh_label]->offset, "an sh_label is beyond the palette",
                            palette ? palette->rows() : 0, label);
        copy(i, label, *palette);
        return {};
      });
    }
    return s;
  }

  Bytes bytes_;
  const FetchFile& fetch_;
  const ReadOptions& options_;
  Meta meta_;
  std::uint64_t base_ = 0, stored_ = 0, decoded_ = 0;
  std::vector<Node> nodes_;
  std::vector<std::uint32_t> kept_;  // their positions in the file
  std::uint64_t written_ = 0;
  SplatCloud cloud_;
  std::array<std::optional<Values>, kMaxShDegree> palettes_;
};

Result<std::vector<std::byte>> no_files(const std::string&) {
  return make_error(Errc::unsupported_feature, 0, "a .rad without the .radc files of its chunks: name the file");
}

}  // namespace

std::array<float, 4> decode_octahedral(const std::array<std::uint8_t, 3>& code) {
  double x = code[0] / 127.5 - 1, y = code[1] / 127.5 - 1;
  const double z = 1 - std::abs(x) - std::abs(y), fold = std::max(0.0, -z);
  x -= std::copysign(fold, x), y -= std::copysign(fold, y);
  const double half_angle = code[2] / 510.0 * std::numbers::pi;
  const double scale = std::sin(half_angle) / std::sqrt(x * x + y * y + z * z);
  return {static_cast<float>(x * scale), static_cast<float>(y * scale), static_cast<float>(z * scale),
          static_cast<float>(std::cos(half_angle))};
}

bool is_rad(std::span<const std::byte> bytes) {
  return begins_with(bytes, kRadMagic);
}

Result<SplatFile> decode_rad(std::span<const std::byte> bytes, const ReadOptions& options) {
  return Reader(bytes, no_files, options).read();
}

Result<SplatFile> decode_rad_folder(std::span<const std::byte> bytes, const std::string& folder,
                                    const ReadOptions& options) {
  std::uint64_t total = 0;
  auto file = Reader(bytes, fetch_from(folder, total), options).read();
  if (file) file->bytes = bytes.size() + total / 2;  // each is read twice
  return file;
}

Result<LevelTree> open_rad_levels(std::span<const std::byte> bytes, const std::string& folder,
                                  const ReadOptions& options) {
  std::uint64_t total = 0;
  auto tree = Reader(bytes, folder.empty() ? no_files : fetch_from(folder, total), options).levels();
  if (tree) tree->file.bytes = bytes.size() + total / 2;
  return tree;
}

}  // namespace rgs::detail
