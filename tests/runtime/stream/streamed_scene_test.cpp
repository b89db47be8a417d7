// streamed_scene_test.cpp - scenes that are drawn while they are read: complete pictures, coarse ones, and what goes wrong on the way.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <array>
#include <atomic>
#include <filesystem>
#include <fstream>
#include <optional>
#include <thread>

#include "streamed_fixture.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

constexpr double kLong = 60;  // seconds, that no test takes

}  // namespace

TEST_CASE("a refined picture is that of the whole file, byte for byte, in every profile and at every detail") {
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    CAPTURE(static_cast<int>(profile));
    const Bytes bytes = town({.profile = profile});
    const Scene all = whole(bytes);
    const StreamedScene scene = streamed(bytes);
    CHECK(scene.size() == all.size());
    CHECK(scene.sh_degree() == all.sh_degree());
    Renderer one = cpu_renderer(1), two = cpu_renderer(2), reference = cpu_renderer();
    std::uint64_t least = ~std::uint64_t{0}, most = 0;
    const std::vector<Camera> cameras = town_cameras(1, 12);
    for (const float detail : {4.0F, 1.0F, 0.5F, 0.0F}) {
      for (std::size_t i = 0; i < cameras.size(); ++i) {
        CAPTURE(detail);
        CAPTURE(i);
        Renderer& renderer = i % 2 == 0 ? one : two;
        const auto complete = renderer.refine(scene, cameras[i], kLong, at_detail(detail));
        REQUIRE(complete);
        REQUIRE(*complete);
        const Frame expected = draw(reference, all, cameras[i], at_detail(detail));
        const Frame frame = draw(renderer, scene, cameras[i], at_detail(detail));
        CHECK(is_same_picture(frame, expected));
        CHECK(frame.stats.stream.pages_missing == 0);
        CHECK(frame.stats.stream.detail_reached_px <= static_cast<double>(detail));
        CHECK(frame.stats.gaussians <= expected.stats.gaussians);
        if (detail == 1) least = std::min(least, frame.stats.pages), most = std::max(most, frame.stats.pages);
      }
    }
    CHECK(least < most);  // the views differ
    CHECK(scene.status());
    CHECK(scene.stats().bytes_read <= 2 * bytes.size());
  }
}
