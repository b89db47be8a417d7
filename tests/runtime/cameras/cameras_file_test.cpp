// cameras_file_test.cpp - every camera format describes the same camera; damaged files cause an error with its place.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <filesystem>
#include <fstream>

#include "cameras_fixture.hpp"
#include "rgs/camera_file.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

void write(const std::string& path, const std::string& content) {
  std::ofstream(path, std::ios::binary) << content;
}

void replace(std::string& text, const std::string& from, const std::string& to) {
  const std::size_t at = text.find(from);
  REQUIRE(at != std::string::npos);
  text.replace(at, from.size(), to);
}

// The camera of all fixtures.
void check_fixture_camera(const Camera& camera) {
  CHECK(camera.width == 640);
  CHECK(camera.height == 480);
  CHECK(camera.fx == 500.5);
  CHECK(camera.fy == 501.5);
  CHECK(camera.cx == 320);
  CHECK(camera.cy == 240);
  const std::array<double, 16> pose{0, 0, -1, 3, 0, 1, 0, -2, 1, 0, 0, -1, 0, 0, 0, 1};
  const auto found = row_major(camera.world_to_camera);
  for (std::size_t i = 0; i < 16; ++i) CHECK(found[i] == doctest::Approx(pose[i]).epsilon(1e-14));
  CHECK(glm::distance(camera_centre(camera), glm::dvec3(1, 2, 3)) < 1e-12);
  CHECK(camera_axis(camera, 2).x == doctest::Approx(1));
}

void check_error(const Result<CameraSet>& result, Errc code, std::uint64_t offset) {
  REQUIRE_FALSE(result);
  CHECK(std::string(errc_name(result.error().code)) == errc_name(code));
  CHECK(result.error().offset == offset);
  CHECK(std::string(result.error().what) != "");
}

}  // namespace

TEST_CASE("one camera, five formats, one result") {
  const auto list = parse_camera_json(camera_list());
  const auto training = parse_camera_json(training_list());
  const auto nerf = parse_camera_json(transforms());
  const ExactCopy cameras(colmap_cameras_bin()), images(colmap_images_bin());
  const auto binary = parse_colmap_binary(cameras.bytes(), images.bytes());
  const auto text = parse_colmap_text(colmap_cameras_txt(), colmap_images_txt());
  for (const auto* set : {&list, &training, &nerf, &binary, &text}) {
    REQUIRE(*set);
    REQUIRE((*set)->cameras.size() == 2);
    REQUIRE((*set)->split.size() == 2);
    check_fixture_camera((*set)->cameras[0]);
    CHECK((*set)->split[0] == Split::test);
    CHECK((*set)->split[1] == Split::train);
    CHECK((*set)->split_declared == (set == &list));
  }
  CHECK(list->source == CameraSet::Source::list);
  CHECK(training->source == CameraSet::Source::training);
  CHECK(nerf->source == CameraSet::Source::transforms);
  CHECK(binary->source == CameraSet::Source::colmap);
  CHECK(list->cameras[0].name == "a");
  check_fixture_camera(nerf->cameras[1]);
  for (const auto* set : {&binary, &text}) {
    CHECK((*set)->cameras[0].name == "a.jpg");
    CHECK((*set)->cameras[1].name == "b.jpg");
    CHECK((*set)->cameras[1].fx == 20);
    CHECK((*set)->cameras[1].fy == 20);
    CHECK((*set)->cameras[1].cx == 16);
    CHECK((*set)->cameras[1].cy == 8);
  }
}

