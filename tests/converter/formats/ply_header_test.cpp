// ply_header_test.cpp - valid PLY headers are read, others refused with a reason.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <string>
#include <vector>

#include "ply_samples.hpp"
#include "rgs/ply.hpp"

using rgs::Errc;
using rgs::Error;
using rgs::PlyFile;
using namespace rgs::test;

namespace {

std::string replaced(std::string text, const std::string& from, const std::string& to) {
  const std::size_t at = text.find(from);
  REQUIRE(at != std::string::npos);
  return text.replace(at, from.size(), to);
}

std::string with_crlf(const std::string& header) {
  std::string out;
  for (const char c : header) out += c == '\n' ? std::string("\r\n") : std::string(1, c);
  return out;
}

std::vector<std::string> without(std::vector<std::string> names, const std::string& name) {
  std::erase(names, name);
  return names;
}

std::vector<std::string> with(std::vector<std::string> names, const std::string& name) {
  names.push_back(name);
  return names;
}

}  // namespace

TEST_CASE("a header is refused with a code, the offset of its line and the numbers") {
  const std::string good = header_of(splat_properties(0));
  const auto at = [&good](const std::string& line) { return static_cast<std::uint64_t>(good.find(line)); };
  struct Case {
    const char* name;
    std::string text;
    Errc code;
    std::uint64_t offset = Error::kNone;
    std::uint64_t expected = Error::kNone;
    std::uint64_t found = Error::kNone;
    const char* says = "";
  };
  const std::uint64_t vertex = at("element vertex");
  const std::vector<Case> cases{
      {"empty", "", Errc::bad_magic, 0},
      {"other file", "RGS\n", Errc::bad_magic, 0},
      {"longer word", "plywood\n", Errc::bad_magic, 0},
      {"more on the first line", replaced(good, "ply\n", "ply 1\n"), Errc::bad_magic, 0},
      {"carriage returns alone", "ply\rformat ascii 1.0\rend_header\r\n", Errc::bad_magic, 0},
      {"no end", "ply\nformat ascii 1.0\n", Errc::truncated, 21},
      {"no format", replaced(good, "format binary_little_endian 1.0\n", ""), Errc::bad_syntax,
       at("end_header") - std::string("format binary_little_endian 1.0\n").size()},
      {"unknown format", replaced(good, "binary_little_endian", "binary_middle_endian"), Errc::bad_syntax,
       at("format")},
      {"unknown version", replaced(good, "1.0", "2.0"), Errc::unsupported_version, at("format")},
      {"two formats", replaced(good, "element", "format ascii 1.0\nelement"), Errc::bad_syntax, vertex},
      {"unknown keyword", replaced(good, "element", "elephant 1\nelement"), Errc::bad_syntax, vertex},
      {"blank line", replaced(good, "element", "\nelement"), Errc::bad_syntax, vertex},
      {"no count", replaced(good, "element vertex 1", "element vertex"), Errc::bad_syntax, vertex},
      {"negative count", replaced(good, "vertex 1", "vertex -1"), Errc::bad_syntax, vertex},
      {"count of 2^64", replaced(good, "vertex 1", "vertex 18446744073709551616"), Errc::bad_syntax, vertex},
      {"fraction as count", replaced(good, "vertex 1", "vertex 1.5"), Errc::bad_syntax, vertex},
      {"property first", replaced(good, "element", "property float x\nelement"), Errc::bad_syntax, vertex},
      {"unknown type", replaced(good, "float y", "half y"), Errc::bad_syntax, at("property float y")},
      {"no name", replaced(good, "float y", "float"), Errc::bad_syntax, at("property float y")},
      {"two names", replaced(good, "float y", "float y y"), Errc::bad_syntax, at("property float y")},
      {"list of length float", replaced(good, "float y", "list float int y"), Errc::bad_syntax, at("property float y")},
      {"property twice", replaced(good, "float y", "float x"), Errc::bad_syntax, at("property float y")},
      {"extra property twice", header_of(with(with(splat_properties(0), "extra"), "extra")), Errc::bad_syntax,
       at("end_header") + std::string("property float extra\n").size()},
      {"element twice", replaced(good, "end_header", "element vertex 1\nend_header"), Errc::bad_syntax,
       at("end_header")},
      {"end with words", replaced(good, "end_header", "end_header now"), Errc::bad_syntax, at("end_header")},
      {"header above the limit", "ply\nformat ascii 1.0\ncomment " + std::string(1 << 20, 'c'), Errc::limit_exceeded,
       21, 1 << 20},
      {"no vertices", "ply\nformat ascii 1.0\nelement face 0\nend_header\n", Errc::not_gaussian_splats, Error::kNone,
       Error::kNone, Error::kNone, "no element vertex"},
      {"point cloud", header_of({"x", "y", "z", "red", "green", "blue"}), Errc::not_gaussian_splats, vertex,
       Error::kNone, Error::kNone, "f_dc_0: a point cloud"},
      {"2DGS", header_of(without(splat_properties(45), "scale_2")), Errc::not_gaussian_splats, vertex, 3, 2, "2DGS"},
      {"a list where a number belongs", replaced(good, "float y", "list uchar float y"), Errc::not_gaussian_splats,
       at("property float y"), Error::kNone, Error::kNone, "list"},
      {"PlayCanvas compressed.ply",
       "ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 256\n"
       "property uint packed_position\nproperty uint packed_rotation\nproperty uint packed_scale\n"
       "property uint packed_color\nend_header\n",
       Errc::unsupported_feature, 92, Error::kNone, Error::kNone, "compressed.ply"},
      {"f_rest without 3", header_of(with(without(splat_properties(9), "f_rest_3"), "f_rest_9")),
       Errc::not_gaussian_splats, Error::kNone, 3, 4, "gaps"},
  };
  for (const Case& c : cases) {
    CAPTURE(std::string(c.name));
    const ExactCopy copy(c.text);
    const auto ply = PlyFile::open(copy.bytes());
    REQUIRE_FALSE(ply);
    CAPTURE(std::string(ply.error().what));
    CHECK(ply.error().code == c.code);
    if (c.offset != Error::kNone) CHECK(ply.error().offset == c.offset);
    CHECK(ply.error().expected == c.expected);
    CHECK(ply.error().found == c.found);
    CHECK(std::string(ply.error().what).find(c.says) != std::string::npos);
  }
}

