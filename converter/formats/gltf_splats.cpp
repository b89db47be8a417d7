// gltf_splats.cpp - glTF 2.0 with KHR_gaussian_splatting (github.com/KhronosGroup/glTF): a POINTS primitive with
// the attributes POSITION and, each after "KHR_gaussian_splatting:", ROTATION (x, y, z, w), SCALE (activated), OPACITY
// (activated) and SH_DEGREE_l_COEF_m. Scales are linear, not logarithms. After the release candidate of the extension as
// of 17 July 2026.
// SPDX-License-Identifier: Apache-2.0
#include "gltf_splats.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <deque>
#include <glm/geometric.hpp>
#include <glm/gtc/type_ptr.hpp>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <utility>

#include "gltf_document.hpp"
#include "json_member.hpp"
#include "matrix_similarity.hpp"
#include "quantised.hpp"
#include "rgs/file.hpp"
#include "rgs/quantize.hpp"
#include "rgs/splat_edit.hpp"
#include "signature.hpp"
#include "spz.hpp"
#include "stated_scene.hpp"

namespace rgs::detail {
namespace {

using nlohmann::json;
using nlohmann::ordered_json;

constexpr int kModePoints = 0;
constexpr const char* kExtension = "KHR_gaussian_splatting";
// Their object names a buffer view that is an SPZ: two drafts inside the extension's object (pull request 2531 of
// KhronosGroup/glTF), and one before them beside it.
constexpr std::array kSpzExtensions{"KHR_gaussian_splatting_compression_spz_2",
                                    "KHR_gaussian_splatting_compression_spz"};
constexpr std::uint64_t kMostGlbBytes = std::numeric_limits<std::uint32_t>::max() - 65536;  // leaves room for the JSON
constexpr const char* kSpzAlone = "KHR_spz_gaussian_splats_compression";
constexpr std::uint64_t kSpzBytesWithoutSh = 19;  // of a decoded Gaussian, at least
constexpr int kMaxNodeDepth = 64;
// Instances and shared arrays may expand to 64 times the file's size, plus 1 MiB, and what is compressed once.
constexpr std::uint64_t kMaxUnfolding = 64, kUnfoldingAnyway = std::uint64_t{1} << 20;

std::string attribute(const std::string& name) {
  return std::string(kExtension) + ":" + name;
}

std::string sh_attribute(int coefficient) {
  const int degree = sh_degree_of(coefficient);
  return attribute("SH_DEGREE_" + std::to_string(degree) + "_COEF_" + std::to_string(coefficient - degree * degree));
}

// ---- reading --------------------------------------------------------------------------------------------------------

// From the coefficients present. A missing one is an error: readers would lose the others silently.
Result<int> degree_of(const GltfDocument& gltf, const json& attributes) {
  int degree = 0;
  while (degree < kMaxShDegree && json_member(attributes, sh_attribute(sh_coefficients(degree)).c_str()) != nullptr)
    ++degree;
  const std::string prefix = attribute("SH_DEGREE_");
  std::int64_t n = 0;
  for (const auto& [name, index] : attributes.items()) n += name.starts_with(prefix) ? 1 : 0;
  if (n > sh_coefficients(degree)) {
    return gltf.bad("a splat primitive has harmonics above degree 3, or lacks some below its highest",
                    Errc::unsupported_feature);
  }
  return degree;
}

// Arrays of one splat primitive, all with the same count.
struct SplatPrimitive {
  std::uint64_t n = 0;
  int sh_degree = 0;
  GltfArray position, rotation, scale, opacity;
  std::vector<GltfArray> sh;
  const SplatCloud* unpacked = nullptr;  // instead of arrays, from an SPZ

