// image_file_test.cpp - pictures survive a round trip through every format, with the documented rounding and metadata.
// SPDX-License-Identifier: Apache-2.0
#include "image_file.hpp"

#include <doctest/doctest.h>
#include <png.h>
#include <turbojpeg.h>
#include <zlib.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <limits>
#include <random>
#include <string>
#include <vector>

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

std::string big_endian(std::uint64_t value, int n_bytes) {
  std::string bytes;
  for (int i = n_bytes - 1; i >= 0; --i) bytes += static_cast<char>(value >> 8 * i & 0xFF);
  return bytes;
}

std::string chunk(const std::string& type, const std::string& data) {
  const std::string body = type + data;
  const auto crc = ::crc32(0, reinterpret_cast<const Bytef*>(body.data()), static_cast<uInt>(body.size()));
  return big_endian(data.size(), 4) + body + big_endian(crc, 4);
}

// A PNG of `rows`, each behind the byte of its filter; `between` are chunks before them.
std::string png(unsigned width, unsigned height, unsigned depth, unsigned colour, const std::string& rows,
                const std::string& between = {}, unsigned interlaced = 0) {
  uLongf size = ::compressBound(rows.size());
  std::string coded(size, '\0');
  REQUIRE(::compress(reinterpret_cast<Bytef*>(coded.data()), &size, reinterpret_cast<const Bytef*>(rows.data()),
                     rows.size()) == Z_OK);
  coded.resize(size);
  const std::string head = big_endian(width, 4) + big_endian(height, 4) + big_endian(depth, 1) + big_endian(colour, 1) +
                           std::string(2, '\0') + big_endian(interlaced, 1);
  return "\x89PNG\r\n\x1A\n" + chunk("IHDR", head) + between + chunk("IDAT", coded) + chunk("IEND", "");
}

Result<Image> read_bytes(const std::string& bytes) {
  const TemporaryFolder folder;
  std::ofstream(folder.file("picture"), std::ios::binary) << bytes;
  const auto image = read_image(folder.file("picture"));
  const auto extent = read_image_extent(folder.file("picture"));
  if (image) {
    REQUIRE(extent);
    CHECK(std::array{extent->width, extent->height, extent->channels} ==
          std::array{image->width, image->height, image->channels});
  }
  return image;
}

using Values = std::vector<float>;

// Of 0 to 255.
Values codes_of(const Result<Image>& image) {
  REQUIRE(image);
  Values codes = image->pixels;
  for (float& v : codes) v *= 255;
  return codes;
}

