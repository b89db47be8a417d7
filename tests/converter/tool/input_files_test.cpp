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
  for (const char* name : {"sparse/0", "photos", "sog/0_0", "gltf", "lcc/data/3dgs", "rad", "3dtiles/b", "3dtiles/g/1"})
    fs::create_directories(folder.path() / name);
  for (const char* name : {"sparse/0/images.bin", "sparse/0/report.html", "photos/a.JPG",       "photos/report.html",
                           "sog/meta.json",       "sog/sh0.webp",         "sog/scene.ply",      "sog/lod-meta.json",
                           "sog/0_0/meta.json",   "sog/0_0/quats.webp",   "gltf/a.gltf",        "gltf/a.bin",
                           "gltf/a.png",          "gltf/b.PLY",           "gltf/b.prj",         "lcc/data.bin",
                           "lcc/a.lcc",           "lcc/a.lcc2",           "lcc/b.sog",          "lcc/data/3dgs/0.sog",
                           "rad/a.rad",           "rad/a-0.radc",         "rad/b-0.radc",       "3dtiles/tileset.json",
                           "3dtiles/b/c.GLB",     "3dtiles/b/a.json",     "3dtiles/b/a.png",    "3dtiles/b/c d.bin",
                           "3dtiles/b/e.gltf",    "3dtiles/f.glb",        "3dtiles/g/1/02.glb", "3dtiles/g/1/a.glb"})
    write_text(folder.file(name), "x");
  // Only what a tileset, an external one or a .gltf names.
  write_text(folder.file("3dtiles/tileset.json"),
             R"({"root": {"content": {"url": "b/a.json"}, "children": [{"contents": [{"uri": "./b//c.GLB"},
              {"uri": "../rad/a.rad"}, {"uri": "none.glb"}, {"uri": "b"}, {"uri": "tileset.json"},
              {"uri": "g/{level}/{x}.glb"}]}]}})");
  write_text(folder.file("3dtiles/b/a.json"), R"({"root": {"content": {"uri": "e.gltf", "x": "a.png"}}})");
  write_text(folder.file("3dtiles/b/e.gltf"), R"({"buffers": [{"uri": "c%20d.bin"}, {"uri": "data:,x"}]})");
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
  InputFiles tiles;
  tiles.add_scene(folder.file("3dtiles/tileset.json"));
  CHECK(tiles.paths() == std::vector{folder.file("3dtiles/tileset.json"), folder.file("3dtiles/b/a.json"),
                                     folder.file("3dtiles/b/c d.bin"), folder.file("3dtiles/b/c.GLB"),
                                     folder.file("3dtiles/b/e.gltf"), folder.file("3dtiles/g/1/02.glb")});
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