TEST_CASE("every missing property is named") {
  for (const std::string& name : splat_properties(0)) {
    CAPTURE(name);
    const auto ply = open_text(header_of(without(splat_properties(0), name), "0"));
    REQUIRE_FALSE(ply);
    CHECK(ply.error().code == Errc::not_gaussian_splats);
    CHECK(std::string(ply.error().what).find("property " + name) != std::string::npos);
  }
}

TEST_CASE("the number of f_rest properties gives the degree or is refused with the number found") {
  for (int count = 0; count <= 80; ++count) {
    CAPTURE(count);
    const auto ply = open_text(header_of(splat_properties(count), "0"));
    const int degree = count == 0 ? 0 : count == 9 ? 1 : count == 24 ? 2 : count == 45 ? 3 : -1;
    REQUIRE(ply.has_value() == (degree >= 0));
    if (ply) {
      CHECK(ply->sh_degree() == degree);
      CHECK(ply->size() == 0);
    } else {
      CHECK(ply.error().code == Errc::unsupported_feature);
      CHECK(ply.error().found == static_cast<std::uint64_t>(count));
    }
  }
}

TEST_CASE("comments, obj_info, CR LF, tabs and type aliases change nothing") {
  const auto splats = random_splats(3, 1, 11);
  const std::string header = rgs::ply_header(3, 1);
  const std::string data = binary_ply(splats, 1).substr(header.size());
  const std::string headers[] = {
      header,
      with_crlf(header),
      replaced(header, "element", "comment made by hand\ncomment\nobj_info num_cols 3\nelement"),
      replaced(header, "property float y", "comment between properties\nproperty\tfloat32  y "),
      replaced(header, "nx", "red"),
  };
  for (const std::string& h : headers) {
    CAPTURE(h);
    const std::string text = h + data;
    const auto ply = open_text(text);
    REQUIRE(ply);
    CHECK(same_bits(read_all(*ply), splats));
    CHECK(ply->bytes() == text.size());
  }
}

