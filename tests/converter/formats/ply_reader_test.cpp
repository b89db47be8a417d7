// ply_reader_test.cpp - PLY data of every encoding, layout and source give the same Gaussians.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <fcntl.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <csignal>
#include <cstdlib>
#include <fstream>
#include <limits>
#include <numeric>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "ply_samples.hpp"
#include "rgs/ply.hpp"
#include "temporary_folder.hpp"

using rgs::Errc;
using rgs::PlyFile;
using rgs::Splat;
using namespace rgs::test;

namespace {

enum class Encoding { ascii, little, big };
constexpr Encoding kEncodings[] = {Encoding::ascii, Encoding::little, Encoding::big};

const char* format_name(Encoding encoding) {
  if (encoding == Encoding::ascii) return "ascii";
  return encoding == Encoding::little ? "binary_little_endian" : "binary_big_endian";
}

// Writes values of named PLY types in one encoding.
class Emitter {
 public:
  explicit Emitter(Encoding encoding) : encoding_(encoding) {}
  void value(const std::string& type, double v) {
    if (encoding_ == Encoding::ascii) return type == "float" ? text(static_cast<float>(v)) : text(v);
    const bool big = encoding_ == Encoding::big;
    if (type == "char" || type == "int8") append_value(data, static_cast<std::int8_t>(v), big);
    if (type == "uchar" || type == "uint8") append_value(data, static_cast<std::uint8_t>(v), big);
    if (type == "short" || type == "int16") append_value(data, static_cast<std::int16_t>(v), big);
    if (type == "ushort" || type == "uint16") append_value(data, static_cast<std::uint16_t>(v), big);
    if (type == "int" || type == "int32") append_value(data, static_cast<std::int32_t>(v), big);
    if (type == "uint" || type == "uint32") append_value(data, static_cast<std::uint32_t>(v), big);
    if (type == "float" || type == "float32") append_value(data, static_cast<float>(v), big);
    if (type == "double" || type == "float64") append_value(data, v, big);
  }
  void end_row() {
    if (encoding_ == Encoding::ascii) data += '\n';
  }
  std::string data;

 private:
  template <class T>
  void text(T v) {
    char digits[64];
    const auto end = std::to_chars(digits, digits + sizeof(digits), v).ptr;
    data.append(digits, end);
    data += ' ';
  }
  Encoding encoding_;
};

// A splat's property by its name in the original code.
float property_of(const Splat& s, const std::string& name, int degree) {
  const int number =
      name.find_last_of('_') == std::string::npos ? 0 : std::atoi(name.c_str() + name.find_last_of('_') + 1);
  const int per_channel = rgs::sh_coefficients(degree) - 1;
  if (name == "x" || name == "y" || name == "z") return s.mean[name[0] - 'x'];
  if (name.starts_with("f_dc_")) return s.sh[number];
  if (name.starts_with("f_rest_")) return s.sh[3 * (number % per_channel + 1) + number / per_channel];
  if (name == "opacity") return s.opacity_logit;
  if (name.starts_with("scale_")) return s.log_scale[number];
  if (name.starts_with("rot_")) return s.rotation[number];
  return -1;
}

class TemporaryVariable {
 public:
  TemporaryVariable(const char* name, const std::string& value) : name_(name) {
    if (const char* old = std::getenv(name)) old_ = old, had_ = true;
    ::setenv(name, value.c_str(), 1);
  }
  ~TemporaryVariable() {
    if (had_) {
      ::setenv(name_, old_.c_str(), 1);
    } else {
      ::unsetenv(name_);
    }
  }
  TemporaryVariable(const TemporaryVariable&) = delete;
  TemporaryVariable& operator=(const TemporaryVariable&) = delete;

