// bench_report_test.cpp - the output of rgs-bench: JSON, CSV, tables and the roofline picture.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <limits>
#include <nlohmann/json.hpp>
#include <sstream>
#include <string>
#include <vector>

#include "bench_plot.hpp"
#include "bench_report.hpp"
#include "bench_sample_report.hpp"
#include "checkout.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"

namespace {

using namespace rgs::bench;
using rgs::test::sample_report;
using rgs::test::stress_report;

std::vector<std::string> lines_of(const std::string& text) {
  std::vector<std::string> lines;
  std::istringstream in(text);
  for (std::string line; std::getline(in, line);) lines.push_back(line);
  return lines;
}

// Fields of a CSV line whose quoted fields hold no line break.
std::vector<std::string> fields_of(const std::string& line) {
  std::vector<std::string> fields(1);
  bool quoted = false;
  for (std::size_t i = 0; i < line.size(); ++i) {
    if (line[i] == '"' && quoted && i + 1 < line.size() && line[i + 1] == '"') {
      fields.back() += line[i++];
    } else if (line[i] == '"') {
      quoted = !quoted;
    } else if (line[i] == ',' && !quoted) {
      fields.emplace_back();
    } else {
      fields.back() += line[i];
    }
  }
  return fields;
}

// A real XML parser prints the elements' names and numbers.
rgs::test::ProgramResult parse_xml(const std::string& text) {
  const rgs::test::TemporaryFolder folder;
  std::ofstream(folder.file("picture.svg"), std::ios::binary) << text;
  return rgs::test::run_program({RGS_PYTHON, "-c",
                                 "import sys, xml.etree.ElementTree as e\n"
                                 "for n in e.parse(sys.argv[1]).iter():\n"
                                 "  print(n.tag.split('}')[1], (n.text or '').strip())\n",
                                 folder.file("picture.svg")});
}

std::size_t count(const std::string& text, const std::string& what) {
  std::size_t n = 0;
  for (std::size_t at = text.find(what); at != std::string::npos; at = text.find(what, at + 1)) ++n;
  return n;
}

}  // namespace

TEST_CASE("the JSON report holds every mode and size") {
  const Report report = sample_report();
  const auto json = nlohmann::json::parse(report_json(report));
  CHECK(json["schema"] == "rgs-bench/2");
  CHECK(json["device"]["name"] == "NVIDIA H100 80GB HBM3");
  CHECK(json["rates"]["copy_bytes"] == 2.9e12);
  REQUIRE(json["modes"].size() == 3);
  CHECK(json["modes"][0]["options"]["attributes"] == "fp32");
  CHECK(json["modes"][1]["step"] == true);
  CHECK(json["modes"][2]["options"]["exp"] == "paper");
  CHECK(json["modes"][2]["options"]["pixel_format"] == "rgb32f");
  CHECK_FALSE(json["modes"][2]["options"].contains("graph"));
  CHECK(json["modes"][2]["options"]["depth_order"] == "quantized");
  CHECK(json["modes"][2]["quality"]["photo_loss"] == doctest::Approx(0.014));
  REQUIRE(json["sizes"].size() == 1);
  REQUIRE(json["sizes"][0]["results"].size() == 3);
  const auto& paper = json["sizes"][0]["results"][2];
  CHECK(paper["mode"] == "+ fast exp = paper");
  CHECK(paper["speedup"] == doctest::Approx(5.9144 / 0.8684));
  const auto& blend = paper["stages"]["blend"];
  CHECK(blend["ms"] == doctest::Approx(0.5208));
  CHECK(blend["flops_per_second"].get<double>() == doctest::Approx(blend["flops"].get<double>() / 0.5208e-3));
  CHECK(blend["time_over_floor"].get<double>() == doctest::Approx(0.5208 / blend["floor_ms"].get<double>()));
}

