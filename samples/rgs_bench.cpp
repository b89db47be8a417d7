// rgs_bench.cpp - rgs-bench: what each step of the method is worth on this GPU, in time and in quality.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <cstdio>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "bench_run.hpp"
#include "console.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/file.hpp"
#include "rgs/image_metrics.hpp"
#include "scene_file.hpp"

namespace {

namespace tool = rgs::tool;
using rgs::bench::Configuration;

struct Options {
  std::string scene, source, cameras, quality_cameras;
  std::vector<std::string> sizes{"1920x1080", "3840x2160"}, modes{"baseline", "paper"};
  std::string exp = "paper", key;
  int frames = 100;
  bool ablate = false;
};

// The paper's steps, one after the other.
std::vector<Configuration> ablation(const rgs::RenderOptions& paper) {
  std::vector<Configuration> rows{{"baseline", rgs::baseline_options(), false}};
  const auto step = [&rows](const char* name, const auto& change) {
    Configuration next = rows.back();
    next.name = name;
    change(next);
    rows.push_back(std::move(next));
  };
  step("+ attributes", [](Configuration& c) { c.compact = true; });
  step("+ fused front end", [](Configuration& c) { c.options.cuda.front_end = rgs::CudaOptions::FrontEnd::fused; });
  step("+ culling", [](Configuration& c) { c.options.extent = rgs::math::Extent::ellipse; });
  step("+ 32-bit key", [&paper](Configuration& c) {
    c.options.depth_order = paper.depth_order;
    c.options.depth_mapping = paper.depth_mapping;
    c.options.depth_range = paper.depth_range;
  });
  step("+ folding, dual pixel", [](Configuration& c) {
    c.options.exponent = rgs::math::Exponent::folded;
    c.options.cuda.pixels_per_thread = 2;
  });
  step("+ fast exp = paper", [&paper](Configuration& c) { c.options.exp = paper.exp; });
  return rows;
}

rgs::RenderOptions paper_options(const Options& o, const std::optional<rgs::Declarations>& declared) {
  rgs::RenderOptions paper = rgs::paper_options(declared);
  if (o.exp == "zero-mean") paper.exp = rgs::math::Exp::zero_mean;
  if (o.exp == "exact") paper.exp = rgs::math::Exp::exact;
  if (!o.key.empty()) paper.depth_mapping = o.key == "log" ? rgs::DepthMapping::logarithmic : rgs::DepthMapping::linear;
  return paper;
}

// Mean and worst PSNR, largest error.
struct Quality {
  double mean_psnr = 0, worst_psnr = std::numeric_limits<double>::infinity();
  float largest = 0;
};

rgs::Result<Quality> compare(const std::vector<rgs::Image>& reference, const std::vector<rgs::Image>& pictures) {
  Quality q;
  for (std::size_t i = 0; i < reference.size(); ++i) {
    const auto d = rgs::difference(reference[i], pictures[i]);
    if (!d) return tl::unexpected(d.error());
    q.mean_psnr += d->psnr / static_cast<double>(reference.size());
    q.worst_psnr = std::min(q.worst_psnr, d->psnr);
    q.largest = std::max(q.largest, d->largest);
  }
  return q;
}

int bench(const Options& o) {
  const auto file = rgs::MappedFile::open(o.scene);
  if (!file) return tool::report(o.scene, file.error());
  const auto view = rgs::open(file->bytes());
  if (!view) return tool::report(o.scene, view.error());
  rgs::bench::DeviceScenes scenes;
  auto compact = rgs::DeviceScene::upload(*view);
  if (!compact) return tool::report(o.scene, compact.error());
  scenes.compact = *compact;
  const std::string source = o.source.empty() ? o.scene : o.source;
  {
    const auto loaded = rgs::load_scene_file(source);
    if (!loaded) return tool::report(source, loaded.error());
    auto fp32 = rgs::DeviceScene::upload(loaded->scene.view());
    if (!fp32) return tool::report(source, fp32.error());
    scenes.fp32 = *fp32;
  }
  const auto cameras = rgs::read_cameras(o.cameras);
  if (!cameras) return tool::report(o.cameras, cameras.error());
  std::vector<rgs::Camera> quality_cameras;
  if (!o.quality_cameras.empty()) {
    const auto set = rgs::read_camera_set(o.quality_cameras);
    if (!set) return tool::report(o.quality_cameras, set.error());
    for (std::size_t i = 0; i < set->cameras.size(); ++i)
      if (set->split[i] == rgs::Split::test) quality_cameras.push_back(set->cameras[i]);
  }

  const rgs::RenderOptions paper = paper_options(o, scenes.compact.declarations());
  std::vector<Configuration> rows = ablation(paper);
  if (!o.ablate) rows.erase(rows.begin() + 1, rows.end() - 1);

  std::vector<Quality> quality;
  if (!quality_cameras.empty()) {
    std::vector<rgs::Image> reference;
    for (const Configuration& row : rows) {
      auto pictures = rgs::bench::pictures(row, scenes, quality_cameras);
      if (!pictures) return tool::report("", pictures.error());
      if (reference.empty()) reference = *pictures;
      const auto q = compare(reference, *pictures);
      if (!q) return tool::report("", q.error());
      quality.push_back(*q);
    }
  }
  for (const std::string& text : o.sizes) {
    const auto size = tool::parse_size(text);
    if (!size) return tool::report_usage("--size takes WxH, not '" + text + "'");
    std::vector<rgs::Camera> sized;
    for (const rgs::Camera& c : *cameras) sized.push_back(rgs::resized(c, size->width, size->height));
    fmt::print("{}  {} cameras, {} frames each\n", text, sized.size(), o.frames);
    fmt::print("{:<22} {:>8} {:>8} {:>8} {:>8} {:>8} {:>7} {:>8} {:>9} {:>9} {:>9} {:>8} {:>7} {:>7}\n", "", "project",
               "bin", "sort", "blend", "total", "ratio", "visible", "pairs", "eval", "blended", "peak", "PSNR", "max");
    double baseline = 0;
    for (std::size_t r = 0; r < rows.size(); ++r) {
      const auto t = rgs::bench::measure(rows[r], scenes, sized, o.frames);
      if (!t) return tool::report("", t.error());
      const rgs::FrameStats& s = t->mean;
      if (r == 0) baseline = s.total_ms;
      fmt::print("{:<22} {:8.4f} {:8.4f} {:8.4f} {:8.4f} {:8.4f} {:6.2f}x {:8} {:9} {:8.1f}M {:8.1f}M {:>8}",
                 rows[r].name, s.project_ms, s.bin_ms, s.sort_ms, s.blend_ms, s.total_ms, baseline / s.total_ms,
                 s.visible, s.instances, static_cast<double>(s.evaluated) * 1e-6, static_cast<double>(s.blended) * 1e-6,
                 tool::format_bytes(t->peak_bytes));
      if (!quality.empty()) fmt::print(" {:7.2f} {:7.4f}", quality[r].mean_psnr, quality[r].largest);
      fmt::print("\n");
      std::fflush(stdout);
    }
  }
  return tool::kSuccess;
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&]() -> int {
    Options o;
    CLI::App app{"Measures the CUDA renderer: time, work and quality of each step of the method.", "rgs-bench"};
    app.add_option("scene", o.scene, ".rgs file")->required();
    app.add_option("--source", o.source, "PLY that the file was made of, for the baseline [the file itself]");
    app.add_option("--cameras,-c", o.cameras, "cameras to time (docs/CAMERAS.md)")->required();
    app.add_option("--quality-cameras", o.quality_cameras, "cameras whose test split is compared with the baseline");
    app.add_option("--size", o.sizes, "WxH,...")->delimiter(',')->capture_default_str();
    app.add_option("--frames", o.frames, "measured per camera")->check(CLI::Range(1, 100000))->capture_default_str();
    app.add_option("--exp", o.exp, "of paper mode")->check(CLI::IsMember({"paper", "zero-mean", "exact"}));
    app.add_option("--key", o.key, "depth mapping of paper mode [the file's]")->check(CLI::IsMember({"linear", "log"}));
    app.add_flag("--ablate", o.ablate, "all steps between baseline and paper");
    try {
      app.parse(argc, argv);
    } catch (const CLI::ParseError& error) {
      return app.exit(error) == 0 ? tool::kSuccess : tool::kUsage;
    }
    return bench(o);
  });
}
