// gltf_splats.cpp - binary glTF 2.0 with KHR_gaussian_splatting (github.com/KhronosGroup/glTF): a POINTS primitive with
// the attributes POSITION and, each after "KHR_gaussian_splatting:", ROTATION (x, y, z, w), SCALE (activated), OPACITY
// (activated) and SH_DEGREE_l_COEF_m. Scale as linear and not as logarithm is the ratified reading, and the files'.
// SPDX-License-Identifier: Apache-2.0
#include "gltf_splats.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <glm/geometric.hpp>
#include <glm/gtc/type_ptr.hpp>
#include <glm/matrix.hpp>
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <utility>

#include "json_member.hpp"
#include "quantised.hpp"
#include "rgs/quantize.hpp"
#include "rgs/splat_edit.hpp"

namespace rgs::detail {
namespace {

using nlohmann::json;
using nlohmann::ordered_json;

constexpr std::uint32_t kMagicGlb = 0x46546C67, kChunkJson = 0x4E4F534A, kChunkBin = 0x004E4942;
constexpr std::uint64_t kGlbHeaderBytes = 12, kChunkHeaderBytes = 8;
constexpr int kComponentFloat = 5126, kComponentU8 = 5121, kModePoints = 0;
constexpr const char* kExtension = "KHR_gaussian_splatting";
constexpr int kMaxNodeDepth = 64;
constexpr std::uint64_t kMaxInstances = 16;  // of the file's size: nodes may show a mesh more than once

std::string attribute(const std::string& name) {
  return std::string(kExtension) + ":" + name;
}

std::string sh_attribute(int coefficient) {
  const int degree = sh_degree_of(coefficient);
  return attribute("SH_DEGREE_" + std::to_string(degree) + "_COEF_" + std::to_string(coefficient - degree * degree));
}

// ---- reading --------------------------------------------------------------------------------------------------------

struct Glb {
  json root;
  std::span<const std::byte> bin;
  std::uint64_t bin_offset = 0;
};

tl::unexpected<Error> bad_gltf(const char* what) {
  return make_error(Errc::bad_syntax, kGlbHeaderBytes + kChunkHeaderBytes, what);
}

Result<Glb> parse_chunks(std::span<const std::byte> bytes) {
  if (bytes.size() < kGlbHeaderBytes + kChunkHeaderBytes) {
    return make_error(Errc::truncated, bytes.size(), "the file ends inside its header",
                      kGlbHeaderBytes + kChunkHeaderBytes, bytes.size());
  }
  if (load<std::uint32_t>(bytes, 0) != kMagicGlb) return make_error(Errc::bad_magic, 0, "is not a binary glTF file");
  if (load<std::uint32_t>(bytes, 4) != 2) {
    return make_error(Errc::unsupported_version, 4, "a glTF version other than 2", 2, load<std::uint32_t>(bytes, 4));
  }
  const std::uint64_t length = load<std::uint32_t>(bytes, 8);
  if (length > bytes.size())
    return make_error(Errc::truncated, 8, "the file is shorter than it says", length, bytes.size());
  if (length < bytes.size())
    return make_error(Errc::trailing_bytes, length, "bytes after the end that the file states");
  Glb glb;
  bool first = true;
  for (std::uint64_t at = kGlbHeaderBytes; at < length;) {
    if (length - at < kChunkHeaderBytes)
      return make_error(Errc::truncated, at, "the file ends inside a chunk's header");
    const std::uint64_t size = load<std::uint32_t>(bytes, at);
    const auto type = load<std::uint32_t>(bytes, at + 4);
    if (size > length - at - kChunkHeaderBytes) {
      return make_error(Errc::truncated, at, "a chunk ends behind the file", size, length - at - kChunkHeaderBytes);
    }
    const auto data = bytes.subspan(at + kChunkHeaderBytes, size);
    if (first) {
      if (type != kChunkJson) return make_error(Errc::bad_header, at + 4, "the first chunk is not JSON");
      const char* text = reinterpret_cast<const char*>(data.data());
      glb.root = json::parse(text, text + data.size(), nullptr, false);
      if (!glb.root.is_object()) return bad_gltf("the glTF's JSON does not parse");
    } else if (type == kChunkBin && glb.bin_offset == 0) {
      glb.bin = data;
      glb.bin_offset = at + kChunkHeaderBytes;
    }
    first = false;
    at += kChunkHeaderBytes + size;
  }
  return glb;
}

// Element `index` of the root's array `name`; nothing if either is absent or of another type.
const json* element(const json& root, const char* name, const json* index) {
  const json* array = json_member(root, name);
  if (array == nullptr || !array->is_array() || index == nullptr || !index->is_number_unsigned()) return nullptr;
  const auto i = index->get<std::uint64_t>();
  return i < array->size() ? &(*array)[i] : nullptr;
}

// A member that is a count or an offset; `otherwise` if absent, nothing if it is something else or above 2^32.
std::optional<std::uint64_t> whole(const json& object, const char* name, std::optional<std::uint64_t> otherwise) {
  const json* value = json_member(object, name);
  if (value == nullptr) return otherwise;
  if (!value->is_number_unsigned()) return std::nullopt;
  const auto number = value->get<std::uint64_t>();
  return number <= std::numeric_limits<std::uint32_t>::max() ? std::optional(number) : std::nullopt;
}

// Floats [count, components] in the binary chunk.
struct Accessor {
  std::span<const std::byte> bytes;  // of the whole array
  std::uint64_t count = 0, stride = 0;
  float at(std::uint64_t i, std::uint64_t component) const { return load<float>(bytes, i * stride + 4 * component); }
};

Result<Accessor> find_accessor(const Glb& glb, const json& attributes, const std::string& name, const char* type,
                               std::uint64_t components) {
  const json* accessor = element(glb.root, "accessors", json_member(attributes, name.c_str()));
  if (accessor == nullptr) return bad_gltf("a splat primitive lacks an attribute of KHR_gaussian_splatting");
  const json* stated = json_member(*accessor, "type");
  if (whole(*accessor, "componentType", 0) != std::uint64_t{kComponentFloat} || stated == nullptr || *stated != type ||
      json_member(*accessor, "sparse") != nullptr) {
    return make_error(Errc::unsupported_feature, kGlbHeaderBytes + kChunkHeaderBytes,
                      "an attribute is sparse, or not of the usual shape in 32-bit floats");
  }
  const json* view = element(glb.root, "bufferViews", json_member(*accessor, "bufferView"));
  if (view == nullptr || whole(*view, "buffer", std::nullopt) != std::uint64_t{0}) {
    return make_error(Errc::unsupported_feature, kGlbHeaderBytes + kChunkHeaderBytes,
                      "an attribute is compressed or outside the file's binary chunk");
  }
  const auto count = whole(*accessor, "count", std::nullopt), offset = whole(*accessor, "byteOffset", 0),
             view_offset = whole(*view, "byteOffset", 0), view_bytes = whole(*view, "byteLength", std::nullopt),
             stride = whole(*view, "byteStride", 4 * components);
  if (!count || !offset || !view_offset || !view_bytes || !stride || *stride < 4 * components) {
    return bad_gltf("an accessor's or buffer view's numbers are missing or out of range");
  }
  if (*view_offset > glb.bin.size() || *view_bytes > glb.bin.size() - *view_offset) {
    return make_error(Errc::truncated, glb.bin_offset, "a buffer view ends behind the binary chunk",
                      *view_offset + *view_bytes, glb.bin.size());
  }
  const std::uint64_t needed = *count == 0 ? 0 : (*count - 1) * *stride + 4 * components;  // below 2^64: 32-bit factors
  if (*offset > *view_bytes || needed > *view_bytes - *offset) {
    return make_error(Errc::truncated, glb.bin_offset + *view_offset, "an accessor ends behind its buffer view",
                      *offset + needed, *view_bytes);
  }
  return Accessor{glb.bin.subspan(*view_offset + *offset, needed), *count, *stride};
}

int degree_of(const json& attributes) {
  int degree = 0;
  while (degree < kMaxShDegree && json_member(attributes, sh_attribute(sh_coefficients(degree)).c_str()) != nullptr)
    ++degree;
  return degree;
}

Result<SplatCloud> read_primitive(const Glb& glb, const json& primitive, std::uint64_t max_n) {
  const json* attributes = json_member(primitive, "attributes");
  if (attributes == nullptr || whole(primitive, "mode", 4) != std::uint64_t{kModePoints}) {
    return bad_gltf("a splat primitive has no attributes or is not of mode POINTS");
  }
  const int degree = degree_of(*attributes);
  const auto position = find_accessor(glb, *attributes, "POSITION", "VEC3", 3);
  if (!position) return tl::unexpected(position.error());
  const auto rotation = find_accessor(glb, *attributes, attribute("ROTATION"), "VEC4", 4);
  if (!rotation) return tl::unexpected(rotation.error());
  const auto scale = find_accessor(glb, *attributes, attribute("SCALE"), "VEC3", 3);
  if (!scale) return tl::unexpected(scale.error());
  const auto opacity = find_accessor(glb, *attributes, attribute("OPACITY"), "SCALAR", 1);
  if (!opacity) return tl::unexpected(opacity.error());
  std::vector<Accessor> sh;
  for (int k = 0; k < sh_coefficients(degree); ++k) {
    const auto coefficient = find_accessor(glb, *attributes, sh_attribute(k), "VEC3", 3);
    if (!coefficient) return tl::unexpected(coefficient.error());
    sh.push_back(*coefficient);
  }
  const std::uint64_t n = position->count;
  bool alike = rotation->count == n && scale->count == n && opacity->count == n;
  for (const Accessor& coefficient : sh) alike = alike && coefficient.count == n;
  if (!alike) return bad_gltf("the attributes of a splat primitive differ in count");
  if (n > max_n) {
    return make_error(Errc::limit_exceeded, glb.bin_offset, "more Gaussians than the caller or the file's size allows",
                      max_n, n);
  }
  SplatCloud cloud;
  cloud.resize(n, degree);
  for (std::uint64_t i = 0; i < n; ++i) {
    Splat s;
    for (std::uint64_t k = 0; k < 3; ++k) {
      s.mean[k] = position->at(i, k);
      s.log_scale[k] = log_from_scale(scale->at(i, k), 0);
      s.rotation[1 + k] = rotation->at(i, k);
    }
    s.rotation[0] = rotation->at(i, 3);
    s.opacity_logit = logit_from_opacity(opacity->at(i, 0));
    for (std::uint64_t k = 0; k < 3 * sh.size(); ++k) s.sh[k] = sh[k / 3].at(i, k % 3);
    cloud.set(i, s);
  }
  return cloud;
}

bool read_numbers(const json& object, const char* name, std::span<double> out) {
  const json* array = json_member(object, name);
  if (array == nullptr) return true;
  if (!array->is_array() || array->size() != out.size()) return false;
  for (std::size_t i = 0; i < out.size(); ++i) {
    if (!(*array)[i].is_number()) return false;
    out[i] = (*array)[i].get<double>();
    if (!std::isfinite(out[i])) return false;
  }
  return true;
}

// As turn, uniform scale and shift; nothing if it is anything else.
std::optional<Similarity> similarity_of(const glm::dmat4& m) {
  double length[3];
  for (int k = 0; k < 3; ++k) length[k] = std::hypot(m[k].x, m[k].y, m[k].z);
  constexpr double kTolerance = 1e-4;  // matrices come as rounded decimals
  if (!(length[0] > 0) || std::abs(length[1] / length[0] - 1) > kTolerance ||
      std::abs(length[2] / length[0] - 1) > kTolerance) {
    return std::nullopt;
  }
  const Similarity s{glm::dmat3(m) / length[0], length[0], glm::dvec3(m[3])};
  if (std::abs(glm::determinant(s.rotation) - 1) > kTolerance) return std::nullopt;
  return s;
}

Result<Similarity> node_transform(const json& node) {
  glm::dmat4 matrix(1.0);  // glTF's are column-major too
  glm::dvec3 translation{0, 0, 0}, scale{1, 1, 1};
  glm::dvec4 xyzw{0, 0, 0, 1};
  if (!read_numbers(node, "matrix", {glm::value_ptr(matrix), 16}) ||
      !read_numbers(node, "translation", {glm::value_ptr(translation), 3}) ||
      !read_numbers(node, "scale", {glm::value_ptr(scale), 3}) ||
      !read_numbers(node, "rotation", {glm::value_ptr(xyzw), 4})) {
    return bad_gltf("a node's transform is not made of numbers");
  }
  const auto from_matrix = similarity_of(matrix);
  if (!from_matrix || !(glm::dot(xyzw, xyzw) > 0) || !(scale.x > 0) || scale.y != scale.x || scale.z != scale.x) {
    return make_error(Errc::unsupported_feature, kGlbHeaderBytes + kChunkHeaderBytes,
                      "a node shears, mirrors or scales unevenly, which Gaussians do not survive");
  }
  const glm::dquat q(xyzw.w, xyzw.x, xyzw.y, xyzw.z);
  // A node has the one or the others.
  return compose(*from_matrix, {rotation_from_quaternion(q), scale.x, translation});
}

class SceneWalk {
 public:
  SceneWalk(const Glb& glb, std::uint64_t max_n) : glb_(glb), max_n_(max_n) {
    const json* nodes = json_member(glb.root, "nodes");
    visited_.resize(nodes != nullptr && nodes->is_array() ? nodes->size() : 0);
  }

