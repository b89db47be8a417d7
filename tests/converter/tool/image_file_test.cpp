// image_file_test.cpp - pictures survive a round trip through every format, with the documented rounding and metadata.
// SPDX-License-Identifier: Apache-2.0
#include "image_file.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <limits>
#include <random>

#include "temporary_folder.hpp"

using namespace rgs;
using rgs::test::TemporaryFolder;

namespace {

// Smooth enough for JPEG; some values are outside 0..1.
Image picture(int width, int height, int channels) {
  Image image = Image::make(width, height, channels);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < channels; ++c)
        image.at(x, y, c) = c == 3 ? 0.25F + 0.5F * static_cast<float>(x) / static_cast<float>(width)
                                   : 0.2F * static_cast<float>(c) - 0.1F +
                                         0.9F * static_cast<float>(x + y) / static_cast<float>(width + height);
  if (channels == 4)
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x)
        for (int c = 0; c < 3; ++c) image.at(x, y, c) = std::clamp(image.at(x, y, c), 0.F, 1.F) * image.at(x, y, 3);
  return image;
}

std::string contents(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

// "2025:" as dates in pictures start.
std::string year() {
  const std::time_t now = std::time(nullptr);
  return std::to_string(1900 + std::gmtime(&now)->tm_year) + ":";
}

float largest_difference(const Image& a, const Image& b) {
  REQUIRE(a.width == b.width);
  REQUIRE(a.height == b.height);
  REQUIRE(a.channels == b.channels);
  float largest = 0;
  for (std::size_t i = 0; i < a.pixels.size(); ++i) largest = std::max(largest, std::abs(a.pixels[i] - b.pixels[i]));
  return largest;
}

Image rounded(const Image& image) {
  Image out = image;
  for (float& v : out.pixels) v = static_cast<float>(to_8bit(v)) / 255.F;
  return out;
}

}  // namespace

TEST_CASE("8-bit rounding") {
  CHECK(to_8bit(-1) == 0);
  CHECK(to_8bit(0.499F / 255) == 0);
  CHECK(to_8bit(0.5F / 255) == 1);
  CHECK(to_8bit(254.4F / 255) == 254);
  CHECK(to_8bit(254.6F / 255) == 255);
  CHECK(to_8bit(1) == 255);
  CHECK(to_8bit(std::numeric_limits<float>::infinity()) == 255);
  CHECK(to_8bit(std::numeric_limits<float>::quiet_NaN()) == 0);
  for (int i = 0; i < 256; ++i) CHECK(to_8bit(static_cast<float>(i) / 255.F) == i);
}

TEST_CASE("the extension chooses the format") {
  CHECK(image_format("a/b.PNG").value() == ImageFormat::png);
  CHECK(image_format("b.jpg").value() == ImageFormat::jpeg);
  CHECK(image_format("b.jpeg").value() == ImageFormat::jpeg);
  CHECK(image_format("b.tif").value() == ImageFormat::tiff);
  CHECK(image_format("b.tiff").value() == ImageFormat::tiff);
  CHECK(image_format("b.x.exr").value() == ImageFormat::exr);
  for (const char* bad : {"b", "png", "b.bmp", "b.png/", ""})
    CHECK(image_format(bad).error().code == Errc::bad_argument);
}

TEST_CASE("round trips: 8-bit codes exactly, EXR bit by bit, JPEG nearly") {
  const TemporaryFolder folder;
  for (const int channels : {1, 3, 4}) {
    for (const auto& [width, height] : {std::pair{1, 1}, {67, 45}}) {
      const Image image = picture(width, height, channels);
      for (const char* name : {"a.png", "a.tif", "a.exr", "a.jpg"}) {
        CAPTURE(name);
        CAPTURE(channels);
        if (channels == 4 && std::string(name) == "a.jpg") continue;
        const std::string path = folder.file(name);
        REQUIRE(write_image(path, image, {.file = {.overwrite = true, .sync = false}}));
        const auto back = read_image(path);
        REQUIRE(back);
        if (std::string(name) == "a.exr") {
          CHECK(back->pixels == image.pixels);
        } else if (std::string(name) == "a.jpg") {
          CHECK(largest_difference(*back, rounded(image)) < 0.03F);
        } else if (channels == 4 && std::string(name) == "a.png") {
          CHECK(largest_difference(*back, rounded(image)) <= 2.01F / 255);  // colour is stored divided by alpha
        } else {
          CHECK(largest_difference(*back, rounded(image)) < 1e-6F);
        }
      }
    }
  }
}

TEST_CASE("PNG holds colour divided by alpha, rounded once") {
  const TemporaryFolder folder;
  Image image = Image::make(1, 1, 4);
  image.pixels = {0.05F, 0.1F, 0, 0.1F};
  REQUIRE(write_image(folder.file("a.png"), image));
  const auto back = read_image(folder.file("a.png"));  // multiplied again: 128/255 * 26/255
  REQUIRE(back);
  CHECK(back->pixels[3] == doctest::Approx(26.0 / 255));
  CHECK(back->pixels[1] == doctest::Approx(26.0 / 255).epsilon(0.02));
  CHECK(back->pixels[0] == doctest::Approx(13.05 / 255).epsilon(0.04));
}

