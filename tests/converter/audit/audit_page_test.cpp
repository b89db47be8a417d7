// audit_page_test.cpp - pages and tables stay harmless whatever the files' names.
// SPDX-License-Identifier: Apache-2.0
#include "audit_page.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "audit_encoding.hpp"
#include "audit_program_fixture.hpp"
#include "encoding.hpp"
#include "skip.hpp"

namespace fs = std::filesystem;
using nlohmann::json;
using namespace rgs;
using namespace rgs::audit;
using namespace rgs::test;

namespace {

const std::vector<std::string> kHostile{"javascript:alert(1)",
                                        "data:text,x",
                                        "\"><script>document.documentElement.dataset.owned=1<",
                                        "' onmouseover='alert(1)",
                                        "a\xE2\x80\xAEgnp",
                                        "two\nlines",
                                        "byte\xff",
                                        "-rf",
                                        "=1+1",
                                        "@SUM(1)",
                                        "+x,\"y",
                                        "\xEF\xBC\x9D"
                                        "1+1",
                                        "\t=1",
                                        "a#b?c%41&d",
                                        "\\\\host",
                                        ".hidden"};

// The text between the first occurrence of two marks.
std::string between(const std::string& text, const std::string& begin, const std::string& end) {
  const std::size_t at = text.find(begin);
  REQUIRE(at != std::string::npos);
  const std::size_t from = at + begin.size(), to = text.find(end, from);
  REQUIRE(to != std::string::npos);
  return text.substr(from, to - from);
}

std::size_t occurrences(const std::string& text, const std::string& part) {
  std::size_t n = 0;
  for (std::size_t at = text.find(part); at != std::string::npos; at = text.find(part, at + part.size())) ++n;
  return n;
}

// Base64 of the SHA-256 by another program.
std::string hash_of(const TemporaryFolder& folder, const std::string& text) {
  write_text(folder.file("hashed"), text);
  const ProgramResult run = run_program({"/usr/bin/sha256sum", folder.file("hashed")});
  REQUIRE(run.exit_code == 0);
  std::vector<std::byte> bytes;
  for (std::size_t i = 0; i < 64; i += 2)
    bytes.push_back(static_cast<std::byte>(std::stoi(run.out.substr(i, 2), nullptr, 16)));
  return tool::base64(bytes);
}

void check_policy(const TemporaryFolder& folder, const std::string& page) {
  const std::string policy = between(page, "Content-Security-Policy\" content=\"", "\">");
  CHECK(policy.starts_with("default-src 'none';"));
  CHECK(policy.find("unsafe") == std::string::npos);
  CHECK(policy.find("style-src 'sha256-" + hash_of(folder, between(page, "<style>", "</style>")) + "'") !=
        std::string::npos);
  CHECK(policy.find("script-src 'sha256-" + hash_of(folder, between(page, "<script>", "</script>")) + "'") !=
        std::string::npos);
  CHECK(occurrences(page, "<style") == 1);
  CHECK(occurrences(page, "<script") == 1);
  CHECK(page.find("style=\"") == std::string::npos);  // which the policy disables
  // It holds no bidirectional control, no invisible character and no invalid UTF-8.
  CHECK(page.find("\xE2\x80\xAE") == std::string::npos);
  CHECK(page.find('\xff') == std::string::npos);
}

// Pairs of every hostile name, of one scene and without pictures, audited into out/.
struct HostileFolders : SceneFolder {
  std::string out = file("out");
  ProgramResult run;

  HostileFolders() {
    for (const char* side : {"ply", "rgs"}) fs::create_directory(file(side));
    for (const std::string& name : kHostile) {
      fs::copy(ply, file("ply/" + name + ".ply"));
      fs::copy(rgs, file("rgs/" + name + ".rgs"));
    }
    write_text(file("rgs/=alone\n\x1b[31m.rgs"), "damaged");
    run = run_audit({file("ply"), file("rgs"), "--report", out, "--no-render"});
  }
};

// The document that a browser builds from a page.
ProgramResult dump_in_browser(const TemporaryFolder& folder, const std::string& url) {
  return run_program({browser(), "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
                      "--no-first-run", "--enable-logging=stderr", "--user-data-dir=" + folder.file("profile"),
                      "--virtual-time-budget=4000", "--dump-dom", url},
                     [&] { ::setenv("HOME", folder.path().c_str(), 1); });
}

}  // namespace

TEST_CASE("SHA-256 agrees with another program") {
  const TemporaryFolder folder;
  for (const std::size_t n : {1U, 54U, 55U, 56U, 63U, 64U, 65U, 119U, 120U, 128U}) {
    const std::string text(n, '\xe7');
    CHECK(tool::base64(tool::sha256(text)) == hash_of(folder, text));
  }
}

TEST_CASE("a link leads to a file beside the page, whatever its name") {
  CHECK(link_to_file("south.html") == "./south.html");
  CHECK(link_to_file("javascript:alert(1)") == "./javascript%3Aalert%281%29");
  CHECK(link_to_file("//host/x") == "./%2F%2Fhost%2Fx");
  CHECK(link_to_file("a\"b'c<d>&#?%\n\xff") == "./a%22b%27c%3Cd%3E%26%23%3F%25%0A%FF");
}