  /// All nodes of a list of indices, and below.
  Status visit(const json* indices, const Similarity& outer, int depth) {
    if (indices == nullptr || !indices->is_array()) return {};
    for (const json& index : *indices) {
      const json* node = element(glb_.root, "nodes", &index);
      if (node == nullptr || depth > kMaxNodeDepth || visited_[index.get<std::size_t>()]) {
        return bad_gltf("the nodes are no tree of at most 64 levels");
      }
      visited_[index.get<std::size_t>()] = true;
      const auto own = node_transform(*node);
      if (!own) return tl::unexpected(own.error());
      const Similarity both = compose(outer, *own);
      if (const json* mesh = element(glb_.root, "meshes", json_member(*node, "mesh"))) {
        if (const Status s = add_mesh(*mesh, both); !s) return s;
      }
      if (const Status s = visit(json_member(*node, "children"), both, depth + 1); !s) return s;
    }
    return {};
  }
  bool found() const { return found_; }
  const StatedScene& stated() const { return stated_; }
  SplatCloud take() { return std::move(cloud_); }
  const Origin& origin() const { return origin_; }

 private:
  Status add_mesh(const json& mesh, const Similarity& similarity) {
    const json* primitives = json_member(mesh, "primitives");
    if (primitives == nullptr || !primitives->is_array()) return {};
    for (const json& primitive : *primitives) {
      const json* extensions = json_member(primitive, "extensions");
      const json* splats = extensions != nullptr ? json_member(*extensions, kExtension) : nullptr;
      if (splats == nullptr) continue;
      auto part = read_primitive(glb_, primitive, max_n_ - cloud_.size());
      if (!part) return tl::unexpected(part.error());
      Origin origin = kNoOrigin;
      transform_splats(*part, origin, similarity);
      if (found_) {
        append_splats(cloud_, origin_, std::move(*part), origin);
      } else {
        cloud_ = std::move(*part);
        origin_ = origin;
      }
      if (!found_) {
        if (const Status s = read_stated(primitive, *splats, similarity); !s) return s;
      }
      found_ = true;
    }
    return {};
  }

