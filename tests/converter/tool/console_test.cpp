// console_test.cpp - error reports, number formats and number parsing of the command-line programs.
// SPDX-License-Identifier: Apache-2.0
#include "console.hpp"
#include "max_expansion.hpp"

#include <doctest/doctest.h>

#include <cerrno>
#include <new>
#include <stdexcept>
#include <string>
#include <utility>

#include "text_lines.hpp"

using namespace rgs;
using namespace rgs::tool;

TEST_CASE("a change of size is described in plain words") {
  CHECK(format_size_change(487, 100) == "4.87x smaller");
  CHECK(format_size_change(60, 100) == "1.67x larger");
  CHECK(format_size_change(100, 100) == "same size");
  CHECK(format_size_change(0, 0) == "same size");
  CHECK(format_size_change(100000, 100001) == "nearly the same size");
  CHECK(format_size_change(100001, 100000) == "nearly the same size");
  CHECK(format_size_change(100, 0) == "empty");
  CHECK(format_size_change(0, 100) == "larger than nothing");
  CHECK(format_size_change(~0ull, 1) == "18446744073709551616.00x smaller");
}

TEST_CASE("an error is described with its place, both numbers and the system's reason") {
  CHECK(describe({Errc::truncated, 512, "the data end early", 1000, 900}) ==
        "byte 512: the data end early (expected 1,000, found 900)");
  CHECK(describe({Errc::bad_value, 0, "bad", Error::kNone, 7}) == "byte 0: bad (found 7)");
  CHECK(describe({Errc::bad_value, 9, "the camera of this index is bad", Error::kNone, 7}) ==
        "byte 9: the camera of index 7 is bad");
  CHECK(describe({Errc::bad_value, 1500, "the Gaussian of this index is bad"}) == "the Gaussian of index 1,500 is bad");
  CHECK(describe({Errc::checksum_mismatch, 64, "checksum", 0xab, 0xcd}) ==
        "byte 64: checksum (expected 00000000000000ab, found 00000000000000cd)");
  CHECK(describe({Errc::open_failed, Error::kNone, "cannot open", Error::kNone, Error::kNone, ENOENT}) ==
        "cannot open: No such file or directory");
  CHECK(std::string(hint({Errc::write_failed, Error::kNone, "", Error::kNone, Error::kNone, ENOSPC})) ==
        "free some space or write to another disk");
  CHECK(std::string(hint({Errc::bad_argument})) == "");
  // Errors in other tools' files and in work folders too: the message itself says what to do.
  CHECK(std::string(hint({Errc::unsupported_version})) == "");
  CHECK(std::string(hint({Errc::limit_exceeded, 8, "decodes to too much (max_expansion)"})).find("--max-expansion") !=
        std::string::npos);
  CHECK(std::string(hint({Errc::limit_exceeded, Error::kNone, "a writer refuses what readers would not decode"})) ==
        "");
}

TEST_CASE("the exit code is the error's class, and unexpected exceptions are internal errors") {
  CHECK(report("a.ply", {Errc::bad_syntax, 3, "broken"}) == kMalformed);
  CHECK(report("a.ply", {Errc::open_failed, Error::kNone, "missing"}) == kInputOutput);
  CHECK(report("", {Errc::unavailable, Error::kNone, "no device"}) == kUsage);
  CHECK(run([] { return 4; }) == 4);
  CHECK(run([]() -> int { throw std::bad_alloc(); }) == kInputOutput);
  CHECK(run([]() -> int { throw std::runtime_error("x"); }) == kInternal);
}

