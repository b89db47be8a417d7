// ppm_file_test.cpp - PPM pictures: valid ones are read, others refused at the right byte.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <memory>
#include <span>
#include <string>

#include "ppm_file.hpp"
#include "temporary_folder.hpp"

namespace {

using rgs::Errc;
using rgs::bench::parse_ppm;

// From an exact-size heap copy, so that a sanitizer detects any overread.
rgs::Result<rgs::Image> parse(const std::string& text) {
  const auto copy = std::make_unique<std::byte[]>(text.size());
  std::memcpy(copy.get(), text.data(), text.size());
  return parse_ppm({copy.get(), text.size()});
}

void refused(const std::string& text, Errc code, std::uint64_t offset) {
  CAPTURE(text);
  const auto image = parse(text);
  REQUIRE_FALSE(image);
  CHECK(image.error().code == code);
  CHECK(image.error().offset == offset);
}

}  // namespace

TEST_CASE("PPM pixels are codes over 255, row by row") {
  const auto image = parse(std::string("P6\n2 1\n255\n\x00\x33\xff\x66\x99\xcc", 17));
  REQUIRE(image);
  CHECK(image->width == 2);
  CHECK(image->height == 1);
  CHECK(image->channels == 3);
  CHECK(image->at(0, 0, 1) == 0.2F);
  CHECK(image->at(0, 0, 2) == 1);
  CHECK(image->at(1, 0, 2) == 0.8F);
}

TEST_CASE("a PPM header may hold comments and any white space, and pixels may look like them") {
  const auto image = parse("P6 # made by\r\n# 7 7\n\t\v1\f# width above\n1\r255\n##\n");
  REQUIRE(image);
  CHECK(image->at(0, 0, 0) == 35.0F / 255.0F);
  CHECK(image->at(0, 0, 2) == 10.0F / 255.0F);
}

TEST_CASE("damaged PPM pictures are refused at the damage") {
  refused("", Errc::bad_magic, 0);
  refused("P5 1 1 255 abc", Errc::bad_magic, 0);
  refused("P61 1 255 abc", Errc::bad_syntax, 2);
  refused("P6 0 1 255 abc", Errc::bad_syntax, 3);
  refused("P6 -1 1 255 abc", Errc::bad_syntax, 3);
  refused("P6 1 65537 255 abc", Errc::bad_syntax, 5);
  refused("P6 1 99999999999 255 abc", Errc::bad_syntax, 5);
  refused("P6 1 x 255 abc", Errc::bad_syntax, 5);
  refused("P6 1 1 65535 abcdef", Errc::unsupported_feature, 12);
  refused("P6 1 1 255", Errc::bad_syntax, 10);
  refused("P6 1 1 255#abc", Errc::bad_syntax, 10);
  refused("P6 65536 65536 255 abc", Errc::truncated, 22);
  refused("P6 1 1 255 abcd", Errc::trailing_bytes, 14);
}

TEST_CASE("every prefix of a PPM picture is refused") {
  const std::string whole = "P6 # c\n2 2\n255\nabcdefghijkl";
  REQUIRE(parse(whole));
  for (std::size_t n = 0; n < whole.size(); ++n) CHECK_FALSE(parse(whole.substr(0, n)));
}

TEST_CASE("PPM files are read from disk") {
  const rgs::test::TemporaryFolder folder;
  std::ofstream(folder.file("a.ppm"), std::ios::binary) << "P6 1 1 255 abc";
  CHECK(rgs::bench::read_ppm(folder.file("a.ppm")));
  const auto missing = rgs::bench::read_ppm(folder.file("b.ppm"));
  REQUIRE_FALSE(missing);
  CHECK(missing.error().code == Errc::open_failed);
}
