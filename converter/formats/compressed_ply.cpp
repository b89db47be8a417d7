// compressed_ply.cpp - PlayCanvas's compressed PLY (developer.playcanvas.com, "Compressed PLY"): chunks of 256
// Gaussians with the bounds of their means, log-scales and colours; 16 bytes a Gaussian relative to them; 1 byte a
// coefficient.
//
//   packed_position  x 11 bits, y 10, z 11 from the top, between the chunk's bounds
//   packed_rotation  2 bits: the largest of w, x, y, z; then the others, 10 bits each, in +-sqrt(1/2)
//   packed_scale     logarithms, 11, 10, 11 bits between the chunk's bounds
//   packed_color     red, green, blue between the chunk's bounds (0..1 in older files), opacity; 8 bits each
//   f_rest_*         256 steps of 1/32 from -4 to 4, channel-major as in 3DGS PLY; the middle of a step, the ends exact
// SPDX-License-Identifier: Apache-2.0
#include "compressed_ply.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <string>
#include <string_view>

#include "pieces.hpp"
#include "ply_header.hpp"
#include "quantised.hpp"
#include "rgs/quantize.hpp"
#include "stated_scene.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kChunk = 256;
constexpr std::array<const char*, 18> kChunkNames{
    "min_x",       "min_y",       "min_z",       "max_x", "max_y", "max_z", "min_scale_x", "min_scale_y", "min_scale_z",
    "max_scale_x", "max_scale_y", "max_scale_z", "min_r", "min_g", "min_b", "max_r",       "max_g",       "max_b"};
constexpr std::array<const char*, 4> kVertexNames{"packed_position", "packed_rotation", "packed_scale", "packed_color"};

struct Table {
  std::uint64_t offset = 0, row_bytes = 0, count = 0;
  std::vector<std::uint64_t> at;  // one per wanted property; empty if the element lacks any of them
};

const PlyElement* find_element(const PlyHeader& header, std::string_view name) {
  const auto found = std::ranges::find(header.elements, name, &PlyElement::name);
  return found == header.elements.end() ? nullptr : &*found;
}

std::vector<std::uint64_t> find_properties(const PlyElement& element, std::span<const std::string> names,
                                           PlyType type) {
  std::vector<std::uint64_t> at;
  for (const std::string& name : names) {
    std::uint64_t offset = 0;
    for (const PlyProperty& property : element.properties) {
      if (property.name == name && property.type == type) {
        at.push_back(offset);
        break;
      }
      offset += ply_type_bytes(property.type);
    }
  }
  if (at.size() != names.size()) at.clear();
  return at;
}

struct Tables {
  Table chunk, vertex, sh;
  int sh_degree = 0;
  StatedScene stated;
};

Result<Table> locate(const PlyHeader& header, const PlyElement& wanted, std::uint64_t file_bytes) {
  Table table;
  table.offset = header.bytes;
  for (const PlyElement& element : header.elements) {
    if (element.has_lists)
      return make_error(Errc::unsupported_feature, element.line, "a compressed PLY has list properties");
    const std::uint64_t row = element.min_row_bytes, rest = file_bytes - table.offset;
    if (row != 0 && element.count > rest / row) {
      return make_error(Errc::truncated, file_bytes, "the file ends inside its data", element.count, rest / row);
    }
    if (&element == &wanted) {
      table.row_bytes = row;
      table.count = element.count;
      return table;
    }
    table.offset += row * element.count;
  }
  return make_error(Errc::internal, Error::kNone, "an element is missing from its header");
}

// The file must end after the last element that its header announces.
Status check_end(const PlyHeader& header, std::uint64_t file_bytes) {
  const auto last = locate(header, header.elements.back(), file_bytes);
  if (!last) return tl::unexpected(last.error());
  const std::uint64_t end = last->offset + last->row_bytes * last->count;
  if (end == file_bytes) return {};
  return make_error(Errc::trailing_bytes, end, "bytes after the last row that the header announces", end, file_bytes);
}

std::vector<std::string> numbered(int count) {
  std::vector<std::string> names;
  names.reserve(static_cast<std::size_t>(count));
  for (int i = 0; i < count; ++i) names.push_back("f_rest_" + std::to_string(i));
  return names;
}

