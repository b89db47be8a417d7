// audit_run.cpp - opens source and asset and runs each part of the audit.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <tbb/parallel_invoke.h>

#include <algorithm>
#include <chrono>
#include <cstring>
#include <filesystem>

#include "audit.hpp"
#include "audit_attributes.hpp"
#include "audit_command.hpp"
#include "audit_declarations.hpp"
#include "audit_distances.hpp"
#include "audit_pairing.hpp"
#include "audit_render.hpp"
#include "audit_source.hpp"
#include "info_report.hpp"
#include "input_files.hpp"
#include "rgs/checksum.hpp"
#include "rgs/file.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/utf8_path.hpp"
#include "rgs/version.hpp"
#include "scene_file.hpp"

namespace rgs::audit {
namespace {

namespace fs = std::filesystem;
using Clock = std::chrono::steady_clock;

constexpr const char* kTool = "rgs-audit " RGS_VERSION;

double since(Clock::time_point start) {
  return std::chrono::duration<double>(Clock::now() - start).count();
}

bool is_rgs(std::span<const std::byte> bytes) {
  return bytes.size() >= kMagic.size() && std::memcmp(bytes.data(), kMagic.data(), kMagic.size()) == 0;
}

std::string file_name(const std::string& path) {
  return detail::path_of(path).filename().string();
}

// Bytes of a Gaussian's FP32 attributes in a renderer without compression.
std::uint64_t fp32_bytes(int sh_degree) {
  return sizeof(float) * static_cast<std::uint64_t>(3 + 4 + 3 + 1 + 3 * sh_coefficients(sh_degree));
}

void measure_sections(const FileView& view, SizeReport& size) {
  for (const SectionEntry& s : view.sections()) {
    const auto type = static_cast<SectionType>(s.type);
    size.sections.push_back({tool::four_characters(s.type), tool::describe(type), s.stored_bytes, s.decoded_bytes});
    // Resident while a scene is shown; other sections are for loading and for people.
    const bool resident = type == SectionType::means || type == SectionType::geometry || type == SectionType::sh ||
                          type == SectionType::sh_steps || type == SectionType::chunks;
    if (resident) size.gpu_bytes += s.decoded_bytes;
  }
}

// Pages replace the sections above.
void measure_pages(const PagedFile& file, SizeReport& size) {
  for (std::uint32_t page = 0; page < file.n_pages(); ++page) size.gpu_bytes += file.decoded_bytes(page);
  size.levels = {file.n_levels(), file.n_pages(), file.n_stored()};
}

// An .rgs asset. One with levels of detail is read as a file of its leaves, which correspond to the source's Gaussians.
struct RgsAsset {
  std::optional<PagedFile> levels;
  std::vector<std::byte> leaves;
  FileView view;  // of `leaves`, or the file itself
};

Result<RgsAsset> open_rgs(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  RgsAsset asset;
  if (!has_levels(bytes)) {
    auto view = FileView::open(bytes, limits);
    if (!view) return tl::unexpected(view.error());
    asset.view = *std::move(view);
    return asset;
  }
  auto file = PagedFile::open(bytes, limits);
  if (!file) return tl::unexpected(file.error());
  if (!file->complete())
    return rgs::make_error(Errc::pages_missing, bytes.size(),
                           "the end of the file is missing; only whole files can be audited",
                           file->head().header().file_bytes, bytes.size());
  asset.levels = *std::move(file);
  return asset;
}

constexpr Axes kUndeclaredAxes{Axis::undeclared, Axis::undeclared, Axis::undeclared};

const Axes& axes_of(const RgsAsset& asset) {
  return (asset.levels ? asset.levels->head() : asset.view).declarations().axes;
}

Status load_rgs(RgsAsset& asset, unsigned threads) {
  if (!asset.levels) return asset.view.preload({.threads = threads});
  if (auto ok = validate(*asset.levels, threads); !ok) return ok;
  auto leaves = leaves_as_file(*asset.levels, {.validate = false, .threads = threads});
  if (!leaves) return tl::unexpected(leaves.error());
  asset.leaves = *std::move(leaves);
  auto view = FileView::open(asset.leaves, {.max_file_bytes = asset.leaves.size(),
                                            .max_gaussians = asset.levels->head().header().n_gaussians});
  if (!view) return tl::unexpected(view.error());
  asset.view = *std::move(view);
  return {};
}

Outcome<std::vector<AlsoReport>> measure_also(const Options& options) {
  std::vector<AlsoReport> out;
  for (const std::string& path : options.also) {
    const auto file = MappedFile::open(path);
    if (!file) return make_error(path, file.error());
    AlsoReport report;
    report.path = path;
    report.bytes = file->bytes().size();
    report.has_levels = has_levels(file->bytes());
    if (!options.render) report.note = "not rendered";
    out.push_back(std::move(report));
  }
  return out;
}

// Hashes the contents of a file, or names and contents of all files of a folder; with a SOG's meta.json the pictures
// beside it. None for an empty path.
Outcome<std::uint64_t> hash_path(const std::string& path) {
  if (path.empty()) return 0;
  std::error_code failed;
  std::vector<fs::path> files;
  if (fs::is_directory(detail::path_of(path), failed)) {
    for (fs::recursive_directory_iterator it(detail::path_of(path), failed), end; !failed && it != end;
         it.increment(failed))
      if (it->is_regular_file(failed)) files.push_back(it->path());
    if (failed)
      return make_error(path, {Errc::open_failed, Error::kNone, "cannot read the folder", Error::kNone, Error::kNone,
                               failed.value()});
    std::sort(files.begin(), files.end());
  } else {
    tool::InputFiles scene;
    scene.add_scene(path);
    for (const std::string& file : scene.paths()) files.push_back(detail::path_of(file));
  }
  Hasher hasher;
  for (const fs::path& name : files) {
    const auto file = MappedFile::open(name.string());
    if (!file) return make_error(name.string(), file.error());
    const std::string text = fmt::format("{}:{}:", name.filename().string(), file->bytes().size());
    hasher.update(std::as_bytes(std::span(text)));
    hasher.update(file->bytes());
  }
  return hasher.digest();
}

}  // namespace

double SizeReport::ratio() const {
  return asset_bytes == 0 ? 0 : static_cast<double>(source_bytes) / static_cast<double>(asset_bytes);
}
double SizeReport::bytes_per_gaussian() const {
  return n_asset == 0 ? 0 : static_cast<double>(asset_bytes) / static_cast<double>(n_asset);
}
double SizeReport::gpu_bytes_per_gaussian() const {
  return n_asset == 0 ? 0 : static_cast<double>(gpu_bytes) / static_cast<double>(n_asset);
}
std::size_t Report::n_contradictions() const {
  return static_cast<std::size_t>(std::ranges::count(declared_differences, true, &DeclaredDifference::changes_picture));
}
double Report::seen_share() const {
  if (!render) return 0;
  const auto share = [](std::uint64_t unseen, std::uint64_t n) {
    return n == 0 ? 0 : 1 - static_cast<double>(unseen) / static_cast<double>(n);
  };
  return std::min(share(render->source_unseen, size.n_source), share(render->asset_unseen, size.n_asset));
}
bool Report::gate_holds() const {
  return std::all_of(gate.begin(), gate.end(), [](const Condition& c) { return c.holds; });
}

Outcome<std::string> fingerprint(const Options& o) {
  std::string text =
      fmt::format("{} {} {}x{} {} {} {} {} {} {} {} {}", kTool, o.split, o.size.width, o.size.height, o.views, o.worst,
                  o.render, o.depth, o.attribution, o.compare_scales, o.distances, static_cast<int>(o.backend));
  for (std::size_t i = 0; i < kMeasures.size(); ++i)
    if (o.measures[i]) text += std::string(" ") + kMeasures[i].name;
  if (o.video) text += fmt::format(" video {}", o.fps);
  std::vector<std::string> inputs{o.source, o.asset, o.cameras, o.photos};
  inputs.insert(inputs.end(), o.also.begin(), o.also.end());
  for (const std::string& path : inputs) {
    const auto hash = hash_path(path);
    if (!hash) return tl::unexpected(hash.error());
    text += fmt::format(" {:016x}", *hash);
  }
  return fmt::format("{:016x}", xxh3(std::as_bytes(std::span(text))));
}

Outcome<Report> run(const Options& options, tool::Progress& progress) {
  const auto start = Clock::now();
  const auto file = MappedFile::open(options.asset);
  if (!file) return make_error(options.asset, file.error());
  auto also = measure_also(options);
  if (!also) return tl::unexpected(also.error());

  Report report;
  report.tool = kTool;
  report.source_name = file_name(options.source);
  report.asset_name = file_name(options.asset);
  report.view_command = view_command(options);
  const bool rgs_asset = is_rgs(file->bytes());
  Result<RgsAsset> asset = rgs_asset ? open_rgs(file->bytes(), options.read.limits) : Result<RgsAsset>();
  // The file that an asset may name as its source; of a SOG folder meta.json alone.
  const auto original = MappedFile::open(options.source);
  if (!original) return make_error(options.source, original.error());
  // A conversion turns formats with axes of their own into the asset's; a PLY only on request.
  const bool is_ply = detect_format(original->bytes()) == SplatFormat::ply;
  std::optional<Axes> axes, other_axes;
  if (rgs_asset && asset) {
    axes = is_ply ? kUndeclaredAxes : axes_of(*asset);
    other_axes = is_ply ? axes_of(*asset) : kUndeclaredAxes;
  }
  auto source = Source::open(options.source, options.read, axes);
  if (!source) return make_error(options.source, source.error());
  if (!asset) return make_error(options.asset, asset.error());
  progress.begin("reading", source->bytes() + file->bytes().size(), "B");
  Status valid;
  tbb::parallel_invoke([&] { report.source_xxh3 = xxh3(original->bytes()); },
                       [&] { report.asset_xxh3 = xxh3(file->bytes()); },
                       [&] {
                         if (rgs_asset) valid = load_rgs(*asset, static_cast<unsigned>(options.threads));
                       });
  if (!valid) return make_error(options.asset, valid.error());
  report.source_format = format_name(source->format());
  progress.advance(source->bytes() + file->bytes().size());
  progress.finish();

  const FileView& view = asset->view;
  SizeReport& size = report.size;
  size.source_bytes = source->bytes();
  size.asset_bytes = file->bytes().size();
  size.n_source = source->size();
  size.source_sh_degree = source->sh_degree();
  const Declarations stated = source->declarations(), usual;
  if (stated.aa_mode != usual.aa_mode || stated.low_pass_px2 != usual.low_pass_px2) report.source_stated = stated;
  size.gpu_bytes_fp32 = size.n_source * fp32_bytes(size.source_sh_degree);
  Pairing pairing;
  Source splats;  // of an asset that is not an .rgs
  if (rgs_asset) {
    report.asset_format = "rgs";
    report.declarations = view.declarations();
    size.n_asset = view.header().n_gaussians;
    size.asset_sh_degree = view.header().sh_degree;
    measure_sections(asset->levels ? asset->levels->head() : view, size);
    if (asset->levels) measure_pages(*asset->levels, size);
    if (const auto& provenance = view.provenance()) {
      report.made_from_source =
          provenance->source_xxh3 == report.source_xxh3 && provenance->source_bytes == original->bytes().size();
      // What is made from an .rgs names that file's source.
      if (const auto& through = source->provenance(); through && provenance->source_xxh3 == through->source_xxh3 &&
                                                      provenance->source_bytes == through->source_bytes)
        report.made_from_source = true;
    }
    const auto began = Clock::now();
    const ArchiveParameters* archive = asset->levels ? asset->levels->head().archive() : view.archive();
    auto paired = pair_gaussians(*source, view, archive);
    if (!paired) return make_error(options.asset, paired.error());
    pairing = std::move(*paired);
    if (2 * pairing.n_paired < size.n_asset) {
      // The conversion may have been given other axes than the source states.
      auto other = Source::open(options.source, options.read, other_axes);
      if (!other) return make_error(options.source, other.error());
      auto again = pair_gaussians(*other, view, archive);
      if (!again) return make_error(options.asset, again.error());
      if (again->n_paired > pairing.n_paired) {
        pairing = std::move(*again);
        source = std::move(other);
      }
    }
    if (pairing.n_paired == 0 && size.n_asset != 0)
      return make_error(options.asset, {Errc::bad_value, Error::kNone,
                                        "none of its Gaussians is in the source: was it converted from another file?",
                                        size.n_asset, 0});
    report.pairs = pairing.report(source->size());
    report.attributes = compare_attributes(*source, view, pairing, progress);
    report.attributes->seconds = since(began);
  } else {
    auto opened = Source::open(options.asset, options.read, source->declarations().axes);
    if (!opened) return make_error(options.asset, opened.error());
    splats = *std::move(opened);
    report.asset_format = format_name(splats.format());
    report.declarations = splats.declarations();
    size.asset_bytes = splats.bytes();
    size.n_asset = splats.size();
    size.asset_sh_degree = splats.sh_degree();
    auto paired = pair_gaussians(*source, splats);
    if (!paired) return make_error(options.asset, paired.error());
    report.pairs = paired->report(source->size());
  }
  report.source_rounding = source->position_rounding();
  report.declared_differences = compare_declarations(*source, *report.declarations, rgs_asset);
  if (options.render) {
    // A file draws what it draws: beside itself its levels lose nothing.
    const bool is_same = report.source_xxh3 == report.asset_xxh3 && size.source_bytes == size.asset_bytes;
    const RenderInputs inputs{&*source,
                              rgs_asset ? &view : nullptr,
                              rgs_asset ? nullptr : &splats,
                              &pairing,
                              asset->levels && !is_same ? &*asset->levels : nullptr,
                              report.declarations,
                              report.source_stated};
    auto rendered = compare_pictures(inputs, options, *also, progress);
    if (!rendered) return tl::unexpected(rendered.error());
    report.render = std::move(*rendered);
    if (options.distances && size.levels) {
      auto distances = compare_distances(inputs, options, report.render->cameras, progress);
      if (!distances) return tl::unexpected(distances.error());
      report.distances = std::move(*distances);
    }
  }
  report.also = std::move(*also);
  report.seconds = since(start);
  return report;
}

}  // namespace rgs::audit
