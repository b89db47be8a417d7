// cameras_file_test.cpp - every camera format describes the same camera; damaged files cause an error with its place.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <glm/geometric.hpp>
#include <glm/gtc/type_ptr.hpp>
#include <iterator>
#include <memory>
#include <nlohmann/json.hpp>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "checkout.hpp"
#include "rgs/camera_file.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;
namespace fs = std::filesystem;

namespace {

// expected.json: of each file or folder, its cameras or its error. The web page reads those without "page".
const std::string kGolden = source_dir() + "/tests/golden/cameras/";

std::string golden(const std::string& name) {
  std::ifstream in(kGolden + name, std::ios::binary);
  REQUIRE(in);
  return {std::istreambuf_iterator<char>(in), {}};
}

std::string colmap_cameras_bin() {
  return golden("colmap_binary/cameras.bin");
}
std::string colmap_images_bin() {
  return golden("colmap_binary/images.bin");
}
std::string colmap_cameras_txt() {
  return golden("colmap_text/cameras.txt");
}
std::string colmap_images_txt() {
  return golden("colmap_text/images.txt");
}

// A heap copy of the first `size` bytes without slack, so that AddressSanitizer detects any overread.
class ExactCopy {
 public:
  ExactCopy(const std::string& source, std::size_t size) : data_(new std::byte[size]), size_(size) {
    if (size > 0) std::memcpy(data_.get(), source.data(), size);
  }
  explicit ExactCopy(const std::string& source) : ExactCopy(source, source.size()) {}
  std::span<const std::byte> bytes() const { return {data_.get(), size_}; }
  std::string_view text() const { return {reinterpret_cast<const char*>(data_.get()), size_}; }

 private:
  std::unique_ptr<std::byte[]> data_;
  std::size_t size_;
};

void check_error(const Result<CameraSet>& result, Errc code, std::uint64_t offset) {
  REQUIRE_FALSE(result);
  CHECK(std::string(errc_name(result.error().code)) == errc_name(code));
  CHECK(result.error().offset == offset);
  CHECK(std::string(result.error().what) != "");
}

}  // namespace

TEST_CASE("camera files give what they should") {
  const auto all = nlohmann::json::parse(golden("expected.json"));
  for (const auto& [file, expected] : all.items()) {
    const std::string name = file;
    CAPTURE(name);
    const auto set = read_camera_set(kGolden + name);
    if (expected.contains("code")) {
      REQUIRE_FALSE(set);
      CHECK(errc_name(set.error().code) == expected["code"]);
      CHECK(set.error().offset ==
            (expected["offset"].is_null() ? Error::kNone : expected["offset"].get<std::uint64_t>()));
      if (expected.contains("camera")) CHECK(set.error().found == expected["camera"]);
      CHECK(std::string(set.error().what) != "");
      continue;
    }
    REQUIRE(set);
    REQUIRE(set->cameras.size() == expected["cameras"].size());
    CHECK(set->split_declared == expected.value("declared", false));
    const auto source = name.starts_with("training")     ? CameraSet::Source::training
                        : name.starts_with("transforms") ? CameraSet::Source::transforms
                        : name.starts_with("colmap")     ? CameraSet::Source::colmap
                                                         : CameraSet::Source::list;
    CHECK(set->source == source);
    for (std::size_t i = 0; i < set->cameras.size(); ++i) {
      const Camera& camera = set->cameras[i];
      const auto& wanted = expected["cameras"][i];
      CHECK(camera.name == wanted["name"]);
      CHECK((set->split[i] == Split::test) == wanted["test"]);
      CHECK(camera.width == wanted["width"]);
      CHECK(camera.height == wanted["height"]);
      const double lens[] = {camera.fx, camera.fy, camera.cx, camera.cy};
      constexpr const char* kLens[] = {"fx", "fy", "cx", "cy"};
      CHECK(std::string(camera_model_name(camera.model)) == wanted.value("model", "pinhole"));
      CHECK(camera.distortion == wanted.value("distortion", decltype(camera.distortion){}));
      for (int k = 0; k < 4; ++k) CHECK(lens[k] == doctest::Approx(wanted[kLens[k]].get<double>()).epsilon(1e-14));
      using Numbers = std::array<double, 3>;
      const auto rows = wanted["rotation"].get<std::array<Numbers, 3>>();
      CHECK(glm::distance(camera_centre(camera), glm::make_vec3(wanted["position"].get<Numbers>().data())) < 1e-12);
      for (std::size_t axis = 0; axis < 3; ++axis) {
        const glm::dvec3 column(rows[0][axis], rows[1][axis], rows[2][axis]);
        CHECK(glm::distance(camera_axis(camera, static_cast<int>(axis)), column) < 1e-12);
      }
    }
  }
}