Status locate_sh(const PlyHeader& header, std::uint64_t file_bytes, Tables& tables) {
  const PlyElement* sh = find_element(header, "sh");
  if (sh == nullptr) return {};
  int degree = kMaxShDegree;
  while (degree > 0 && sh->properties.size() != static_cast<std::size_t>(3 * (sh_coefficients(degree) - 1))) --degree;
  const auto table = locate(header, *sh, file_bytes);
  if (!table) return tl::unexpected(table.error());
  tables.sh = *table;
  tables.sh.at = find_properties(*sh, numbered(3 * (sh_coefficients(degree) - 1)), PlyType::uint8);
  if (degree == 0 || tables.sh.at.empty()) {
    return make_error(Errc::unsupported_feature, sh->line,
                      "the element sh is not 9, 24 or 45 properties uchar f_rest_*");
  }
  if (sh->count != tables.vertex.count) {
    return make_error(Errc::bad_header, sh->line, "the element sh has another count than vertex", tables.vertex.count,
                      sh->count);
  }
  tables.sh_degree = degree;
  return {};
}

Result<Tables> locate_tables(std::span<const std::byte> bytes) {
  const auto header = parse_ply_header(bytes);
  if (!header) return tl::unexpected(header.error());
  if (header->encoding != PlyEncoding::little_endian) {
    return make_error(Errc::unsupported_feature, 0, "a compressed PLY that is not binary_little_endian");
  }
  const PlyElement *chunk = find_element(*header, "chunk"), *vertex = find_element(*header, "vertex");
  if (chunk == nullptr || vertex == nullptr) {
    return make_error(Errc::bad_header, header->bytes, "a compressed PLY has no element chunk or vertex");
  }
  Tables tables;
  tables.stated = header->stated;
  for (const auto& [element, table] : {std::pair{chunk, &tables.chunk}, {vertex, &tables.vertex}}) {
    auto found = locate(*header, *element, bytes.size());
    if (!found) return tl::unexpected(found.error());
    *table = std::move(*found);
  }
  const std::vector<std::string> bounds(kChunkNames.begin(), kChunkNames.end());
  tables.chunk.at = find_properties(*chunk, bounds, PlyType::float32);
  if (tables.chunk.at.empty()) {
    tables.chunk.at = find_properties(*chunk, std::span(bounds).first(12), PlyType::float32);
  }
  if (tables.chunk.at.empty()) {
    return make_error(Errc::bad_header, chunk->line,
                      "the element chunk lacks one of the bounds float min_x to max_scale_z");
  }
  tables.vertex.at =
      find_properties(*vertex, std::vector<std::string>(kVertexNames.begin(), kVertexNames.end()), PlyType::uint32);
  if (tables.vertex.at.empty()) {
    return make_error(Errc::bad_header, vertex->line,
                      "the element vertex lacks one of the four properties uint packed_*");
  }
  const std::uint64_t n_chunks = vertex->count / kChunk + (vertex->count % kChunk != 0 ? 1 : 0);
  if (chunk->count != n_chunks) {
    return make_error(Errc::bad_header, chunk->line, "the number of chunks is not that of vertices over 256", n_chunks,
                      chunk->count);
  }
  if (const Status s = locate_sh(*header, bytes.size(), tables); !s) return tl::unexpected(s.error());
  if (const Status s = check_end(*header, bytes.size()); !s) return tl::unexpected(s.error());
  return tables;
}

// Bounds of a chunk in the order of kChunkNames; colours default to 0..1.
using Bounds = std::array<float, 18>;

Bounds load_bounds(std::span<const std::byte> bytes, const Table& table, std::uint64_t chunk) {
  Bounds bounds{0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1};
  const std::uint64_t row = table.offset + chunk * table.row_bytes;
  for (std::size_t i = 0; i < table.at.size(); ++i) bounds[i] = load<float>(bytes, row + table.at[i]);
  return bounds;
}

double between(const Bounds& bounds, std::size_t first, std::size_t axis, double t) {
  const double low = static_cast<double>(bounds[first + axis]), high = static_cast<double>(bounds[first + 3 + axis]);
  return low + t * (high - low);
}

