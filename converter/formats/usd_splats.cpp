// usd_splats.cpp - the schema is UsdVol's of OpenUSD 26.03 (github.com/PixarAnimationStudios/OpenUSD,
// pxr/usd/usdVol/schema.usda): linear scales, opacities from 0 to 1, quaternions w, x, y, z, and each Gaussian's
// harmonics as RGB triples with the constant one first, in the basis and order of 3DGS.
// SPDX-License-Identifier: Apache-2.0
#include "usd_splats.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <glm/gtc/type_ptr.hpp>
#include <glm/matrix.hpp>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <string>
#include <string_view>
#include <utility>

#include "matrix_similarity.hpp"
#include "quantised.hpp"
#include "rgs/quantize.hpp"
#include "rgs/splat_edit.hpp"
#include "signature.hpp"
#include "stated_scene.hpp"
#include "usda_text.hpp"
#include "zip_archive.hpp"

namespace rgs::detail {
namespace {

using Floats = std::vector<float>;

constexpr std::string_view kMagicUsda = "#usda ", kMagicCrate = "PXR-USDC", kSplatType = "ParticleField3DGaussianSplat",
                           kDegree = "radiance:sphericalHarmonicsDegree", kLinear = "lin_rec709_",
                           kDisplay = "srgb_rec709_";
constexpr Axes kAxesUpZ{Axis::right, Axis::forward, Axis::up};
constexpr double kCentimetre = 0.01;  // UsdGeom's unit, where a stage states none
constexpr int kMaxPrimDepth = 64;

// The schema's arrays. Each has a twin of half precision with "h" after its name, which holds where this one is empty.
enum Parameter : std::uint8_t { kPositions, kOrientations, kScales, kOpacities, kHarmonics, kParameters };
struct Parameters {
  std::string_view name, type, half_type;
  std::uint64_t each = 0;
};
constexpr std::array<Parameters, kParameters> kSchema{
    {{"positions", "point3f", "point3h", 3},
     {"orientations", "quatf", "quath", 4},
     {"scales", "float3", "half3", 3},
     {"opacities", "float", "half", 1},
     {"radiance:sphericalHarmonicsCoefficients", "float3", "half3", 3}}};

// ---- reading --------------------------------------------------------------------------------------------------------

struct Values {
  Floats floats;
  std::uint64_t at = Error::kNone;  // of the attribute; kNone: there is none
};

struct SplatPrim {
  std::array<std::array<Values, 2>, kParameters> values;  // in float and half precision
  std::uint64_t at = 0;
  int sh_degree = 3;  // the schema's default
  std::string_view colour_space;
  glm::dmat4 to_stage{1.0};
  bool is_placed = false;    // its parents' transforms do not count
  bool has_purpose = false;  // nor their purposes

  // The values that hold, [n, each]; empty: the default holds.
  const Values& of(Parameter p) const { return values[p][values[p][0].floats.empty() ? 1 : 0]; }
  std::uint64_t n() const { return of(kPositions).floats.size() / 3; }
  int cloud_degree() const { return of(kHarmonics).floats.empty() ? 0 : sh_degree; }
  // One Gaussian's values.
  std::span<const float> row(Parameter p, std::uint64_t i, std::uint64_t floats) const {
    const Floats& all = of(p).floats;
    return all.empty() ? std::span<const float>() : std::span(all).subspan(i * floats, floats);
  }
  Splat splat(std::uint64_t i) const {
    Splat s;
    std::ranges::copy(row(kPositions, i, 3), s.mean);
    s.rotation[0] = 1;
    std::ranges::copy(row(kOrientations, i, 4), s.rotation);
    std::ranges::transform(row(kScales, i, 3), s.log_scale, [](float scale) { return log_from_scale(scale, 0); });
    s.opacity_logit = logit_from_opacity(1);
    for (const float opacity : row(kOpacities, i, 1)) s.opacity_logit = logit_from_opacity(opacity);
    std::ranges::copy(row(kHarmonics, i, static_cast<std::uint64_t>(3 * sh_coefficients(cloud_degree()))), s.sh);
    return s;
  }
};

// A transform's numbers, and where its attribute is.
struct Op {
  std::array<double, 16> numbers{};
  std::uint64_t n = 0, at = 0;
  bool is_static = true;
};

// What is known of a prim while its children are read.
struct Prim {
  std::string_view type;
  std::uint64_t at = 0;
  std::size_t first = 0;  // of its Gaussians in the stage's list
  bool is_shown = true, comes_and_goes = false;
  std::map<std::string_view, Op> ops;
  std::vector<std::string_view> order;
  std::uint64_t order_at = 0;
  std::string_view colour_space, purpose;