TEST_CASE("numbers are formatted for people") {
  CHECK(format_bytes(0) == "0 B");
  CHECK(format_bytes(999) == "999 B");
  CHECK(format_bytes(1000) == "1.0 kB");
  CHECK(format_bytes(999'960) == "1.0 MB");
  CHECK(format_bytes(193'146'907) == "193.1 MB");
  CHECK(format_bytes(~0ull) == "18.4 EB");
  CHECK(format_count(0) == "0");
  CHECK(format_count(999) == "999");
  CHECK(format_count(778'812) == "778,812");
  CHECK(format_count(1'000'000) == "1,000,000");
  CHECK(format_seconds(12e-6) == "12 us");
  CHECK(format_seconds(0.0352) == "35.2 ms");
  CHECK(format_seconds(1.25) == "1.25 s");
  CHECK(format_seconds(187) == "3 min 07 s");
  CHECK(format_seconds(119.7) == "2 min 00 s");
  CHECK(format_seconds(7260) == "2 h 01 min");
}

TEST_CASE("counts with suffixes are exact") {
  CHECK(parse_count("0").value() == 0);
  CHECK(parse_count("250000").value() == 250'000);
  CHECK(parse_count("200k").value() == 200'000);
  CHECK(parse_count("1.5M").value() == 1'500'000);
  CHECK(parse_count("0.001K").value() == 1);
  CHECK(parse_count("2.50G").value() == 2'500'000'000);
  CHECK(parse_count("18446744073709551615").value() == ~0ull);
  for (const char* bad : {"", "k", "-1", "+1", "1.5", "1.0001k", "1.k", ".5M", "5 M", "5Mi", "1e6", "0x10", "nan",
                          "18446744073709551616", "99999999999999999999G"}) {
    CAPTURE(bad);
    REQUIRE_FALSE(parse_count(bad));
    CHECK(parse_count(bad).error().code == Errc::bad_argument);
  }
}

TEST_CASE("sizes in bytes are exact, whatever their unit") {
  constexpr std::uint64_t kMost = ~0ull;
  const std::pair<std::string, std::uint64_t> sizes[] = {
      {"0", 0},
      {"4096", 4096},
      {"007", 7},
      {"8GB", 8'000'000'000},
      {"8gb", 8'000'000'000},
      {" 8 GB ", 8'000'000'000},
      {"8G", 8'000'000'000},
      {"12 b", 12},
      {"512K", 512'000},
      {"512kb", 512'000},
      {"512KiB", 512u << 10},
      {"512ki", 512u << 10},
      {"3.5MB", 3'500'000},
      {"3.5MiB", 7u << 19},
      {"2TB", 2'000'000'000'000},
      {"2TiB", std::uint64_t{2} << 40},
      {"3PB", 3'000'000'000'000'000},
      {"3eib", std::uint64_t{3} << 60},
      // Rounded down, and exact where double is not.
      {"1.9", 1},
      {"0.9999kB", 999},
      {"0.0009765624KiB", 0},
      {"0.0009765625KiB", 1},
      {"0.29MB", 290'000},
      {"9007199254740993", 9'007'199'254'740'993},
      {"9.007199254740993PB", 9'007'199'254'740'993},
      {"0.00000000000000000000000000000000000000000000000001GB", 0},
      {"0.9999999999999999999999999999999999999999999999999EiB", (std::uint64_t{1} << 60) - 1},
      {"18446744073709551615", kMost},
      {"18446744073709551615.9", kMost},
      {"18446744073709551.615kB", kMost},
      {"18.446744073709551615EB", kMost},
      {"15.9999999999999999999EiB", kMost},
      {"17179869183.999999999999GiB", kMost}};
  for (const auto& size : sizes) {
    const std::string text = size.first;
    CAPTURE(text);
    REQUIRE(parse_bytes(text));
    CHECK(parse_bytes(text).value() == size.second);
  }
  const auto refuses = [](const std::string& text) {
    CAPTURE(text);
    REQUIRE_FALSE(parse_bytes(text));
    CHECK(parse_bytes(text).error().code == Errc::bad_argument);
  };
  for (const char* bad : {"",   " ",    "GB",   "k",      "-1",  "+1",  "nan",  "inf",  "0x10", "1e6", "1,5GB",
                          "1.", "1.GB", ".5GB", "1.5.2B", "8XB", "8iB", "8GBB", "8kkB", "8G B", "8 8"})
    refuses(bad);
  for (const char* large : {"18446744073709551616", "18446744073709551.616kB", "16EiB", "99999999999999999999B"})
    refuses(large);
}

TEST_CASE("image sizes") {
  CHECK(parse_size("1920x1080").value().width == 1920);
  CHECK(parse_size("1X65536").value().height == 65536);
  for (const char* bad :
       {"", "x", "1920", "1920x", "x1080", "0x5", "5x0", "-1x5", "65537x1", "1x1x1", "1 x1", "1x1 "}) {
    CAPTURE(bad);
    CHECK_FALSE(parse_size(bad));
  }
}

TEST_CASE("lines of a report have no trailing spaces") {
  TextLines lines;
  lines.line("{:<6}{:>4}{:<5}", "ab", 7, "");
  lines.line("");
  lines.line("{}", "   ");
  lines.line(" x");
  CHECK(lines.take() == "ab       7\n\n\n x\n");
  CHECK(lines.take() == "");
}

TEST_CASE("--max-expansion takes a ratio, or bytes regardless of the ratio") {
  const auto parse = [](const char* text) -> std::optional<DecodeLimits> {
    DecodeLimits limits;
    if (!parse_max_expansion(text, limits)) return {};
    return limits;
  };
  CHECK(parse("1")->max_expansion == 1);
  CHECK(parse("4096")->max_expansion == 4096);
  CHECK(parse("4096")->max_decoded_bytes == DecodeLimits().max_decoded_bytes);
  CHECK(parse("8GB")->decoded_bytes(1) == 8'000'000'000);
  CHECK(parse("3MiB")->decoded_bytes(std::uint64_t{1} << 50) == 3u << 20);
  CHECK(parse("1.5 gb")->decoded_bytes(1) == 1'500'000'000);
  for (const char* bad :
       {"", "0", "0GB", "-1", "1.5", "1.0", "GB", "x", "1e3", "nan", "99999999999999999999", "99999999999TiB"}) {
    CAPTURE(bad);
    CHECK_FALSE(parse(bad));
  }
}