std::array<double, 3> unpack_11_10_11(std::uint32_t code) {
  return {(code >> 21) / 2047.0, (code >> 11 & 1023) / 1023.0, (code & 2047) / 2047.0};
}

double decode_sh(std::uint8_t code) {
  return code == 0 ? -4 : code == 255 ? 4 : (code + 0.5) / 32 - 4;
}

Splat decode_vertex(std::span<const std::byte> row, const Table& table, const Bounds& bounds) {
  const auto position = unpack_11_10_11(load<std::uint32_t>(row, table.at[0]));
  const auto rotation = load<std::uint32_t>(row, table.at[1]);
  const auto scale = unpack_11_10_11(load<std::uint32_t>(row, table.at[2]));
  const auto colour = load<std::uint32_t>(row, table.at[3]);
  Splat s;
  for (std::size_t k = 0; k < 3; ++k) {
    s.mean[k] = static_cast<float>(between(bounds, 0, k, position[k]));
    s.log_scale[k] = static_cast<float>(between(bounds, 6, k, scale[k]));
    s.sh[k] = dc_from_colour(between(bounds, 12, k, (colour >> (24 - 8 * k) & 255) / 255.0));
  }
  s.opacity_logit = logit_from_opacity(static_cast<float>(colour & 255) / 255.F);
  SmallestThree three;
  three.largest = rotation >> 30;
  for (unsigned k = 0; k < 3; ++k) three.rest[k] = ((rotation >> (20 - 10 * k) & 1023) / 1023.0 * 2 - 1) * kRootHalf;
  from_smallest_three(three, s.rotation);
  return s;
}

// ---- encoding -------------------------------------------------------------------------------------------------------

struct Packed {
  double mean[3], log_scale[3], colour[3];
};

Packed values_of(const Splat& s) {
  Packed p;
  for (int k = 0; k < 3; ++k) {
    p.mean[k] = static_cast<double>(s.mean[k]);
    p.log_scale[k] = std::clamp(static_cast<double>(s.log_scale[k]), -kMaxCompressedLogScale, kMaxCompressedLogScale);
    p.colour[k] = colour_from_dc(s.sh[k]);
  }
  return p;
}

Bounds bounds_of(std::span<const Splat> chunk) {
  Bounds bounds;
  for (std::size_t group = 0; group < 3; ++group) {
    std::fill_n(&bounds[6 * group], 3, std::numeric_limits<float>::infinity());
    std::fill_n(&bounds[6 * group + 3], 3, -std::numeric_limits<float>::infinity());
  }
  for (const Splat& s : chunk) {
    const Packed p = values_of(s);
    for (std::size_t k = 0; k < 3; ++k) {
      const float values[3] = {static_cast<float>(p.mean[k]), static_cast<float>(p.log_scale[k]),
                               static_cast<float>(p.colour[k])};
      for (std::size_t group = 0; group < 3; ++group) {
        float &low = bounds[6 * group + k], &high = bounds[6 * group + 3 + k];
        low = std::min(low, values[group]);
        high = std::max(high, values[group]);
      }
    }
  }
  return bounds;
}

std::uint32_t code_between(const Bounds& bounds, std::size_t first, std::size_t axis, double value, std::uint32_t max) {
  const double low = static_cast<double>(bounds[first + axis]), high = static_cast<double>(bounds[first + 3 + axis]);
  return high > low ? unit_code((value - low) / (high - low), max) : 0;
}

std::uint32_t pack_11_10_11(const Bounds& bounds, std::size_t first, const double (&values)[3]) {
  return code_between(bounds, first, 0, values[0], 2047) << 21 | code_between(bounds, first, 1, values[1], 1023) << 11 |
         code_between(bounds, first, 2, values[2], 2047);
}

void encode_vertex(const Splat& s, const Bounds& bounds, std::span<std::byte> row) {
  const Packed p = values_of(s);
  store(row, 0, pack_11_10_11(bounds, 0, p.mean));
  const SmallestThree three = smallest_three(s.rotation);
  std::uint32_t rotation = three.largest;
  for (const double value : three.rest) rotation = rotation << 10 | unit_code(value / kRootHalf / 2 + 0.5, 1023);
  store(row, 4, rotation);
  store(row, 8, pack_11_10_11(bounds, 6, p.log_scale));
  std::uint32_t colour = 0;
  for (std::size_t k = 0; k < 3; ++k) colour = colour << 8 | code_between(bounds, 12, k, p.colour[k], 255);
  store(row, 12, colour << 8 | unit_code(static_cast<double>(opacity_from_logit(s.opacity_logit)), 255));
}