TEST_CASE("transforms.json: field of view instead of focal lengths, values per frame, distortion refused") {
  std::string angle = transforms();
  replace(angle, R"("fl_x":500.5,"fl_y":501.5,"cx":320,"cy":240,)", R"("camera_angle_x":1.5707963267948966,)");
  const auto set = parse_camera_json(angle);
  REQUIRE(set);
  CHECK(set->cameras[0].fx == doctest::Approx(320));
  CHECK(set->cameras[0].fy == doctest::Approx(320));
  CHECK(set->cameras[0].cx == 320);
  CHECK(set->cameras[0].cy == 240);

  std::string own = transforms();
  replace(own, R"({"file_path":"b",)", R"({"file_path":"b","fl_x":7,"w":20,"h":10,"cx":9,"cy":4,)");
  const auto mixed = parse_camera_json(own);
  REQUIRE(mixed);
  CHECK(mixed->cameras[0].fx == 500.5);
  CHECK(mixed->cameras[1].fx == 7);
  CHECK(mixed->cameras[1].fy == 501.5);
  CHECK(mixed->cameras[1].width == 20);
  CHECK(mixed->cameras[1].cx == 9);

  std::string distorted = transforms();
  replace(distorted, R"("k1":0)", R"("k1":0.1)");
  check_error(parse_camera_json(distorted), Errc::unsupported_feature, transforms().find(R"({"file_path":"a")") + 2);
  for (const char* key : {"k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"}) {
    std::string one = transforms();
    replace(one, R"("k1":0)", "\"" + std::string(key) + "\":-1e-9");
    const auto refused = parse_camera_json(one);
    REQUIRE_FALSE(refused);
    CHECK(refused.error().code == Errc::unsupported_feature);
    CHECK(refused.error().found == 0);  // the first frame
    CHECK(std::string(refused.error().what).find("(" + std::string(key) + " is not 0)") != std::string::npos);
  }
  std::string fisheye = transforms();
  replace(fisheye, R"("k1":0)", R"("camera_model":"OPENCV_FISHEYE")");
  CHECK(parse_camera_json(fisheye).error().code == Errc::unsupported_feature);
  std::string no_size = transforms();
  replace(no_size, R"("w":640,"h":480.0,)", "");
  CHECK(parse_camera_json(no_size).error().code == Errc::bad_syntax);
}

