// audit_batch_test.cpp - sources of every format, nested folders, gates without pictures, and JUnit XML.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <filesystem>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <string>
#include <vector>

#include "audit_gate.hpp"
#include "audit_json.hpp"
#include "audit_junit.hpp"
#include "audit_program_fixture.hpp"
#include "data_folder.hpp"
#include "rgs/interchange.hpp"
#include "run_program.hpp"
#include "skip.hpp"

namespace fs = std::filesystem;
using nlohmann::json;
using namespace rgs;
using namespace rgs::test;

namespace {

void convert(const std::vector<std::string>& arguments) {
  std::vector<std::string> command{built("rgs-convert"), "-q", "--no-sync", "--overwrite"};
  command.insert(command.end(), arguments.begin(), arguments.end());
  const ProgramResult run = run_program(command);
  INFO(run.err);
  REQUIRE(run.exit_code == 0);
}

json audited(std::vector<std::string> arguments) {
  arguments.insert(arguments.end(), {"--json", "-", "--quiet", "--size", "64x48", "--views", "2"});
  const ProgramResult run = run_audit(arguments);
  CAPTURE(arguments);
  INFO(run.err);
  REQUIRE((run.exit_code == 0 || run.exit_code == 5));
  return json::parse(run.out);
}

// Whether Python's XML parser accepts it, and its content.
json parse_xml(const TemporaryFolder& folder, const std::string& path) {
  const std::string script = folder.file("parse.py");
  write_text(script, R"(import json, sys
import xml.etree.ElementTree as tree
root = tree.parse(sys.argv[1]).getroot()
print(json.dumps({'attributes': root.attrib, 'suites': [{'name': s.attrib['name'], 'attributes': s.attrib, 'cases': [
    {'name': c.attrib['name'], 'classname': c.attrib['classname'],
     'failures': [f.attrib['message'] for f in c.findall('failure')],
     'errors': [e.attrib['message'] for e in c.findall('error')]} for c in s]} for s in root]}))
)");
  const ProgramResult run = run_program({"/usr/bin/python3", script, path});
  INFO(run.err);
  REQUIRE(run.exit_code == 0);
  return json::parse(run.out);
}

// ply/ and rgs/ with pairs of small scenes.
struct Pairs : TemporaryFolder {
  std::string sources = file("ply"), assets = file("rgs"), out = file("out");

