// input_files_test.cpp - identity of paths, and detection of changed files.
// SPDX-License-Identifier: Apache-2.0
#include "input_files.hpp"

#include <doctest/doctest.h>

#include <filesystem>
#include <fstream>
#include <string>
#include <vector>

#include "file_times.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

using namespace rgs::tool;
using rgs::test::TemporaryFolder;
using rgs::test::write_text;
namespace fs = std::filesystem;

TEST_CASE("names of one file clash, whether it exists or not, and others do not") {
  const TemporaryFolder folder;
  const std::string a = folder.file("a"), b = folder.file("b"), link = folder.file("link");
  write_text(a, "a");
  fs::create_symlink("b", link);  // not created yet
  InputFiles inputs;
  inputs.add(a);
  inputs.add("");
  const auto clash = [&](std::vector<std::string> outputs) { return inputs.clash(outputs); };
  CHECK(clash({b, "", "", folder.file("c")}) == "");
  CHECK(clash({folder.file("./a")}) == "output " + folder.file("./a") + " is the same file as input " + a);
  CHECK(clash({b, link}) == "output " + link + " is the same file as output " + b);
  CHECK(clash({b, folder.file("x/../b")}) != "");
  CHECK(clash({folder.file("x/y/c"), folder.file("x//y/./c")}) != "");
  CHECK(clash({folder.file("x/y/c"), folder.file("x/z/c")}) == "");
  CHECK(clash({"-", b}) == "");
  CHECK(clash({"-", b, "-"}) == "two outputs go to standard output");
  const fs::path before = fs::current_path();
  fs::current_path(folder.path());
  CHECK(clash({"a"}) != "");
  CHECK(clash({"b", b}) != "");
  fs::current_path(before);
}

TEST_CASE(
    "a COLMAP model's files, a SOG's pictures, the files of a glTF or an LCC and photographs are inputs; others are "
    "not") {
  const TemporaryFolder folder;
  for (const char* name : {"sparse/0", "photos", "sog/0_0", "gltf", "lcc/data/3dgs", "rad"})
    fs::create_directories(folder.path() / name);
  for (const char* name : {"sparse/0/images.bin", "sparse/0/report.html", "photos/a.JPG",  "photos/report.html",
                           "sog/meta.json",       "sog/sh0.webp",         "sog/scene.ply", "sog/lod-meta.json",
                           "sog/0_0/meta.json",   "sog/0_0/quats.webp",   "gltf/a.gltf",   "gltf/a.bin",
                           "gltf/a.png",          "gltf/b.PLY",           "gltf/b.prj",    "lcc/data.bin",
                           "lcc/a.lcc",           "lcc/a.lcc2",           "lcc/b.sog",     "lcc/data/3dgs/0.sog",
                           "rad/a.rad",           "rad/a-0.radc",         "rad/b-0.radc"})
    write_text(folder.file(name), "x");
  InputFiles inputs;
  inputs.add_cameras(folder.path().string());
  inputs.add_pictures(folder.file("photos"));
  for (const char* scene :
       {"sog/meta.json", "gltf/a.gltf", "lcc/a.lcc", "lcc/a.lcc2", "gltf/b.PLY", "sog/scene.ply", "rad/a.rad"})
    inputs.add_scene(folder.file(scene));
  CHECK(inputs.paths() == std::vector{folder.file("sparse/0/images.bin"), folder.file("photos/a.JPG"),
                                      folder.file("sog/meta.json"), folder.file("sog/sh0.webp"),
                                      folder.file("gltf/a.gltf"), folder.file("gltf/a.bin"), folder.file("lcc/a.lcc"),
                                      folder.file("lcc/data.bin"), folder.file("lcc/a.lcc2"),
                                      folder.file("lcc/data/3dgs/0.sog"), folder.file("gltf/b.PLY"),
                                      folder.file("gltf/b.prj"), folder.file("sog/scene.ply"), folder.file("rad/a.rad"),
                                      folder.file("rad/a-0.radc"), folder.file("rad/b-0.radc")});
  InputFiles streamed;
  streamed.add_scene(folder.file("sog/lod-meta.json"));
  CHECK(streamed.paths() == std::vector{folder.file("sog/lod-meta.json"), folder.file("sog/0_0/meta.json"),
                                        folder.file("sog/0_0/quats.webp")});
}

