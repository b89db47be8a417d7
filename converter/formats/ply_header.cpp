// ply_header.cpp - parses PLY headers (Turk, "The PLY Polygon File Format", 1994) and recognises 3DGS properties.
// SPDX-License-Identifier: Apache-2.0
#include "ply_header.hpp"

#include <algorithm>
#include <charconv>
#include <limits>
#include <optional>
#include <unordered_map>
#include <unordered_set>

namespace rgs::detail {
namespace {

// The words of a header line; only comments may have more than five.
struct Words {
  std::array<std::string_view, 6> word;
  std::size_t n = 0;
};

Words split(std::string_view line) {
  constexpr std::string_view kBlank = " \t\r\v\f";
  Words words;
  for (std::size_t at = line.find_first_not_of(kBlank); at != line.npos && words.n < words.word.size();) {
    const std::size_t end = std::min(line.find_first_of(kBlank, at), line.size());
    words.word[words.n++] = line.substr(at, end - at);
    at = line.find_first_not_of(kBlank, end);
  }
  return words;
}

std::optional<PlyType> type_named(std::string_view name) {
  static constexpr std::array<std::string_view, 8> kOld{"char", "uchar", "short", "ushort",
                                                        "int",  "uint",  "float", "double"};
  static constexpr std::array<std::string_view, 8> kNew{"int8",  "uint8",  "int16",   "uint16",
                                                        "int32", "uint32", "float32", "float64"};
  for (std::size_t i = 0; i < kOld.size(); ++i) {
    if (name == kOld[i] || name == kNew[i]) return static_cast<PlyType>(i);
  }
  return std::nullopt;
}

template <class T>
bool parse_decimal(std::string_view text, T& value) {
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  return error == std::errc{} && end == text.data() + text.size();
}

Result<PlyProperty> parse_property(const Words& words, std::uint64_t line) {
  PlyProperty property;
  property.line = line;
  property.is_list = words.n > 1 && words.word[1] == "list";
  if (words.n != (property.is_list ? 5U : 3U)) {
    return make_error(Errc::bad_syntax, line,
                      "a property line is not `property TYPE NAME` or `property list TYPE TYPE NAME`");
  }
  const auto type = type_named(words.word[words.n - 2]);
  if (!type) return make_error(Errc::bad_syntax, line, "a property has an unknown type");
  property.type = *type;
  property.name = words.word[words.n - 1];
  if (property.is_list) {
    const auto count_type = type_named(words.word[2]);
    if (!count_type || *count_type >= PlyType::float32) {
      return make_error(Errc::bad_syntax, line, "a list's length is not of an integer type");
    }
    property.count_type = *count_type;
  }
  return property;
}

std::optional<PlyEncoding> encoding_named(std::string_view name) {
  if (name == "ascii") return PlyEncoding::ascii;
  if (name == "binary_little_endian") return PlyEncoding::little_endian;
  if (name == "binary_big_endian") return PlyEncoding::big_endian;
  return std::nullopt;
}

}  // namespace

Result<PlyHeader> parse_ply_header(std::span<const std::byte> bytes) {
  const std::string_view text(reinterpret_cast<const char*>(bytes.data()),
                              std::min<std::uint64_t>(bytes.size(), kMaxPlyHeaderBytes));
  PlyHeader header;
  bool has_format = false;
  std::unordered_set<std::string_view> elements, properties;  // of the file; of the last element
  if (!text.starts_with("ply") || (text.size() > 3 && text[3] != '\n' && text[3] != '\r')) {
    return make_error(Errc::bad_magic, 0, "is not a PLY file: the first line is not `ply`");
  }
  for (std::size_t line = 0;;) {
    const std::size_t end = text.find('\n', line);
    if (end == text.npos) {
      if (bytes.size() > kMaxPlyHeaderBytes) {
        return make_error(Errc::limit_exceeded, line, "the PLY header is longer than 1 MiB", kMaxPlyHeaderBytes);
      }
      return make_error(Errc::truncated, bytes.size(), "the file ends inside the PLY header");
    }
    const Words words = split(text.substr(line, end - line));
    const std::string_view keyword = words.n > 0 ? words.word[0] : std::string_view();
    if (line == 0) {
      if (words.n != 1) return make_error(Errc::bad_magic, 0, "is not a PLY file: the first line is not `ply`");
    } else if (keyword == "comment") {
      const std::string_view whole = text.substr(line, end - line);
      if (!read_comment(whole.substr(whole.find(keyword) + keyword.size()), header.stated)) {
        return make_error(Errc::bad_value, line, "a comment rgs_... has an invalid value; correct or delete the line");
      }
    } else if (keyword == "obj_info") {
    } else if (keyword == "format") {
      const auto encoding = words.n == 3 ? encoding_named(words.word[1]) : std::nullopt;
      if (!encoding) return make_error(Errc::bad_syntax, line, "the format line is not `format ENCODING 1.0`");
      if (words.word[2] != "1.0") return make_error(Errc::unsupported_version, line, "the PLY version is not 1.0");
      if (has_format) return make_error(Errc::bad_syntax, line, "there are two format lines");
      header.encoding = *encoding;
      has_format = true;
    } else if (keyword == "element") {
      PlyElement element;
      element.line = line;
      if (words.n != 3) return make_error(Errc::bad_syntax, line, "an element line is not `element NAME COUNT`");
      element.name = words.word[1];
      if (!parse_decimal(words.word[2], element.count)) {
        return make_error(Errc::bad_syntax, line, "an element's count is not a number from 0 to 2^64 - 1");
      }
      if (!elements.insert(element.name).second)
        return make_error(Errc::bad_syntax, line, "two elements have the same name");
      properties.clear();
      header.elements.push_back(std::move(element));
    } else if (keyword == "property") {
      auto property = parse_property(words, line);
      if (!property) return tl::unexpected(property.error());
      if (header.elements.empty()) return make_error(Errc::bad_syntax, line, "a property precedes the first element");
      if (!properties.insert(property->name).second) {
        return make_error(Errc::bad_syntax, line, "an element has two properties of the same name");
      }
      PlyElement& element = header.elements.back();
      element.has_lists |= property->is_list;
      element.min_row_bytes += ply_type_bytes(property->is_list ? property->count_type : property->type);
      element.properties.push_back(*property);
    } else if (keyword == "end_header" && words.n == 1) {
      if (!has_format) return make_error(Errc::bad_syntax, line, "the header has no format line");
      header.bytes = end + 1;
      return header;
    } else {
      return make_error(Errc::bad_syntax, line, "a header line does not start with a PLY keyword");
    }
    line = end + 1;
  }
}

Result<SplatProperties> find_splat_properties(const PlyHeader& header) {
  struct Required {
    std::string_view name;
    const char* missing;
  };
  // In the order in which absence is reported: a point cloud fails at f_dc_0, 2DGS at scale_2.
  static constexpr std::array<Required, 14> kRequired{{
      {"x", "the vertices have no property x"},
      {"y", "the vertices have no property y"},
      {"z", "the vertices have no property z"},
      {"f_dc_0", "the vertices have no property f_dc_0: a point cloud or mesh, not 3D Gaussian splats"},
      {"f_dc_1", "the vertices have no property f_dc_1: not 3D Gaussian splats"},
      {"f_dc_2", "the vertices have no property f_dc_2: not 3D Gaussian splats"},
      {"opacity", "the vertices have no property opacity: not 3D Gaussian splats"},
      {"scale_0", "the vertices have no property scale_0: not 3D Gaussian splats"},
      {"scale_1", "the vertices have no property scale_1: not 3D Gaussian splats"},
      {"scale_2", "the vertices have two scales, no property scale_2: 2D Gaussian splats (2DGS), not 3DGS"},
      {"rot_0", "the vertices have no property rot_0: not 3D Gaussian splats"},
      {"rot_1", "the vertices have no property rot_1: not 3D Gaussian splats"},
      {"rot_2", "the vertices have no property rot_2: not 3D Gaussian splats"},
      {"rot_3", "the vertices have no property rot_3: not 3D Gaussian splats"},
  }};
  static constexpr std::array<std::int16_t, 14> kSplatFloat{0, 1, 2, 11, 12, 13, 10, 3, 4, 5, 6, 7, 8, 9};

  const auto vertex = std::find_if(header.elements.begin(), header.elements.end(),
                                   [](const PlyElement& element) { return element.name == "vertex"; });
  if (vertex == header.elements.end()) {
    return make_error(Errc::not_gaussian_splats, header.bytes, "the PLY file has no element vertex");
  }
  SplatProperties result;
  result.element = static_cast<std::size_t>(vertex - header.elements.begin());
  result.splat_float.assign(vertex->properties.size(), -1);

  std::unordered_map<std::string_view, std::size_t> index;
  std::vector<std::pair<std::uint32_t, std::size_t>> f_rest;  // number in the name, property
  constexpr std::string_view kRestPrefix = "f_rest_";
  for (std::size_t i = 0; i < vertex->properties.size(); ++i) {
    const std::string_view name = vertex->properties[i].name;
    index.emplace(name, i);
    std::uint32_t number = 0;
    if (name.starts_with(kRestPrefix) && parse_decimal(name.substr(kRestPrefix.size()), number)) {
      f_rest.emplace_back(number, i);
    }
  }
  if (const auto packed = index.find("packed_position"); packed != index.end()) {
    return make_error(
        Errc::unsupported_feature, vertex->properties[packed->second].line,
        "a .compressed.ply with packed_position (PlayCanvas, SuperSplat), not a 3DGS PLY: convert it with rgs-convert");
  }

  for (std::size_t i = 0; i < kRequired.size(); ++i) {
    const auto found = index.find(kRequired[i].name);
    if (found == index.end()) {
      const bool two_scales = kRequired[i].name == "scale_2";
      return make_error(Errc::not_gaussian_splats, vertex->line, kRequired[i].missing, two_scales ? 3 : Error::kNone,
                        two_scales ? 2 : Error::kNone);
    }
    result.splat_float[found->second] = kSplatFloat[i];
  }

  int degree = 0;
  while (degree <= kMaxShDegree && f_rest.size() != static_cast<std::size_t>(3 * (sh_coefficients(degree) - 1))) {
    ++degree;
  }
  if (degree > kMaxShDegree) {
    return make_error(Errc::unsupported_feature, vertex->line,
                      "the number of f_rest properties is not 0, 9, 24 or 45 (SH degree 0 to 3)", Error::kNone,
                      f_rest.size());
  }
  result.sh_degree = degree;
  std::sort(f_rest.begin(), f_rest.end());
  for (std::size_t i = 0; i < f_rest.size(); ++i) {
    if (f_rest[i].first != i) {
      return make_error(Errc::not_gaussian_splats, vertex->properties[f_rest[i].second].line,
                        "the f_rest properties are not numbered from 0 without gaps", i, f_rest[i].first);
    }
    // Channel-major (all R, all G, all B) over the coefficients 1 .. n - 1 in the file; coefficient-major in a Splat.
    const std::size_t per_channel = f_rest.size() / 3;
    result.splat_float[f_rest[i].second] = static_cast<std::int16_t>(11 + 3 * (i % per_channel + 1) + i / per_channel);
  }
  for (std::size_t i = 0; i < vertex->properties.size(); ++i) {
    if (result.splat_float[i] >= 0 && vertex->properties[i].is_list) {
      return make_error(Errc::not_gaussian_splats, vertex->properties[i].line,
                        "a 3DGS property is a list, not a number");
    }
  }
  return result;
}

}  // namespace rgs::detail
