// parts_job.cpp - the shared job, the plan, and the state of the work.
// SPDX-License-Identifier: Apache-2.0
#include <sys/stat.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <filesystem>
#include <string_view>
#include <utility>

#include "input_files.hpp"
#include "parts.hpp"
#include "parts_scan.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

namespace fs = std::filesystem;
using nlohmann::json;

template <class T, std::size_t N>
json list_of(const std::array<T, N>& values) {
  json list = json::array();
  for (const T& value : values) list.push_back(value);
  return list;
}

json axes_json(const Axes& axes) {
  json list = json::array();
  for (const Axis axis : axes) list.push_back(static_cast<int>(axis));
  return list;
}

Axes axes_of(const json& list) {
  Axes axes;
  for (std::size_t k = 0; k < 3; ++k) axes[k] = static_cast<Axis>(list.at(k).get<int>());
  return axes;
}

json origin_json(const Origin& origin) {
  return json::array({origin[0], origin[1], origin[2]});
}

Origin origin_of(const json& list) {
  return {list.at(0).get<double>(), list.at(1).get<double>(), list.at(2).get<double>()};
}

template <class T>
json optional_json(const std::optional<T>& value) {
  return value ? json(*value) : json();
}

template <class T>
std::optional<T> optional_of(const json& value) {
  return value.is_null() ? std::optional<T>() : std::optional<T>(value.get<T>());
}

template <class E>
json enum_json(E value) {
  return static_cast<int>(value);
}

template <class E>
E enum_of(const json& value) {
  return static_cast<E>(value.get<int>());
}

json encode_json(const EncodeOptions& o) {
  json j{{"profile", enum_json(o.profile)},
         {"archive_step", o.archive.step},  // not its threads: each process has its own
         {"level", o.level},
         {"chunk_size", o.chunk_size},
         {"chunk_step_sets", o.chunk_step_sets},
         {"order", enum_json(o.order)},
         {"keep_permutation", o.keep_permutation},
         {"page_origins", o.page_origins},
         {"sh_degree", o.sh_degree},
         {"on_bad", enum_json(o.on_bad)},
         {"max_bad_fraction", o.max_bad_fraction},
         {"depth_mapping", enum_json(o.depth_mapping)},
         {"axes", axes_json(o.axes)},
         {"colour_space", enum_json(o.colour_space)},
         {"aa_mode", enum_json(o.aa_mode)},
         {"low_pass_px2", optional_json(o.low_pass_px2)},
         {"metres_per_unit", o.metres_per_unit},
         {"origin", origin_json(o.origin)},
         {"cutoff_sigma", o.cutoff_sigma},
         {"alpha_threshold", o.alpha_threshold},
         {"alpha_max", o.alpha_max},
         {"transmittance_min", o.transmittance_min},
         {"n_source", o.n_source},
         {"n_repaired", o.n_repaired}};
  if (o.depth) j["depth"] = json::array({o.depth->z_near, o.depth->z_far, enum_json(o.depth->source)});
  if (const FirstView& v = o.first_view; v != FirstView())
    j["first_view"] = json::array({enum_json(v.kind), v.position, v.pivot, v.up, v.horizontal_fov});
  if (o.crs != Crs()) j["crs"] = json::array({o.crs.text, axes_json(o.crs.axes)});
  if (o.provenance) {
    // Names need not be UTF-8.
    const auto bytes = [](const std::string& text) { return json::binary({text.begin(), text.end()}); };
    j["provenance"] = json::array({o.provenance->source_bytes, o.provenance->source_xxh3,
                                   bytes(o.provenance->source_name), bytes(o.provenance->tool)});
  }
  return j;
}

std::string text_of(const json& binary) {
  const auto& bytes = binary.get_binary();
  return {bytes.begin(), bytes.end()};
}

json text_json(const std::string& text) {
  return json::binary({text.begin(), text.end()});
}