  Splat splat(std::uint64_t i) const {
    if (unpacked != nullptr) return unpacked->view().splat(i);
    Splat s;
    for (std::uint64_t k = 0; k < 3; ++k) {
      s.mean[k] = position.at(i, k);
      s.log_scale[k] = log_from_scale(scale.at(i, k), 0);
      s.rotation[1 + k] = rotation.at(i, k);
    }
    s.rotation[0] = rotation.at(i, 3);
    s.opacity_logit = logit_from_opacity(opacity.at(i, 0));
    for (std::uint64_t k = 0; k < 3 * sh.size(); ++k) s.sh[k] = sh[k / 3].at(i, k % 3);
    return s;
  }
  Status check() const {
    for (const GltfArray* array : {&position, &rotation, &scale, &opacity}) {
      if (const Status s = array->check(); !s) return s;
    }
    for (const GltfArray& array : sh) {
      if (const Status s = array.check(); !s) return s;
    }
    return {};
  }
};

// What the extension and, for POSITION, KHR_mesh_quantization allow besides floats.
constexpr GltfTypes kPositionTypes{true, true, true, true}, kRotationTypes{true, false, false, true},
    kScaleTypes{false, true, true, true}, kOpacityTypes{false, true, false, true}, kShTypes{};

Result<SplatPrimitive> find_primitive(GltfDocument& gltf, const json& primitive) {
  const json* attributes = json_member(primitive, "attributes");
  if (attributes == nullptr || gltf_whole(primitive, "mode", 4) != std::uint64_t{kModePoints}) {
    return gltf.bad("a splat primitive has no attributes or its mode is not POINTS");
  }
  const auto degree = degree_of(gltf, *attributes);
  if (!degree) return tl::unexpected(degree.error());
  SplatPrimitive out;
  out.sh_degree = *degree;
  out.sh.resize(static_cast<std::size_t>(sh_coefficients(*degree)));
  struct Wanted {
    std::string name;
    std::uint64_t components;
    const GltfTypes& types;
    GltfArray& to;
  };
  std::vector<Wanted> wanted{{"POSITION", 3, kPositionTypes, out.position},
                             {attribute("ROTATION"), 4, kRotationTypes, out.rotation},
                             {attribute("SCALE"), 3, kScaleTypes, out.scale},
                             {attribute("OPACITY"), 1, kOpacityTypes, out.opacity}};
  for (int k = 0; k < sh_coefficients(*degree); ++k) {
    wanted.push_back({sh_attribute(k), 3, kShTypes, out.sh[static_cast<std::size_t>(k)]});
  }
  for (const Wanted& w : wanted) {
    auto array = gltf.array(json_member(*attributes, w.name.c_str()), w.components, w.types);
    if (!array) return tl::unexpected(array.error());
    w.to = *array;
    if (w.to.size() != out.position.size()) return gltf.bad("the attributes of a splat primitive differ in count");
  }
  out.n = out.position.size();
  return out;
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

Result<Similarity> node_transform(const GltfDocument& gltf, const json& node) {
  glm::dmat4 matrix(1.0);  // column-major, as in glTF
  glm::dvec3 translation{0, 0, 0}, scale{1, 1, 1};
  glm::dvec4 xyzw{0, 0, 0, 1};
  if (!read_numbers(node, "matrix", {glm::value_ptr(matrix), 16}) ||
      !read_numbers(node, "translation", {glm::value_ptr(translation), 3}) ||
      !read_numbers(node, "scale", {glm::value_ptr(scale), 3}) ||
      !read_numbers(node, "rotation", {glm::value_ptr(xyzw), 4})) {
    return gltf.bad("a node's transform is not made of numbers");
  }
  const auto from_matrix = similarity_of(matrix);
  if (!from_matrix || !(glm::dot(xyzw, xyzw) > 0) || !(scale.x > 0) || scale.y != scale.x || scale.z != scale.x) {
    return gltf.bad("a node shears, mirrors or scales unevenly, which Gaussians do not survive",
                    Errc::unsupported_feature);
  }
  const glm::dquat q(xyzw.w, xyzw.x, xyzw.y, xyzw.z);
  return compose(*from_matrix, {rotation_from_quaternion(q), scale.x, translation});
}

// A mesh's splat primitives at one node.
struct Instance {
  std::size_t mesh = 0;
  Similarity similarity;
};

// Walks the scene's nodes and counts Gaussians before reading any. Each mesh is parsed once and each Gaussian written
// once, however often the scene shows it.
class SceneWalk {
 public:
  SceneWalk(GltfDocument& gltf, const ReadOptions& options) : gltf_(gltf), options_(options) {
    visited_.resize(size_of("nodes"));
    meshes_.resize(size_of("meshes"));
  }

  /// Visits the nodes of an index list and their descendants.
  Status visit(const json* indices, const Similarity& outer, int depth) {
    if (indices == nullptr) return {};
    if (!indices->is_array()) return gltf_.bad("the scene's nodes or a node's children are not an array");
    for (const json& index : *indices) {
      const json* node = gltf_.element("nodes", &index);
      if (node == nullptr || depth > kMaxNodeDepth || visited_[index.get<std::size_t>()]) {
        return gltf_.bad("the nodes are not a tree of at most 64 levels");
      }
      visited_[index.get<std::size_t>()] = true;
      const auto own = node_transform(gltf_, *node);
      if (!own) return tl::unexpected(own.error());
      const Similarity both = compose(outer, *own);
      if (const json* mesh = json_member(*node, "mesh")) {
        if (const Status s = add_mesh(*mesh, both); !s) return s;
      }
      if (const Status s = visit(json_member(*node, "children"), both, depth + 1); !s) return s;
    }
    return {};
  }
  bool found() const { return !instances_.empty(); }
  const StatedScene& stated() const { return stated_; }
  std::vector<std::string> unused() const {
    std::vector<std::string> all;
    for (const auto& [view, file] : unpacked_) all.insert(all.end(), file.unused.begin(), file.unused.end());
    return all;
  }

  /// Gaussians of all instances in order, the origin of their means, and the largest rounding of a coordinate.
  Result<SplatCloud> read(Origin& origin, double& rounding) const {
    SplatCloud cloud;
    cloud.resize(0, sh_degree_);
    std::vector<ScenePart> parts;
    for (const Instance& instance : instances_) {
      ScenePart& own = parts.emplace_back();
      auto part = read(instance, own.origin);
      if (!part) return part;
      own.n = part->size();
      if (instances_.size() == 1) {
        origin = own.origin;
        return part;
      }
      append_splats(cloud, *part);
    }
    merge_parts(cloud, parts, origin);
    for (const ScenePart& part : parts) rounding = std::max(rounding, part.position_rounding);
    return cloud;
  }

 private:
  struct Mesh {
    bool known = false;
    std::vector<SplatPrimitive> primitives;
    std::uint64_t n = 0, bytes = 0;
  };

  std::size_t size_of(const char* name) const {
    const json* array = json_member(gltf_.root(), name);
    return array != nullptr && array->is_array() ? array->size() : 0;
  }

  Status add_mesh(const json& index, const Similarity& similarity) {
    const json* stated = gltf_.element("meshes", &index);
    if (stated == nullptr) return gltf_.bad("a node refers to a mesh that does not exist");
    const auto number = index.get<std::size_t>();
    Mesh& mesh = meshes_[number];
    if (!mesh.known) {
      if (const Status s = find_primitives(*stated, similarity, mesh); !s) return s;
    }
    if (mesh.primitives.empty()) return {};
    const std::uint64_t max_n = options_.limits.max_gaussians;
    if (mesh.n > max_n - n_) {
      return gltf_.bad("more Gaussians than the caller allows", Errc::limit_exceeded, max_n, n_ + mesh.n);
    }
    const std::uint64_t max_bytes = kMaxUnfolding * gltf_.bytes() + kUnfoldingAnyway + gltf_.unpacked_bytes();
    if (mesh.bytes > max_bytes - bytes_) {
      return gltf_.bad("instances of meshes expand to more than 64 times the file's bytes", Errc::limit_exceeded,
                       max_bytes, bytes_ + mesh.bytes);
    }
    n_ += mesh.n;
    bytes_ += mesh.bytes;
    instances_.push_back({number, similarity});
    return {};
  }

  Status find_primitives(const json& stated, const Similarity& similarity, Mesh& mesh) {
    mesh.known = true;
    const json* primitives = json_member(stated, "primitives");
    if (primitives == nullptr || !primitives->is_array()) return gltf_.bad("a mesh has no primitives array");
    for (const json& primitive : *primitives) {
      const json* extensions = json_member(primitive, "extensions");
      const json* splats = extensions != nullptr ? json_member(*extensions, kExtension) : nullptr;
      const json* spz = extensions != nullptr ? spz_of(*extensions, splats) : nullptr;
      if (splats == nullptr && spz == nullptr) continue;
      AaMode aa_mode = AaMode::classic;
      auto found = spz != nullptr ? unpack(primitive, *spz, aa_mode) : find_primitive(gltf_, primitive);
      if (!found) return tl::unexpected(found.error());
      if (!has_stated_) {
        stated_.aa_mode = aa_mode;
        if (const Status s = read_stated(primitive, splats, similarity); !s) return s;
      }
      sh_degree_ = std::max(sh_degree_, found->sh_degree);
      mesh.n += found->n;
      mesh.bytes += bytes_of(found->n, found->sh_degree);
      mesh.primitives.push_back(std::move(*found));
    }
    return {};
  }

  // As floats. Empty ones count too: visiting them takes time.
  static std::uint64_t bytes_of(std::uint64_t n, int sh_degree) {
    return 4 * std::max<std::uint64_t>(n, 1) * static_cast<std::uint64_t>(11 + 3 * sh_coefficients(sh_degree));
  }

  static const json* spz_of(const json& extensions, const json* splats) {
    const json* inner = splats != nullptr ? json_member(*splats, "extensions") : nullptr;
    for (const char* name : kSpzExtensions) {
      if (const json* spz = inner != nullptr ? json_member(*inner, name) : nullptr) return spz;
    }
    return json_member(extensions, kSpzAlone);
  }

  // A primitive that is an SPZ. CesiumJS takes its coordinates for those of glTF, so this does, unless it declares its
  // axes; the drafts ask for the half turn from SPZ's to glTF's.
  Result<SplatPrimitive> unpack(const json& primitive, const json& spz, AaMode& aa_mode) {
    const json* index = json_member(spz, "bufferView");
    const auto view = gltf_.view(index);
    if (!view) return tl::unexpected(view.error());
    const auto [place, is_new] = unpacked_.try_emplace(index->get<std::uint64_t>());
    SplatFile& file = place->second;
    if (is_new) {
      if (const Status s = gltf_.add_unpacked(view->bytes.size(), 0); !s) return tl::unexpected(s.error());
      if (!is_spz(view->bytes)) return make_error(Errc::bad_magic, view->offset, "a buffer view is no SPZ");
      ReadOptions options = options_;
      options.spz_axes = kAxesGltf;
      options.limits.max_decoded_bytes = gltf_.decodable_bytes();  // of all SPZ of the file together
      auto unpacked = decode_spz(view->bytes, options, false);
      if (!unpacked) {
        Error error = unpacked.error();
        if (error.offset != Error::kNone) error.offset += view->offset;
        return tl::unexpected(error);
      }
      file = std::move(*unpacked);
      const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(file.cloud.sh_degree));
      gltf_.add_decoded(file.cloud.size() * (kSpzBytesWithoutSh + floats - 3));
      convert_axes(file.cloud, file.axes, kAxesGltf);
      if (const Status s = gltf_.add_unpacked(0, bytes_of(file.cloud.size(), file.cloud.sh_degree)); !s)
        return tl::unexpected(s.error());
    }
    const json* attributes = json_member(primitive, "attributes");
    const json* position =
        attributes != nullptr ? gltf_.element("accessors", json_member(*attributes, "POSITION")) : nullptr;
    if (gltf_whole(primitive, "mode", 4) != std::uint64_t{kModePoints})
      return gltf_.bad("the mode of a splat primitive is not POINTS");
    if (position != nullptr && gltf_whole(*position, "count", std::nullopt) != file.cloud.size())
      return gltf_.bad("an SPZ holds another number of Gaussians than its primitive", Errc::size_mismatch);
    aa_mode = file.aa_mode;
    SplatPrimitive out;
    out.n = file.cloud.size();
    out.sh_degree = file.cloud.sh_degree;
    out.unpacked = &file.cloud;
    return out;
  }

  // The first primitive's statements hold for all.
  Status read_stated(const json& primitive, const json* splats, const Similarity& similarity) {
    has_stated_ = true;
    const json* space = splats != nullptr ? json_member(*splats, "colorSpace") : nullptr;
    if (space != nullptr && *space == "lin_rec709_display") stated_.colour_space = ColourSpace::linear_display;
    if (const json* extras = json_member(primitive, "extras"); extras != nullptr && !read_extras(*extras, stated_)) {
      return gltf_.bad("a primitive's extras.rgs has an invalid value", Errc::bad_value);
    }
    stated_.metres_per_unit = static_cast<float>(static_cast<double>(stated_.metres_per_unit) / similarity.scale);
    return {};
  }

  Result<SplatCloud> read(const Instance& instance, Origin& origin) const {
    const Mesh& mesh = meshes_[instance.mesh];
    SplatCloud cloud;
    cloud.resize(mesh.n, sh_degree_);
    std::uint64_t at = 0;
    for (const SplatPrimitive& primitive : mesh.primitives) {
      if (const Status s = primitive.check(); !s) return tl::unexpected(s.error());
      for (std::uint64_t i = 0; i < primitive.n; ++i) cloud.set(at++, primitive.splat(i));
    }
    transform_splats(cloud, origin, instance.similarity);
    return cloud;
  }

  GltfDocument& gltf_;
  const ReadOptions& options_;
  std::vector<bool> visited_;
  std::vector<Mesh> meshes_;
  std::vector<Instance> instances_;
  std::map<std::uint64_t, SplatFile> unpacked_;  // of SPZ, by buffer view
  std::uint64_t n_ = 0, bytes_ = 0;
  int sh_degree_ = 0;
  StatedScene stated_{.axes = kAxesGltf};
  bool has_stated_ = false;
};

// ---- writing --------------------------------------------------------------------------------------------------------

// Collects the binary chunk's arrays with their views and accessors.
class BufferBuilder {
 public:
  explicit BufferBuilder(std::uint64_t n) : n_(n) {}