  // The first primitive speaks for all.
  Status read_stated(const json& primitive, const json& splats, const Similarity& similarity) {
    const json* space = json_member(splats, "colorSpace");
    if (space != nullptr && *space == "lin_rec709_display") stated_.colour_space = ColourSpace::linear_display;
    if (const json* extras = json_member(primitive, "extras"); extras != nullptr && !read_extras(*extras, stated_)) {
      return make_error(Errc::bad_value, kGlbHeaderBytes + kChunkHeaderBytes,
                        "a primitive's extras.rgs states a value that it cannot have");
    }
    stated_.metres_per_unit = static_cast<float>(static_cast<double>(stated_.metres_per_unit) / similarity.scale);
    return {};
  }

  const Glb& glb_;
  std::uint64_t max_n_;
  std::vector<bool> visited_;
  SplatCloud cloud_;
  Origin origin_ = kNoOrigin;
  StatedScene stated_{.axes = kAxesGltf};
  bool found_ = false;
};

// ---- writing --------------------------------------------------------------------------------------------------------

// Collects arrays of the binary chunk with their views and accessors.
class BufferBuilder {
 public:
  explicit BufferBuilder(std::uint64_t n) : n_(n) {}

  /// Floats [n, components]; `value(i, k)`. Returns the accessor's index.
  template <class Value>
  std::size_t add_floats(const char* type, std::uint64_t components, const Value& value) {
    const std::uint64_t start = begin_view(4 * components);
    for (std::uint64_t i = 0; i < n_; ++i) {
      for (std::uint64_t k = 0; k < components; ++k) {
        store(std::span(bin_), start + 4 * (components * i + k), static_cast<float>(value(i, k)));
      }
    }
    return add_accessor({{"componentType", kComponentFloat}, {"count", n_}, {"type", type}});
  }
  /// Normalised bytes [n, 4].
  template <class Value>
  std::size_t add_colours(const Value& value) {
    const std::uint64_t start = begin_view(4);
    for (std::uint64_t i = 0; i < n_; ++i) {
      for (std::uint64_t k = 0; k < 4; ++k)
        bin_[start + 4 * i + k] = static_cast<std::byte>(unit_code(value(i, k), 255));
    }
    return add_accessor({{"componentType", kComponentU8}, {"normalized", true}, {"count", n_}, {"type", "VEC4"}});
  }
  ordered_json& accessor(std::size_t i) { return accessors_[i]; }
  const ordered_json& views() const { return views_; }
  const ordered_json& accessors() const { return accessors_; }
  const std::vector<std::byte>& bin() const { return bin_; }