TEST_CASE("the pages' policy names their style and script, and nothing else may run") {
  const TemporaryFolder folder;
  check_policy(folder, page_begin("<title>") + page_end());
  const SceneFolder scene;
  const std::string page = scene.file("r.html");
  REQUIRE(run_audit({scene.ply, scene.rgs, "--cameras", scene.cameras, "--report", page}).exit_code == 0);
  check_policy(scene, read_text(page));
}

TEST_CASE("a folder's table escapes every name in page, CSV, JSON and terminal lines") {
  const HostileFolders folder;
  CHECK(folder.run.exit_code == 3);  // of the single pair
  const std::string page = read_text(folder.out + "/index.html"), csv = read_text(folder.out + "/index.csv");
  check_policy(folder, page);
  CHECK(occurrences(page, "<a href=\"./") == kHostile.size());
  CHECK(occurrences(page, "<a ") == kHostile.size());
  CHECK(page.find("href=\"./javascript%3Aalert%281%29.html\"") != std::string::npos);
  CHECK(page.find("><script>doc") == std::string::npos);
  for (const std::string& name : kHostile) check_policy(folder, read_text(folder.out + "/" + name + ".html"));

  // One line per pair, no control byte, and no cell that a spreadsheet would evaluate.
  CHECK(static_cast<std::size_t>(std::count(csv.begin(), csv.end(), '\n')) == kHostile.size() + 2);
  for (const std::string& text : {csv, folder.run.out, folder.run.err}) {
    CHECK(std::none_of(text.begin(), text.end(),
                       [](char c) { return static_cast<unsigned char>(c) < ' ' && c != '\n'; }));
    CHECK(text.find("\xE2\x80\xAE") == std::string::npos);
    CHECK(text.find('\xff') == std::string::npos);
  }
  for (const char* cell : {"\"'=1+1\"", "\"'@SUM(1)\"", "\"'+x,\"\"y\"", "\"'-rf\"",
                           "\"'\xEF\xBC\x9D"
                           "1+1\"",
                           "\"two\\u{a}lines\"", "\"a\\u{202e}gnp\"", "\"byte\\xff\"", "\"'=alone\\u{a}\\u{1b}[31m\""})
    CHECK_MESSAGE(csv.find(cell) != std::string::npos, cell);
  for (const char* start : {"\n\"=", "\n\"+", "\n\"-", "\n\"@", ",\"=", ",\"+", ",\"-", ",\"@"})
    CHECK_MESSAGE(csv.find(start) == std::string::npos, start);
  CHECK(json::parse(read_text(folder.out + "/index.json"))["pairs"].size() == kHostile.size() + 1);
}

TEST_CASE("in a browser a table of hostile names runs nothing, and its links find the reports") {
  if (browser().empty()) return skip_without_tool("there is no browser to open the table in (Debian: chromium)");
  const HostileFolders folder;
  check_in_browser(folder, folder.out + "/index.html", "ok, 0 images, 0 sliders");
  const ProgramResult table = dump_in_browser(folder, "file://" + folder.out + "/index.html");
  CHECK(table.out.find("data-owned") == std::string::npos);
  for (const std::string& name : {kHostile[0], kHostile[2], std::string("byte\xff"), std::string("two\nlines")}) {
    const std::string link = link_to_file(name + ".html");
    REQUIRE(table.out.find("href=\"" + link + "\"") != std::string::npos);
    const ProgramResult report = dump_in_browser(folder, "file://" + folder.out + link.substr(1));
    CHECK_MESSAGE(report.out.find("<h2 id=\"method\">") != std::string::npos, name);
    CHECK(report.out.find("data-owned") == std::string::npos);
    CHECK_MESSAGE(report.err.find("CONSOLE") == std::string::npos, report.err);
  }

  // Even if a name were not escaped, the policy would stop it.
  std::string broken = page_begin("broken");
  broken +=
      "<script>document.documentElement.dataset.owned=1</script><img src=x "
      "onerror=\"document.documentElement.dataset.owned=2\"><p id=\"hidden\" style=\"display:none\">shown</p>";
  write_text(folder.file("broken.html"), broken + page_end());
  const ProgramResult stopped = dump_in_browser(folder, "file://" + folder.file("broken.html"));
  CHECK(stopped.out.find("data-owned") == std::string::npos);
  CHECK(stopped.err.find("CONSOLE") != std::string::npos);
}

TEST_CASE("a pair named like the folder's table keeps its report") {
  const SceneFolder scene;
  for (const char* name : {"ply", "rgs"}) fs::create_directory(scene.file(name));
  fs::copy(scene.ply, scene.file("ply/index.ply"));
  fs::copy(scene.rgs, scene.file("rgs/index.rgs"));
  const ProgramResult run =
      run_audit({scene.file("ply"), scene.file("rgs"), "--report", scene.file("out"), "--no-render"});
  CHECK(run.exit_code == 2);
  // Neither the report nor the table replaced the other.
  const std::string left = scene.file("out/index.json");
  if (fs::exists(left)) CHECK(json::parse(read_text(left))["pairs"][0]["status"] == "error");
}