  /// Floats [n, components] from `value(i, k)`. Returns the accessor's index.
  template <class Value>
  std::size_t add_floats(const char* type, std::uint64_t components, const Value& value) {
    const std::uint64_t start = begin_view(4 * components);
    for (std::uint64_t i = 0; i < n_; ++i) {
      for (std::uint64_t k = 0; k < components; ++k) {
        store(std::span(bin_), start + 4 * (components * i + k), static_cast<float>(value(i, k)));
      }
    }
    return add_accessor({{"componentType", GltfComponent::f32}, {"count", n_}, {"type", type}});
  }
  template <class Value>
  std::size_t add_colours(const Value& value) {
    const std::uint64_t start = begin_view(4);
    for (std::uint64_t i = 0; i < n_; ++i) {
      for (std::uint64_t k = 0; k < 4; ++k)
        bin_[start + 4 * i + k] = static_cast<std::byte>(unit_code(value(i, k), 255));
    }
    return add_accessor({{"componentType", GltfComponent::u8}, {"normalized", true}, {"count", n_}, {"type", "VEC4"}});
  }
  /// An array that the SPZ of this primitive holds.
  std::size_t add_packed(const char* type, GltfComponent component = GltfComponent::f32) {
    ordered_json accessor{{"componentType", component}, {"count", n_}, {"type", type}};
    if (component == GltfComponent::u8) accessor["normalized"] = true;
    accessors_.push_back(std::move(accessor));
    return accessors_.size() - 1;
  }
  /// Returns the view's index.
  std::size_t add_bytes(std::vector<std::byte> bytes) {
    views_.push_back({{"buffer", 0}, {"byteOffset", 0}, {"byteLength", bytes.size()}});
    bin_ = std::move(bytes);
    bin_.resize((bin_.size() + 3) / 4 * 4);
    return views_.size() - 1;
  }
  ordered_json& accessor(std::size_t i) { return accessors_[i]; }
  const ordered_json& views() const { return views_; }
  const ordered_json& accessors() const { return accessors_; }
  const std::vector<std::byte>& bin() const { return bin_; }