TEST_CASE("the JSON report states which modes draw equal depths in the order of the scene") {
  Report report = sample_report();
  for (ModeReport& mode : report.modes) mode.configuration.options.paper.deterministic = false;
  report.modes.push_back({make_mode("turbo", {}), {}});
  report.modes.push_back({make_mode("paper", {}), {}});
  const auto modes = nlohmann::json::parse(report_json(report))["modes"];
  CHECK(modes[0]["options"]["deterministic"] == true);  // a front end without an alternative
  CHECK(modes[2]["options"]["deterministic"] == false);
  CHECK(modes[3]["options"]["deterministic"] == true);
  CHECK(modes[4]["options"]["deterministic"] == true);
}

TEST_CASE("the JSON report has null for equal pictures and omits what was not measured") {
  Report report = sample_report();
  report.modes[0].quality->psnr = std::numeric_limits<double>::infinity();
  report.modes[0].quality->photo_loss.reset();
  report.modes[1].quality.reset();
  report.rates.reset();
  const auto json = nlohmann::json::parse(report_json(report));
  CHECK(json["modes"][0]["quality"]["psnr"].is_null());
  CHECK_FALSE(json["modes"][0]["quality"].contains("photo_loss"));
  CHECK_FALSE(json["modes"][1].contains("quality"));
  CHECK_FALSE(json.contains("rates"));
  CHECK_FALSE(json["sizes"][0]["results"][0]["stages"]["sort"].contains("floor_ms"));
}

TEST_CASE("times from outside stand beside those of the stages, in the table, JSON and CSV") {
  const Report report = sample_report();
  const auto json = nlohmann::json::parse(report_json(report));
  const auto& paper = json["sizes"][0]["results"][2];
  CHECK(paper["total_ms"] == doctest::Approx(0.8684));
  CHECK(paper["eager_clock_ms"] == doctest::Approx(0.9084));
  CHECK(paper["eager_events_ms"] == doctest::Approx(0.8984));
  CHECK(paper["queued_ms"] == doctest::Approx(0.8784));
  CHECK(paper["host_us"] == doctest::Approx(27.3));
  CHECK(paper["frames"] == 100);
  const auto csv = lines_of(report_csv(report));
  const auto names = fields_of(csv[0]), values = fields_of(csv[3]);
  const auto at = [&](const char* name) {
    return values[static_cast<std::size_t>(std::find(names.begin(), names.end(), name) - names.begin())];
  };
  CHECK(at("eager_clock_ms") == "0.9084");
  CHECK(at("eager_events_ms") == "0.8984");
  CHECK(at("queued_ms") == "0.8784");
  CHECK(at("host_us") == "27.3");
  CHECK(at("view").empty());
  const auto table = lines_of(outside_text(report.sizes[0], report));
  REQUIRE(table.size() == 3 + 3);
  CHECK(table[1].find("1920x1080") == 0);
  CHECK(table[5].find("+ fast exp = paper") == 0);
  for (const char* number : {"0.8684", "0.9084", "0.8984", "0.8784", "27.3"})
    CHECK(table[5].find(number) != std::string::npos);
  for (std::size_t k = 2; k < table.size(); ++k) CHECK(table[k].size() == table[2].size());
}