 private:
  const char* name_;
  std::string old_;
  bool had_ = false;
};

// A pipe that a thread writes into.
rgs::Result<PlyFile> open_piped(const std::string& text) {
  std::signal(SIGPIPE, SIG_IGN);  // the writing thread hits a closed pipe when open() fails
  int ends[2];
  REQUIRE(::pipe(ends) == 0);
  std::thread writer([&] {
    for (std::size_t at = 0; at < text.size();) {
      const ssize_t n = ::write(ends[1], text.data() + at, text.size() - at);
      if (n <= 0) break;
      at += static_cast<std::size_t>(n);
    }
    ::close(ends[1]);
  });
  auto ply = PlyFile::open(ends[0]);
  ::close(ends[0]);
  writer.join();
  return ply;
}

std::string ascii_splat(const std::string& first_value) {
  return header_of(splat_properties(0), "1", "ascii") + first_value + " 2 3 4 5 6 7 8 9 10 11 12 13 14\n";
}

}  // namespace

TEST_CASE("any encoding, property order, scalar type, extra property and extra element gives the same splats") {
  std::mt19937 random(20);
  for (const Encoding encoding : kEncodings) {
    for (int degree = 0; degree <= 3; ++degree) {
      for (int variant = 0; variant < 6; ++variant) {
        CAPTURE(degree);
        CAPTURE(variant);
        CAPTURE(static_cast<int>(encoding));
        const bool shuffled = variant >= 1, doubles = variant == 2, elements = variant >= 3, lists = variant == 4;
        const bool small_types = variant == 5;
        auto splats = random_splats(9, degree, 40U + static_cast<std::uint32_t>(variant));
        if (small_types) {
          for (Splat& s : splats) {
            s.mean[0] = -7, s.mean[1] = 200, s.mean[2] = -30000, s.opacity_logit = 60000, s.rotation[0] = -2000000000;
            s.rotation[1] = 4000000000.0F;
          }
        }
        auto names = splat_properties(3 * (rgs::sh_coefficients(degree) - 1));
        names.insert(names.begin() + 3, {"nx", "ny", "nz"});
        if (shuffled) {
          names.push_back("extra_uchar");
          if (lists) names.push_back("extra_list");
          std::shuffle(names.begin(), names.end(), random);
        }
        const auto type_of = [&](const std::string& name) -> std::string {
          if (name == "extra_uchar") return "uchar";
          if (small_types && name == "x") return "char";
          if (small_types && name == "y") return "uint8";
          if (small_types && name == "z") return "short";
          if (small_types && name == "opacity") return "uint16";
          if (small_types && name == "rot_0") return "int";
          if (small_types && name == "rot_1") return "uint32";
          return doubles ? "double" : "float";
        };
        std::string header = "ply\nformat " + std::string(format_name(encoding)) + " 1.0\n";
        Emitter emit(encoding);
        if (elements) {
          header += "element camera 2\nproperty double fx\nproperty short id\nelement nothing 5\n";
          header += "element face 3\nproperty list uchar int vertex_indices\nproperty list uint double w\n";
          for (int i = 0; i < 2; ++i) emit.value("double", 0.5), emit.value("short", i), emit.end_row();
          for (int i = 0; i < 3; ++i) {
            emit.value("uchar", i);
            for (int k = 0; k < i; ++k) emit.value("int", k);
            emit.value("uint", 1), emit.value("double", 1), emit.end_row();
          }
        }
        header += "element vertex 9\n";
        for (const std::string& name : names) {
          header += name == "extra_list" ? "property list short double extra_list\n"
                                         : "property " + type_of(name) + " " + name + "\n";
        }
        for (std::size_t i = 0; i < splats.size(); ++i) {
          for (const std::string& name : names) {
            if (name == "extra_list") {
              emit.value("short", static_cast<double>(i % 4));
              for (std::size_t k = 0; k < i % 4; ++k) emit.value("double", 3);
            } else {
              const float v = name == "extra_uchar" ? 9.0F : property_of(splats[i], name, degree);
              emit.value(type_of(name), static_cast<double>(v));
            }
          }
          emit.end_row();
        }
        if (elements) {
          header += "element tail 1\nproperty list uchar uchar bytes\n";
          emit.value("uchar", 1), emit.value("uchar", 1), emit.end_row();
        }
        const ExactCopy copy(header + "end_header\n" + emit.data);
        const auto ply = PlyFile::open(copy.bytes());
        if (!ply) FAIL(ply.error().what);
        CHECK(ply->size() == 9);
        CHECK(ply->sh_degree() == degree);
        CHECK(same_bits(read_all(*ply), splats));
        std::vector<std::uint32_t> indices{8, 0, 3, 3, 7};
        std::vector<Splat> gathered(indices.size());
        ply->gather(indices, gathered);
        for (std::size_t i = 0; i < indices.size(); ++i) CHECK(same_bits({&gathered[i], 1}, {&splats[indices[i]], 1}));
      }
    }
  }
}