EncodeOptions encode_of(const json& j) {
  EncodeOptions o;
  o.profile = enum_of<Profile>(j.at("profile"));
  o.archive.step = j.at("archive_step");
  o.level = j.at("level");
  o.chunk_size = j.at("chunk_size");
  o.chunk_step_sets = j.at("chunk_step_sets");
  o.order = enum_of<Order>(j.at("order"));
  o.keep_permutation = j.at("keep_permutation");
  o.page_origins = j.at("page_origins");
  o.sh_degree = j.at("sh_degree");
  o.on_bad = enum_of<BadPolicy>(j.at("on_bad"));
  o.max_bad_fraction = j.at("max_bad_fraction");
  o.depth_mapping = enum_of<DepthMapping>(j.at("depth_mapping"));
  o.axes = axes_of(j.at("axes"));
  o.colour_space = enum_of<ColourSpace>(j.at("colour_space"));
  o.aa_mode = enum_of<AaMode>(j.at("aa_mode"));
  o.low_pass_px2 = optional_of<float>(j.at("low_pass_px2"));
  o.metres_per_unit = j.at("metres_per_unit");
  o.origin = origin_of(j.at("origin"));
  o.cutoff_sigma = j.at("cutoff_sigma");
  o.alpha_threshold = j.at("alpha_threshold");
  o.alpha_max = j.at("alpha_max");
  o.transmittance_min = j.at("transmittance_min");
  o.n_source = j.at("n_source");
  o.n_repaired = j.at("n_repaired");
  if (j.contains("depth")) {
    const json& d = j["depth"];
    o.depth = DepthRange{d.at(0), d.at(1), enum_of<DepthSource>(d.at(2))};
  }
  if (j.contains("first_view")) {
    const json& v = j["first_view"];
    o.first_view = {enum_of<ViewKind>(v.at(0)), v.at(1), v.at(2), v.at(3), v.at(4)};
  }
  if (j.contains("crs")) o.crs = {j["crs"].at(0), axes_of(j["crs"].at(1))};
  if (j.contains("provenance")) {
    const json& p = j["provenance"];
    o.provenance = Provenance{p.at(0), p.at(1), text_of(p.at(2)), text_of(p.at(3))};
  }
  return o;
}

json input_json(const PartsInput& input) {
  json placed = json::array();
  for (int column = 0; column < 3; ++column) {
    for (int row = 0; row < 3; ++row) placed.push_back(input.placed.rotation[column][row]);
  }
  placed.push_back(input.placed.scale);
  for (int k = 0; k < 3; ++k) placed.push_back(input.placed.translation[k]);
  return {{"path", text_json(input.path)},
          {"name", text_json(input.name)},
          {"bytes", input.bytes},
          {"prefix_xxh3", input.prefix_xxh3},
          {"format", enum_json(input.format)},
          {"axes", axes_json(input.axes)},
          {"placed", std::move(placed)},
          {"n", input.facts.n},
          {"sh_degree", input.facts.sh_degree},
          {"gets_origin", input.facts.gets_origin},
          {"origin", origin_json(input.facts.origin)},
          {"first", input.first}};
}

PartsInput input_of(const json& j) {
  PartsInput input;
  input.path = text_of(j.at("path"));
  input.name = text_of(j.at("name"));
  input.bytes = j.at("bytes");
  input.prefix_xxh3 = j.at("prefix_xxh3");
  input.format = enum_of<SplatFormat>(j.at("format"));
  input.axes = axes_of(j.at("axes"));
  const json& placed = j.at("placed");
  std::size_t next = 0;
  for (int column = 0; column < 3; ++column) {
    for (int row = 0; row < 3; ++row) input.placed.rotation[column][row] = placed.at(next++);
  }
  input.placed.scale = placed.at(next++);
  for (int k = 0; k < 3; ++k) input.placed.translation[k] = placed.at(next++);
  input.facts = {j.at("n"), j.at("sh_degree"), j.at("gets_origin"), origin_of(j.at("origin"))};
  input.first = j.at("first");
  return input;
}

json texts_json(const std::vector<std::string>& texts) {
  json list = json::array();
  for (const std::string& text : texts) list.push_back(text_json(text));
  return list;
}

std::vector<std::string> texts_of(const json& list) {
  std::vector<std::string> texts;
  for (const json& text : list) texts.push_back(text_of(text));
  return texts;
}