TEST_CASE("stress views compare turbo with paper, and the slower one fails by name") {
  Report report = stress_report();
  CHECK(stress_row(report.sizes[0], report).ratio() == doctest::Approx(0.875 / 0.32));
  CHECK(stress_row(report.sizes[0], report).passes());
  CHECK_FALSE(stress_row(report.sizes[1], report).passes());
  CHECK(failed_views(report) == std::vector<std::string>{"back 300 units at 1920x1080 (9.4500 ms, paper 0.8750 ms)"});
  const auto json = nlohmann::json::parse(report_json(report));
  CHECK(json["stress"]["passed"] == false);
  CHECK(json["stress"]["scene_size"] == 12.5);
  CHECK(json["stress"]["densest"] == nlohmann::json{1.0, 2.0, 3.0});
  REQUIRE(json["stress"]["views"].size() == 2);
  const auto& far = json["stress"]["views"][1];
  CHECK(far["view"] == "back 300 units");
  CHECK(far["width"] == 1920);
  CHECK(far["height"] == 1080);
  CHECK(far["paper_ms"] == doctest::Approx(0.875));
  CHECK(far["turbo_ms"] == doctest::Approx(9.45));
  CHECK(far["ratio"] == doctest::Approx(0.875 / 9.45));
  CHECK(far["passed"] == false);
  CHECK(json["stress"]["views"][0]["passed"] == true);
  CHECK(json["sizes"][1]["view"] == "back 300 units");
  CHECK(json["sizes"][1]["results"][1]["stages"]["blend"]["ms"] == doctest::Approx(9.15));
  CHECK_FALSE(nlohmann::json::parse(report_json(sample_report())).contains("stress"));
  CHECK_FALSE(nlohmann::json::parse(report_json(sample_report()))["sizes"][0].contains("view"));
  const auto csv = lines_of(report_csv(report));
  REQUIRE(csv.size() == 5);
  CHECK(csv[4].find("\"back 300 units\",1920,1080,\"turbo\"") != std::string::npos);

  const auto head = lines_of(stress_head_text(report));
  const auto first = lines_of(stress_row_text(report.sizes[0], report))[0],
             second = lines_of(stress_row_text(report.sizes[1], report))[0];
  CHECK(first.size() == head.back().size());
  CHECK(first.find("2.73x") != std::string::npos);
  CHECK(second.find("slower") != std::string::npos);
  CHECK(second.find("9.4500") != std::string::npos);
  for (const auto& line : {head[1], head[2], first, second}) CHECK(line.size() <= 160);

  // Equal is not slower; an unmeasured gate fails.
  report.sizes[1].rows[1].timing.mean.total_ms = 0.875;
  CHECK(failed_views(report).empty());
  CHECK(nlohmann::json::parse(report_json(report))["stress"]["passed"] == true);
  report.sizes[1].rows[1].timing.mean.total_ms = 0;
  CHECK(failed_views(report).size() == 1);
  // The baseline before them changes nothing.
  Report more = stress_report();
  more.modes.insert(more.modes.begin(), {make_mode("baseline", {}), {}});
  for (SizeReport& size : more.sizes) size.rows.insert(size.rows.begin(), size.rows[1]);
  CHECK(failed_views(more) == failed_views(stress_report()));
}

TEST_CASE("rows whose depth key is too coarse are named, others are not") {
  const Report report = stress_report();
  CHECK(coarse_depth_text(report.sizes[0], 0, report).empty());
  CHECK(coarse_depth_text(report.sizes[1], 1, report).empty());
  const std::string text = coarse_depth_text(report.sizes[1], 0, report);
  for (const char* part : {"back 300 units at 1920x1080, paper", "19 bits", "0.0025", "0.0001", "Depth resolution"}) {
    CHECK_MESSAGE(text.find(part) != std::string::npos, text);
  }
  CHECK(text.back() == '\n');
  Report limit = report;
  limit.sizes[1].rows[0].timing.mean.depth_resolution = rgs::kCoarseDepthResolution;
  CHECK_FALSE(coarse_depth_text(limit.sizes[1], 0, limit).empty());
  CHECK(nlohmann::json::parse(report_json(report))["sizes"][1]["results"][0]["depth_resolution"] == 2.5e-3);
}

TEST_CASE("compared modes: always the baseline, or paper and turbo in stress views") {
  using Names = std::vector<std::string>;
  const auto compared = [](const Names& asked, bool is_stress) { return compared_modes(asked, is_stress); };
  CHECK(compared({"baseline", "paper", "turbo"}, false) == Names{"baseline", "paper", "turbo"});
  CHECK(compared({"turbo"}, false) == Names{"baseline", "turbo"});
  CHECK(compared({}, true) == Names{"paper", "turbo"});
  CHECK(compared({"turbo"}, true) == Names{"paper", "turbo"});
  CHECK(compared({"turbo-fp32", "baseline"}, true) == Names{"baseline", "paper", "turbo", "turbo-fp32"});
}