TEST_CASE("reading overwrites the whole splat, degrees above the file's included") {
  for (int degree = 0; degree <= 3; ++degree) {
    const auto splats = random_splats(40, degree, 2);
    const std::string text = binary_ply(splats, degree);
    const auto ply = open_text(text);
    REQUIRE(ply);
    std::vector<Splat> out(40);
    for (Splat& s : out) std::fill_n(reinterpret_cast<float*>(&s), 59, std::numeric_limits<float>::quiet_NaN());
    ply->read(10, std::span(out).subspan(10));
    ply->read(0, std::span(out).first(10));
    CHECK(same_bits(out, splats));
    std::vector<std::uint32_t> order(40);
    std::iota(order.rbegin(), order.rend(), 0U);
    ply->gather(order, out);
    std::reverse(out.begin(), out.end());
    CHECK(same_bits(out, splats));
    ply->gather({}, {});
    ply->read(40, {});
  }
}

TEST_CASE("non-finite values of binary files pass unchanged") {
  auto splats = random_splats(1, 3, 1);
  splats[0].mean[0] = std::numeric_limits<float>::quiet_NaN();
  splats[0].opacity_logit = -std::numeric_limits<float>::infinity();
  splats[0].sh[47] = std::bit_cast<float>(0x7fa00001U);  // a signalling NaN with payload
  const std::string text = binary_ply(splats, 3);
  const auto ply = open_text(text);
  REQUIRE(ply);
  CHECK(same_bits(read_all(*ply), splats));
}

TEST_CASE("numbers in text") {
  const float inf = std::numeric_limits<float>::infinity();
  struct Case {
    const char* text;
    float value;
  };
  const std::string many_zeros = "0." + std::string(400, '0') + "1", many_digits = "1" + std::string(400, '0');
  const Case cases[] = {{"1", 1},
                        {"-0", -0.0F},
                        {"+2.5", 2.5F},
                        {"1e3", 1000},
                        {"1E-3", 1e-3F},
                        {".5", 0.5F},
                        {"3.", 3},
                        {"0.1", 0.1F},
                        {"inf", inf},
                        {"-inf", -inf},
                        {"Infinity", inf},
                        {"+INF", inf},
                        {"1e39", inf},
                        {"-1e400", -inf},
                        {"1e-60", 0},
                        {"-1e-400", -0.0F},
                        {"1e-40", 1e-40F},
                        {many_zeros.c_str(), 0},
                        {many_digits.c_str(), inf}};
  for (const Case& c : cases) {
    CAPTURE(std::string(c.text));
    const std::string text = ascii_splat(c.text);
    const auto ply = open_text(text);
    REQUIRE(ply);
    CHECK(std::bit_cast<std::uint32_t>(read_all(*ply)[0].mean[0]) == std::bit_cast<std::uint32_t>(c.value));
    CHECK(read_all(*ply)[0].mean[1] == 2);
  }
  for (const char* nan : {"nan", "-nan", "NaN", "NAN"}) {
    const std::string text = ascii_splat(nan);
    const auto ply = open_text(text);
    REQUIRE(ply);
    CHECK(std::isnan(read_all(*ply)[0].mean[0]));
  }
  for (const char* bad : {"x", "1x", "+-1", "+", "1,5", "--1", "0x10", "1 1", "1..2", "1e"}) {
    CAPTURE(std::string(bad));
    const std::string text = ascii_splat(bad);
    const auto ply = open_text(text);
    REQUIRE_FALSE(ply);
    CHECK(ply.error().code == Errc::bad_syntax);
    CHECK(ply.error().offset == header_of(splat_properties(0), "1", "ascii").size());
  }
}