TEST_CASE("transforms.json: a coefficient is one of the model's, or the file is refused") {
  const auto parsed = [](const std::string& fields) {
    std::string file = golden("transforms.json");
    return parse_camera_json(file.replace(file.find(R"("k1":0)"), 6, fields));
  };
  struct Case {
    std::string model;
    std::string_view has;
  };
  const Case cases[] = {{"", "k1 k2 k3 p1 p2"},
                        {R"("camera_model":"PINHOLE",)", "k1 k2 k3 p1 p2"},
                        {R"("camera_model":"OPENCV",)", "k1 k2 k3 p1 p2"},
                        {R"("camera_model":"OPENCV_FISHEYE",)", "k1 k2 k3 k4"},
                        {R"("is_fisheye":true,)", "k1 k2 k3 k4"},
                        {R"("camera_model":"EQUIRECTANGULAR",)", ""}};
  for (const Case& of : cases) {
    for (const std::string key : {"k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"}) {
      CAPTURE(of.model);
      CAPTURE(key);
      const auto set = parsed(of.model + "\"" + key + "\":-1e-9");
      CHECK(set.has_value() == (of.has.find(key) != std::string_view::npos));
      if (set) CHECK(set->cameras[0].model != CameraModel::pinhole);
      if (set) continue;
      CHECK(set.error().code == Errc::unsupported_feature);
      CHECK(set.error().found == 0);  // the first frame
    }
  }
  CHECK(parsed(R"("camera_model":"OPENCV")")->cameras[0].model == CameraModel::pinhole);
  CHECK(parsed(R"("camera_model":"FISHEYE624")").error().code == Errc::unsupported_feature);
  // 500.5 px over an angle of pi; the circle is wider than the picture.
  CHECK(parsed(R"("camera_model":"EQUIRECTANGULAR")")->cameras[0].fx == doctest::Approx(500.5 / 3.14159265358979));
  std::string angle = golden("transforms_angle.json");
  angle.insert(1, R"("camera_model":"OPENCV_FISHEYE",)");
  CHECK(parse_camera_json(angle).error().code == Errc::bad_syntax);
}