 private:
  std::uint64_t begin_view(std::uint64_t bytes_each) {
    const std::uint64_t start = bin_.size();
    bin_.resize(start + bytes_each * n_);  // every array is a multiple of four bytes: the next one is aligned
    views_.push_back({{"buffer", 0}, {"byteOffset", start}, {"byteLength", bytes_each * n_}});
    return start;
  }
  std::size_t add_accessor(ordered_json accessor) {
    accessor["bufferView"] = views_.size() - 1;
    accessors_.push_back(std::move(accessor));
    return accessors_.size() - 1;
  }
  std::uint64_t n_;
  std::vector<std::byte> bin_;
  ordered_json views_ = ordered_json::array(), accessors_ = ordered_json::array();
};

// glTF requires the bounds of POSITION.
void add_bounds(ordered_json& accessor, std::span<const float> mean) {
  std::array<float, 3> low{0, 0, 0}, high{0, 0, 0};
  for (std::size_t i = 0; i < mean.size(); ++i) {
    low[i % 3] = i < 3 ? mean[i] : std::min(low[i % 3], mean[i]);
    high[i % 3] = i < 3 ? mean[i] : std::max(high[i % 3], mean[i]);
  }
  accessor["min"] = low;
  accessor["max"] = high;
}

ordered_json add_attributes(const SplatView& splats, BufferBuilder& buffer) {
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(splats.sh_degree));
  ordered_json attributes;
  const std::size_t position =
      buffer.add_floats("VEC3", 3, [&](std::uint64_t i, std::uint64_t k) { return splats.mean[3 * i + k]; });
  add_bounds(buffer.accessor(position), splats.mean);
  attributes["POSITION"] = position;
  attributes["COLOR_0"] = buffer.add_colours([&](std::uint64_t i, std::uint64_t k) {
    return k < 3 ? colour_from_dc(splats.sh[floats * i + k])
                 : static_cast<double>(opacity_from_logit(splats.opacity_logit[i]));
  });
  attributes[attribute("ROTATION")] = buffer.add_floats("VEC4", 4, [&](std::uint64_t i, std::uint64_t k) {
    const float* q = &splats.rotation[4 * i];
    double squared = 0;
    for (int j = 0; j < 4; ++j) squared += static_cast<double>(q[j]) * static_cast<double>(q[j]);
    return static_cast<double>(q[(k + 1) % 4]) / std::sqrt(squared);
  });
  attributes[attribute("SCALE")] = buffer.add_floats(
      "VEC3", 3, [&](std::uint64_t i, std::uint64_t k) { return scale_from_log(splats.log_scale[3 * i + k]); });
  attributes[attribute("OPACITY")] = buffer.add_floats(
      "SCALAR", 1, [&](std::uint64_t i, std::uint64_t) { return opacity_from_logit(splats.opacity_logit[i]); });
  for (int c = 0; c < sh_coefficients(splats.sh_degree); ++c) {
    const auto first = static_cast<std::uint64_t>(3 * c);
    attributes[sh_attribute(c)] = buffer.add_floats(
        "VEC3", 3, [&](std::uint64_t i, std::uint64_t k) { return splats.sh[floats * i + first + k]; });
  }
  return attributes;
}

std::string make_json(const SplatView& splats, const StatedScene& stated, BufferBuilder& buffer) {
  const ordered_json attributes = add_attributes(splats, buffer);
  ordered_json root;
  root["asset"] = {{"version", "2.0"}, {"generator", "RoofGS"}};
  root["extensionsUsed"] = {kExtension};
  root["scene"] = 0;
  root["scenes"] = ordered_json::array({{{"nodes", {0}}}});
  root["nodes"] = ordered_json::array({{{"mesh", 0}}});
  if (stated.origin != kNoOrigin) root["nodes"][0]["translation"] = stated.origin;
  ordered_json primitive;
  primitive["attributes"] = attributes;
  primitive["mode"] = kModePoints;
  primitive["extensions"][kExtension] = {
      {"kernel", "ellipse"},
      {"colorSpace",
       stated.colour_space == ColourSpace::linear_display ? "lin_rec709_display" : "srgb_rec709_display"}};
  if (ordered_json extras = extras_of(stated); !extras.is_null()) primitive["extras"] = std::move(extras);
  root["meshes"] = ordered_json::array({{{"primitives", ordered_json::array({primitive})}}});
  root["buffers"] = ordered_json::array({{{"byteLength", buffer.bin().size()}}});
  root["bufferViews"] = buffer.views();
  root["accessors"] = buffer.accessors();
  std::string text = root.dump();
  text.resize((text.size() + 3) / 4 * 4, ' ');
  return text;
}

}  // namespace