 private:
  std::uint64_t begin_view(std::uint64_t bytes_each) {
    const std::uint64_t start = bin_.size();
    bin_.resize(start + bytes_each * n_);  // a multiple of four bytes: the next array is aligned
    constexpr int kVertices = 34962;
    views_.push_back({{"buffer", 0}, {"byteOffset", start}, {"byteLength", bytes_each * n_}, {"target", kVertices}});
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

// glTF requires POSITION's bounds.
void add_bounds(ordered_json& accessor, std::span<const float> mean) {
  std::array<float, 3> low{0, 0, 0}, high{0, 0, 0};
  for (std::size_t i = 0; i < mean.size(); ++i) {
    low[i % 3] = i < 3 ? mean[i] : std::min(low[i % 3], mean[i]);
    high[i % 3] = i < 3 ? mean[i] : std::max(high[i % 3], mean[i]);
  }
  accessor["min"] = low;
  accessor["max"] = high;
}

// sRGB's decoding of 0..1, which COLOR_0 asks for: its values are linear whatever the splats' are.
double linear_from_srgb(double value) {
  const double v = std::clamp(value, 0.0, 1.0);
  return v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4);
}

ordered_json add_attributes(const SplatView& splats, const StatedScene& stated, BufferBuilder& buffer) {
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(splats.sh_degree));
  ordered_json attributes;
  const std::size_t position =
      buffer.add_floats("VEC3", 3, [&](std::uint64_t i, std::uint64_t k) { return splats.mean[3 * i + k]; });
  add_bounds(buffer.accessor(position), splats.mean);
  attributes["POSITION"] = position;
  const bool is_linear = stated.colour_space == ColourSpace::linear_display;
  attributes["COLOR_0"] = buffer.add_colours([&](std::uint64_t i, std::uint64_t k) {
    if (k == 3) return static_cast<double>(opacity_from_logit(splats.opacity_logit[i]));
    const double colour = colour_from_dc(splats.sh[floats * i + k]);
    return is_linear ? colour : linear_from_srgb(colour);
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

ordered_json asset() {
  return {{"version", "2.0"}, {"generator", "RoofGS"}};
}

// A .glb of one primitive at one node.
std::vector<std::byte> make_glb(ordered_json root, ordered_json node, ordered_json primitive, const StatedScene& stated,
                                const BufferBuilder& buffer) {
  root["scene"] = 0;
  root["scenes"] = ordered_json::array({{{"nodes", {0}}}});
  node["mesh"] = 0;
  root["nodes"] = ordered_json::array({std::move(node)});
  if (ordered_json extras = extras_of(stated); !extras.is_null()) primitive["extras"].update(extras, true);
  root["meshes"] = ordered_json::array({{{"primitives", ordered_json::array({primitive})}}});
  root["buffers"] = ordered_json::array({{{"byteLength", buffer.bin().size()}}});
  root["bufferViews"] = buffer.views();
  root["accessors"] = buffer.accessors();
  std::string text = root.dump();
  text.resize((text.size() + 3) / 4 * 4, ' ');
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

Result<SplatFile> read_scene(GltfDocument& gltf, const ReadOptions& options) {
  const json first = 0U;
  const json* stated = json_member(gltf.root(), "scene");
  const json* scene = gltf.element("scenes", stated != nullptr ? stated : &first);
  if (scene == nullptr) return gltf.bad("the glTF has no scene");
  SceneWalk walk(gltf, options);
  if (const Status s = walk.visit(json_member(*scene, "nodes"), {}, 0); !s) return tl::unexpected(s.error());
  if (!walk.found()) {
    return gltf.bad("the glTF's scene shows no primitive with KHR_gaussian_splatting", Errc::not_gaussian_splats);
  }
  SplatFile file;
  file.format = SplatFormat::glb;
  file.bytes = gltf.bytes();
  file.unused = walk.unused();
  walk.stated().copy_to(file);
  auto cloud = walk.read(file.origin, file.position_rounding);
  if (!cloud) return tl::unexpected(cloud.error());
  file.cloud = *std::move(cloud);
  return file;
}

}  // namespace

bool is_gltf(std::span<const std::byte> bytes) {
  return begins_with(bytes, "glTF") || is_gltf_text(bytes);
}

bool is_gltf_text(std::span<const std::byte> bytes) {
  // One of them is before the end of the first long text, a data: URI.
  return is_json_with(bytes, "\"buffers\"") || is_json_with(bytes, "\"bufferViews\"") ||
         is_json_with(bytes, "\"accessors\"");
}

Result<SplatFile> decode_gltf(std::span<const std::byte> bytes, const ReadOptions& options) {
  auto gltf = is_gltf_text(bytes) ? GltfDocument::open_text(bytes, options.limits, {})
                                  : GltfDocument::open_glb(bytes, options.limits);
  if (!gltf) return tl::unexpected(gltf.error());
  return read_scene(*gltf, options);
}

Result<SplatFile> decode_gltf_folder(std::span<const std::byte> bytes, const std::string& folder,
                                     const ReadOptions& options) {
  std::deque<MappedFile> files;
  auto gltf = GltfDocument::open_text(
      bytes, options.limits, [&](const std::string& name) -> Result<std::span<const std::byte>> {
        auto file = MappedFile::open(folder + "/" + name);
        if (!file) {
          return make_error(file.error().code, Error::kNone, "a buffer's file beside the .gltf cannot be opened",
                            Error::kNone, Error::kNone, file.error().system);
        }
        return files.emplace_back(std::move(*file)).bytes();
      });
  if (!gltf) return tl::unexpected(gltf.error());
  auto scene = read_scene(*gltf, options);
  for (const MappedFile& file : files)
    if (const Status s = file.check_unchanged(); !s) return tl::unexpected(s.error());
  return scene;
}

Result<std::vector<std::byte>> encode_glb(const SplatView& splats, const WriteOptions& options) {
  const std::uint64_t each = 4 * (11 + 1 + 3 * static_cast<std::uint64_t>(sh_coefficients(splats.sh_degree)));
  if (splats.n > kMostGlbBytes / each) {
    return make_error(Errc::limit_exceeded, Error::kNone,
                      "a .glb holds at most 4 GiB; strip harmonics or split the scene", kMostGlbBytes / each, splats.n);
  }
  const StatedScene stated = stated_scene(options);
  BufferBuilder buffer(splats.n);
  ordered_json root, node, primitive;
  root["asset"] = asset();
  root["extensionsUsed"] = {kExtension};
  if (stated.origin != kNoOrigin) node["translation"] = stated.origin;
  primitive["attributes"] = add_attributes(splats, stated, buffer);
  primitive["mode"] = kModePoints;
  primitive["extensions"][kExtension] = {
      {"kernel", "ellipse"},
      {"colorSpace",
       stated.colour_space == ColourSpace::linear_display ? "lin_rec709_display" : "srgb_rec709_display"}};
  return make_glb(std::move(root), std::move(node), std::move(primitive), stated, buffer);
}

bool is_spz_glb(std::span<const std::byte> bytes) {
  const std::string_view text = text_of(bytes).substr(0, 65536);
  return begins_with(bytes, "glTF") && (text.find("compression_spz") != text.npos || text.find(kSpzAlone) != text.npos);
}

// As files for CesiumJS 1.145 are: it wants the node's matrix, and of attributes those of its decoder, so neither
// opacity nor harmonics of degree 0, which are in COLOR_0. Kernel and colour space are not stated: with them a reader
// may make the half turn of the later draft.
Result<std::vector<std::byte>> encode_spz_glb(const SplatView& splats, const WriteOptions& options) {
  auto spz = encode_spz(splats, {.aa_mode = options.aa_mode});  // the node says where it lies
  if (!spz) return spz;
  if (spz->size() > kMostGlbBytes) {
    return make_error(Errc::limit_exceeded, Error::kNone,
                      "a .glb holds at most 4 GiB; strip harmonics or split the scene", kMostGlbBytes, spz->size());
  }
  const StatedScene stated = stated_scene(options);
  BufferBuilder buffer(splats.n);
  ordered_json root, node, primitive;
  root["asset"] = asset();
  root["extensionsUsed"] = {kExtension, kSpzExtensions[0]};
  root["extensionsRequired"] = root["extensionsUsed"];
  glm::dmat4 matrix(1.0);
  for (int k = 0; k < 3; ++k) matrix[3][k] = stated.origin[static_cast<std::size_t>(k)];
  node["matrix"] = std::span<const double, 16>(glm::value_ptr(matrix), 16);
  ordered_json& attributes = primitive["attributes"];
  attributes["POSITION"] = buffer.add_packed("VEC3");
  add_bounds(buffer.accessor(0), splats.mean);
  attributes["COLOR_0"] = buffer.add_packed("VEC4", GltfComponent::u8);
  attributes[attribute("ROTATION")] = buffer.add_packed("VEC4");
  attributes[attribute("SCALE")] = buffer.add_packed("VEC3");
  for (int c = 1; c < sh_coefficients(splats.sh_degree); ++c) attributes[sh_attribute(c)] = buffer.add_packed("VEC3");
  primitive["mode"] = kModePoints;
  primitive["extensions"][kExtension]["extensions"][kSpzExtensions[0]]["bufferView"] =
      buffer.add_bytes(std::move(*spz));
  if (stated.colour_space == ColourSpace::linear_display) primitive["extras"]["rgs"]["colour_space"] = "linear";
  return make_glb(std::move(root), std::move(node), std::move(primitive), stated, buffer);
}

}  // namespace rgs::detail