TEST_CASE("text lines may end in CR LF, be blank or lack the last line end; a short or missing line is refused") {
  const std::string header = header_of(splat_properties(0), "2", "ascii");
  const std::string row = "1 2 3 4 5 6 7 8 9 10 11 12 13 14";
  for (const std::string& data : {row + "\n" + row + "\n", row + "\r\n" + row + "\r\n", row + "\n" + row,
                                  "\n \n\t" + row + "  \n\r\n" + row + "\n\n"}) {
    CAPTURE(data);
    const ExactCopy copy(header + data);
    const auto ply = PlyFile::open(copy.bytes());
    REQUIRE(ply);
    CHECK(read_all(*ply)[1].rotation[3] == 14);
  }
  const std::string short_text = header + row + "\n1 2 3 4 5 6 7 8 9 10 11 12 13\n";
  const auto short_line = open_text(short_text);
  REQUIRE_FALSE(short_line);
  CHECK(short_line.error().code == Errc::bad_syntax);
  CHECK(short_line.error().offset == header.size() + row.size() + 1);
  CHECK(short_line.error().expected == 14);
  CHECK(short_line.error().found == 13);
  const std::string missing_text = header + row + std::string(40, '\n');
  const auto missing = open_text(missing_text);
  REQUIRE_FALSE(missing);
  CHECK(missing.error().code == Errc::truncated);
  CHECK(missing.error().expected == 2);
  CHECK(missing.error().found == 1);
}

TEST_CASE("elements after the vertices must be complete, and nothing may follow them") {
  // Elements after the vertices: numbers alone, and lists.
  struct Tail {
    const char* header;
    std::vector<std::string> rows;  // little-endian
    const char* text;
  };
  const std::vector<Tail> tails = {
      {"", {}, ""},
      {"element edge 2\nproperty int a\nproperty uchar b\n", {"abcde", "fghij"}, "1 2\n3 4\n"},
      {"element face 2\nproperty list uchar int vertex_indices\n",
       {std::string("\x01") + "abcd", std::string("\x02") + "abcdefgh"},
       "1 5\n2 5 6\n"},
      {"element face 1\nproperty list uchar short i\nelement edge 1\nproperty int a\n",
       {std::string("\x01") + "ab", "cdef"},
       "1 5\n7\n"},
      {"element nothing 3\n", {}, ""}};
  const std::vector<Splat> splats = random_splats(3, 0, 1);
  for (const Tail& tail : tails) {
    CAPTURE(tail.header);
    std::string file = binary_ply(splats, 0);
    file.insert(file.find("end_header"), tail.header);
    const std::size_t vertices_end = file.size();
    for (const std::string& row : tail.rows) file += row;
    const auto whole = open_text(file);
    REQUIRE(whole);
    CHECK(same_bits(read_all(*whole), splats));
    for (std::size_t size = vertices_end; size < file.size(); ++size) {
      CAPTURE(size);
      const ExactCopy cut(std::string_view(file).substr(0, size));
      const auto opened = PlyFile::open(cut.bytes());
      REQUIRE_FALSE(opened);
      CHECK(opened.error().code == Errc::truncated);
      CHECK(opened.error().offset == size);
    }
    for (const std::string& more : {std::string("\n"), std::string(1, '\0'), std::string(300, 'x')}) {
      const auto opened = open_text(file + more);
      REQUIRE_FALSE(opened);
      CHECK(opened.error().code == Errc::trailing_bytes);
      CHECK(opened.error().offset == file.size());
      CHECK(opened.error().found == file.size() + more.size());
    }
    std::string text = header_of(splat_properties(0), "1", "ascii");
    text.insert(text.find("end_header"), tail.header);
    text += "1 2 3 4 5 6 7 8 9 10 11 12 13 14\n";
    const std::size_t line_end = text.size();
    text += tail.text;
    CHECK(open_text(text));
    CHECK(open_text(text + " \r\n\n"));  // blank lines do not count
    const auto trailing = open_text(text + "\n1\n");
    REQUIRE_FALSE(trailing);
    CHECK(trailing.error().code == Errc::trailing_bytes);
    CHECK(trailing.error().offset == text.size() + 1);
    if (*tail.text == '\0') continue;
    const auto cut = open_text(text.substr(0, line_end));
    REQUIRE_FALSE(cut);
    CHECK(cut.error().code == Errc::truncated);
  }
  // A count beyond any file is refused at once.
  std::string huge = binary_ply(splats, 0);
  huge.insert(huge.find("end_header"), "element face 18446744073709551615\nproperty list uchar int i\n");
  CHECK(open_text(huge).error().code == Errc::truncated);
}

