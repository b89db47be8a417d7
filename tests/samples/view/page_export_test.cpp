// page_export_test.cpp - the page in one file. SPDX-License-Identifier: Apache-2.0
#include "page_export.hpp"

#include <doctest/doctest.h>

#include <cstdint>
#include <nlohmann/json.hpp>
#include <random>
#include <string>

#include "temporary_folder.hpp"
#include "text_file.hpp"

using rgs::test::read_text;
using rgs::test::write_text;
using rgs::view::PageExport;

namespace {

// The content of the element with this id.
std::string element(const std::string& page, const std::string& id) {
  const std::size_t at = page.find("id=\"" + id + "\">");
  if (at == page.npos) return "no " + id;
  const std::size_t begin = page.find('>', at) + 1;
  return page.substr(begin, page.find("</script>", begin) - begin);
}

std::string from_base64(const std::string& text) {
  const std::string digits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string out;
  std::uint32_t group = 0;
  int n_bits = 0;
  for (const char c : text) {
    if (c == '=') break;
    group = group << 6 | static_cast<std::uint32_t>(digits.find(c));
    n_bits += 6;
    if (n_bits >= 8) out += static_cast<char>(group >> (n_bits -= 8));
  }
  return out;
}

rgs::Status exported(const PageExport& page, const std::string& path) {
  auto out = rgs::AtomicFile::create(path, {.sync = false, .inputs = page.inputs()});
  if (!out) return tl::unexpected(out.error());
  if (rgs::Status s = page.write(*out); !s) return s;
  return out->commit().map([](double) {});
}

}  // namespace

TEST_CASE("an exported page is the page with each file embedded whole") {
  const rgs::test::TemporaryFolder folder;
  write_text(folder.file("page.html"), "<html><head><!-- rgs-view:insert --></head></html>");
  auto page = PageExport::open(folder.file("page.html"));
  REQUIRE(page);
  std::mt19937 random(5);
  std::vector<std::string> files;
  for (const std::size_t size : {std::size_t{0}, std::size_t{1}, std::size_t{2}, std::size_t{3}, std::size_t{4},
                                 std::size_t{3 * 65536}, std::size_t{3 * 65536 + 1}, std::size_t{500'000}}) {
    std::string bytes(size, '\0');
    for (char& c : bytes) c = static_cast<char>(random());
    files.push_back(bytes);
    if (size == 0 || size % 2 == 1) {
      CHECK(page->add(bytes) == "#rgs-file-" + std::to_string(files.size() - 1));
    } else {
      write_text(folder.file("part"), bytes);
      std::filesystem::rename(folder.file("part"), folder.file(std::to_string(size)));
      page->add(rgs::MappedFile::open(folder.file(std::to_string(size))).value());
    }
  }
  page->set_view(R"({"name": "</script><script>alert(1)</script>&amp;"})");
  REQUIRE(exported(*page, folder.file("out.html")));
  const std::string text = read_text(folder.file("out.html"));
  CHECK(text.size() == page->bytes());
  CHECK(text.starts_with("<html><head><script type=\"application/json\" id=\"rgs-view\">"));
  CHECK(text.ends_with("</script>\n</head></html>"));
  for (std::size_t i = 0; i < files.size(); ++i) {
    CAPTURE(i);
    CHECK(element(text, "rgs-file-" + std::to_string(i)).size() == (files[i].size() + 2) / 3 * 4);
    CHECK(from_base64(element(text, "rgs-file-" + std::to_string(i))) == files[i]);
  }
  const std::string view = element(text, "rgs-view");
  CHECK(view.find('<') == view.npos);
  CHECK(nlohmann::json::parse(view)["name"] == "</script><script>alert(1)</script>&amp;");
  // Elements open and close in pairs, whatever the names.
  std::size_t n_ends = 0;
  for (std::size_t at = text.find("</script>"); at != text.npos; at = text.find("</script>", at + 1)) ++n_ends;
  CHECK(n_ends == files.size() + 1);
}

TEST_CASE("a page without its mark, or with two, is refused") {
  const rgs::test::TemporaryFolder folder;
  const std::string mark(rgs::view::kInsertMark);
  for (const std::string& text : {std::string("<html></html>"), mark + mark, std::string()}) {
    write_text(folder.file("page.html"), text);
    const auto page = PageExport::open(folder.file("page.html"));
    REQUIRE(!page);
    CHECK(page.error().code == rgs::Errc::bad_syntax);
  }
  CHECK(PageExport::open(folder.file("nowhere")).error().code == rgs::Errc::open_failed);
}

TEST_CASE("a file that changes during the export leaves no page") {
  const rgs::test::TemporaryFolder folder;
  write_text(folder.file("page.html"), std::string(rgs::view::kInsertMark));
  write_text(folder.file("scene"), "0123456789");
  std::filesystem::last_write_time(folder.file("scene"),
                                   std::filesystem::file_time_type::clock::now() - std::chrono::hours(1));
  auto page = PageExport::open(folder.file("page.html"));
  REQUIRE(page);
  page->add(rgs::MappedFile::open(folder.file("scene")).value());
  write_text(folder.file("scene"), "abcdefghij");
  const rgs::Status status = exported(*page, folder.file("out.html"));
  REQUIRE(!status);
  CHECK(status.error().code == rgs::Errc::read_failed);
  CHECK(!std::filesystem::exists(folder.file("out.html")));
}