json job_json(const PartsJob& job) {
  json inputs = json::array();
  for (const PartsInput& input : job.inputs) inputs.push_back(input_json(input));
  return {{"inputs", std::move(inputs)},
          {"read",
           {enum_json(job.read.format), job.read.skip_unknown_extensions, job.read.limits.max_expansion,
            job.read.limits.max_decoded_bytes}},
          {"encode", encode_json(job.encode)},
          {"quality", enum_json(job.quality)},
          {"n_ranges", job.n_ranges},
          {"bin_rows", job.bin_rows},
          {"cameras", text_json(job.cameras)},
          {"cameras_hash", job.cameras_hash},
          {"z_near", optional_json(job.z_near)},
          {"z_far", optional_json(job.z_far)},
          {"strict", job.strict},
          {"allow_rounding", job.allow_rounding},
          {"sh_degree", job.sh_degree},
          {"n", job.n},
          {"source_format", job.source_format},
          {"unused", texts_json(job.unused)},
          {"notes", texts_json(job.notes)}};
}

PartsJob job_of(const json& j) {
  PartsJob job;
  for (const json& input : j.at("inputs")) job.inputs.push_back(input_of(input));
  const json& read = j.at("read");
  job.read.format = enum_of<SplatFormat>(read.at(0));
  job.read.skip_unknown_extensions = read.at(1);
  job.read.limits.max_expansion = read.at(2);
  job.read.limits.max_decoded_bytes = read.at(3);
  job.encode = encode_of(j.at("encode"));
  job.quality = enum_of<lod::Quality>(j.at("quality"));
  job.n_ranges = j.at("n_ranges");
  job.bin_rows = j.at("bin_rows");
  job.cameras = text_of(j.at("cameras"));
  job.cameras_hash = j.at("cameras_hash");
  job.z_near = optional_of<float>(j.at("z_near"));
  job.z_far = optional_of<float>(j.at("z_far"));
  job.strict = j.at("strict");
  job.allow_rounding = j.at("allow_rounding");
  job.sh_degree = j.at("sh_degree");
  job.n = j.at("n");
  job.source_format = j.at("source_format");
  job.unused = texts_of(j.at("unused"));
  job.notes = texts_of(j.at("notes"));
  return job;
}

bool is_digits(std::string_view text) {
  return !text.empty() && text.find_first_not_of("0123456789") == std::string_view::npos;
}

// Whether the steps write a file of this name, or a killed process may have left it (AtomicFile).
bool is_work_file(std::string_view name) {
  constexpr std::string_view kTemporary = ".tmp-";
  constexpr std::size_t kRandom = 6;
  if (name.size() > kTemporary.size() + kRandom &&
      name.substr(name.size() - kRandom - kTemporary.size(), kTemporary.size()) == kTemporary)
    name.remove_suffix(kRandom + kTemporary.size());
  if (name == "job" || name == "plan") return true;
  return std::ranges::any_of(std::array<std::string_view, 3>{"scan.", "rows.", "range."}, [name](std::string_view of) {
    return name.starts_with(of) && is_digits(name.substr(of.size()));
  });
}

std::vector<fs::path> list_work_files(const std::string& folder) {
  std::vector<fs::path> paths;
  std::error_code error;
  for (fs::directory_iterator it(folder, error), end; !error && it != end; it.increment(error)) {
    if (is_work_file(it->path().filename().string())) paths.push_back(it->path());
  }
  return paths;
}

// An input that has the name of a file of the work and would be removed or overwritten. Empty if there is none.
std::string overwritten_input(const std::vector<fs::path>& work_files, const PartsJob& job) {
  tool::InputFiles inputs;
  for (const PartsInput& input : job.inputs) inputs.add_scene(input.path);
  inputs.add_cameras(job.cameras);
  std::vector<std::string> paths;
  paths.reserve(work_files.size());
  for (const fs::path& path : work_files) paths.push_back(path.string());
  if (inputs.clash(paths).empty()) return {};
  const auto taken = std::ranges::find_if(
      paths, [&inputs](const std::string& path) { return !inputs.clash(std::span(&path, 1)).empty(); });
  return taken == paths.end() ? "" : *taken;
}

bool is_there(const std::string& path) {
  std::error_code ignored;
  return fs::exists(path, ignored);
}

}  // namespace