std::uint8_t encode_sh(float value) {
  return static_cast<std::uint8_t>(std::clamp(std::floor(static_cast<double>(value) * 32 + 128), 0.0, 255.0));
}

std::string make_header(std::uint64_t n, int sh_degree, const StatedScene& stated) {
  std::string text = "ply\nformat binary_little_endian 1.0\n" + comment_lines(stated);
  const auto element = [&text](const char* name, std::uint64_t count) {
    text += std::string("element ") + name + " " + std::to_string(count) + "\n";
  };
  element("chunk", (n + kChunk - 1) / kChunk);
  for (const char* name : kChunkNames) text += std::string("property float ") + name + "\n";
  element("vertex", n);
  for (const char* name : kVertexNames) text += std::string("property uint ") + name + "\n";
  if (sh_degree > 0) element("sh", n);
  for (const std::string& name : numbered(3 * (sh_coefficients(sh_degree) - 1)))
    text += "property uchar " + name + "\n";
  return text + "end_header\n";
}

// The longest side of the bounding box of some means.
struct Side {
  std::size_t axis = 0;
  float low = 0, high = 0;
};

Side longest_side(std::span<const std::uint32_t> indices, std::span<const float> mean) {
  Side longest;
  for (std::size_t k = 0; k < 3; ++k) {
    Side side{k, std::numeric_limits<float>::infinity(), -std::numeric_limits<float>::infinity()};
    for (const std::uint32_t i : indices) {
      side.low = std::min(side.low, mean[3 * std::size_t{i} + k]);
      side.high = std::max(side.high, mean[3 * std::size_t{i} + k]);
    }
    if (k == 0 || side.high - side.low > longest.high - longest.low) longest = side;
  }
  return longest;
}

// The middle of a side, in floats where possible; near FLT_MAX the sum needs doubles.
float middle_of(const Side& side) {
  const float width = side.high - side.low;
  return std::isfinite(width) ? side.low + width / 2 : side.low / 2 + side.high / 2;
}

// Splits the Gaussians at half the length of their box's longest side, rounded to whole chunks, until only chunks are
// left. Splitting in space, not by count, keeps a few distant Gaussians from making a chunk of near ones coarse:
// South's test views have 48.1 dB, 36.9 dB split by count, 45.8 dB along a Morton curve.
// Splitting in space may take off one chunk at a time, so after `cuts` splits it goes by count, which bounds the time
// by n (kCuts + log n). South needs 36. Coincident Gaussians keep their order.
constexpr int kCuts = 128;

void gather_chunks(std::span<std::uint32_t> indices, std::span<const float> mean, int cuts) {
  for (; indices.size() > kChunk; --cuts) {
    const Side side = longest_side(indices, mean);
    if (!(side.high > side.low)) break;
    const float cut = middle_of(side);
    const auto at = [&](std::uint32_t i) { return mean[3 * std::size_t{i} + side.axis]; };
    const auto n_below =
        cuts > 0
            ? static_cast<std::uint64_t>(std::ranges::count_if(indices, [&](std::uint32_t i) { return at(i) < cut; }))
            : indices.size() / 2;
    const std::uint64_t last = (indices.size() - 1) / kChunk;  // chunks before the last
    const std::uint64_t middle = std::clamp<std::uint64_t>((n_below + kChunk / 2) / kChunk, 1, last) * kChunk;
    std::ranges::nth_element(indices, indices.begin() + static_cast<std::ptrdiff_t>(middle),
                             [&](std::uint32_t a, std::uint32_t b) {  // a total order: deterministic
                               return at(a) != at(b) ? at(a) < at(b) : a < b;
                             });
    // Recurse into the smaller part: the depth stays logarithmic.
    const auto below = indices.first(middle), above = indices.subspan(middle);
    gather_chunks(below.size() < above.size() ? below : above, mean, cuts - 1);
    indices = below.size() < above.size() ? above : below;
  }
  std::ranges::sort(indices);
}