TEST_CASE("what a tileset is read from are inputs, in whatever way it is named; others are not") {
  const TemporaryFolder folder;
  const auto at = [&](const std::string& name) { return folder.file("3d{x}tiles/" + name); };
  for (const char* name : {"b", "h", "s"}) fs::create_directories(at(name));
  fs::create_directory_symlink("h", at("g"));
  for (const char* name : {"b/a.png", "b/c.GLB", "b/c d.bin", "b/g.bin", "f.glb", "h/000.glb", "h/1.glb", "s/1.json"})
    write_text(at(name), "x");
  // An external tileset, the .gltf that it names, a tiling whose bits are in a file of their own, and a damaged tile.
  write_text(at("tileset.json"),
             R"({"asset": {"version": "1.1"}, "geometricError": 1, "root": {"children": [
                {"content": {"url": "b/a.tiles"}}, {"contents": [{"uri": "./b//c.GLB"}]},
                {"content": {"uri": "g/{level}{x}{y}.glb"}, "implicitTiling": {"subdivisionScheme": "QUADTREE",
                 "availableLevels": 1, "subtreeLevels": 1, "subtrees": {"uri": "s/{level}.json"}}},
                {"content": {"uri": "../a.glb"}}, {"content": {"uri": "f.glb"}}]}})");
  write_text(at("b/a.tiles"), R"({"asset": {"version": "1.0"}, "geometricError": 1,
                                  "root": {"content": {"uri": "e.gltf", "x": "a.png"}}})");
  write_text(at("b/e.gltf"), R"({"asset": {"version": "2.0"}, "accessors": [], "meshes": [], "buffers":
                                 [{"uri": "c%20d.bin"}, {"uri": "data:,x"}, {"uri": "none.bin"}]})");
  write_text(at("s/0.json"), R"({"buffers": [{"uri": "bits", "byteLength": 1}], "bufferViews": [{"buffer": 0,
                                 "byteLength": 1}], "tileAvailability": {"bitstream": 0},
                                 "contentAvailability": [{"constant": 1}],
                                 "childSubtreeAvailability": {"constant": 0}})");
  write_text(at("s/bits"), "\x01");
  const auto inputs_of = [&](const std::string& scene) {
    InputFiles inputs;
    inputs.add_scene(scene);
    return inputs.paths();
  };
  CHECK(inputs_of(at("tileset.json")) == std::vector{at("tileset.json"), at("b/a.tiles"), at("b/c d.bin"),
                                                     at("b/c.GLB"), at("b/e.gltf"), at("g/000.glb"), at("s/0.json"),
                                                     at("s/bits")});
  const fs::path before = fs::current_path();
  fs::current_path(at("b"));
  CHECK(inputs_of("a.tiles") == std::vector<std::string>{"a.tiles", "c d.bin", "e.gltf"});
  fs::current_path(before);
  // Each tile of a tiling has a URI of that length.
  std::string uri = "f.glb";
  while (uri.size() <= 4096) uri.insert(0, "./");
  const auto naming = [&](const std::string& file) {
    write_text(at("long.json"), R"({"asset": {"version": "1.0"}, "geometricError": 1, "root": {"content": {"uri": ")" +
                                    file + R"("}}})");
    return inputs_of(at("long.json"));
  };
  CHECK(naming(uri) == std::vector{at("long.json")});
  CHECK(naming(uri.substr(2)) == std::vector{at("long.json"), at("f.glb")});
}

TEST_CASE("a file that was rewritten, extended or replaced has changed; a removed one has not") {
  const TemporaryFolder folder;
  const std::string path = folder.file("a"), other = folder.file("other");
  const auto changed_by = [&](const auto& change) {
    write_text(path, "0123456789");
    rgs::test::wait_for_later_time(path);
    InputFiles inputs;
    inputs.add(path);
    CHECK_FALSE(inputs.changed());
    const auto time = fs::last_write_time(path);
    change(time);
    return inputs.changed() == path;
  };
  CHECK_FALSE(changed_by([](auto) {}));
  CHECK_FALSE(changed_by([&](auto) { fs::remove(path); }));
  CHECK(changed_by([&](auto) { write_text(path, "9876543210"); }));
  CHECK(changed_by([&](auto) { std::ofstream(path, std::ios::app) << "more"; }));
  CHECK(changed_by([&](auto time) {
    write_text(path, "9876543210");
    fs::last_write_time(path, time);
  }));
  CHECK(changed_by([&](auto) {
    write_text(other, "0123456789");
    fs::rename(other, path);
  }));
}