TEST_CASE("above detail 0 levels have no baseline: paper replaces it, drawn like levels") {
  using Names = std::vector<std::string>;
  const auto compared = [](const Names& asked, bool is_stress) { return compared_modes(asked, is_stress, false); };
  CHECK(compared({"baseline", "paper", "turbo"}, false) == Names{"paper", "turbo"});
  CHECK(compared({"turbo"}, false) == Names{"paper", "turbo"});
  CHECK(compared({}, true) == Names{"paper", "turbo"});
  CHECK(compared({"turbo-fp32", "baseline"}, true) == Names{"paper", "turbo", "turbo-fp32"});

  rgs::Declarations declared;  // classic, 0.3
  for (const char* name : {"paper", "turbo", "turbo-fp32"}) {
    const rgs::RenderOptions levels = make_mode(name, {declared, {}, {}, 2.0F}).options;
    CHECK(levels.detail_px == 2);
    CHECK(levels.anti_aliasing == rgs::math::AntiAliasing::mip_splatting);
    CHECK(levels.low_pass == 0.1F);
    const rgs::RenderOptions leaves = make_mode(name, {declared, {}, {}, 0.0F}).options;
    CHECK(leaves.detail_px == 0);
    CHECK(leaves.anti_aliasing == rgs::math::AntiAliasing::classic);
    CHECK_FALSE(make_mode(name, {declared, {}, {}}).options.detail_px);
  }
  CHECK(make_mode("baseline", {declared, {}, {}, 2.0F}).options.detail_px == 0);
  for (const Configuration& step : ablation({declared, {}, {}, 0.0F})) CHECK(step.options.detail_px == 0);
}

TEST_CASE("a scene with levels states pages and Gaussians of each camera, in the table, JSON and CSV") {
  Report report = sample_report();
  CHECK(drawn_text(report.sizes[0], report).empty());
  CHECK_FALSE(nlohmann::json::parse(report_json(report))["scene"].contains("levels"));
  CHECK_FALSE(nlohmann::json::parse(report_json(report)).contains("detail_px"));
  report.levels = LevelsDrawn{6, 406, 1038164, 1.5F};
  Timing& timing = report.sizes[0].rows[2].timing;
  timing.mean.pages = 200, timing.mean.gaussians = 500000;
  timing.drawn = {{"near.jpg", 277, 778812}, {"far.jpg", 123, 221188}};

  const auto json = nlohmann::json::parse(report_json(report));
  CHECK(json["detail_px"] == 1.5);
  CHECK(json["scene"]["gaussians"] == 778812);
  CHECK(json["scene"]["levels"] == nlohmann::json{{"levels", 6}, {"pages", 406}, {"gaussians", 1038164}});
  const auto& row = json["sizes"][0]["results"][2];
  CHECK(row["gaussians"] == 500000);
  CHECK(row["pages"] == 200);
  REQUIRE(row["drawn"].size() == 2);
  CHECK(row["drawn"][1] == nlohmann::json{{"camera", "far.jpg"}, {"pages", 123}, {"gaussians", 221188}});
  CHECK_FALSE(json["sizes"][0]["results"][0].contains("drawn"));
  CHECK(json["sizes"][0]["results"][0]["gaussians"] == 778812);

  const auto csv = lines_of(report_csv(report));
  const auto names = fields_of(csv[0]);
  const auto at = static_cast<std::size_t>(std::find(names.begin(), names.end(), "pages") - names.begin());
  REQUIRE(at < names.size());
  CHECK(fields_of(csv[1])[at].empty());
  CHECK(fields_of(csv[3])[at] == "200");

  CHECK(header_text(report).find("6 levels, 1,038,164 Gaussians in 406 pages, drawn at detail 1.5") !=
        std::string::npos);
  const auto table = lines_of(drawn_text(report.sizes[0], report));
  REQUIRE(table.size() == 5);
  CHECK(table[3].find("near.jpg") == 0);
  CHECK(table[3].find("100.0 %") != std::string::npos);
  CHECK(table[4].find("221,188") != std::string::npos);
  CHECK(table[4].find("28.4 %") != std::string::npos);
}