  bool is_splats() const { return type == kSplatType; }
};

// "rotate" followed by axes, the first to turn about first.
glm::dmat3 turn_of(std::string_view axes, std::span<const double> degrees) {
  glm::dmat3 product(1.0);
  for (const char axis : axes) {
    const int k = axis - 'X';
    glm::dvec3 angles(0);
    angles[k] = degrees[degrees.size() == 1 ? 0 : static_cast<std::size_t>(k)];
    product = rotation_from_euler(angles) * product;
  }
  return product;
}

// Of the operation `kind`, as in "xformOp:kind:suffix"; nullopt if it is unknown or its numbers do not fit.
std::optional<glm::dmat4> matrix_of(std::string_view kind, const Op& op) {
  constexpr std::array<std::string_view, 9> kTurns{"X", "Y", "Z", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"};
  const std::span<const double> v = std::span(op.numbers).first(op.n);
  glm::dmat4 m(1.0);
  if (kind == "transform" && v.size() == 16) {
    m = glm::make_mat4(v.data());  // its rows are GLM's columns: USD's vectors are rows
  } else if (kind == "translate" && v.size() == 3) {
    m[3] = {v[0], v[1], v[2], 1};
  } else if (kind == "scale" && v.size() == 3) {
    for (int k = 0; k < 3; ++k) m[k][k] = v[static_cast<std::size_t>(k)];
  } else if (kind == "orient" && v.size() == 4 && v[0] * v[0] + v[1] * v[1] + v[2] * v[2] + v[3] * v[3] > 0) {
    m = glm::dmat4(rotation_from_quaternion(glm::dquat(v[0], v[1], v[2], v[3])));
  } else if (kind.starts_with("rotate") && std::ranges::find(kTurns, kind.substr(6)) != kTurns.end() &&
             v.size() == (kind.size() == 7 ? 1U : 3U)) {
    m = glm::dmat4(turn_of(kind.substr(6), v));
  } else {
    return std::nullopt;
  }
  return m;
}

class StageReader {
 public:
  StageReader(std::string_view text, std::uint64_t file_bytes, const DecodeLimits& limits)
      : text_(text), file_bytes_(file_bytes), limits_(limits) {}

  Result<SplatFile> read();

 private:
  void layer_metadata();
  void our_data(nlohmann::json& ours, std::uint64_t& at);
  void prim(std::string_view specifier, int depth);
  void prim_metadata(Prim& prim);
  void statement(Prim& prim, std::string_view first, int depth);
  void property(Prim& prim, std::string_view first);
  void value(Prim& prim, std::string_view type, bool is_array, std::string_view name, std::uint64_t at);
  bool splat_value(SplatPrim& splats, std::string_view type, bool is_array, std::string_view name, std::uint64_t at);
  Floats floats(std::uint64_t each);
  void numbers(Op& op);
  std::vector<std::string_view> texts();
  void leave(Prim& prim);
  std::optional<glm::dmat4> transform_of(const Prim& prim, bool& is_placed);
  Status check(const SplatPrim& splats) const;
  SplatCloud cloud_of(const SplatPrim& splats, ScenePart& part) const;
  // After a list operation, if there is one, the next word.
  std::string_view key() {
    constexpr std::array<std::string_view, 5> kLists{"add", "append", "prepend", "delete", "reorder"};
    const std::string_view first = text_.word();
    return std::ranges::find(kLists, first) == kLists.end() ? first : text_.word();
  }
  void note(const char* what) {
    if (std::ranges::find(unused_, what) == unused_.end()) unused_.emplace_back(what);
  }

  UsdaText text_;
  std::uint64_t file_bytes_;
  const DecodeLimits& limits_;
  StatedScene stated_{.axes = kAxesOpenGl, .metres_per_unit = static_cast<float>(kCentimetre)};
  std::vector<SplatPrim> splats_;
  std::vector<std::string> unused_;
  std::uint64_t arc_ = Error::kNone;        // of the stage's first composition
  std::uint64_t arc_above_ = Error::kNone;  // of one of the prim that is read or of those around it
};

constexpr const char* kArcs =
    "a reference, payload, sublayer, variant, inherit or clip brings in what is not read: compose it (usdcat --flatten "
    "-o flat.usda)";

void StageReader::layer_metadata() {
  nlohmann::json ours = nlohmann::json::object();
  std::uint64_t ours_at = 0;
  while (text_.ok() && !text_.take(')')) {
    if (text_.next() == '"' || text_.next() == '\'') {  // a comment
      text_.quoted();
      continue;
    }
    const std::uint64_t at = text_.at();
    const std::string_view name = key();
    text_.expect('=');
    if (name == "upAxis") {
      const std::string_view up = text_.quoted();
      if (up != "Y" && up != "Z") return text_.fail(Errc::bad_value, at, "upAxis is neither Y nor Z");
      if (up == "Z") stated_.axes = kAxesUpZ;
    } else if (name == "metersPerUnit") {
      stated_.metres_per_unit = text_.number<float>();
      if (!(stated_.metres_per_unit > 0) || !std::isfinite(stated_.metres_per_unit))
        return text_.fail(Errc::bad_value, at, "metersPerUnit is not a positive number");
    } else if (name == "subLayers" && text_.next() == '[') {
      text_.take('[');
      if (!text_.take(']')) return text_.fail(Errc::unsupported_feature, at, kArcs);
    } else if (name == "customLayerData" && text_.take('{')) {
      our_data(ours, ours_at);
    } else {
      text_.skip_value();
    }
  }
  // Ours hold over the fields, which cannot say that something is unknown.
  if (text_.ok() && !read_extras({{"rgs", ours}}, stated_))
    text_.fail(Errc::bad_value, ours_at, "customLayerData's rgs has an invalid value");
}

// A text without the backslashes before quotes and backslashes.
std::string unescaped(std::string_view quoted) {
  std::string text;
  for (std::size_t i = 0; i < quoted.size(); ++i) {
    if (quoted[i] == '\\' && i + 1 < quoted.size()) ++i;
    text += quoted[i];
  }
  return text;
}

// Of customLayerData only the dictionary rgs, which has the names and values of a glTF primitive's extras.rgs.
void StageReader::our_data(nlohmann::json& ours, std::uint64_t& at) {
  const auto entries = [this](const auto& entry) {
    while (text_.ok() && !text_.take('}')) {
      const std::string_view type = text_.word();
      if (text_.take('[')) text_.expect(']');
      const std::string_view name = text_.next() == '"' || text_.next() == '\'' ? text_.quoted() : text_.word();
      text_.expect('=');
      entry(type, name);
    }
  };
  entries([&](std::string_view type, std::string_view name) {
    if (name != "rgs" || type != "dictionary" || text_.next() != '{') return text_.skip_value();
    at = text_.at();
    text_.take('{');
    entries([&](std::string_view kind, std::string_view member) {
      nlohmann::json& value = ours[std::string(member)];
      if (kind == "string")
        value = unescaped(text_.quoted());
      else if (kind == "double")
        value = text_.number<double>();
      else
        text_.skip_value();
    });
  });
}

void StageReader::prim_metadata(Prim& prim) {
  constexpr std::array<std::string_view, 6> kCompositions{"references",  "payload",     "inherits",
                                                          "specializes", "variantSets", "clips"};
  while (text_.ok() && !text_.take(')')) {
    if (text_.next() == '"' || text_.next() == '\'') {
      text_.quoted();
      continue;
    }
    const std::uint64_t at = text_.at();
    const std::string_view name = key();
    text_.expect('=');
    if (name == "active") {
      const std::string_view active = text_.atom();
      prim.is_shown = prim.is_shown && active != "false" && active != "0";
      continue;
    }
    if (std::ranges::find(kCompositions, name) != kCompositions.end() && text_.next() != 'N') {  // None
      arc_ = std::min(arc_, at);
      arc_above_ = std::min(arc_above_, at);
    }
    text_.skip_value();
    if (text_.next() == '<') text_.skip_value();  // the prim of a referenced layer, and its offset in time
    if (text_.next() == '(') text_.skip_value();
  }
}

void StageReader::prim(std::string_view specifier, int depth) {
  Prim prim;
  prim.at = text_.at();
  prim.first = splats_.size();
  prim.is_shown = specifier == "def";
  if (text_.next() != '"' && text_.next() != '\'') prim.type = text_.word();
  text_.quoted();
  const std::uint64_t arc_outside = arc_above_;
  if (text_.take('(')) prim_metadata(prim);
  if (depth > kMaxPrimDepth) return text_.fail(Errc::bad_syntax, prim.at, "prims are nested more than 64 deep");
  if (!prim.is_shown) {  // nor are those below it
    if (text_.next() != '{') return text_.expect('{');
    text_.skip_value();
    arc_above_ = arc_outside;
    return;
  }
  if (prim.type == "ParticleField")
    return text_.fail(Errc::unsupported_feature, prim.at,
                      "a particle field of another kernel than ParticleField3DGaussianSplat's is not read");
  if (prim.is_splats()) {
    if (arc_above_ != Error::kNone) return text_.fail(Errc::unsupported_feature, arc_above_, kArcs);
    splats_.emplace_back().at = prim.at;
    if (const Status s = check_expansion(sizeof(SplatPrim) * splats_.size(), file_bytes_, prim.at, limits_); !s)
      return text_.fail(s.error().code, prim.at, s.error().what);
  }
  text_.expect('{');
  while (text_.ok() && !text_.take('}')) statement(prim, text_.word(), depth);
  if (text_.ok()) leave(prim);
  arc_above_ = arc_outside;
}

void StageReader::statement(Prim& prim, std::string_view first, int depth) {
  if (first == "def" || first == "over" || first == "class") return this->prim(first, depth + 1);
  if (first != "variantSet") return property(prim, first);
  text_.quoted();
  text_.expect('=');
  text_.skip_value();
}

void StageReader::property(Prim& prim, std::string_view first) {
  constexpr std::array<std::string_view, 9> kModifiers{"custom", "uniform", "varying", "config", "add",
                                                       "append", "prepend", "delete",  "reorder"};
  std::string_view type = first;
  while (text_.ok() && std::ranges::find(kModifiers, type) != kModifiers.end()) type = text_.word();
  if (type != "nameChildren" && type != "properties") {
    const bool is_array = text_.take('[');
    if (is_array) text_.expect(']');
    const std::uint64_t at = text_.at();
    const std::string_view name = text_.word();
    if (text_.take('=')) value(prim, type, is_array, name, at);
  } else {
    text_.expect('=');
    text_.skip_value();
  }
  if (text_.next() == '(') text_.skip_value();  // metadata
}

void StageReader::value(Prim& prim, std::string_view type, bool is_array, std::string_view name, std::uint64_t at) {
  if (text_.next() == 'N') return text_.skip_value();  // None: as if it were not here
  if (prim.is_splats() && splat_value(splats_[prim.first], type, is_array, name, at)) return;
  const std::string_view base = name.substr(0, name.find('.'));
  if (base.starts_with("xformOp:")) {
    Op& op = prim.ops[base];
    if (op.is_static) op.at = at;
    if (base == name) return numbers(op);
    op.is_static = false;
  } else if (name == "xformOpOrder") {
    prim.order_at = at;
    prim.order = texts();
    return;
  } else if (name == "colorSpace:name") {
    prim.colour_space = text_.quoted();
    return;
  } else if (name == "purpose" && !is_array && type == "token") {
    prim.purpose = text_.quoted();
    return;
  } else if (name == "visibility") {
    prim.is_shown = text_.quoted() != "invisible";
    return;
  } else if (base == "visibility") {
    prim.comes_and_goes = true;
  }
  text_.skip_value();
}

// Reads the value of one of the schema's own attributes; false if it is none.
bool StageReader::splat_value(SplatPrim& splats, std::string_view type, bool is_array, std::string_view name,
                              std::uint64_t at) {
  const std::string_view base = name.substr(0, name.find('.'));
  const auto* const known = std::ranges::find_if(kSchema, [&](const Parameters& p) {
    return base.starts_with(p.name) && (base.size() == p.name.size() || base.substr(p.name.size()) == "h");
  });
  if (known == kSchema.end() && base != kDegree) {
    if (name == "projectionModeHint" && text_.quoted() == "tangential") note("projectionModeHint: tangential");
    return name == "projectionModeHint";
  }
  if (base != name) {
    text_.fail(Errc::unsupported_feature, at,
               "an attribute of the Gaussians varies in time or is connected: export one moment");
    return true;
  }
  if (base == kDegree) {
    splats.sh_degree = text_.number<int>();
    if (splats.sh_degree < 0 || splats.sh_degree > kMaxShDegree)
      text_.fail(splats.sh_degree < 0 ? Errc::bad_value : Errc::unsupported_feature, at,
                 "a degree of harmonics other than 0 to 3");
    return true;
  }
  const bool is_half = base.size() != known->name.size();
  Values& values = splats.values[static_cast<std::size_t>(known - kSchema.begin())][is_half ? 1 : 0];
  if (!is_array || type != (is_half ? known->half_type : known->type))
    text_.fail(Errc::unsupported_feature, at, "an attribute of the Gaussians has another type than the schema's");
  if (values.at != Error::kNone) text_.fail(Errc::bad_syntax, at, "an attribute of the Gaussians occurs twice");
  values.at = at;
  values.floats = floats(known->each);
  return true;
}

// An array of numbers, or of tuples of `each`.
Floats StageReader::floats(std::uint64_t each) {
  Floats values;
  text_.expect('[');
  while (text_.ok() && !text_.take(']')) {
    if (each > 1) text_.expect('(');
    for (std::uint64_t k = 0; k < each && text_.ok(); ++k) {
      if (k != 0) text_.expect(',');
      values.push_back(text_.number<float>());
    }
    if (each > 1) text_.expect(')');
    if (!text_.take(',') && text_.next() != ']') text_.expect(']');
  }
  return values;
}

// A number, a tuple or a tuple of tuples, in order.
void StageReader::numbers(Op& op) {
  op.n = 0;
  int depth = 0;
  do {
    if (depth < 2 && text_.take('('))
      ++depth;
    else if (depth > 0 && text_.take(')'))
      --depth;
    else if (depth > 0 && text_.take(','))
      continue;
    else if (op.n == op.numbers.size())
      text_.fail("a transform is not of at most 4 x 4 numbers");
    else
      op.numbers[op.n++] = text_.number<double>();
  } while (text_.ok() && depth > 0);
}

std::vector<std::string_view> StageReader::texts() {
  std::vector<std::string_view> list;
  text_.expect('[');
  while (text_.ok() && !text_.take(']')) {
    list.push_back(text_.quoted());
    if (!text_.take(',') && text_.next() != ']') text_.expect(']');
  }
  return list;
}

// The product of the operations in their order, the last one nearest to the prim; nullopt after an error.
std::optional<glm::dmat4> StageReader::transform_of(const Prim& prim, bool& is_placed) {
  constexpr std::string_view kInvert = "!invert!", kPrefix = "xformOp:";
  glm::dmat4 product(1.0);
  for (const std::string_view entry : prim.order) {
    if (entry == "!resetXformStack!") {
      is_placed = true;
      product = glm::dmat4(1.0);
      continue;
    }
    const bool inverts = entry.starts_with(kInvert);
    const std::string_view name = inverts ? entry.substr(kInvert.size()) : entry;
    const auto found = prim.ops.find(name);
    if (found == prim.ops.end())
      return text_.fail(Errc::bad_value, prim.order_at, "xformOpOrder names a transform that the prim does not have"),
             std::nullopt;
    const Op& op = found->second;
    if (!op.is_static)
      return text_.fail(Errc::unsupported_feature, op.at, "a transform varies in time: export one moment"),
             std::nullopt;
    const std::string_view kind = name.substr(kPrefix.size());
    const auto m = matrix_of(kind.substr(0, kind.find(':')), op);
    if (!m) return text_.fail(Errc::unsupported_feature, op.at, "a transform of unknown kind or size"), std::nullopt;
    product = product * (inverts ? glm::inverse(*m) : *m);
    for (int k = 0; k < 16; ++k) {
      if (std::isfinite(glm::value_ptr(product)[k])) continue;
      return text_.fail(Errc::bad_value, op.at, "a transform is not finite or has no inverse"), std::nullopt;
    }
  }
  return product;
}

// What a prim says holds for all Gaussians in and below it.
void StageReader::leave(Prim& prim) {
  if (splats_.size() == prim.first) return;
  if (!prim.is_shown) {
    note("invisible Gaussians");
    splats_.resize(prim.first);
    return;
  }
  if (prim.type == "PointInstancer") {
    note("Gaussians below a PointInstancer");
    splats_.resize(prim.first);
    return;
  }
  if (prim.purpose == "guide" || prim.purpose == "proxy") {
    const auto below = splats_.begin() + static_cast<std::ptrdiff_t>(prim.first);
    const auto gone = std::remove_if(below, splats_.end(), [](const SplatPrim& s) { return !s.has_purpose; });
    if (gone != splats_.end()) note("Gaussians of purpose guide or proxy");
    splats_.erase(gone, splats_.end());
  }
  if (prim.comes_and_goes) note("visibility that varies in time");
  bool is_placed = false;
  const auto transform = transform_of(prim, is_placed);
  if (!transform) return;
  for (SplatPrim& splats : std::span(splats_).subspan(prim.first)) {
    if (!splats.is_placed) splats.to_stage = *transform * splats.to_stage;
    splats.is_placed = splats.is_placed || is_placed;
    splats.has_purpose = splats.has_purpose || !prim.purpose.empty();
    if (splats.colour_space.empty()) splats.colour_space = prim.colour_space;
  }
}

Status StageReader::check(const SplatPrim& splats) const {
  for (const Parameter p : {kOrientations, kScales, kOpacities, kHarmonics}) {
    const Values& values = splats.of(p);
    const std::uint64_t each =
        p == kHarmonics ? static_cast<std::uint64_t>(3 * sh_coefficients(splats.sh_degree)) : kSchema[p].each;
    if (values.floats.empty() || values.floats.size() == each * splats.n()) continue;
    return make_error(Errc::size_mismatch, values.at, "an array does not have one entry for each position",
                      each / kSchema[p].each * splats.n(), values.floats.size() / kSchema[p].each);
  }
  return {};
}

SplatCloud StageReader::cloud_of(const SplatPrim& splats, ScenePart& part) const {
  SplatCloud cloud;
  part.n = splats.n();
  cloud.resize(part.n, splats.cloud_degree());
  for (std::uint64_t i = 0; i < part.n; ++i) cloud.set(i, splats.splat(i));
  transform_splats(cloud, part.origin, *similarity_of(splats.to_stage));
  return cloud;
}

Result<SplatFile> StageReader::read() {
  if (text_.take('(')) layer_metadata();
  while (!text_.ends()) {
    const std::string_view first = text_.word();
    if (first == "def" || first == "over" || first == "class") {
      prim(first, 0);
    } else if (first == "reorder") {  // rootPrims
      text_.word();
      text_.expect('=');
      text_.skip_value();
    } else {
      text_.fail("the text is not in the grammar of .usda");
    }
  }
  if (!text_.ok()) return tl::unexpected(text_.status().error());
  if (splats_.empty()) {
    if (arc_ != Error::kNone) return make_error(Errc::unsupported_feature, arc_, kArcs);
    return make_error(Errc::not_gaussian_splats, 0, "the stage shows no ParticleField3DGaussianSplat");
  }
  if (arc_ != Error::kNone) note("references, payloads or variants");
  std::uint64_t n = 0;
  SplatFile file;
  file.cloud.resize(0, std::ranges::max(splats_, {}, &SplatPrim::cloud_degree).cloud_degree());
  const std::uint64_t floats_each = 11 + 3 * static_cast<std::uint64_t>(sh_coefficients(file.cloud.sh_degree));
  for (const SplatPrim& splats : splats_) {
    if (const Status s = check(splats); !s) return tl::unexpected(s.error());
    if (!similarity_of(splats.to_stage))
      return make_error(Errc::unsupported_feature, splats.at,
                        "transforms shear, mirror or scale the Gaussians unevenly, which they do not survive");
    n += splats.n();
  }
  if (n > limits_.max_gaussians)
    return make_error(Errc::limit_exceeded, 0, "more Gaussians than the caller allows", limits_.max_gaussians, n);
  if (const Status s = check_expansion(4 * n * floats_each, file_bytes_, 0, limits_); !s)
    return tl::unexpected(s.error());
  const std::string_view space = splats_.front().colour_space;
  if (space.starts_with(kLinear))
    stated_.colour_space = ColourSpace::linear_display;
  else if (!space.empty() && !space.starts_with(kDisplay))
    note("a colour space other than Rec. 709");
  stated_.copy_to(file);
  std::vector<ScenePart> parts;
  for (SplatPrim& splats : splats_) {
    SplatCloud part = cloud_of(splats, parts.emplace_back());
    splats.values = {};  // to hold them once
    if (splats_.size() == 1) {
      file.cloud = std::move(part);
      file.origin = parts.front().origin;
    } else {
      append_splats(file.cloud, part);
    }
  }
  if (parts.size() > 1) merge_parts(file.cloud, parts, file.origin);
  for (const ScenePart& part : parts) file.position_rounding = std::max(file.position_rounding, part.position_rounding);
  file.unused = std::move(unused_);
  return file;
}

Result<SplatFile> decode_layer(std::span<const std::byte> bytes, std::uint64_t file_bytes, const DecodeLimits& limits) {
  if (begins_with(bytes, kMagicCrate)) return make_error(Errc::unsupported_feature, 0, kUsdCrate);
  if (!begins_with(bytes, kMagicUsda)) return make_error(Errc::bad_magic, 0, "is not a text of OpenUSD (#usda 1.0)");
  const std::string_view text = text_of(bytes);
  if (!text.substr(kMagicUsda.size()).starts_with("1."))
    return make_error(Errc::unsupported_version, kMagicUsda.size(), "a version of .usda other than 1");
  return StageReader(text, file_bytes, limits).read();
}

// ---- writing --------------------------------------------------------------------------------------------------------

class UsdaWriter {
 public:
  void add(std::string_view text) {
    const auto bytes = std::as_bytes(std::span(text));
    file_.insert(file_.end(), bytes.begin(), bytes.end());
  }
  /// The shortest decimals that read back as the same number.
  template <class Number>
  void add_number(Number value) {
    std::array<char, 32> digits;
    const char* const end = std::to_chars(digits.data(), digits.data() + digits.size(), value).ptr;
    add({digits.data(), static_cast<std::size_t>(end - digits.data())});
  }
  template <class Number>
  void add_tuple(std::span<const Number> values) {
    if (values.size() > 1) add("(");
    for (const Number& value : values) {
      if (&value != values.data()) add(", ");
      add_number(value);
    }
    if (values.size() > 1) add(")");
  }
  /// An attribute with `n` entries of `each` floats, which row(i, floats) fills in.
  template <std::size_t each, class Row>
  void add_array(std::string_view type, std::string_view name, std::uint64_t n, const Row& row) {
    add("    ");
    add(type);
    add("[] ");
    add(name);
    add(" = [");
    for (std::uint64_t i = 0; i < n; ++i) {
      std::array<float, each> values;
      row(i, values);
      if (i != 0) add(", ");
      add_tuple(std::span<const float>(values));
    }
    add("]");
  }
  std::vector<std::byte> take() { return std::move(file_); }

 private:
  std::vector<std::byte> file_;
};

// The box of all Gaussians' three-sigma spheres.
void add_extent(const SplatView& splats, UsdaWriter& file) {
  std::array<float, 3> low, high;
  low.fill(std::numeric_limits<float>::infinity());
  high.fill(-low[0]);
  for (std::size_t i = 0; i < splats.mean.size(); ++i) {
    const float* log_scale = &splats.log_scale[i - i % 3];
    const float radius = 3 * scale_from_log(std::max({log_scale[0], log_scale[1], log_scale[2]}));
    low[i % 3] = std::min(low[i % 3], splats.mean[i] - radius);
    high[i % 3] = std::max(high[i % 3], splats.mean[i] + radius);
  }
  file.add("    float3[] extent = [");
  file.add_tuple(std::span<const float>(low));
  file.add(", ");
  file.add_tuple(std::span<const float>(high));
  file.add("]\n");
}

void add_layer_metadata(const StatedScene& stated, UsdaWriter& file) {
  StatedScene rest = stated;
  rest.metres_per_unit = 0;
  nlohmann::ordered_json extras = extras_of(rest);
  nlohmann::ordered_json ours = extras.is_null() ? nlohmann::ordered_json::object() : extras["rgs"];
  if (stated.metres_per_unit == 0) ours["metres_per_unit"] = 0.0;  // unknown
  file.add("#usda 1.0\n(\n");
  if (!ours.empty()) {
    file.add("    customLayerData = {\n        dictionary rgs = {\n");
    for (const auto& [key, value] : ours.items())
      file.add("            " + std::string(value.is_string() ? "string " : "double ") + key + " = " + value.dump() +
               "\n");
    file.add("        }\n    }\n");
  }
  file.add("    defaultPrim = \"Splats\"\n    metersPerUnit = ");
  file.add_number(stated.metres_per_unit == 0 ? 1.F : stated.metres_per_unit);
  file.add("\n    upAxis = \"Y\"\n)\n\n");
}

void add_gaussians(const SplatView& splats, UsdaWriter& file) {
  const std::uint64_t n = splats.n, coefficients = static_cast<std::uint64_t>(sh_coefficients(splats.sh_degree));
  file.add_array<3>("point3f", kSchema[kPositions].name, n, [&](std::uint64_t i, std::array<float, 3>& mean) {
    std::copy_n(&splats.mean[3 * i], 3, mean.begin());
  });
  file.add("\n");
  file.add_array<4>("quatf", kSchema[kOrientations].name, n, [&](std::uint64_t i, std::array<float, 4>& wxyz) {
    double squared = 0;
    for (std::size_t k = 0; k < 4; ++k) squared += std::pow(static_cast<double>(splats.rotation[4 * i + k]), 2);
    for (std::size_t k = 0; k < 4; ++k)
      wxyz[k] = static_cast<float>(static_cast<double>(splats.rotation[4 * i + k]) / std::sqrt(squared));
  });
  file.add("\n");
  file.add_array<3>("float3", kSchema[kScales].name, n, [&](std::uint64_t i, std::array<float, 3>& scale) {
    for (std::size_t k = 0; k < 3; ++k) scale[k] = scale_from_log(splats.log_scale[3 * i + k]);
  });
  file.add("\n");
  file.add_array<1>("float", kSchema[kOpacities].name, n, [&](std::uint64_t i, std::array<float, 1>& opacity) {
    opacity[0] = opacity_from_logit(splats.opacity_logit[i]);
  });
  file.add("\n    uniform int " + std::string(kDegree) + " = ");
  file.add_number(splats.sh_degree);
  file.add("\n");
  file.add_array<3>(
      "float3", kSchema[kHarmonics].name, n * coefficients,
      [&](std::uint64_t i, std::array<float, 3>& rgb) { std::copy_n(&splats.sh[3 * i], 3, rgb.begin()); });
  file.add(" (\n        elementSize = ");
  file.add_number(coefficients);
  file.add("\n        interpolation = \"vertex\"\n    )\n");
}

}  // namespace

bool is_usda(std::span<const std::byte> bytes) {
  return begins_with(bytes, kMagicUsda);
}

bool is_usdz(std::span<const std::byte> bytes) {
  return is_zip_with(bytes, ".usd");
}

Result<SplatFile> decode_usda(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  return decode_layer(bytes, bytes.size(), limits);
}

Result<SplatFile> decode_usdz(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto archive = ZipArchive::open(bytes);
  if (!archive) return tl::unexpected(archive.error());
  const auto layer = archive->read(archive->name_ending(""), limits, "the package is empty");
  if (!layer) return tl::unexpected(layer.error());
  return decode_layer(*layer, bytes.size(), limits);
}

Result<std::vector<std::byte>> encode_usda(const SplatView& splats, const WriteOptions& options) {
  const StatedScene stated = stated_scene(options);
  UsdaWriter file;
  add_layer_metadata(stated, file);
  file.add("def ParticleField3DGaussianSplat \"Splats\"");
  if (stated.colour_space == ColourSpace::undeclared) {
    file.add("\n{\n");
  } else {
    file.add(" (\n    prepend apiSchemas = [\"ColorSpaceAPI\"]\n)\n{\n    uniform token colorSpace:name = \"");
    file.add(stated.colour_space == ColourSpace::linear_display ? "lin_rec709_scene" : "srgb_rec709_display");
    file.add("\"\n");
  }
  if (splats.n != 0) add_extent(splats, file);
  add_gaussians(splats, file);
  file.add("    uniform token projectionModeHint = \"perspective\"\n    uniform token sortingModeHint = \"zDepth\"\n");
  if (stated.origin != kNoOrigin) {
    file.add("    double3 xformOp:translate = ");
    file.add_tuple(std::span<const double>(stated.origin));
    file.add("\n    uniform token[] xformOpOrder = [\"xformOp:translate\"]\n");
  }
  file.add("}\n");
  return file.take();
}

Result<std::vector<std::byte>> encode_usdz(const SplatView& splats, const WriteOptions& options) {
  auto layer = encode_usda(splats, options);
  if (!layer) return layer;
  constexpr std::uint64_t kMost = std::numeric_limits<std::uint32_t>::max() - 65536, kAlignment = 64;
  if (layer->size() > kMost)
    return make_error(Errc::limit_exceeded, Error::kNone,
                      "a .usdz holds at most 4 GiB; write .usda, strip harmonics or split the scene", kMost,
                      layer->size());
  const std::pair<std::string, std::vector<std::byte>> file("scene.usda", *std::move(layer));
  return zip_stored({&file, 1}, kAlignment);
}

}  // namespace rgs::detail