TEST_CASE("EXR and TIFF keep depth; other formats refuse it") {
  const TemporaryFolder folder;
  Image depth = Image::make(9, 7, 1);
  std::mt19937 generator(5);
  for (float& v : depth.pixels) v = std::uniform_real_distribution<float>(0, 1e5F)(generator);
  for (const char* name : {"d.exr", "d.tif"}) {
    REQUIRE(write_image(folder.file(name), depth, {.depth = true}));
    CHECK(read_image(folder.file(name)).value().pixels == depth.pixels);
  }
  CHECK(contents(folder.file("d.exr")).find("Z") != std::string::npos);
  CHECK(write_image(folder.file("d.png"), depth, {.depth = true}).error().code == Errc::bad_argument);
  CHECK(write_image(folder.file("d.jpg"), depth, {.depth = true}).error().code == Errc::bad_argument);
  CHECK(write_image(folder.file("e.exr"), picture(2, 2, 3), {.depth = true}).error().code == Errc::bad_argument);
}

TEST_CASE("pictures declare sRGB and have the same bytes every time") {
  const TemporaryFolder folder;
  const Image image = picture(64, 32, 3);
  for (const char* extension : {".png", ".jpg", ".tif", ".exr"}) {
    const std::string a = folder.file(std::string("a") + extension), b = folder.file(std::string("b") + extension);
    REQUIRE(write_image(a, image, {.software = "rgs-test 1.2"}));
    REQUIRE(write_image(b, image, {.software = "rgs-test 1.2"}));
    CHECK(contents(a) == contents(b));
    CAPTURE(extension);
    CHECK(contents(a).find(year()) == std::string::npos);
    CHECK(contents(a).find("rgs-test 1.2") != std::string::npos);
    CHECK(contents(a).find("Display-referred sRGB") != std::string::npos);
  }
  CHECK(contents(folder.file("a.png")).find("sRGB") < 100);  // the chunk, not the description
}

TEST_CASE("existing pictures stay unless overwriting is requested; failures leave nothing behind") {
  const TemporaryFolder folder;
  const std::string path = folder.file("a.png");
  REQUIRE(write_image(path, picture(2, 2, 3)));
  const std::string before = contents(path);
  CHECK(write_image(path, picture(3, 3, 3)).error().code == Errc::output_exists);
  CHECK(contents(path) == before);
  CHECK(write_image(path, picture(3, 3, 3), {.file = {.overwrite = true, .sync = false}}));
  CHECK(contents(path) != before);
  CHECK(write_image(folder.file("b.jpg"), picture(3, 3, 4)).error().code == Errc::bad_argument);
  CHECK(write_image(folder.file("none/b.jpg"), picture(3, 3, 3)).error().code == Errc::write_failed);
  CHECK(write_image(folder.file("wide.jpg"), Image::make(65536, 1, 3)).error().code == Errc::bad_argument);
  CHECK(std::distance(std::filesystem::directory_iterator(folder.path()), {}) == 1);
}

TEST_CASE("reading a missing file or no picture is an error") {
  const TemporaryFolder folder;
  CHECK(read_image(folder.file("none.png")).error().code == Errc::open_failed);
  std::ofstream(folder.file("text.png")) << "not a picture";
  CHECK(read_image(folder.file("text.png")).error().code == Errc::bad_syntax);
  REQUIRE(write_image(folder.file("a.exr"), picture(40, 40, 3)));
  const std::string whole = contents(folder.file("a.exr"));
  std::ofstream(folder.file("cut.exr"), std::ios::binary) << whole.substr(0, whole.size() / 2);
  CHECK(read_image(folder.file("cut.exr")).error().code == Errc::bad_syntax);
}

TEST_CASE("a picture in memory equals the written file") {
  const TemporaryFolder folder;
  const Image image = picture(61, 43, 3);
  const auto check = [&](ImageFormat format, const std::string& name) {
    const auto bytes = encode_image(image, format);
    REQUIRE(bytes);
    REQUIRE(write_image(folder.file(name), image));
    const std::string written = contents(folder.file(name));
    CHECK(written == std::string(reinterpret_cast<const char*>(bytes->data()), bytes->size()));
    CHECK(largest_difference(read_image(folder.file(name)).value(), rounded(image)) < 0.05F);
  };
  check(ImageFormat::png, "a.png");
  check(ImageFormat::jpeg, "a.jpg");
  CHECK(encode_image(image, ImageFormat::jpeg, {.jpeg_quality = 30})->size() <
        encode_image(image, ImageFormat::jpeg)->size());
  REQUIRE(write_image(folder.file("quick.png"), image, {.png_level = 0}));
  CHECK(contents(folder.file("quick.png")).size() > contents(folder.file("a.png")).size());
  CHECK(read_image(folder.file("quick.png")).value().pixels == read_image(folder.file("a.png")).value().pixels);
  CHECK(encode_image(image, ImageFormat::tiff).error().code == Errc::bad_argument);
  CHECK(encode_image(image, ImageFormat::exr).error().code == Errc::bad_argument);
  CHECK(encode_image(picture(8, 8, 4), ImageFormat::jpeg).error().code == Errc::bad_argument);
  CHECK(encode_image(Image::make(8, 8, 2), ImageFormat::png).error().code == Errc::bad_argument);
}

TEST_CASE("a picture's size can be read without its pixels") {
  const TemporaryFolder folder;
  REQUIRE(write_image(folder.file("a.jpg"), picture(61, 43, 3)));
  const auto extent = read_image_extent(folder.file("a.jpg"));
  REQUIRE(extent);
  CHECK(extent->width == 61);
  CHECK(extent->height == 43);
  CHECK(extent->channels == 3);
  CHECK(read_image_extent(folder.file("b.jpg")).error().code == Errc::open_failed);
  std::ofstream(folder.file("c.png")) << "text";
  CHECK(read_image_extent(folder.file("c.png")).error().code == Errc::bad_syntax);
}