Result<SplatFile> decode_glb(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto glb = parse_chunks(bytes);
  if (!glb) return tl::unexpected(glb.error());
  const json first = 0;
  const json* stated = json_member(glb->root, "scene");
  const json* scene = element(glb->root, "scenes", stated != nullptr ? stated : &first);
  if (scene == nullptr) return bad_gltf("the glTF has no scene");
  constexpr std::uint64_t kLeastBytes = 56;  // of a Gaussian of degree 0
  SceneWalk walk(*glb, std::min(limits.max_gaussians, kMaxInstances * bytes.size() / kLeastBytes));
  if (const Status s = walk.visit(json_member(*scene, "nodes"), {}, 0); !s) return tl::unexpected(s.error());
  if (!walk.found()) {
    return make_error(Errc::not_gaussian_splats, kGlbHeaderBytes + kChunkHeaderBytes,
                      "the glTF's scene shows no primitive with KHR_gaussian_splatting");
  }
  SplatFile file;
  file.format = SplatFormat::glb;
  file.bytes = bytes.size();
  walk.stated().copy_to(file);
  file.origin = walk.origin();
  file.cloud = walk.take();
  return file;
}

Result<std::vector<std::byte>> encode_glb(const SplatView& splats, const StatedScene& stated) {
  const std::uint64_t each = 4 * (11 + 1 + 3 * static_cast<std::uint64_t>(sh_coefficients(splats.sh_degree)));
  constexpr std::uint64_t kMostBytes = std::numeric_limits<std::uint32_t>::max() - 65536;  // room for the JSON
  if (splats.n > kMostBytes / each) {
    return make_error(Errc::limit_exceeded, Error::kNone,
                      "a .glb holds at most 4 GiB; strip harmonics or split the scene", kMostBytes / each, splats.n);
  }
  BufferBuilder buffer(splats.n);
  const std::string text = make_json(splats, stated, buffer);
  const std::uint64_t bin_header = kGlbHeaderBytes + kChunkHeaderBytes + text.size();
  const std::uint64_t total = bin_header + kChunkHeaderBytes + buffer.bin().size();
  std::vector<std::byte> file(total);
  store(std::span(file), 0, kMagicGlb);
  store(std::span(file), 4, std::uint32_t{2});
  store(std::span(file), 8, static_cast<std::uint32_t>(total));
  store(std::span(file), 12, static_cast<std::uint32_t>(text.size()));
  store(std::span(file), 16, kChunkJson);
  std::memcpy(&file[kGlbHeaderBytes + kChunkHeaderBytes], text.data(), text.size());
  store(std::span(file), bin_header, static_cast<std::uint32_t>(buffer.bin().size()));
  store(std::span(file), bin_header + 4, kChunkBin);
  std::ranges::copy(buffer.bin(), file.begin() + static_cast<std::ptrdiff_t>(bin_header + kChunkHeaderBytes));
  return file;
}

}  // namespace rgs::detail