TEST_CASE("FP32 attributes are uploaded for the modes that draw them") {
  const auto reads = [](std::vector<std::string> asked, bool is_stress) {
    std::vector<Configuration> rows;
    for (const std::string& mode : compared_modes(asked, is_stress)) rows.push_back(make_mode(mode, {}));
    return reads_fp32(rows);
  };
  CHECK(reads({"turbo"}, false));  // beside the baseline
  CHECK_FALSE(reads({}, true));
  CHECK_FALSE(reads({"turbo-fp32"}, true));
  CHECK(reads({"baseline"}, true));
  CHECK(reads_fp32(ablation({})));
}

TEST_CASE("the orbit is in the JSON report and in its own table") {
  Report report = sample_report();
  CHECK_FALSE(nlohmann::json::parse(report_json(report)).contains("orbit"));
  const Change step{0.01, 0.25, 0.5, 0.75F}, second{0.005, 0.125, 0.25, 0.5F}, twice{0.01, 0.25, 0.5, 1};
  report.orbit = OrbitReport{"a.jpg", 1920, 1080, 60, 0.25, 4.5, {}};
  report.orbit->rows = {{"baseline", step, second, {}}, {"turbo", step, twice, second}};
  const auto json = nlohmann::json::parse(report_json(report))["orbit"];
  CHECK(json["frames"] == 60);
  CHECK(json["distance"] == 4.5);
  REQUIRE(json["results"].size() == 2);
  CHECK(json["results"][0]["unsteadiness"] == 1.0);
  CHECK(json["results"][1]["unsteadiness"] == 2.0);
  CHECK(json["results"][1]["second"]["worst_p999"] == 0.5);
  CHECK(json["results"][1]["added"]["p999"] == 0.125);
  CHECK(json["results"][0]["step"]["largest"] == 0.75);
  const auto lines = lines_of(orbit_text(*report.orbit));
  REQUIRE(lines.size() == 6);
  CHECK(lines[1].find("60 frames") == 0);
  for (std::size_t i = 2; i < lines.size(); ++i) CHECK(lines[i].size() <= 160);
  CHECK(lines[4].size() == lines[5].size());
  CHECK(lines[5].find("2.000x") != std::string::npos);
  // A steady baseline has no ratio.
  report.orbit->rows.front() = {"baseline", {}, {}, {}};
  CHECK(nlohmann::json::parse(report_json(report))["orbit"]["results"][1]["unsteadiness"].is_null());
}

TEST_CASE("every line of the CSV report has the fields that its first line names") {
  Report report = sample_report();
  report.modes[1].quality.reset();
  const auto lines = lines_of(report_csv(report));
  REQUIRE(lines.size() == 4);
  const auto names = fields_of(lines[0]);
  const auto column = [&](const char* name) {
    const auto at = std::find(names.begin(), names.end(), name);
    REQUIRE_MESSAGE(at != names.end(), name);
    return static_cast<std::size_t>(at - names.begin());
  };
  for (const std::string& line : lines) CHECK(fields_of(line).size() == names.size());
  CHECK(fields_of(lines[1])[column("scene")] == "south & \"north\" <1>.rgs");
  CHECK(fields_of(lines[1])[column("instances")] == "14888772");
  CHECK(fields_of(lines[3])[column("sort_ms")] == "0.1966");
  CHECK(fields_of(lines[3])[column("psnr")] == "51.1");
  CHECK(fields_of(lines[2])[column("psnr")].empty());
  CHECK_FALSE(fields_of(lines[3])[column("blend_floor_ms")].empty());
  report.rates.reset();
  CHECK(fields_of(lines_of(report_csv(report))[3])[column("blend_floor_ms")].empty());
}