TEST_CASE("a list of negative length is refused at its offset") {
  std::string text = header_of(splat_properties(0), "1");
  text.insert(text.find("end_header"), "property list char int tags\n");
  const std::size_t at = text.size() + 56;
  text += std::string(56, '\0') + "\xff" + std::string(8, '\0');
  const auto ply = open_text(text);
  REQUIRE_FALSE(ply);
  CHECK(ply.error().code == Errc::bad_value);
  CHECK(ply.error().offset == at);
}

TEST_CASE("files, pipes, named pipes and redirected files read like memory") {
  const TemporaryFolder folder;
  // Sizes on both sides of the memory buffer (1 MiB).
  for (const std::size_t n : {3UL, 9000UL}) {
    const auto splats = random_splats(n, 3, 77);
    const std::string text = binary_ply(splats, 3);
    const std::string path = folder.file("scene.ply");
    std::ofstream(path, std::ios::binary) << text;

    const auto from_file = PlyFile::open(path);
    REQUIRE(from_file);
    CHECK(same_bits(read_all(*from_file), splats));
    CHECK(from_file->bytes() == text.size());
    from_file->advise(rgs::MappedFile::Access::sequential, 0, n);
    from_file->advise(rgs::MappedFile::Access::done, 1, n - 1);
    CHECK(same_bits(read_all(*from_file), splats));

    const auto from_pipe = open_piped(text);
    REQUIRE(from_pipe);
    CHECK(same_bits(read_all(*from_pipe), splats));
    CHECK(from_pipe->bytes() == text.size());
    CHECK(std::equal(text.begin(), text.end(), reinterpret_cast<const char*>(from_pipe->source().data())));
    from_pipe->advise(rgs::MappedFile::Access::done, 0, n);
    CHECK(same_bits(read_all(*from_pipe), splats));

    const std::string fifo = folder.file("fifo");
    REQUIRE(::mkfifo(fifo.c_str(), 0600) == 0);
    std::thread writer([&] { std::ofstream(fifo, std::ios::binary) << text; });
    const auto from_fifo = PlyFile::open(fifo);
    writer.join();
    REQUIRE(from_fifo);
    CHECK(same_bits(read_all(*from_fifo), splats));
    std::filesystem::remove(fifo);

    // A descriptor past the start is read from its position, as standard input is.
    std::ofstream(path, std::ios::binary) << "skipped\n" << text;
    const int fd = ::open(path.c_str(), O_RDONLY);
    REQUIRE(::lseek(fd, 8, SEEK_SET) == 8);
    const auto redirected = PlyFile::open(fd);
    ::close(fd);
    REQUIRE(redirected);
    CHECK(same_bits(read_all(*redirected), splats));
  }
}