TEST_CASE("JSON that ends in the hundred-thousandth list is truncated") {
  check_error(parse_camera_json(std::string(100'000, '[')), Errc::truncated, 100'000);
}

TEST_CASE("every prefix of every format is refused without reading past its end") {
  for (const std::string& whole : {golden("list.json"), golden("training.json"), golden("transforms.json")}) {
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
  for (const std::string& whole : {golden("list.json"), golden("training.json"), golden("transforms.json")})
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
  for (const char model : {'\x07', '\x0a'}) {
    opencv[12] = model;
    check_error(parse(opencv, good_images), Errc::unsupported_feature, 8);
    CHECK(std::string(parse(opencv, good_images).error().what).find("image_undistorter") != std::string::npos);
    CHECK(parse(opencv, good_images).error().found == 0);
  }
  opencv[12] = 99;
  check_error(parse(opencv, good_images), Errc::unsupported_feature, 8);
  twice[8 + 56] = 7;
  check_error(parse(twice, good_images), Errc::bad_value, 8 + 56);
  wide[8 + 8 + 4] = 1;  // width + 2^32
  check_error(parse(wide, good_images), Errc::bad_value, 8);

  std::string unknown = good_images;
  unknown[8 + 4 + 7 * 8] = 8;  // the first image's camera
  check_error(parse(good_cameras, unknown), Errc::bad_value, 8);
  CHECK(parse(good_cameras, unknown).error().found == 8);
  std::string no_rotation = good_images;
  std::memset(no_rotation.data() + 12, 0, 32);
  check_error(parse(good_cameras, no_rotation), Errc::bad_value, 8);
  CHECK(parse(good_cameras, std::string(8, '\0')).error().code == Errc::bad_value);
}

TEST_CASE("COLMAP binary: lenses are what the text says") {
  struct Lens {
    std::uint32_t model;
    std::vector<double> parameters;
  };
  const std::vector<Lens> lenses{{2, {500.5, 310, 240, 0.1}},
                                 {3, {500.5, 310, 240, 0.1, -0.02}},
                                 {4, {500.5, 501.5, 310, 240, 0.1, -0.02, 0.001, -0.002}},
                                 {5, {500.5, 501.5, 310, 240, 0.1, -0.02, 0.003, -0.0004}},
                                 {6, {500.5, 501.5, 310, 240, 0.1, -0.02, 0.001, -0.002, 0.003, 0.004, 0.005, 0.006}},
                                 {8, {500.5, 310, 240, 0.1}},
                                 {9, {500.5, 310, 240, 0.1, -0.02}},
                                 {3, {500.5, 310, 240, 0, 0}}};
  std::string cameras, images;
  const auto put = [](std::string& out, const auto& value) {
    out.append(reinterpret_cast<const char*>(&value), sizeof(value));
  };
  put(cameras, std::uint64_t{lenses.size()});
  put(images, std::uint64_t{lenses.size()});
  for (std::uint32_t i = 0; i < lenses.size(); ++i) {
    put(cameras, i);
    put(cameras, lenses[i].model);
    put(cameras, std::uint64_t{640});
    put(cameras, std::uint64_t{480});
    for (const double value : lenses[i].parameters) put(cameras, value);
    put(images, i);
    for (const double value : {1., 0., 0., 0., 0., 0., 0.}) put(images, value);
    put(images, i);
    images += static_cast<char>('a' + i);
    images += std::string(1 + 8, '\0');
  }
  const auto read = parse_colmap_binary(ExactCopy(cameras).bytes(), ExactCopy(images).bytes());
  const auto text = read_camera_set(kGolden + "colmap_lenses");
  REQUIRE(read);
  REQUIRE(text);
  REQUIRE(read->cameras.size() == text->cameras.size());
  for (std::size_t i = 0; i < lenses.size(); ++i) {
    const Camera &a = read->cameras[i], &b = text->cameras[i];
    CHECK(a.model == b.model);
    CHECK(a.distortion == b.distortion);
    CHECK((a.fx == b.fx && a.fy == b.fy && a.cx == b.cx && a.cy == b.cy));
  }
}

TEST_CASE("what bends a camera's rays is read or refused wherever it stands") {
  const auto transforms = [](const std::string& fields) {
    return parse_camera_json(R"({"w": 8, "h": 4, "frames": [{"transform_matrix":
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], )" +
                             fields + "}]}");
  };
  const auto lens = [&](const std::string& fields) {
    const auto set = transforms(fields);
    REQUIRE(set);
    return set->cameras.front();
  };
  const auto code = [&](const std::string& fields) {
    const auto set = transforms(fields);
    return set ? Errc::internal : set.error().code;
  };
  const std::string focal = R"("fl_x": 5, "fl_y": 6)";
  const Camera listed = lens(focal + R"(, "camera_model": "OPENCV", "k1": 9, "distortion_params": [1, 2, 3, 0, 5, 6])");
  CHECK(listed.distortion == std::array<double, 8>{1, 2, 5, 6, 3});
  const Camera fisheye = lens(focal + R"(, "is_fisheye": true, "distortion_params": [1, 2, 3, 4, 0, 0])");
  CHECK(fisheye.model == CameraModel::opencv_fisheye);
  CHECK(fisheye.distortion == std::array<double, 8>{1, 2, 3, 4});
  CHECK(code(focal + R"(, "camera_model": "OPENCV", "distortion_params": [0, 0, 0, 1, 0, 0])") ==
        Errc::unsupported_feature);
  CHECK(code(focal + R"(, "is_fisheye": true, "distortion_params": [0, 0, 0, 0, 1, 0])") == Errc::unsupported_feature);
  CHECK(code(focal + R"(, "distortion_params": [0, 0])") == Errc::bad_syntax);
  CHECK(code(focal + R"(, "camera_model": "FISHEYE624", "is_fisheye": true)") == Errc::unsupported_feature);
  CHECK(code(focal + R"(, "is_fisheye": 1)") == Errc::bad_syntax);

  // A fisheye needs one focal length; angles are a pinhole's.
  CHECK(lens(R"("camera_model": "OPENCV_FISHEYE", "fl_x": 5, "camera_angle_y": 1)").fy == 5);
  CHECK(code(R"("camera_model": "OPENCV_FISHEYE", "camera_angle_x": 1)") == Errc::bad_syntax);
  const Camera panorama = lens(R"("camera_model": "EQUIRECTANGULAR", "fl_x": 5)");
  CHECK(panorama.fy == panorama.fx);

  const auto training = [](const std::string& fields) {
    return parse_camera_json(R"([{"width": 8, "height": 4, "fx": 5, "fy": 6, "position": [0, 0, 0],
        "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]])" +
                             fields + "}]");
  };
  const auto bent = training(R"(, "model": "opencv", "distortion": [0.5])");
  REQUIRE(bent);
  CHECK(bent->cameras.front().model == CameraModel::opencv);
  CHECK(bent->cameras.front().distortion[0] == 0.5);
  CHECK_FALSE(training(R"(, "distortion": [0.5])"));
  const auto plain = training(R"(, "model": "opencv", "distortion": [0, 0])");
  REQUIRE(plain);
  CHECK(plain->cameras.front().model == CameraModel::pinhole);
}

TEST_CASE("COLMAP text: the error has the byte offset") {
  const std::string images = colmap_images_txt();
  const auto fov = parse_colmap_text("1 PINHOLE 4 4 1 1 1 1\n2 FOV 4 4 1 1 1 1 0\n", images);
  REQUIRE_FALSE(fov);
  CHECK(fov.error().code == Errc::unsupported_feature);
  CHECK(fov.error().found == 1);
  CHECK(std::string(fov.error().what).find("model FOV") != std::string::npos);
  check_error(parse_colmap_text("1 OPENCV 4 4 1 1 1 1 0 0 0\n", images), Errc::bad_syntax, 26);
  check_error(parse_colmap_text("1 OPENCV 4 4 1 1 1 1 0 0 0 1e999\n", images), Errc::bad_syntax, 32);
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

TEST_CASE("a COLMAP model is found in its folder, the binary one first") {
  const TemporaryFolder folder;
  CHECK(read_cameras(folder.file("missing.json")).error().code == Errc::open_failed);
  CHECK(read_cameras(folder.path().string()).error().code == Errc::open_failed);

  for (const char* inside : {"one", "two/sparse/0", "three/sparse"}) {
    const fs::path model = folder.path() / inside;
    fs::create_directories(model);
    for (const char* name : {"cameras.txt", "images.txt"}) fs::copy_file(kGolden + "colmap_text/" + name, model / name);
    const std::string asked = (folder.path() / std::string(inside).substr(0, std::string(inside).find('/'))).string();
    CHECK(read_cameras(asked).value().size() == 2);
    fs::copy_file(kGolden + "colmap_binary/cameras.bin", model / "cameras.bin");
    std::ofstream((model / "images.bin").string());
    CHECK(read_cameras(asked).error().code == Errc::truncated);  // binary is preferred
  }
}