lod::StreamOptions PartsRun::stream_options(lod::Quality quality) const {
  lod::StreamOptions options;
  options.build = build;
  options.build.quality = quality;
  options.memory_bytes = memory_bytes;
  options.scratch = scratch;
  options.advance = [this](std::uint64_t units) { observer.advance(units); };
  return options;
}

std::uint64_t choose_bin_rows(const EncodeOptions& encode, int sh_degree, std::uint64_t memory_bytes) {
  const auto kind = lod::LevelRows::Kind::of_leaves(encode);
  const std::uint64_t row_bytes = lod::LevelRows({}, sh_degree, kind).row_bytes();
  // A quarter of the memory; bins may be three times as large as planned.
  return std::clamp<std::uint64_t>(memory_bytes / 4 / lod::sorting_bytes(row_bytes) / 3, 1024, 400'000);
}

std::uint64_t hash_of_prefix(std::span<const std::byte> input) {
  return xxh3(input.first(std::min<std::size_t>(input.size(), std::size_t{64} << 10)));
}

Outcome<PartsJob> begin_parts(const PartsRun& run, const PartsJob& job, bool overwrite) {
  const std::string path = run.job_path();
  const json about = job_json(job);
  const std::vector<fs::path> work_files = list_work_files(run.folder);
  if (const std::string input = overwritten_input(work_files, job); !input.empty()) {
    return failed(
        input, {Errc::bad_argument, Error::kNone, "the input has the name of a file of the work; name another folder",
                Error::kNone, Error::kNone, 0});
  }
  std::error_code error;
  if (overwrite) {
    for (const fs::path& step : work_files) {
      if (step.filename() != "job" && fs::symlink_status(step, error).type() == fs::file_type::regular)
        fs::remove(step, error);
    }
  } else if (is_there(path)) {
    auto old = WorkFile::open(path, WorkKind::job);
    if (old && old->about() == about) return open_job(run);
    if (!old && old.error().code != Errc::bad_magic) return failed(path, old.error());
    return failed(path, {Errc::output_exists, Error::kNone,
                         "this work has other inputs or options; name another folder, or begin again with --overwrite",
                         Error::kNone, Error::kNone, 0});
  }
  fs::create_directories(run.folder, error);
  if (error) {
    return failed(run.folder, {Errc::write_failed, Error::kNone, "cannot create the folder of the work", Error::kNone,
                               Error::kNone, error.value()});
  }
  auto writer = WorkWriter::create(path, WorkKind::job, 0, run.sync);
  if (!writer) return failed(path, writer.error());
  if (const Status s = writer->finish(about); !s) return failed(path, s.error());
  return open_job(run);
}

Outcome<PartsJob> open_job(const PartsRun& run) {
  const auto file = WorkFile::open(run.job_path(), WorkKind::job);
  if (!file) {
    Error error = file.error();
    if (error.code == Errc::open_failed && error.system == ENOENT)
      error.what = "no work has begun in this folder; begin with rgs-convert --lod-partition FOLDER --ranges N INPUTS";
    return failed(run.job_path(), error);
  }
  auto job = read_about([&]() -> Result<PartsJob> { return job_of(file->about()); });
  if (!job) return failed(run.job_path(), job.error());
  job->identity = file->identity();
  return std::move(*job);
}

Outcome<std::optional<PartsPlan>> find_plan(const PartsRun& run, const PartsJob& job) {
  const std::string path = run.plan_path();
  if (!is_there(path)) return std::nullopt;
  const auto basis = find_basis_of_plan(run, job);
  if (!basis) return tl::unexpected(basis.error());
  if (!*basis) return std::nullopt;
  auto found = WorkFile::find(path, WorkKind::plan, **basis);
  if (!found) return failed(path, found.error());
  std::optional<WorkFile>& file = *found;
  if (!file) return std::nullopt;
  PartsPlan plan;
  plan.identity = file->identity();
  const Status read = read_about([&]() -> Status {
    plan.encode = encode_of(file->about().at("encode"));
    auto bins = unpack_numbers<std::uint64_t>(file->about().at("bins"));
    if (!bins) return tl::unexpected(bins.error());
    plan.bins = std::move(*bins);
    if (plan.bins.empty() || plan.bins.front() != 0 || !std::ranges::is_sorted(plan.bins, std::less_equal<>())) {
      return make_error(Errc::bad_value, Error::kNone,
                        "the bins of the plan are not ranges of the curve; remove the file");
    }
    std::vector<std::byte> bytes(file->end() - kWorkHeadBytes);
    if (Status s = file->read(kWorkHeadBytes, bytes); !s) return s;
    if (xxh3(bytes) != file->about().at("scan_xxh3").get<std::uint64_t>()) {
      return make_error(Errc::checksum_mismatch, kWorkHeadBytes, "the plan is damaged; remove the file");
    }
    auto scan = SceneScan::from_bytes(bytes);
    if (!scan) return tl::unexpected(scan.error());
    plan.scan = std::move(*scan);
    return {};
  });
  if (!read) return failed(path, read.error());
  return plan;
}

Status write_plan(const PartsRun& run, const PartsPlan& plan, std::uint64_t basis) {
  auto writer = WorkWriter::create(run.plan_path(), WorkKind::plan, basis, run.sync);
  if (!writer) return tl::unexpected(writer.error());
  const std::vector<std::byte> scan = plan.scan.to_bytes();
  if (Status s = writer->append(scan); !s) return s;
  return writer->finish({{"encode", encode_json(plan.encode)},
                         {"bins", pack_numbers(std::span<const std::uint64_t>(plan.bins))},
                         {"scan_xxh3", xxh3(scan)}});
}

std::vector<std::uint64_t> stretches_of(const PartsRun& run, const PartsJob& job, const PartsPlan& plan) {
  return lod::cut_stretches(plan.scan.n_kept(), lod::build_options(plan.encode, run.stream_options(job.quality)));
}

StretchRange stretches_of_range(std::size_t n_stretches, std::size_t range, std::size_t n_ranges) {
  return {n_stretches * range / n_ranges, n_stretches * (range + 1) / n_ranges};
}

std::optional<Selection> parse_selection(const std::string& text) {
  if (text == "all") return Selection{};
  if (text == "none") return Selection{1, 0, false, text};
  Selection selection{0, 0, true, text};
  const char *first = text.data(), *last = first + text.size();
  const auto begin = std::from_chars(first, last, selection.first);
  if (begin.ec != std::errc()) return std::nullopt;
  selection.last = selection.first;
  if (begin.ptr == last) return selection;
  if (*begin.ptr != '-') return std::nullopt;
  const auto end = std::from_chars(begin.ptr + 1, last, selection.last);
  if (end.ec != std::errc() || end.ptr != last || selection.last < selection.first) return std::nullopt;
  return selection;
}

Outcome<std::string> list_parts(const PartsRun& run) {
  auto job = open_job(run);
  if (!job) return tl::unexpected(job.error());
  const auto plan = find_plan(run, *job);
  if (!plan) return tl::unexpected(plan.error());
  const auto done = [](const std::string& path, WorkKind kind, std::uint64_t basis) {
    const auto file = WorkFile::find(path, kind, basis);
    return file && *file;
  };
  json inputs = json::array(), ranges = json::array();
  for (std::size_t i = 0; i < job->inputs.size(); ++i) {
    inputs.push_back({{"input", i},
                      {"path", job->inputs[i].path},
                      {"gaussians", job->inputs[i].facts.n},
                      {"scanned", done(run.scan_path(i), WorkKind::scan, job->identity)},
                      {"placed", *plan && done(run.rows_path(i), WorkKind::rows, (*plan)->identity)}});
  }
  const std::size_t n_stretches = *plan ? stretches_of(run, *job, **plan).size() - 1 : 0;
  for (std::size_t i = 0; i < job->n_ranges; ++i) {
    const StretchRange of = stretches_of_range(n_stretches, i, job->n_ranges);
    const bool nothing = *plan && of.first == of.last;
    const bool built = nothing || (*plan && done(run.range_path(i), WorkKind::range, (*plan)->identity));
    ranges.push_back({{"range", i}, {"stretches", of.last - of.first}, {"built", built}});
  }
  const json list{{"schema", "rgs-parts/1"},
                  {"gaussians", job->n},
                  {"planned", plan->has_value()},
                  {"inputs", std::move(inputs)},
                  {"ranges", std::move(ranges)}};
  return list.dump(1, ' ', false, json::error_handler_t::replace) + "\n";
}

}  // namespace rgs
