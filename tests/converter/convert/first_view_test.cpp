// first_view_test.cpp - the first view that rgs-convert states.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <array>
#include <string>
#include <vector>

#include "convert_program.hpp"
#include "convert_scenes.hpp"
#include "edit_file.hpp"
#include "interchange_samples.hpp"
#include "rgs/paged_file.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

FirstView stated_by(const std::string& path) {
  const Bytes bytes = read_bytes(path);
  if (const auto paged = PagedFile::open(bytes)) return paged->head().declarations().first_view;
  return FileView::open(bytes).value().declarations().first_view;
}

FirstView converted_view(std::vector<std::string> arguments) {
  CAPTURE(arguments);
  converted(arguments);
  return stated_by(arguments.back());
}

}  // namespace

TEST_CASE("an .rgs states the view that its source's Gaussians give, however it is converted, and keeps it") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(40000, 1, 1);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), rgs = folder.file("scene.rgs"),
                    again = folder.file("again.rgs");
  const FirstView view = chosen_for(cloud);
  REQUIRE(view.kind == ViewKind::outside);
  for (const std::vector<std::string>& options : {std::vector<std::string>{},
                                                  {"--profile", "direct", "--threads", "1"},
                                                  {"--profile", "archive:small"},
                                                  {"--keep-order", "--threads", "3"},
                                                  {"--lod", "--memory", "128MiB"}}) {
    std::vector<std::string> arguments = options;
    arguments.insert(arguments.end(), {ply, rgs});
    CHECK(converted_view(arguments) == view);
    CHECK(converted_view({"--profile", "direct", rgs, again}) == view);
  }
  CHECK(converted_view({"--lod", "--profile", "archive:small", "--sh-degree", "0", rgs, again}) == view);
}

TEST_CASE("a view is chosen anew where Gaussians are moved, merged, cropped or turned, and not before") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(500, 0, 1), other = ordinary_cloud(300, 0, 2);
  const FirstView stated{ViewKind::inside, {1, 2, 3}, {4, 5, 6}, {0, -1, 0}, 75};
  EncodeOptions options;
  options.first_view = stated;
  const std::string a = folder.file("a.rgs"), b = folder.file("b.rgs"), out = folder.file("out.rgs");
  write_bytes(a, encode(cloud.view(), options).value());
  write_bytes(b, encode(other.view(), options).value());
  CHECK(converted_view({a, out}) == stated);
  CHECK(converted_view({"--lod", a, out}) == stated);
  CHECK(converted_view({"--to-axes", "right,up,backward", a, out}) != stated);
  CHECK(converted_view({"--scale", "2", a, out}) != stated);
  CHECK(converted_view({"--merge", a, b, out}) != stated);
  CHECK(converted_view({"--lod", "--merge", a, b, out}) != stated);
  const FirstView cropped = converted_view({"--max-count", "400", a, out});
  CHECK(cropped == chosen_for(decode(read_bytes(out)).value()));
}

TEST_CASE("other formats say that they lose the first view") {
  const TemporaryFolder folder;
  EncodeOptions options;
  options.first_view = {ViewKind::inside, {1, 2, 3}, {4, 5, 6}, {0, -1, 0}, 75};
  const std::string rgs = folder.file("a.rgs");
  write_bytes(rgs, encode(ordinary_cloud(500, 0, 1).view(), options).value());
  const nlohmann::json lost{"first view"};
  for (const std::string to : {"ply", "spz", "npz"}) CHECK(converted({rgs, folder.file("a." + to)})["lost"] == lost);
  CHECK(converted({"--max-count", "500", rgs, folder.file("b.ply")})["lost"] == lost);
  CHECK(converted({folder.file("a.ply"), folder.file("b.npz")})["lost"].empty());
}

TEST_CASE("with cameras the view is the best of them") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(3000, 0, 1)),
                    rgs = folder.file("scene.rgs"), cameras = folder.file("cameras.json");
  const auto camera = [](const std::string& position, const std::string& rotation) {
    return R"({"id":0,"img_name":"a","width":640,"height":480,"position":)" + position + R"(,"rotation":)" + rotation +
           R"(,"fx":320,"fy":320})";
  };
  // Away from the scene, towards it, and from too far away.
  const std::string ahead = "[[1,0,0],[0,1,0],[0,0,1]]", back = "[[-1,0,0],[0,1,0],[0,0,-1]]";
  write_text(cameras, "[" + camera("[0,0,-12]", back) + "," + camera("[0,0,-12.5]", ahead) + "," +
                          camera("[0,0,-900]", ahead) + "]");
  for (const bool with_levels : {false, true}) {
    std::vector<std::string> arguments{"--cameras", cameras, ply, rgs};
    if (with_levels) arguments.insert(arguments.begin(), "--lod");
    const FirstView view = converted_view(arguments);
    CHECK(view.position[0] == doctest::Approx(0).epsilon(1e-4));
    CHECK(view.position[2] == doctest::Approx(-12.5).epsilon(1e-4));
    CHECK(view.pivot[2] > -12);
    CHECK(std::abs(view.pivot[0]) < 1e-3F);
    CHECK(view.up[1] == doctest::Approx(-1));
    CHECK(view.horizontal_fov == doctest::Approx(90));
  }
}