void check_near(const Values& found, const Values& expected) {
  REQUIRE(found.size() == expected.size());
  for (std::size_t i = 0; i < found.size(); ++i) CHECK(found[i] == doctest::Approx(expected[i]));
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

TEST_CASE("PNG of every kind is read") {
  const std::string palette = chunk("PLTE", std::string("\x0A\x14\x1E\x28\x32\x3C", 6));
  constexpr unsigned kGrey = 0, kRgb = 2, kPalette = 3, kGreyAlpha = 4, kRgba = 6;
  using namespace std::string_literals;
  check_near(codes_of(read_bytes(png(3, 1, 1, kGrey, "\0\xA0"s))), {255, 0, 255});
  check_near(codes_of(read_bytes(png(2, 1, 2, kGrey, "\0\x60"s))), {85, 170});
  check_near(codes_of(read_bytes(png(1, 1, 16, kGrey, "\0\x01\x02"s))), {258.F / 257});
  check_near(codes_of(read_bytes(png(1, 2, 8, kRgb, "\0\x01\x02\x03\2\x01\x01\x01"s))), {1, 2, 3, 2, 3, 4});
  check_near(codes_of(read_bytes(png(2, 1, 1, kPalette, "\0\x40"s, palette))), {10, 20, 30, 40, 50, 60});
  // Transparent colours make a channel; colour is multiplied by it, and not rounded.
  check_near(codes_of(read_bytes(png(2, 1, 1, kPalette, "\0\x40"s, palette + chunk("tRNS", "\x33")))),
             {2, 4, 6, 51, 40, 50, 60, 255});
  check_near(codes_of(read_bytes(png(2, 1, 8, kGrey, "\0\x07\x09"s, chunk("tRNS", "\0\x07"s)))), {0, 0, 9, 255});
  check_near(codes_of(read_bytes(png(1, 1, 8, kGreyAlpha, "\0\x64\x80"s))), {100 * 128 / 255.F, 128});
  // No transfer curve is applied, whatever the file says.
  const std::string linear = chunk("gAMA", big_endian(100000, 4));
  check_near(codes_of(read_bytes(png(1, 1, 8, kRgba, "\0\x64\x32\xFF\x33"s, linear))), {20, 10, 51, 51});
  // The seven passes of a picture of 3 x 3; the second and third are empty.
  const std::string passes = "\0\1\0\3\0\x07\x09\0\2\0\x08\0\4\5\6"s;
  check_near(codes_of(read_bytes(png(3, 3, 8, kGrey, passes, {}, 1))), {1, 2, 3, 4, 5, 6, 7, 8, 9});
}

TEST_CASE("JPEG of CMYK and grey is read") {
  const std::array<unsigned char, 4> inks{200, 100, 50, 128};
  for (const int format : {TJPF_CMYK, TJPF_GRAY}) {
    const tjhandle turbo = tjInitCompress();
    unsigned char* bytes = nullptr;
    unsigned long size = 0;
    REQUIRE(tjCompress2(turbo, inks.data(), 1, 0, 1, format, &bytes, &size,
                        format == TJPF_GRAY ? TJSAMP_GRAY : TJSAMP_444, 100, 0) == 0);
    const Values found = codes_of(read_bytes({reinterpret_cast<char*>(bytes), size}));
    tjFree(bytes);
    tjDestroy(turbo);
    const Values expected =
        format == TJPF_GRAY ? Values{200} : Values{200 * 128 / 255.F, 100 * 128 / 255.F, 50 * 128 / 255.F};
    REQUIRE(found.size() == expected.size());
    for (std::size_t i = 0; i < found.size(); ++i) CHECK(std::abs(found[i] - expected[i]) < 2);
  }
}

TEST_CASE("a picture that ends early is an error at every byte") {
  for (const ImageFormat format : {ImageFormat::png, ImageFormat::jpeg}) {
    const auto bytes = encode_image(picture(9, 5, 3), format);
    REQUIRE(bytes);
    const std::string whole(reinterpret_cast<const char*>(bytes->data()), bytes->size());
    REQUIRE(read_bytes(whole));
    // What comes behind the last pixels of a PNG is not read: a checksum and an empty chunk.
    const std::size_t end = format == ImageFormat::png ? whole.size() - 16 : whole.size();
    for (std::size_t n = 0; n < end; ++n) {
      CAPTURE(n);
      const auto cut = read_bytes(whole.substr(0, n));
      REQUIRE_FALSE(cut);
      CHECK(exit_code(cut.error().code) == 4);
    }
  }
}

TEST_CASE("a JPEG may have something behind it, but nothing missing in its middle") {
  const auto bytes = encode_image(picture(64, 64, 3), ImageFormat::jpeg);
  REQUIRE(bytes);
  const std::string whole(reinterpret_cast<const char*>(bytes->data()), bytes->size());
  // A film's bytes may look like markers.
  CHECK(codes_of(read_bytes(whole + "film \xFF\xDA\xFF\xD9 and on")) == codes_of(read_bytes(whole)));
  const std::size_t scan = whole.rfind("\xFF\xDA"), half = (whole.size() - scan) / 2;
  const auto cut = read_bytes(whole.substr(0, scan + half) + whole.substr(whole.size() - 2));
  REQUIRE_FALSE(cut);
  CHECK(cut.error().code == Errc::corrupt_data);
}

TEST_CASE("a picture larger than its bytes can hold is refused before memory is taken") {
  CHECK(read_bytes(png(1U << 30, 1U << 30, 16, 6, std::string(100, '\0'))).error().code == Errc::corrupt_data);
  const auto bytes = encode_image(picture(9, 5, 3), ImageFormat::jpeg);
  REQUIRE(bytes);
  std::string huge(reinterpret_cast<const char*>(bytes->data()), bytes->size());
  const std::size_t frame = huge.find("\xFF\xC0");
  REQUIRE(frame != huge.npos);
  huge.replace(frame + 5, 4, "\xFF\x00\xFF\x00", 4);
  CHECK(read_bytes(huge).error().code == Errc::corrupt_data);
  // What its bytes could hold may still be too much for a memory.
  CHECK(read_bytes(png(20000, 20000, 1, 0, std::string(50'000'000, '\0'))).error().code == Errc::limit_exceeded);
}