std::vector<std::uint32_t> order_of(const SplatView& splats, bool keep_order) {
  std::vector<std::uint32_t> order(splats.n);
  std::iota(order.begin(), order.end(), 0u);
  if (!keep_order) gather_chunks(order, splats.mean, kCuts);
  return order;
}

}  // namespace

bool is_compressed_ply(std::span<const std::byte> bytes) {
  const auto header = parse_ply_header(bytes);
  if (!header) return false;
  const PlyElement* vertex = find_element(*header, "vertex");
  return vertex != nullptr && std::ranges::find(vertex->properties, std::string_view("packed_position"),
                                                &PlyProperty::name) != vertex->properties.end();
}

Result<SplatFile> decode_compressed_ply(std::span<const std::byte> bytes, const ReadOptions& options) {
  const auto tables = locate_tables(bytes);
  if (!tables) return tl::unexpected(tables.error());
  const std::uint64_t n = tables->vertex.count;
  if (n > options.limits.max_gaussians) {
    return make_error(Errc::limit_exceeded, 0, "more Gaussians than the caller allows", options.limits.max_gaussians,
                      n);
  }
  SplatFile file;
  file.format = SplatFormat::compressed_ply;
  file.bytes = bytes.size();
  tables->stated.copy_to(file);
  PieceFiller filler(file, n, tables->sh_degree, options);
  const auto per_channel = static_cast<std::size_t>(sh_coefficients(tables->sh_degree) - 1);
  Bounds bounds{};
  for (std::uint64_t i = 0; i < n; ++i) {
    if (i % kChunk == 0) bounds = load_bounds(bytes, tables->chunk, i / kChunk);
    const Table& vertex = tables->vertex;
    Splat s = decode_vertex(bytes.subspan(vertex.offset + i * vertex.row_bytes, vertex.row_bytes), vertex, bounds);
    for (std::size_t c = 0; c < 3; ++c) {
      for (std::size_t k = 0; k < per_channel; ++k) {
        const std::uint64_t row = tables->sh.offset + i * tables->sh.row_bytes;
        const std::uint8_t code = load_u8(bytes, row + tables->sh.at[c * per_channel + k]);
        s.sh[3 * (k + 1) + c] = static_cast<float>(decode_sh(code));
      }
    }
    if (const Status filled = filler.add(s); !filled) return tl::unexpected(filled.error());
  }
  return file;
}

Result<std::vector<std::byte>> encode_compressed_ply(const SplatView& splats, const WriteOptions& options) {
  const std::string header = make_header(splats.n, splats.sh_degree, stated_scene(options));
  const auto per_channel = static_cast<std::size_t>(sh_coefficients(splats.sh_degree) - 1);
  const std::uint64_t chunks_at = header.size();
  const std::uint64_t vertices_at = chunks_at + (splats.n + kChunk - 1) / kChunk * sizeof(Bounds);
  const std::uint64_t sh_at = vertices_at + 16 * splats.n;
  std::vector<std::byte> file(sh_at + 3 * per_channel * splats.n);
  std::memcpy(file.data(), header.data(), header.size());
  const std::vector<std::uint32_t> order = order_of(splats, options.keep_order);
  std::vector<Splat> chunk;
  for (std::uint64_t first = 0; first < splats.n; first += kChunk) {
    chunk.clear();
    for (std::uint64_t i = first; i < std::min(splats.n, first + kChunk); ++i) {
      chunk.push_back(splats.splat(order[i]));
    }
    const Bounds bounds = bounds_of(chunk);
    std::memcpy(&file[chunks_at + first / kChunk * sizeof(Bounds)], bounds.data(), sizeof(Bounds));
    for (std::uint64_t i = 0; i < chunk.size(); ++i) {
      encode_vertex(chunk[i], bounds, std::span(file).subspan(vertices_at + 16 * (first + i), 16));
      std::byte* out = file.data() + sh_at + 3 * per_channel * (first + i);
      for (std::size_t c = 0; c < 3; ++c) {
        for (std::size_t k = 1; k <= per_channel; ++k)
          *out++ = static_cast<std::byte>(encode_sh(chunk[i].sh[3 * k + c]));
      }
    }
  }
  return file;
}

}  // namespace rgs::detail