TEST_CASE("text larger than the memory buffer is converted in an unlinked temporary file") {
  const TemporaryFolder folder;
  const TemporaryVariable tmpdir("TMPDIR", folder.path().string());
  const auto splats = random_splats(30000, 0, 123);
  Emitter emit(Encoding::ascii);
  for (const Splat& s : splats) {
    for (const std::string& name : splat_properties(0))
      emit.value("float", static_cast<double>(property_of(s, name, 0)));
    emit.end_row();
  }
  const std::string text = header_of(splat_properties(0), "30000", "ascii") + emit.data;
  const auto ply = open_text(text);
  REQUIRE(ply);
  CHECK(std::filesystem::is_empty(folder.path()));
  CHECK(same_bits(read_all(*ply), splats));
  ply->advise(rgs::MappedFile::Access::done, 0, ply->size());
  CHECK(same_bits(read_all(*ply), splats));
}

TEST_CASE("a full disk or missing temporary folder is an input/output error with errno") {
  const TemporaryFolder folder;
  const std::string text = binary_ply(random_splats(9000, 3, 8), 3);
  {
    const TemporaryVariable tmpdir("TMPDIR", folder.file("missing"));
    const auto ply = open_piped(text);
    REQUIRE_FALSE(ply);
    CHECK(ply.error().code == Errc::open_failed);
    CHECK(ply.error().system == ENOENT);
  }
  // A file size limit simulates a full disk: both fail a write.
  const TemporaryVariable tmpdir("TMPDIR", folder.path().string());
  rlimit old{};
  REQUIRE(::getrlimit(RLIMIT_FSIZE, &old) == 0);
  const auto old_handler = std::signal(SIGXFSZ, SIG_IGN);
  rlimit small = old;
  small.rlim_cur = 1 << 20;
  REQUIRE(::setrlimit(RLIMIT_FSIZE, &small) == 0);
  const auto ply = open_piped(text);
  REQUIRE(::setrlimit(RLIMIT_FSIZE, &old) == 0);
  std::signal(SIGXFSZ, old_handler);
  REQUIRE_FALSE(ply);
  CHECK(ply.error().code == Errc::write_failed);
  CHECK(ply.error().system == EFBIG);
}

TEST_CASE("an open file stays readable after it is unlinked; missing files and folders are refused") {
  const TemporaryFolder folder;
  const auto splats = random_splats(500, 2, 31);
  const std::string path = folder.file("scene.ply");
  std::ofstream(path, std::ios::binary) << binary_ply(splats, 2);
  const auto ply = PlyFile::open(path);
  REQUIRE(ply);
  REQUIRE(std::filesystem::remove(path));
  CHECK(same_bits(read_all(*ply), splats));
  const auto missing = PlyFile::open(path);
  REQUIRE_FALSE(missing);
  CHECK(missing.error().code == Errc::open_failed);
  CHECK(missing.error().system == ENOENT);
  const auto directory = PlyFile::open(folder.path().string());
  REQUIRE_FALSE(directory);
  CHECK(directory.error().code == Errc::open_failed);
  CHECK_FALSE(rgs::read_ply(path));
}

TEST_CASE("several threads read one file") {
  const auto splats = random_splats(4000, 3, 64);
  const std::string text = binary_ply(splats, 3);
  const auto ply = open_text(text);
  REQUIRE(ply);
  std::vector<std::vector<Splat>> out(4);
  std::vector<std::thread> threads;
  for (auto& part : out) threads.emplace_back([&] { part = read_all(*ply); });
  for (std::thread& thread : threads) thread.join();
  for (const auto& part : out) CHECK(same_bits(part, splats));
}
