// byte_range_test.cpp - which bytes a field Range asks for. SPDX-License-Identifier: Apache-2.0
#include "byte_range.hpp"

#include <doctest/doctest.h>

#include <cstdint>
#include <string>

using rgs::view::ByteRange;
using rgs::view::parse_range;

namespace {

constexpr std::uint64_t kSize = 1000;
constexpr ByteRange kWhole{ByteRange::Kind::whole, 0, kSize}, kNone{ByteRange::Kind::unsatisfiable, 0, 0};

ByteRange part(std::uint64_t first, std::uint64_t count) {
  return {ByteRange::Kind::part, first, count};
}

}  // namespace

TEST_CASE("a range is a part of the file and ends at most where the file does") {
  CHECK(parse_range("bytes=0-0", kSize) == part(0, 1));
  CHECK(parse_range("bytes=10-19", kSize) == part(10, 10));
  CHECK(parse_range("Bytes= 10-19 ", kSize) == part(10, 10));
  CHECK(parse_range("bytes=999-", kSize) == part(999, 1));
  CHECK(parse_range("bytes=0-999", kSize) == part(0, 1000));
  CHECK(parse_range("bytes=990-5000", kSize) == part(990, 10));
  CHECK(parse_range("bytes=-1", kSize) == part(999, 1));
  CHECK(parse_range("bytes=-2000", kSize) == part(0, 1000));
}

TEST_CASE("numbers beyond 64 bits mean the end of the file, or beyond it") {
  const std::string huge(60, '9');
  CHECK(parse_range("bytes=0-" + huge, kSize) == part(0, 1000));
  CHECK(parse_range("bytes=-" + huge, kSize) == part(0, 1000));
  CHECK(parse_range("bytes=" + huge + "-", kSize) == kNone);
  CHECK(parse_range("bytes=18446744073709551615-18446744073709551615", kSize) == kNone);
  CHECK(parse_range("bytes=18446744073709551616-18446744073709551616", kSize) == kNone);
  CHECK(parse_range("bytes=0-18446744073709551615", ~std::uint64_t{0}) == part(0, ~std::uint64_t{0}));
}

TEST_CASE("ranges beyond the file cannot be satisfied") {
  CHECK(parse_range("bytes=1000-", kSize) == kNone);
  CHECK(parse_range("bytes=1000-1001", kSize) == kNone);
  CHECK(parse_range("bytes=-0", kSize) == kNone);
  CHECK(parse_range("bytes=0-0", 0) == kNone);
}

TEST_CASE("anything but a single range of bytes means the whole file") {
  for (const char* field : {"", "bytes", "bytes=", "bytes= ", "bytes=-", "bytes=5", "bytes=20-10", "bytes=a-b",
                            "bytes=0x1-2", "bytes=1-2-3", "bytes=--1", "bytes=0-1,5-6", "bytes=0-1, 5-6", "bytes=+1-2",
                            "bytes=1 -2", "lines=1-2", "bytes 1-2", "bytes=1-2;", "bytes=9-18446744073709551616x"}) {
    CAPTURE(field);
    CHECK(parse_range(field, kSize) == kWhole);
  }
  CHECK(parse_range("bytes=-5", 0) == ByteRange{ByteRange::Kind::whole, 0, 0});
}