TEST_CASE("tables have a line for each row and fit a terminal of 160 columns") {
  const Report report = sample_report();
  const std::string head = size_text(report.sizes[0], report);
  for (const std::string& line : lines_of(head + header_text(report))) CHECK(line.size() <= 160);
  const std::size_t width = lines_of(head).back().size();
  for (std::size_t row = 0; row < 3; ++row) {
    const std::string line = row_text(report.sizes[0], row, report);
    CHECK(line.size() == width + 1);
    CHECK(line.find(report.modes[row].configuration.name) == 0);
  }
  CHECK(row_text(report.sizes[0], 2, report).find("6.81x") != std::string::npos);
  const auto roofline = lines_of(roofline_text(report.sizes[0], report));
  CHECK(roofline.size() == 3 + 3 * 5);
  for (const std::string& line : roofline) CHECK(line.size() <= 160);
}

TEST_CASE("speed-up is the baseline's time over the row's") {
  Report report = sample_report();
  CHECK(speedup(report.sizes[0], 0) == 1);
  report.sizes[0].rows[2].timing.mean.total_ms = 0;
  CHECK(speedup(report.sizes[0], 2) == 0);
}

TEST_CASE("the roofline is well-formed XML with a point for each computing stage") {
  const Report report = sample_report();
  const std::string svg = roofline_svg(report);
  if (const char* keep = std::getenv("RGS_KEEP_SVG")) std::ofstream(keep) << svg;
  const auto parsed = parse_xml(svg);
  CHECK_MESSAGE(parsed.exit_code == 0, parsed.err);
  CHECK(parsed.out.find("south & \"north\" <1>.rgs") != std::string::npos);
  // Two modes (the step between them is not drawn): project and blend each, and a circle in the legend.
  CHECK(count(parsed.out, "circle") == 2 * 2 + 2);
  CHECK(count(parsed.out, "text project") == 2 + 1);  // and once beside the bars
  CHECK(count(parsed.out, "text sort") == 1);
  CHECK(parsed.out.find("memory 2900 GB/s") != std::string::npos);
  CHECK(svg.find("nan") == std::string::npos);
  CHECK(svg.find("inf") == std::string::npos);
}

TEST_CASE("a roofline of frames without work has no points and is still a picture") {
  Report report = sample_report();
  for (Measurement& m : report.sizes[0].rows) m = {};
  const std::string svg = roofline_svg(report);
  CHECK(parse_xml(svg).exit_code == 0);
  CHECK(svg.find("nan") == std::string::npos);
  CHECK(svg.find("inf") == std::string::npos);
}