  explicit Pairs(const std::vector<std::string>& names = {"one", "sub/two"}) {
    fs::create_directory(assets);
    for (const std::string& name : names) {
      fs::create_directories(fs::path(sources + "/" + name).parent_path());
      write_ply(sources + "/" + name + ".ply", audit_cloud(200, 1, name.size()));
    }
    convert({sources, assets, "--to", "rgs"});
  }
  std::vector<std::string> command(std::vector<std::string> more = {}) const {
    std::vector<std::string> arguments{sources,  assets,  "--report",        out, "--views", "2",
                                       "--size", "64x48", "--no-attribution"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return arguments;
  }
  json index() const { return json::parse(read_text(out + "/index.json")); }
};

// Removes when and how pictures were measured.
json measurements(const std::string& path) {
  json j = json::parse(read_text(path));
  j.erase("gate");
  j["verdict"].erase("headline");
  return j;
}

}  // namespace

TEST_CASE("an asset is audited against a source of any format as against the same Gaussians in a PLY") {
  const SceneFolder scene;
  for (const char* name : {"source.spz", "source.glb", "source.splat", "source.compressed.ply", "source.rgs"}) {
    CAPTURE(name);
    const std::string source = scene.file(name), ply = scene.file("same.ply"), asset = scene.file("asset.rgs");
    convert({scene.ply, source});
    convert({source, ply});
    convert({source, asset});
    const json from_other = audited({source, asset}), from_ply = audited({ply, asset});
    CHECK(from_other["source"]["format"] == std::string(name).substr(7));
    CHECK(from_ply["source"]["format"] == "ply");
    CHECK(from_other["source"]["bytes"] == fs::file_size(source));
    CHECK(from_other["source"]["gaussians"] == 700);
    CHECK(from_other["gaussians"]["paired"] == 700);
    CHECK(from_other["gaussians"]["dropped"] == 0);
    if (from_other["source"]["format"] == "rgs") {
      CHECK(from_other["rendered"]["mse"] == 0);  // a PLY holds logarithms of its values, which round
    } else {
      CHECK(from_other["attributes"]["errors"] == from_ply["attributes"]["errors"]);
      CHECK(from_other["rendered"]["mse"] == from_ply["rendered"]["mse"]);
      CHECK(from_other["rendered"]["attribution"] == from_ply["rendered"]["attribution"]);
    }
    CHECK(from_other["asset"]["made_from_source"] == true);
    // The same for assets that are no .rgs.
    CHECK(audited({source, source})["verdict"]["grade"] == "identical");
  }
  // Positions of an asset made from an .rgs refer to that file.
  const std::string archive = scene.file("archive.rgs");
  convert({scene.ply, scene.file("kept.rgs"), "--keep-permutation"});
  convert({scene.file("kept.rgs"), archive, "--keep-permutation", "--profile", "archive:small"});
  CHECK(audited({scene.file("kept.rgs"), archive})["rendered"]["psnr"].get<double>() > 20);
  CHECK(audited({scene.file("kept.rgs"), archive})["gaussians"]["paired_by"] == "nearest");
}

TEST_CASE("a source in other axes, far away or unzipped is audited") {
  const SceneFolder scene;
  // --to-axes turns the asset.
  const std::string spz = scene.file("scene.spz"), turned = scene.file("turned.rgs");
  convert({scene.ply, spz});
  convert({spz, turned, "--to-axes", "opengl"});
  CHECK(audited({spz, turned})["gaussians"]["paired"] == 700);
  convert({scene.ply, turned, "--to-axes", "opengl"});
  CHECK(audited({scene.ply, turned})["gaussians"]["paired"] == 700);
  // --axes overrides the axes that the source states, and turns nothing.
  convert({scene.ply, turned, "--axes", "opengl"});
  CHECK(audited({scene.ply, turned})["gaussians"]["paired"] == 700);
  convert({spz, turned, "--axes", "gltf"});
  CHECK(audited({spz, turned})["gaussians"]["paired"] == 700);
  // An SPZ in the other axes that such files have, which each program is told.
  convert({scene.ply, scene.file("gl.spz"), "--spz-axes", "opengl"});
  convert({scene.file("gl.spz"), turned, "--spz-axes", "opengl", "--to-axes", "gltf"});
  CHECK(audited({scene.file("gl.spz"), turned, "--spz-axes", "opengl"})["gaussians"]["paired"] == 700);
  const Origin place{4.2e6, 1.7e5, 4.8e6};
  const std::string far = write_ply(scene.file("far.ply"), scene.cloud, place), glb = scene.file("far.glb");
  convert({far, glb});
  convert({glb, scene.file("far.rgs")});
  const json j = audited({glb, scene.file("far.rgs")});
  CHECK(j["gaussians"]["paired"] == 700);
  CHECK(j["rendered"]["psnr"].get<double>() > 40);
  const fs::path sog = data_folder() / "formats" / "crop.sog";
  if (!fs::exists(sog)) return;
  REQUIRE(run_shell("python3 -m zipfile -e '" + sog.string() + "' '" + scene.file("sog") + "'").exit_code == 0);
  convert({scene.file("sog/meta.json"), scene.file("sog.rgs")});
  const json unzipped = audited({scene.file("sog/meta.json"), scene.file("sog.rgs"), "--no-render"});
  CHECK(unzipped["source"]["format"] == "sog");
  CHECK(unzipped["asset"]["made_from_source"] == true);
  CHECK(unzipped["gaussians"]["dropped"] == 0);
  // Its pictures count as an earlier result's do.
  const std::vector<std::string> command{scene.file("sog/meta.json"), scene.file("sog.rgs"), "--no-render", "--json",
                                         scene.file("sog.json")};
  REQUIRE(run_audit(command).exit_code == 0);
  CHECK(run_audit(command).exit_code == 0);
  fs::path picture;
  for (const auto& entry : fs::directory_iterator(scene.file("sog")))
    if (entry.path().extension() == ".webp") picture = entry.path();
  write_text(picture.string(), read_text(picture.string()) + "x");
  CHECK(run_audit(command).exit_code == 3);
}

TEST_CASE("pairs are found in subfolders by stem, whatever their formats") {
  const Pairs f({"one", "sub/two", "sub/deep/three"});
  convert({f.sources + "/sub/two.ply", f.sources + "/sub/two.spz"});
  fs::remove(f.sources + "/sub/two.ply");
  convert({f.sources + "/sub/two.spz", f.assets + "/sub/two.rgs"});
  write_text(f.sources + "/README.md", "no scene");
  write_text(f.sources + "/points.ply", "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n");
  write_text(f.assets + "/notes.txt", "no scene");
  const ProgramResult run = run_audit(f.command());
  INFO(run.err);
  CHECK(run.exit_code == 0);
  std::set<std::string> names;
  const json index = f.index();
  for (const json& pair : index["pairs"]) {
    names.insert(pair["name"]);
    CHECK(pair["status"] == "passed");
    CHECK(fs::exists(f.out + "/" + pair["report"].get<std::string>()));
  }
  CHECK(json(names).dump() == R"(["one","sub/deep/three","sub/two"])");
  CHECK(read_text(f.out + "/index.html").find("href=\"./sub/deep/three.html\"") != std::string::npos);

  // Both in one folder, and one folder inside the other.
  const Pairs g({"one", "sub/two"});
  fs::copy(g.assets, g.sources, fs::copy_options::recursive);
  CHECK(run_audit({g.sources, g.sources, "--report", g.file("same"), "--no-render"}).exit_code == 0);
  CHECK(json::parse(read_text(g.file("same/index.json")))["pairs"].size() == 2);
  fs::rename(g.assets, g.sources + "/made");
  for (const char* name : {"/one.rgs", "/sub/two.rgs"}) fs::remove(g.sources + name);
  CHECK(run_audit({g.sources, g.sources + "/made", "--report", g.file("inside"), "--no-render"}).exit_code == 0);

  // Assets of another format, without an .rgs.
  convert({f.sources, f.file("spz"), "--to", "spz"});
  CHECK(run_audit({f.sources, f.file("spz"), "--report", f.file("to-spz"), "--no-render"}).exit_code == 0);
  // Two sources match: the program cannot know which was meant.
  convert({f.sources + "/one.ply", f.sources + "/one.spz"});
  const ProgramResult two = run_audit(f.command());
  CHECK(two.exit_code == 3);
  CHECK(two.err.find("more than one source of this name: one.ply, one.spz") != std::string::npos);
}

TEST_CASE("a new limit renders nothing again and appears in every result") {
  const Pairs f;
  const std::vector<std::string> lax = f.command({"--fail-below", "psnr=20,ratio=1"}),
                                 strict = f.command({"--fail-below", "psnr=300,ratio=1,worst-ssim=0.5"});
  REQUIRE(run_audit(lax).exit_code == 0);
  const std::string one = f.out + "/sub/two.json";
  const json before = measurements(one);
  const ProgramResult run = run_audit(strict);
  CHECK(run.exit_code == 5);
  CHECK(measurements(one) == before);  // seconds too, because nothing was measured
  CHECK(run.out.find("(as before)") != std::string::npos);
  const json gate = json::parse(read_text(one))["gate"];
  CHECK(gate["holds"] == false);
  CHECK(gate["conditions"].size() == 3);
  CHECK(json::parse(read_text(one))["verdict"]["headline"].get<std::string>().starts_with("Gate failed: psnr"));
  const std::string page = read_text(f.out + "/sub/two.html");
  CHECK(page.find("<h1>Gate failed: psnr") != std::string::npos);
  CHECK(page.find("&lt; 300</li>") != std::string::npos);
  // The table names the failed gate.
  const json pair = f.index()["pairs"][1];
  CHECK(pair["status"] == "gate failed");
  REQUIRE(pair["failed_conditions"].size() == 1);
  CHECK(pair["failed_conditions"][0].get<std::string>().ends_with("< 300"));
  CHECK(read_text(f.out + "/index.csv").find("< 300\",\"\"\n") != std::string::npos);
  CHECK(read_text(f.out + "/index.html").find("gate failed: psnr") != std::string::npos);
  // Apart from times, the page equals that of a new audit.
  fs::rename(f.out, f.file("earlier"));
  REQUIRE(run_audit(strict).exit_code == 5);
  const auto without_times = [](std::string text) {
    text.erase(std::remove_if(text.begin(), text.end(), [](char c) { return c >= '0' && c <= '9'; }), text.end());
    return text;
  };
  CHECK(without_times(read_text(f.out + "/sub/two.html")) == without_times(page));
  // The old limit again, then none.
  CHECK(run_audit(lax).exit_code == 0);
  CHECK(read_text(f.out + "/sub/two.html").find("Gate failed") == std::string::npos);
  CHECK(run_audit(f.command()).exit_code == 0);
  CHECK(json::parse(read_text(one))["gate"]["conditions"].empty());

  // Other settings, cameras or bytes are measured again once that is allowed.
  std::vector<std::string> other = strict;
  other[7] = "48x64";
  CHECK(run_audit(other).exit_code == 3);
  const std::string asset = f.assets + "/sub/two.rgs";
  convert({f.sources + "/sub/two.ply", asset, "--profile", "direct"});
  CHECK(run_audit(strict).exit_code == 3);
  // A page of another run does not count as this run's.
  convert({f.sources + "/sub/two.ply", asset});
  CHECK(run_audit(lax).exit_code == 0);
  write_text(f.out + "/sub/two.html", read_text(f.out + "/one.html"));
  CHECK(run_audit(lax).exit_code == 0);
  CHECK(read_text(f.out + "/sub/two.html").find("two.rgs") != std::string::npos);
}

TEST_CASE("a single pair, too, is measured once for any number of limits") {
  const SceneFolder scene;
  const std::string out = scene.file("audit.json"), page = scene.file("audit.html");
  const auto audit = [&](const std::string& conditions, std::vector<std::string> more = {}) {
    std::vector<std::string> arguments{scene.ply, scene.rgs, "--cameras", scene.cameras, "--json", out};
    arguments.insert(arguments.end(), {"--report", page, "--fail-below", conditions});
    arguments.insert(arguments.end(), more.begin(), more.end());
    return run_audit(arguments);
  };
  CHECK(audit("psnr=20").exit_code == 0);
  const json before = measurements(out);
  const ProgramResult failed = audit("psnr=200,loss=1", {"--photos", scene.path().string()});
  CHECK(failed.exit_code != 5);  // other inputs
  const ProgramResult strict = audit("together-psnr=200");
  CHECK(strict.exit_code == 5);
  CHECK(strict.out.find("as measured before") != std::string::npos);
  CHECK(strict.err.find("condition failed: together-psnr") != std::string::npos);
  CHECK(measurements(out) == before);
  CHECK(read_text(page).find("Gate failed: together-psnr") != std::string::npos);
  fs::remove(page);  // made again, which takes pictures
  CHECK(audit("psnr=20").exit_code == 3);
  CHECK(audit("psnr=20", {"--overwrite"}).exit_code == 0);
  CHECK(read_text(page).find("Gate failed") == std::string::npos);
}

TEST_CASE("a stored result holds what later gates need, infinite and missing values included") {
  audit::Report report;
  report.size.source_bytes = 900, report.size.asset_bytes = 300, report.size.n_asset = 10;
  report.render.emplace();
  report.render->n_rated = 1;
  report.render->psnr = report.render->worst_psnr = std::numeric_limits<double>::infinity();
  report.render->ssim = report.render->worst_ssim = 1;
  report.render->largest = 0.1F;
  report.fingerprint = "0123456789abcdef";
  const TemporaryFolder folder;
  const std::string path = folder.file("a.json");
  write_text(path, audit::audit_json(report));
  std::string all;
  for (const audit::ConditionKind& kind : audit::condition_kinds())
    all += (all.empty() ? "" : ",") + std::string(kind.name) + "=1.0000001";
  audit::Report direct = report;
  audit::evaluate(*audit::parse_conditions(all), direct);
  const auto earlier = audit::earlier_audit(path, report.fingerprint, *audit::parse_conditions(all));
  REQUIRE(earlier);
  REQUIRE(earlier->gate.size() == direct.gate.size());
  for (std::size_t i = 0; i < direct.gate.size(); ++i) {
    CHECK(audit::describe(earlier->gate[i]) == audit::describe(direct.gate[i]));
    CHECK(earlier->gate[i].holds == direct.gate[i].holds);
  }
  CHECK(earlier->json == audit::audit_json(direct));
  CHECK_FALSE(audit::earlier_audit(path, "another", {}));
  CHECK_FALSE(audit::earlier_audit(path, report.fingerprint, {})->changed);
  const std::string text = read_text(path);
  for (std::size_t cut = 0; cut + 1 < text.size(); cut += 97) {
    write_text(path, text.substr(0, cut));
    CHECK_FALSE(audit::earlier_audit(path, report.fingerprint, {}));
  }
  for (const char* wrong : {"{}", "[]", "7", R"({"schema":"rgs-audit/3","fingerprint":"0123456789abcdef"})",
                            R"({"schema":"rgs-audit/3","fingerprint":"0123456789abcdef","measured":{"psnr":"x"}})"}) {
    write_text(path, wrong);
    CHECK_FALSE(audit::earlier_audit(path, report.fingerprint, {}));
  }
}

TEST_CASE("JUnit has a test case for each gate of each scene") {
  const Pairs f({"one", "sub/two"});
  write_text(f.assets + "/bad.rgs", "damaged");
  write_ply(f.sources + "/bad.ply", audit_cloud(10, 0));
  write_ply(f.sources + "/alone & \"<one>\" \x01\xff\xEF\xBF\xBE.ply", audit_cloud(10, 0));
  const std::string junit = f.file("junit.xml");
  const std::vector<std::string> command = f.command({"--fail-below", "psnr=20,ratio=300", "--junit", junit});
  CHECK(run_audit(command).exit_code == 3);
  const json xml = parse_xml(f, junit);
  CHECK(xml["attributes"]["tests"] == "6");
  CHECK(xml["attributes"]["failures"] == "2");
  CHECK(xml["attributes"]["errors"] == "2");
  std::map<std::string, json> suites;
  for (const json& suite : xml["suites"]) suites[suite["name"]] = suite;
  REQUIRE(suites.size() == 4);
  const json& two = suites.at("sub/two");
  REQUIRE(two["cases"].size() == 2);
  CHECK(two["cases"][0]["name"] == "psnr");
  CHECK(two["cases"][0]["classname"] == "sub/two");
  CHECK(two["cases"][0]["failures"].empty());
  REQUIRE(two["cases"][1]["failures"].size() == 1);
  CHECK(two["cases"][1]["failures"][0].get<std::string>().find("< 300") != std::string::npos);
  CHECK(suites.at("bad")["cases"][0]["errors"][0].get<std::string>().find("bad.rgs") != std::string::npos);
  // The next run replaces it, and nothing else.
  CHECK(run_audit(f.command({"--junit", junit})).exit_code == 3);
  CHECK(parse_xml(f, junit)["attributes"]["failures"] == "0");
  write_text(junit, "mine");
  CHECK(run_audit(command).exit_code == 3);
  CHECK(read_text(junit) == "mine");
  CHECK(run_audit(f.command({"--junit", f.sources + "/one.ply"})).exit_code == 2);
}

TEST_CASE("JUnit of one pair with and without gates, and of one that cannot be audited") {
  const SceneFolder scene;
  const std::string junit = scene.file("junit.xml");
  const auto audit = [&](const std::string& asset, std::vector<std::string> more) {
    std::vector<std::string> arguments{scene.ply, asset, "--no-render", "--junit", junit, "--quiet"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return run_audit(arguments).exit_code;
  };
  CHECK(audit(scene.rgs, {}) == 0);
  json xml = parse_xml(scene, junit);
  REQUIRE(xml["suites"].size() == 1);
  CHECK(xml["suites"][0]["name"] == "scene.rgs");
  CHECK(xml["suites"][0]["cases"][0]["name"] == "audit");
  CHECK(audit(scene.rgs, {"--fail-below", "ratio=100"}) == 5);
  CHECK(parse_xml(scene, junit)["attributes"]["failures"] == "1");
  write_text(scene.file("damaged.rgs"), read_text(scene.rgs).substr(0, 3000));
  CHECK(audit(scene.file("damaged.rgs"), {}) == 4);
  xml = parse_xml(scene, junit);
  CHECK(xml["attributes"]["errors"] == "1");
  CHECK(xml["suites"][0]["cases"][0]["errors"][0].get<std::string>().find("byte") != std::string::npos);
}

TEST_CASE("JUnit turns red when the audit ends before it measures") {
  const SceneFolder scene;
  const std::string junit = scene.file("junit.xml"), mine = scene.file("mine.html");
  const auto audit = [&](std::vector<std::string> more) {
    std::vector<std::string> arguments{scene.ply, scene.rgs, "--no-render", "--junit", junit, "--quiet"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return run_audit(arguments).exit_code;
  };
  REQUIRE(audit({}) == 0);
  write_text(mine, "mine");
  for (const char* option : {"--report", "--json"}) {
    CHECK(audit({option, mine}) == 3);
    CHECK(parse_xml(scene, junit)["attributes"]["errors"] == "1");
    CHECK(read_text(mine) == "mine");
    CHECK(audit({}) == 0);
    CHECK(parse_xml(scene, junit)["attributes"]["errors"] == "0");
  }
  // Folders without pairs.
  fs::create_directory(scene.file("no"));
  fs::create_directory(scene.file("none"));
  CHECK(run_audit({scene.file("no"), scene.file("none"), "--report", scene.file("out"), "--junit", junit}).exit_code !=
        0);
  CHECK(parse_xml(scene, junit)["attributes"]["errors"] == "1");
}

TEST_CASE("JUnit may be written to the folder of reports before it exists") {
  const Pairs pairs({"one"});
  const ProgramResult run = run_audit(pairs.command({"--junit", pairs.out + "/junit.xml"}));
  INFO(run.err);
  CHECK(run.exit_code == 0);
  CHECK(fs::exists(pairs.out + "/junit.xml"));
}

TEST_CASE("an audit killed between page and JSON continues, and replaces no other page") {
  const Pairs pairs({"one"});
  const std::string page = pairs.out + "/one.html", result = pairs.out + "/one.json";
  REQUIRE(run_audit(pairs.command()).exit_code == 0);
  const std::string made = read_text(page);
  fs::remove(result);
  const ProgramResult rerun = run_audit(pairs.command());
  INFO(rerun.out);
  CHECK(rerun.exit_code == 0);
  CHECK(fs::exists(result));
  // A page made with other options.
  fs::remove(result);
  const std::vector<std::string> other{pairs.sources, pairs.assets, "--report", pairs.out,         "--views",
                                       "3",           "--size",     "64x48",    "--no-attribution"};
  CHECK(run_audit(other).exit_code == 3);
  CHECK(run_audit(pairs.command()).exit_code == 0);
  // A user's own page, beside a result and alone.
  write_text(page, "mine");
  CHECK(run_audit(pairs.command()).exit_code == 3);
  CHECK(read_text(page) == "mine");
  fs::remove(result);
  CHECK(run_audit(pairs.command()).exit_code == 3);
  CHECK(read_text(page) == "mine");
  CHECK(run_audit(pairs.command({"--overwrite"})).exit_code == 0);

  // A single pair with --json is no exception.
  const SceneFolder scene;
  const std::string html = scene.file("scene.html"), numbers = scene.file("scene.json");
  const std::vector<std::string> one{scene.ply, scene.rgs, "--no-render", "--report", html, "--json", numbers, "-q"};
  REQUIRE(run_audit(one).exit_code == 0);
  fs::remove(numbers);
  CHECK(run_audit(one).exit_code == 0);
  fs::remove(numbers);
  write_text(html, "mine");
  CHECK(run_audit(one).exit_code == 3);
  CHECK(read_text(html) == "mine");
}