TEST_CASE("the error of a JSON camera states its index and its byte offset") {
  const std::string good = camera_list();
  const std::uint64_t second = good.find('{', 1 + good.find('{'));
  struct Case {
    const char *from, *to;
    Errc code;
  };
  for (const Case& c :
       {Case{R"("fx":500.5)", R"("fx":0)", Errc::bad_value}, Case{R"("fx":500.5)", R"("fx":"1")", Errc::bad_syntax},
        Case{R"("fx":500.5,)", "", Errc::bad_syntax}, Case{R"("width":640)", R"("width":-1)", Errc::bad_value},
        Case{R"("width":640)", R"("width":1e30)", Errc::bad_value},
        Case{R"("width":640)", R"("width":640.5)", Errc::bad_value},
        Case{R"("height":480)", R"("height":18446744073709551616)", Errc::bad_value},
        Case{R"([0,0,-1,3])", R"([0,0,-2,3])", Errc::bad_value}, Case{R"([0,0,-1,3])", R"([0,0,1,3])", Errc::bad_value},
        Case{R"([0,0,-1,3])", R"([0,0,-1])", Errc::bad_syntax}, Case{R"([0,0,0,1])", R"([0,0,0,2])", Errc::bad_value},
        Case{R"(,[0,0,0,1])", "", Errc::bad_syntax}, Case{R"("split":"train")", R"("split":"x")", Errc::bad_value},
        Case{R"("name":"b")", R"("name":["{", "\"]}"])", Errc::bad_syntax}}) {
    CAPTURE(c.to);
    std::string bad = good.substr(second);
    replace(bad, c.from, c.to);
    const auto result = parse_camera_json(good.substr(0, second) + bad);
    check_error(result, c.code, second);
    CHECK(result.error().found == 1);
  }
  std::string nested = "[" + list_camera(R"(a\"{[,)", "test") + ", 5]";
  check_error(parse_camera_json(nested), Errc::bad_syntax, nested.size() - 2);
}

TEST_CASE("broken JSON: the error has the byte offset") {
  check_error(parse_camera_json("[1, @]"), Errc::bad_syntax, 4);
  check_error(parse_camera_json("[]"), Errc::bad_value, 0);
  check_error(parse_camera_json("{}"), Errc::bad_syntax, 0);
  check_error(parse_camera_json(R"({"frames":{}})"), Errc::bad_syntax, 0);
  check_error(parse_camera_json(R"([ {"a":1}])"), Errc::bad_syntax, 2);
  check_error(parse_camera_json("7"), Errc::bad_syntax, 0);
  check_error(parse_camera_json("[1e999]"), Errc::bad_value, Error::kNone);
  check_error(parse_camera_json(std::string(100'000, '[')), Errc::truncated, 100'000);
  check_error(parse_camera_json("[\"\xff\"]"), Errc::bad_syntax, 2);
}

TEST_CASE("every prefix of every format is refused without reading past its end") {
  for (const std::string& whole : {camera_list(), training_list(), transforms()}) {
    const std::size_t end = whole.find_last_of("]}");
    for (std::size_t size = 0; size <= end; ++size) {
      const auto result = parse_camera_json(ExactCopy(whole, size).text());
      REQUIRE_FALSE(result);
      CHECK(result.error().offset == size);
    }
  }
  const std::string cameras = colmap_cameras_bin(), images = colmap_images_bin();
  for (std::size_t size = 0; size < cameras.size(); ++size)
    CHECK_FALSE(parse_colmap_binary(ExactCopy(cameras, size).bytes(), ExactCopy(images).bytes()));
  for (std::size_t size = 0; size < images.size(); ++size) {
    const auto result = parse_colmap_binary(ExactCopy(cameras).bytes(), ExactCopy(images, size).bytes());
    REQUIRE_FALSE(result);
    CHECK(result.error().code == Errc::truncated);
  }
  // Text may end between words and still be complete: a result, never a crash.
  const std::string cameras_txt = colmap_cameras_txt(), images_txt = colmap_images_txt();
  for (std::size_t size = 0; size < cameras_txt.size(); ++size)
    (void)parse_colmap_text(ExactCopy(cameras_txt, size).text(), images_txt);
  for (std::size_t size = 0; size < images_txt.size(); ++size)
    (void)parse_colmap_text(cameras_txt, ExactCopy(images_txt, size).text());
}

TEST_CASE("every single changed byte gives cameras or an error") {
  const auto mutate = [](const std::string& whole, auto&& parse) {
    for (std::size_t i = 0; i < whole.size(); ++i) {
      for (const char value : {'\0', '\x7f', '\xff', '-', '9', '"', '\n'}) {
        std::string changed = whole;
        changed[i] = value;
        const auto result = parse(ExactCopy(changed));
        if (!result) continue;
        for (const Camera& camera : result->cameras) REQUIRE(validate(camera));
      }
    }
  };
  for (const std::string& whole : {camera_list(), training_list(), transforms()})
    mutate(whole, [](const ExactCopy& copy) { return parse_camera_json(copy.text()); });
  const ExactCopy cameras(colmap_cameras_bin()), images(colmap_images_bin());
  mutate(colmap_cameras_bin(), [&](const ExactCopy& c) { return parse_colmap_binary(c.bytes(), images.bytes()); });
  mutate(colmap_images_bin(), [&](const ExactCopy& c) { return parse_colmap_binary(cameras.bytes(), c.bytes()); });
  const std::string cameras_txt = colmap_cameras_txt(), images_txt = colmap_images_txt();
  mutate(cameras_txt, [&](const ExactCopy& c) { return parse_colmap_text(c.text(), images_txt); });
  mutate(images_txt, [&](const ExactCopy& c) { return parse_colmap_text(cameras_txt, c.text()); });
}

TEST_CASE("COLMAP binary: counts beyond the file's size, trailing bytes, unknown ids, lens models") {
  const std::string good_cameras = colmap_cameras_bin(), good_images = colmap_images_bin();
  const auto parse = [](const std::string& cameras, const std::string& images) {
    const ExactCopy c(cameras), i(images);
    return parse_colmap_binary(c.bytes(), i.bytes());
  };
  for (const std::uint64_t count : {std::uint64_t{3}, std::uint64_t{0xffffffff}, std::uint64_t{1} << 32,
                                    std::uint64_t{1} << 61, ~std::uint64_t{0}}) {
    CAPTURE(count);
    std::string cameras = good_cameras, images = good_images, points = good_images;
    std::memcpy(cameras.data(), &count, 8);
    std::memcpy(images.data(), &count, 8);
    std::memcpy(points.data() + points.size() - 2 * 24 - 8, &count, 8);
    CHECK(parse(cameras, good_images).error().code == Errc::truncated);
    CHECK(parse(good_cameras, images).error().code == Errc::truncated);
    CHECK(parse(good_cameras, points).error().code == Errc::truncated);
  }
  check_error(parse(good_cameras + '\0', good_images), Errc::trailing_bytes, good_cameras.size());
  check_error(parse(good_cameras, good_images + '\0'), Errc::trailing_bytes, good_images.size());

  std::string opencv = good_cameras, twice = good_cameras, wide = good_cameras;
  opencv[12] = 4;
  check_error(parse(opencv, good_images), Errc::unsupported_feature, 8);
  CHECK(std::string(parse(opencv, good_images).error().what).find("OPENCV, which has lens distortion k1") !=
        std::string::npos);
  CHECK(parse(opencv, good_images).error().found == 0);
  opencv[12] = 99;
  check_error(parse(opencv, good_images), Errc::unsupported_feature, 8);
  twice[8 + 56] = 7;
  check_error(parse(twice, good_images), Errc::bad_value, 8 + 56);
  wide[8 + 8 + 4] = 1;  // width + 2^32
  check_error(parse(wide, good_images), Errc::bad_value, 8);

  Bytes unknown;
  unknown.put(std::uint64_t{1});
  put_image(unknown, "c", 8, 0);
  check_error(parse(good_cameras, unknown.str()), Errc::bad_value, 8);
  CHECK(parse(good_cameras, unknown.str()).error().found == 8);
  std::string no_rotation = good_images;
  std::memset(no_rotation.data() + 12, 0, 32);
  check_error(parse(good_cameras, no_rotation), Errc::bad_value, 8);
  CHECK(parse(good_cameras, Bytes().put(std::uint64_t{0}).str()).error().code == Errc::bad_value);
}

TEST_CASE("COLMAP text: the error has the byte offset") {
  const std::string images = colmap_images_txt();
  check_error(parse_colmap_text("1 OPENCV 4 4 1 1 1 1 0 0 0 0\n", images), Errc::unsupported_feature, 0);
  const auto radial = parse_colmap_text("1 PINHOLE 4 4 1 1 1 1\n2 RADIAL 4 4 1 1 1 0 0\n", images);
  REQUIRE_FALSE(radial);
  CHECK(radial.error().found == 1);
  CHECK(std::string(radial.error().what).find("RADIAL, which has lens distortion k1, k2") != std::string::npos);
  check_error(parse_colmap_text("1 MY_LENS 4 4 1 1 1 0 0\n", images), Errc::unsupported_feature, 0);
  check_error(parse_colmap_text("1 PINHOLE 4 4 1 1 1\n", images), Errc::bad_syntax, 19);
  check_error(parse_colmap_text("1 PINHOLE 4 4 1 1 1 1 1\n", images), Errc::bad_syntax, 22);
  check_error(parse_colmap_text("# x\nx PINHOLE 4 4 1 1 1 1\n", images), Errc::bad_syntax, 5);
  check_error(parse_colmap_text("1 PINHOLE 4 4 -1 1 1 1\n", images), Errc::bad_value, 0);
  check_error(parse_colmap_text("1 PINHOLE 4 4 1 1 1 1\n1 PINHOLE 4 4 1 1 1 1", images), Errc::bad_value, 22);
  check_error(parse_colmap_text(colmap_cameras_txt(), "1 1 0 0 0 0 0 0 3 a"), Errc::bad_value, 0);
  check_error(parse_colmap_text(colmap_cameras_txt(), "1 1 0 0 0 0 0 z 7 a"), Errc::bad_syntax, 15);
  check_error(parse_colmap_text(colmap_cameras_txt(), ""), Errc::bad_value, Error::kNone);
}

TEST_CASE("without a declared split every eighth camera in name order is a test camera") {
  std::string text = "[";
  for (int i = 16; i >= 0; --i)
    text += training_camera(std::string(1, static_cast<char>('a' + i))) + (i > 0 ? "," : "]");
  const auto set = parse_camera_json(text);
  REQUIRE(set);
  for (std::size_t i = 0; i < 17; ++i) CHECK((set->split[i] == Split::test) == ((16 - i) % 8 == 0));
}

TEST_CASE("a split declared of some cameras makes the others training cameras") {
  std::string text = camera_list();
  const std::string declared = "\"split\":\"train\",";
  REQUIRE(text.find(declared) != std::string::npos);
  text.erase(text.find(declared), declared.size());
  const auto set = parse_camera_json(text);
  REQUIRE(set);
  CHECK(set->split_declared);
  CHECK(set->split == std::vector{Split::test, Split::train});
}

TEST_CASE("read_cameras detects the format") {
  const TemporaryFolder folder;
  write(folder.file("anything.txt"), "\xef\xbb\xbf \n" + camera_list());
  CHECK(read_cameras(folder.file("anything.txt")).value().size() == 2);
  write(folder.file("scene.ply"), "ply\nformat");
  check_error(read_camera_set(folder.file("scene.ply")), Errc::bad_syntax, 0);
  write(folder.file("empty.json"), "  \n");
  check_error(read_camera_set(folder.file("empty.json")), Errc::truncated, 3);
  CHECK(read_cameras(folder.file("missing.json")).error().code == Errc::open_failed);
  CHECK(read_cameras(folder.path().string()).error().code == Errc::open_failed);

  for (const char* inside : {"one", "two/sparse/0", "three/sparse"}) {
    const auto model = folder.path() / inside;
    std::filesystem::create_directories(model);
    write((model / "cameras.txt").string(), colmap_cameras_txt());
    write((model / "images.txt").string(), colmap_images_txt());
    const std::string asked = (folder.path() / std::string(inside).substr(0, std::string(inside).find('/'))).string();
    CHECK(read_cameras(asked).value().size() == 2);
    write((model / "cameras.bin").string(), colmap_cameras_bin());
    write((model / "images.bin").string(), "");
    CHECK(read_cameras(asked).error().code == Errc::truncated);  // binary is preferred
  }
}