TEST_CASE("the tables of the documents are made from JSON reports") {
  const rgs::test::TemporaryFolder folder;
  Report full = sample_report(), pruned = sample_report();
  pruned.gaussians = 311525;
  pruned.scene = "pruned.rgs";
  for (std::size_t row = 0; row < 3; ++row) pruned.sizes[0].rows[row].timing.mean.total_ms /= 2;
  pruned.sizes[0].rows[2].timing.mean.total_ms *= 1.25;  // pruning helps the fast mode less
  std::ofstream(folder.file("full.json")) << report_json(full);
  std::ofstream(folder.file("pruned.json")) << report_json(pruned);
  std::ofstream(folder.file("audit.json")) << R"({"rendered":{"psnr":28.09,"worst_psnr":25.74,)"
                                              R"("photos":{"asset_psnr":20.98,"loss":1.046}}})";
  const auto tables = [&](const std::vector<std::string>& more) {
    std::vector<std::string> arguments{RGS_PYTHON, rgs::test::source_dir() + "/scripts/bench_tables.py",
                                       folder.file("full.json")};
    arguments.insert(arguments.end(), more.begin(), more.end());
    const auto result = rgs::test::run_program(arguments);
    CHECK_MESSAGE(result.exit_code == 0, result.err);
    return result.out;
  };
  CHECK(tables({}).find("| baseline | 0.087 | 1.026 |") != std::string::npos);
  const std::string both =
      tables({folder.file("pruned.json"), "--orthogonality", "--audit", folder.file("audit.json")});
  CHECK(both.find("| baseline | 169 | 1.0x |  | 22.00 |") != std::string::npos);
  CHECK(both.find("| + fast exp = paper | 1,152 | 6.8x | 51.10 | 22.00 |") != std::string::npos);
  CHECK(both.find("| pruned baseline | 338 | 2.0x | 28.09 | 22.00 |") != std::string::npos);
  CHECK(both.find("| pruned + fast exp = paper | 1,842 | 10.9x |") != std::string::npos);
  CHECK(both.find("80 % at 1920x1080 of the product") != std::string::npos);
  CHECK(both.find("28.09 dB, worst view 25.74, 1.05 dB lost") != std::string::npos);
  // The mode is the pruned file's last: the whole scene may have been measured in more.
  Report more = full;
  more.modes.push_back(more.modes[1]);
  more.modes.back().configuration.name = "another";
  more.sizes[0].rows.push_back(more.sizes[0].rows[1]);
  std::ofstream(folder.file("full.json")) << report_json(more);
  CHECK(tables({folder.file("pruned.json"), "--orthogonality", "--audit", folder.file("audit.json")}) == both);
  std::ofstream(folder.file("full.json")) << report_json(full);
  const std::string growth = tables({folder.file("pruned.json"), "--scaling"});
  const std::size_t small = growth.find("| 0.312 M | 1920x1080 | 2.957 |"), large = growth.find("| 0.779 M |");
  CHECK(small < large);
  CHECK(large != std::string::npos);
}

TEST_CASE("modes have the options that their names state") {
  const ModeInput input{{}, rgs::math::Exp::zero_mean, rgs::DepthMapping::logarithmic};
  CHECK(mode_names().front() == "baseline");
  for (const std::string& name : mode_names()) CHECK(make_mode(name, input).name == name);
  const Configuration baseline = make_mode("baseline", input), paper = make_mode("paper", input);
  CHECK_FALSE(baseline.compact);
  CHECK(baseline.options.pipeline == rgs::Pipeline::baseline);
  CHECK(paper.compact);
  CHECK(paper.options.paper.exp == rgs::math::Exp::zero_mean);
  CHECK(paper.options.paper.depth_mapping == rgs::DepthMapping::logarithmic);
}

TEST_CASE("the ablation goes from baseline to paper in steps") {
  const auto rows = ablation({});
  REQUIRE(rows.size() == 7);
  CHECK(rows.front().name == "baseline");
  CHECK_FALSE(rows.front().step);
  CHECK_FALSE(rows.back().step);
  for (std::size_t i = 1; i + 1 < rows.size(); ++i) CHECK(rows[i].step);
  // The last step ends at paper mode.
  Report report;
  report.modes = {{rows.back(), {}}, {make_mode("paper", {}), {}}, {rows[5], {}}};
  const auto json = nlohmann::json::parse(report_json(report));
  CHECK(json["modes"][0]["options"] == json["modes"][1]["options"]);
  auto before = json["modes"][2]["options"];
  CHECK(before["exp"] == "exact");
  before["exp"] = "paper";
  CHECK(before == json["modes"][1]["options"]);
}

TEST_CASE("the JSON report distinguishes turbo's two blends") {
  Report report;
  report.modes = {{make_mode("paper", {}), {}}, {make_mode("turbo", {}), {}}, {make_mode("turbo-fp32", {}), {}}};
  const auto modes = nlohmann::json::parse(report_json(report))["modes"];
  CHECK(modes[0]["options"]["tensor_cores"] == false);
  CHECK(modes[1]["options"]["tensor_cores"] == true);
  CHECK(modes[2]["options"]["tensor_cores"] == false);
}