TEST_CASE("counts beyond the file's size are refused with expected and found bytes") {
  struct Case {
    const char* count;
    std::uint64_t expected_rows_bytes;  // saturated one below kNone
  };
  const std::uint64_t row = 14 * 4;
  const Case cases[] = {
      {"2", 2 * row},
      {"2147483649", 2147483649U * row},
      {"4294967297", 4294967297U * row},
      {"329406144173384850", 329406144173384850U * row},  // the last product below 2^64
      {"329406144173384851", Error::kNone - 1},
      {"18446744073709551615", Error::kNone - 1},
  };
  for (const Case& c : cases) {
    CAPTURE(std::string(c.count));
    const std::string header = header_of(splat_properties(0), c.count);
    const ExactCopy copy(header + std::string(row, '\0'));
    const auto ply = PlyFile::open(copy.bytes());
    REQUIRE_FALSE(ply);
    CHECK(ply.error().code == Errc::truncated);
    CHECK(ply.error().found == header.size() + row);
    const std::uint64_t room = Error::kNone - 1 - header.size();
    CHECK(ply.error().expected ==
          (c.expected_rows_bytes > room ? Error::kNone - 1 : header.size() + c.expected_rows_bytes));
  }
}

TEST_CASE("huge counts of other elements and lists are refused without walking or multiplying") {
  const std::string vertex =
      header_of(splat_properties(0), "1").substr(std::string("ply\nformat binary_little_endian 1.0\n").size());
  for (const char* format : {"ascii", "binary_little_endian", "binary_big_endian"}) {
    for (const char* property :
         {"property double d\n", "property list uint double d\n", "property list char int d\n"}) {
      CAPTURE(std::string(format));
      CAPTURE(std::string(property));
      const std::string text = "ply\nformat " + std::string(format) + " 1.0\nelement face 18446744073709551615\n" +
                               property + vertex + std::string(200, '\xff');
      const ExactCopy copy(text);
      const auto ply = PlyFile::open(copy.bytes());
      REQUIRE_FALSE(ply);
      CHECK((ply.error().code == Errc::truncated || ply.error().code == Errc::bad_value));
    }
    const std::string empty_rows =
        "ply\nformat " + std::string(format) + " 1.0\nelement nothing 18446744073709551615\n" + vertex;
    const auto ply = open_text(empty_rows);
    REQUIRE_FALSE(ply);
    CHECK(ply.error().code == Errc::truncated);
  }
}

TEST_CASE("every prefix and every single-byte change of the header is an error or a valid file") {
  const auto splats = random_splats(2, 1, 5);
  std::string ascii = header_of(splat_properties(0), "2", "ascii");
  for (int row = 0; row < 2; ++row) ascii += "1 2 3 4 5 6 7 8 9 10 11 12 13 14\n";
  std::string listed =
      "ply\nformat binary_big_endian 1.0\nelement face 1\nproperty list uchar int v\n" +
      header_of(splat_properties(0), "1").substr(std::string("ply\nformat binary_little_endian 1.0\n").size());
  listed = replaced(listed, "end_header", "property list ushort short tags\nend_header");
  listed += std::string("\1\0\0\0\1", 5) + std::string(56, '\1') + std::string("\0\1\0\2", 4);
  const std::string files[] = {binary_ply(splats, 1), ascii, listed};
  const auto open_and_read = [](const std::string& text) {
    const ExactCopy copy(text);
    const auto ply = PlyFile::open(copy.bytes());
    if (!ply) {
      CHECK(ply.error().offset <= text.size());
      return false;
    }
    if (ply->size() < 100) {
      CHECK(read_all(*ply).size() == ply->size());
    }
    return true;
  };
  for (const std::string& file : files) {
    REQUIRE(open_and_read(file));
    for (std::size_t n = 0; n < file.size(); ++n) {
      CAPTURE(n);
      const bool opened = open_and_read(file.substr(0, n));
      // Text may lack its last line end and digits of its last value; binary data may lack nothing.
      if (&file != &files[1] || n + 3 < file.size()) CHECK_FALSE(opened);
    }
    const std::size_t end = file.find("end_header\n") + 11;
    for (std::size_t i = 0; i < end; ++i) {
      for (const int c : std::initializer_list<int>{0, '\n', '\r', ' ', '-', '0', '9', 'a', 255}) {
        std::string changed = file;
        changed[i] = static_cast<char>(c);
        open_and_read(changed);
      }
      for (int bit = 0; bit < 8; ++bit) {
        std::string changed = file;
        changed[i] = static_cast<char>(changed[i] ^ (1 << bit));
        open_and_read(changed);
      }
    }
  }
}
