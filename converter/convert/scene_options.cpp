// scene_options.cpp - the options of what is read, and reading it.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <charconv>
#include <cmath>
#include <map>
#include <utility>

#include "max_expansion.hpp"
#include "rgs_convert.hpp"
#include "spz_axes.hpp"

namespace rgs {
namespace {

// Finite numbers separated by commas; empty if the text is anything else.
std::vector<double> numbers(const std::string& text) {
  std::vector<double> values;
  for (const char *at = text.data(), *last = at + text.size();; ++at) {
    double value = 0;
    const auto [end, error] = std::from_chars(at, last, value);
    if (error != std::errc() || !std::isfinite(value) || (end != last && *end != ',')) return {};
    values.push_back(value);
    if (end == last) return values;
    at = end;
  }
}

Axes parse_axes(const std::string& text) {
  static const std::map<std::string, Axes> kFrames = {
      {"3dgs", kAxes3dgs}, {"opengl", kAxesOpenGl}, {"gltf", kAxesGltf}};
  if (const auto frame = kFrames.find(text); frame != kFrames.end()) return frame->second;
  if (const auto axes = axes_of_text(text)) return *axes;
  refuse_option("axes are 3dgs, opengl, gltf, undeclared or three directions that span space, e.g. right,down,forward");
}

glm::dvec3 parse_translation(const std::string& text) {
  const std::vector<double> t = numbers(text);
  if (t.size() != 3) refuse_option("--translate takes three numbers, e.g. 1,0,-2.5");
  return {t[0], t[1], t[2]};
}

glm::dmat3 parse_rotation(const std::string& text) {
  const std::vector<double> r = numbers(text);
  if (r.size() == 3) return rotation_from_euler({r[0], r[1], r[2]});
  if (r.size() == 4 && std::hypot(std::hypot(r[0], r[1]), std::hypot(r[2], r[3])) > 1e-30)
    return rotation_from_quaternion({r[0], r[1], r[2], r[3]});
  refuse_option("--rotate takes degrees about x,y,z, or a quaternion w,x,y,z other than 0");
}

double parse_scale(const std::string& text) {
  const std::vector<double> s = numbers(text);
  if (s.size() != 1 || !(s[0] > 0)) refuse_option("--scale takes one factor above 0");
  return s[0];
}

WorldBox parse_box(const std::string& text) {
  const std::vector<double> v = numbers(text);
  if (v.size() != 6 || !(v[0] <= v[3] && v[1] <= v[4] && v[2] <= v[5]))
    refuse_option("--crop takes two corners, the smaller first: x,y,z,X,Y,Z");
  return WorldBox{{v[0], v[1], v[2]}, {v[3], v[4], v[5]}};
}

std::string parse_crs(const std::string& text) {
  if (text == "none") return "";
  if (!is_crs_text(text))
    refuse_option("--crs takes UTF-8 of at most 16,384 bytes without control characters, e.g. EPSG:4978");
  return text;
}

std::uint64_t parse_max_count(const std::string& text) {
  const auto count = tool::parse_count(text);
  if (!count) refuse_option(std::string("--max-count: ") + count.error().what);
  return *count;
}

// An option whose text is parsed into `value`.
template <class T, class Parsed>
CLI::Option* add_parsed(CLI::App& app, const char* name, T& value, Parsed (*parse)(const std::string&),
                        const char* description) {
  return app.add_option_function<std::string>(
      name, [&value, parse](const std::string& text) { value = parse(text); }, description);
}

// An option that is given once for all inputs or once for each.
template <class T>
void add_each(CLI::App& app, const char* name, std::vector<T>& values, T (*parse)(const std::string&),
              const char* description) {
  app.add_option_function<std::vector<std::string>>(
         name,
         [&values, parse](const std::vector<std::string>& texts) {
           for (const std::string& text : texts) values.push_back(parse(text));
         },
         description)
      ->allow_extra_args(false);
}

template <class T>
T of_input(const std::vector<T>& values, std::size_t input, const T& otherwise) {
  return values.empty() ? otherwise : values[values.size() == 1 ? 0 : input];
}

// Converts an input to these axes and places it; returns the placement.
Similarity place(const SceneOptions& options, std::size_t input, const Axes& axes, SplatFile& file) {
  convert_axes(file.cloud, file.axes, axes);
  convert_axes(file.origin, file.axes, axes);
  const Similarity placed = options.placement(input);
  if (placed.translation != glm::dvec3(0)) file.cloud.mean_rest.resize(file.cloud.mean.size());
  transform_splats(file.cloud, file.origin, placed);
  return placed;
}

// How to read an input. Gaussians that other filters drop do not count towards max_count.
Result<ReadOptions> read_options(const SceneOptions& options, const SceneInput& input, SplatFormat to) {
  ReadOptions read = options.read_options();
  SplatFilter others = options.filter;
  others.max_n = SplatFilter().max_n;
  if (!read.max_count || others.keeps_all()) return read;
  auto counts = input.count_in_pages(read.limits, [&](SplatFile some) {
    if (options.axes) some.axes = *options.axes;
    place(options, 0, options.target_axes(some.axes, SplatFormat::rgs, to), some);
    return filter_splats(some.cloud, others, some.origin);
  });
  if (!counts) return tl::unexpected(counts.error());
  read.page_counts = std::move(*counts);
  return read;
}

// The axes of an SPZ, and why: the format leaves them open.
void note_spz_axes(const SceneOptions& options, const SceneInput& input, const SplatFile& file,
                   std::vector<std::string>& notes) {
  if (file.format != SplatFormat::spz || options.axes || file.axes[0] == Axis::undeclared) return;
  notes.push_back("the axes of " + tool::printable(input.name()) + " are " + axes_text(file.axes) +
                  (file.axes_assumed ? ", assumed because it declares none (--spz-axes)" : ", as it declares"));
}

}  // namespace

std::map<std::string, SplatFormat> formats_by_name(bool writable) {
  std::map<std::string, SplatFormat> formats;
  for (const FormatInfo& info : all_formats())
    if (info.writable || !writable) formats.emplace(info.name, info.format);
  return formats;
}

void SceneOptions::add_to(CLI::App& app) {
  app.option_defaults()->group(kSceneGroup);
  app.add_option(
         "files", files,
         "Inputs, " + format_list() +
             " (several with --merge), then the output; - for a standard stream. Or a folder of scenes, then the "
             "output folder")
      ->expected(0, -1)
      ->option_text("input... output");
  app.add_option("--from", from, "Format of the inputs; default: detected from their content")
      ->transform(tool::one_of(formats_by_name()))
      ->option_text(tool::names_of(formats_by_name(), "|"));
  app.add_flag("--skip-unknown-extensions", skip_unknown_extensions,
               "Skip an SPZ's extensions of unknown type, though they may change what its Gaussians mean");
  tool::add_spz_axes(app, spz_axes);
  app.add_flag("--merge", merge, "Merge several inputs into one output");
  add_parsed(app, "--axes", axes, parse_axes,
             "Directions of the input's +x,+y,+z, if not its format's: 3dgs (right,down,forward), opengl "
             "(right,up,backward), gltf (left,up,forward), undeclared, or three directions");
  add_parsed(app, "--to-axes", to_axes, parse_axes, "Turn the scene to these axes; default: docs/user/INTERCHANGE.md");
  add_each(app, "--translate", translate, parse_translation,
           "Move each input, or the first, the second, ...: x,y,z in the output's axes");
  add_each(app, "--rotate", rotate, parse_rotation,
           "Turn it first: degrees about x, y, z in turn, or a quaternion w,x,y,z");
  add_each(app, "--scale", scale, parse_scale, "Scale it first: one factor");
  add_parsed(app, "--crop", filter.crop, parse_box,
             "Keep Gaussians with means between two corners x,y,z,X,Y,Z of the placed scene");
  app.add_option("--min-opacity", filter.min_opacity, "Keep Gaussians of at least this opacity")
      ->check(CLI::Range(0.0, 1.0));
  add_parsed(app, "--max-count", filter.max_n, parse_max_count,
             "Keep at most this many (200k, 1.5M) after --crop and --min-opacity: of an .rgs with levels of "
             "detail the finest cut with no more, of others those with the largest opacity times "
             "area");
  app.add_option(
      "--level-of-detail", level_of_detail,
      "Level to read of .rgs, streamed SOG, .rad, .lcc, .lcc2 and tilesets (3D Tiles) with levels of detail; "
      "0, the default: the scene's own Gaussians");
  app.add_option("--aa,--aa-mode", asked.aa_mode,
                 "Anti-aliasing that the scene was trained with [the input's, else classic]")
      ->transform(tool::one_of<AaMode>({{"undeclared", AaMode::undeclared},
                                        {"classic", AaMode::classic},
                                        {"mip", AaMode::mip_splatting},
                                        {"mip-splatting", AaMode::mip_splatting}}))
      ->option_text("classic|mip|mip-splatting|undeclared");
  app.add_option("--low-pass", asked.low_pass_px2,
                 "px^2 added to projected covariances in training [the input's, else 0.3, mip 0.1]")
      ->check(CLI::NonNegativeNumber);
  app.add_option("--colour-space", asked.colour_space, "Colours that SH evaluates to")
      ->transform(tool::one_of<ColourSpace>({{"undeclared", ColourSpace::undeclared},
                                             {"srgb", ColourSpace::srgb_display},
                                             {"linear", ColourSpace::linear_display}}))
      ->option_text("srgb|linear|undeclared");
  app.add_option("--metres-per-unit", asked.metres_per_unit, "Size of a unit of the output, if known")
      ->check(CLI::NonNegativeNumber);
  add_parsed(
      app, "--crs", asked.crs, parse_crs,
      "Coordinate reference system of the output's positions, in the inputs' axes: an authority's code (EPSG:4978) "
      "or WKT, or none [the inputs']");
  tool::add_max_expansion(app, limits);
  app.option_defaults()->group(kRgsGroup);
  app.add_option("--depth-map", asked.depth_mapping, "Mapping of depth to the sort key [an .rgs's, else log]")
      ->transform(tool::one_of<DepthMapping>({{"linear", DepthMapping::linear}, {"log", DepthMapping::logarithmic}}))
      ->option_text("linear|log");
}

std::optional<std::string> SceneOptions::check() const {
  if (n_inputs() > 1 && !merge) return "several inputs require --merge";
  for (const std::size_t n : {translate.size(), rotate.size(), scale.size()}) {
    if (n > 1 && n != n_inputs()) return "give --translate, --rotate and --scale once for all inputs or once for each";
  }
  if (asked.aa_mode == AaMode::undeclared && asked.low_pass_px2)
    return "--low-pass requires --aa classic or mip-splatting";
  if (std::ranges::count(inputs(), "-") > 1) return "only one input can be standard input";
  return std::nullopt;
}

SplatFormat SceneOptions::format_of(const SceneInput& input) const {
  return from != SplatFormat::unknown ? from : detect_format(input.bytes());
}

Similarity SceneOptions::placement(std::size_t input) const {
  const Similarity identity;
  return {of_input(rotate, input, identity.rotation), of_input(scale, input, identity.scale),
          of_input(translate, input, identity.translation)};
}

Axes SceneOptions::target_axes(const Axes& source, SplatFormat from_format, SplatFormat to_format) const {
  const bool undeclared = source[0] == Axis::undeclared && n_inputs() == 1;
  if (undeclared && !to_axes) return source;  // nothing to convert
  if (to_format == SplatFormat::spz) return spz_axes;
  if (format_info(to_format).axes != kAxes3dgs) return format_info(to_format).axes;
  if (to_axes) return *to_axes;
  const bool prescribed = from_format == SplatFormat::spz || format_info(from_format).axes != kAxes3dgs;
  return to_format == SplatFormat::rgs && (!prescribed || axes) ? source : kAxes3dgs;
}

ReadOptions SceneOptions::read_options() const {
  ReadOptions options;
  options.limits = limits;
  options.format = from;
  options.skip_unknown_extensions = skip_unknown_extensions;
  options.spz_axes = spz_axes;
  options.level_of_detail = level_of_detail;
  if (n_inputs() == 1 && filter.max_n != SplatFilter().max_n && !level_of_detail) options.max_count = filter.max_n;
  return options;
}

Outcome<LoadedScene> load_scene(const SceneOptions& options, ConvertOptions& convert,
                                const std::deque<SceneInput>& inputs, SplatFormat to, DeclaredLoss& loss) {
  LoadedScene scene;
  EncodeOptions& encode = convert.encode;
  std::vector<std::uint64_t> hashes;
  std::vector<InputDeclarations> declared;
  std::vector<ScenePart> parts;
  SplatFile only;  // without its Gaussians
  for (std::size_t i = 0; i < inputs.size(); ++i) {
    auto read = read_options(options, inputs[i], to);
    if (!read) return failed(inputs[i].path(), read.error());
    auto file = inputs[i].read(std::move(*read));
    if (!file) return failed(inputs[i].path(), file.error());
    note_spz_axes(options, inputs[i], *file, loss.notes);
    if (options.axes) file->axes = *options.axes;
    if (i == 0) encode.axes = options.target_axes(file->axes, file->format, to);
    scene.format = i == 0 ? format_name(file->format) : "merged";
    scene.bytes += file->bytes;
    scene.n_source += file->cloud.size();
    scene.source_sh_degree = std::max(scene.source_sh_degree, file->cloud.sh_degree);
    hashes.push_back(inputs[i].hash());
    scene.unused.insert(scene.unused.end(), file->unused.begin(), file->unused.end());
    const Similarity placed = place(options, i, encode.axes, *file);
    declared.push_back(declared_by(*file, inputs[i].name(), placed));
    declare_prj(declared.back(), inputs[i].prj(), options.asked, loss.notes);
    if (to != SplatFormat::rgs) restore_order(*file);
    const double rounding = file->cloud.mean_rest.empty() ? file->position_rounding * placed.scale : 0;
    parts.push_back({file->cloud.size(), file->origin, rounding});
    if (i == 0) {
      scene.cloud = std::move(file->cloud);
      if (inputs.size() == 1) only = std::move(*file);
    } else {
      append_splats(scene.cloud, file->cloud);
    }
  }
  if (auto s = declare_scene(encode, declared, options.asked, loss.notes); !s)
    return failed(inputs.front().path(), s.error());
  const bool keeps_rests =
      to == SplatFormat::ply || (to == SplatFormat::rgs && convert.levels && encode.profile != Profile::archive);
  if (keeps_rests) scene.cloud.mean_rest.resize(scene.cloud.mean.size());
  merge_parts(scene.cloud, parts, scene.origin);
  const double most = max_rounding(encode, convert.allow_rounding);
  const double rounded = largest_rest(scene.cloud.mean_rest);
  if (!keeps_rests || rounded <= max_rounding(encode, false) / 4) {
    scene.cloud.mean_rest.clear();
    scene.position_rounding = rounded;
    if (auto s = check_rounding(rounded, most); !s) return failed(inputs.front().path(), s.error());
  }
  for (std::size_t i = 0; i < parts.size(); ++i) {
    scene.position_rounding = std::max(scene.position_rounding, parts[i].position_rounding);
    if (auto s = check_rounding(parts[i].position_rounding, most); !s) return failed(inputs[i].path(), s.error());
  }
  const std::vector<std::uint64_t> kept = filter_splats(scene.cloud, options.filter, scene.origin);
  if (kept.size() != scene.n_source) encode.first_view = {};  // it might look at what is gone
  scene.xxh3 = hash_of_sources(hashes);
  if (!keep_source(encode, scene, only, kept, options.moves())) {
    loss.notes.push_back("positions refer to " + inputs.front().name() +
                         ", which does not hold positions in its own source (--keep-permutation)");
  }
  if (to == SplatFormat::rgs && !only.source_index.empty() && !encode.keep_permutation)
    loss.lost.emplace_back("positions in the source (--keep-permutation keeps them)");
  return scene;
}

Outcome<InputTile> open_tile(const SceneOptions& options, const SceneInput& input, std::size_t i,
                             std::vector<std::string>& notes) {
  InputTile out;
  out.format = options.format_of(input);
  auto tile = input.tile(out.format, options.read_options());
  if (!tile) return failed(input.path(), tile.error());
  out.tile = std::move(*tile);
  out.tile.placed = options.placement(i);
  if (out.tile.ply) {
    out.tile.axes = out.tile.ply->declarations().axes;
    out.declared = declared_by(*out.tile.ply, input.name(), out.tile.placed);
    out.bytes = input.bytes().size();
  } else {
    const auto file = out.tile.read([](const SplatFile&) { return Status(); });
    if (!file) return failed(input.path(), file.error());
    out.tile.axes = file->axes;
    out.format = file->format;
    out.bytes = file->bytes;
    out.unused = file->unused;
    note_spz_axes(options, input, *file, notes);
    out.declared = declared_by(*file, input.name(), out.tile.placed);
  }
  declare_prj(out.declared, input.prj(), options.asked, notes);
  if (options.axes) out.tile.axes = *options.axes;
  out.declared.stated.axes = out.tile.axes;
  return out;
}

}  // namespace rgs
