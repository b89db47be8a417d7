// view_site_test.cpp - who may ask for what. SPDX-License-Identifier: Apache-2.0
#include "view_site.hpp"

#include <doctest/doctest.h>

#include <chrono>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <string>
#include <utility>
#include <vector>

#include "temporary_folder.hpp"
#include "text_file.hpp"

using nlohmann::json;
using rgs::test::write_text;
using rgs::view::HttpAnswer;
using rgs::view::HttpRequest;
using rgs::view::ViewSite;
using Fields = std::vector<std::pair<std::string, std::string>>;

namespace {

constexpr int kPort = 4711;
const std::string kToken = "0123456789abcdef0123456789abcdef";

struct Site {
  rgs::test::TemporaryFolder folder;
  ViewSite site{kToken, kPort};

  Site() {
    std::filesystem::create_directories(folder.path() / "page/assets");
    write_text(folder.file("page/index.html"), "<!doctype html>");
    write_text(folder.file("page/assets/index-D4f_x2Ab.js"), "export {};");
    write_text(folder.file("page/assets/logo.svg"), "<svg/>");
    write_text(folder.file("scene.rgs"), "0123456789");
    write_text(folder.file("secret"), "nobody's business");
    // Older than its replacements below: a file's time is that of the kernel's last tick.
    for (const auto& entry : std::filesystem::recursive_directory_iterator(folder.path()))
      std::filesystem::last_write_time(entry, std::filesystem::file_time_type::clock::now() - std::chrono::hours(1));
    REQUIRE(site.add_page(folder.file("page")));
    REQUIRE(site.add_file("scenes/0/my scene.rgs", folder.file("scene.rgs")));
    site.add_json("view.json", "{}");
    site.add_action("frame", [](const std::string& body) { return HttpAnswer{.type = "image/png", .body = body}; });
  }

  // The decoded path, in the server's form.
  HttpAnswer ask(const std::string& path, const std::string& method = "GET", Fields fields = {},
                 const std::string& host = "127.0.0.1:4711") const {
    if (!host.empty()) fields.emplace_back("Host", host);
    const HttpRequest request{method, path, "", std::move(fields)};
    const auto handlers = site.handlers();
    const auto refusal = handlers.refuse(request);
    return refusal ? *refusal : handlers.answer(request);
  }
  HttpAnswer get(const std::string& name, Fields fields = {}) const {
    return ask("/" + kToken + "/" + name, "GET", std::move(fields));
  }
  HttpAnswer post(Fields fields) const { return ask("/" + kToken + "/frame", "POST", std::move(fields)); }
};

std::string field(const HttpAnswer& answer, const std::string& name) {
  for (const auto& [key, value] : answer.fields)
    if (key == name) return value;
  return {};
}

std::string content(const HttpAnswer& answer) {
  if (answer.file == nullptr) return answer.body;
  std::string text(answer.count, '\0');
  return answer.file->read_at(answer.first, text) ? text : "unreadable";
}

std::string code(const HttpAnswer& answer) {
  return json::parse(answer.body)["error"]["code"];
}

}  // namespace

TEST_CASE("named files are served with the type of their names") {
  const Site s;
  CHECK(content(s.get("")) == "<!doctype html>");
  CHECK(content(s.get("index.html")) == "<!doctype html>");
  CHECK(s.get("").type == "text/html; charset=utf-8");
  CHECK(s.get("assets/index-D4f_x2Ab.js").type == "text/javascript; charset=utf-8");
  CHECK(content(s.get("scenes/0/my scene.rgs")) == "0123456789");
  CHECK(s.get("view.json").type == "application/json");
  CHECK(s.get("view.json").body == "{}");
  CHECK(s.ask("/" + kToken).status == 308);
  CHECK(field(s.ask("/" + kToken), "Location") == "/" + kToken + "/");
}

TEST_CASE("nothing else is served, however the path is written") {
  const Site s;
  for (const std::string name :
       {"../secret", "..", "../", "assets/../../secret", "scenes/0/../../../secret", "./index.html", "/etc/passwd",
        "//etc/passwd", "assets", "assets/", "scenes/0/", "scenes/1/my scene.rgs", "index.html/", "INDEX.HTML",
        "..\\secret", "secret", "%2e%2e/secret", "cameras.json"}) {
    CAPTURE(name);
    const HttpAnswer answer = s.get(name);
    CHECK(answer.status == 404);
    CHECK(code(answer) == "not_found");
  }
  CHECK(s.get(std::string("index.html\0", 11)).status == 404);
}

TEST_CASE("another token, or a part of the token, is refused") {
  const Site s;
  for (const std::string& path :
       {std::string("/"), std::string(""), std::string("index.html"), "/" + kToken.substr(1) + "/", "/" + kToken + "0/",
        std::string("/0123456789abcdef0123456789abcdeF/"), std::string("/1123456789abcdef0123456789abcdef/"),
        std::string("//") + kToken + "/", "/../" + kToken + "/", "/x" + kToken + "/view.json",
        std::string("/view.json"), std::string("*")}) {
    CAPTURE(path);
    const HttpAnswer answer = s.ask(path);
    CHECK(answer.status == 403);
    CHECK(code(answer) == "wrong_token");
    CHECK(answer.body.find(kToken) == std::string::npos);
  }
}

TEST_CASE("hosts and origins other than this server's are refused") {
  const Site s;
  const std::string path = "/" + kToken + "/";
  CHECK(s.ask(path, "GET", {}, "localhost:4711").status == 200);
  for (const std::string host :
       {"", "evil.example", "evil.example:4711", "127.0.0.1", "127.0.0.1:80", "127.0.0.1:47110", "localhost",
        "127.0.0.1:4711.evil.example", "0.0.0.0:4711", "[::1]:4711"}) {
    CAPTURE(host);
    CHECK(code(s.ask(path, "GET", {}, host)) == "other_host");
  }
  CHECK(code(s.ask(path, "GET", {{"Host", "127.0.0.1:4711"}})) == "other_host");  // two of them
  CHECK(s.ask(path, "GET", {{"Origin", "http://127.0.0.1:4711"}}).status == 200);
  for (const char* origin : {"", "null", "http://evil.example", "https://127.0.0.1:4711", "http://127.0.0.1:4712",
                             "http://localhost:4711", "http://127.0.0.1:4711/"}) {
    CAPTURE(origin);
    CHECK(code(s.ask(path, "GET", {{"Origin", origin}})) == "other_origin");
  }
}

TEST_CASE("an address accepts only its own methods and bodies") {
  const Site s;
  const std::string index = "/" + kToken + "/", frame = index + "frame";
  for (const char* method : {"POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE", "CONNECT"}) {
    CHECK(s.ask(index, method).status == 405);
    CHECK(field(s.ask(index, method), "Allow") == "GET, HEAD");
  }
  for (const char* method : {"GET", "HEAD", "PUT", "OPTIONS"}) {
    CHECK(s.ask(frame, method).status == 405);
    CHECK(field(s.ask(frame, method), "Allow") == "POST");
  }
  CHECK(s.ask(index, "HEAD").status == 200);
  CHECK(s.ask(index, "GET", {{"Content-Length", "5"}}).status == 413);
  CHECK(s.post({{"Content-Length", "65536"}}).status == 200);
  CHECK(s.post({{"Content-Length", "65536"}, {"Content-Type", "application/json; charset=utf-8"}}).status == 200);
  for (const char* length : {"65537", "99999999999999999999999", "-1", "1x", "", "0x10", " 1"}) {
    CAPTURE(length);
    CHECK(s.post({{"Content-Length", length}}).status == 413);
  }
  CHECK(s.post({}).status == 411);
  CHECK(s.post({{"Content-Length", "2"}, {"Content-Length", "3"}}).status == 400);
  CHECK(s.post({{"Transfer-Encoding", "chunked"}}).status == 411);
  CHECK(s.post({{"Content-Length", "2"}, {"Transfer-Encoding", "identity"}}).status == 411);
  CHECK(s.post({{"Content-Length", "2"}, {"Content-Encoding", "gzip"}}).status == 415);
  CHECK(s.post({{"Content-Length", "2"}, {"Content-Type", "multipart/form-data; boundary=x"}}).status == 415);
  CHECK(s.post({{"Content-Length", "2"}, {"Content-Type", "application/x-www-form-urlencoded"}}).status == 415);
}

TEST_CASE("parts of a file are answered with their range") {
  const Site s;
  const std::string name = "scenes/0/my scene.rgs";
  const HttpAnswer part = s.get(name, {{"Range", "bytes=2-4"}});
  CHECK(part.status == 206);
  CHECK(field(part, "Content-Range") == "bytes 2-4/10");
  CHECK(content(part) == "234");
  CHECK(content(s.get(name, {{"Range", "bytes=-3"}})) == "789");
  CHECK(s.get(name, {{"Range", "bytes=4-2"}}).status == 200);
  CHECK(s.get(name, {{"Range", "bytes=0-1,3-4"}}).status == 200);
  CHECK(content(s.get(name, {{"Range", "bytes=0-1,3-4"}})) == "0123456789");
  CHECK(s.get(name, {{"Range", "bytes=0-1"}, {"Range", "bytes=3-4"}}).status == 200);
  const HttpAnswer beyond = s.get(name, {{"Range", "bytes=10-"}});
  CHECK(beyond.status == 416);
  CHECK(field(beyond, "Content-Range") == "bytes */10");
  CHECK(s.ask("/" + kToken + "/" + name, "HEAD", {{"Range", "bytes=2-4"}}).status == 200);

  const std::string tag = field(part, "ETag");
  CHECK(tag.size() > 2);
  CHECK(s.get(name, {{"Range", "bytes=2-4"}, {"If-Range", tag}}).status == 206);
  CHECK(s.get(name, {{"Range", "bytes=2-4"}, {"If-Range", "\"older\""}}).status == 200);
  CHECK(s.get(name, {{"Range", "bytes=2-4"}, {"If-Range", "W/" + tag}}).status == 200);
  CHECK(s.get(name, {{"Range", "bytes=2-4"}, {"If-Range", "Mon, 23 Nov 2026 14:00:00 GMT"}}).status == 200);
}

TEST_CASE("a file that was changed, removed or replaced is an error") {
  const Site s;
  const std::string name = "scenes/0/my scene.rgs", path = s.folder.file("scene.rgs");
  const auto before = s.get(name);
  write_text(s.folder.file("other"), "0123456789");
  std::filesystem::rename(s.folder.file("other"), path);
  CHECK(s.get(name).status == 409);
  CHECK(code(s.get(name)) == "read_failed");
  CHECK(content(before) == "0123456789");  // the open file is the requested one
  std::filesystem::remove(path);
  CHECK(s.get(name).status == 410);

  write_text(s.folder.file("page/index.html"), "<!doctype html>");  // the same bytes again
  CHECK(s.get("").status == 409);
}

TEST_CASE("a file written to while it is open is not read further") {
  const Site s;
  const auto before = s.get("scenes/0/my scene.rgs");
  write_text(s.folder.file("scene.rgs"), "abcdefghij");
  CHECK(content(before) == "unreadable");
}

TEST_CASE("every answer states what the page may do, and only immutable ones are cached") {
  const Site s;
  for (const HttpAnswer& answer :
       {s.get(""), s.get("view.json"), s.get("nothing"), s.ask("/"), s.site.handlers().fail(500),
        s.post({{"Content-Length", "0"}}), s.get("", {{"Range", "bytes=100-"}})}) {
    CHECK(field(answer, "Content-Security-Policy").find("script-src 'self' 'wasm-unsafe-eval';") != std::string::npos);
    CHECK(field(answer, "Content-Security-Policy").starts_with("default-src 'none';"));
    CHECK(field(answer, "X-Content-Type-Options") == "nosniff");
    CHECK(field(answer, "Referrer-Policy") == "no-referrer");
    CHECK(field(answer, "Cross-Origin-Resource-Policy") == "same-origin");
    CHECK(field(answer, "Cache-Control") == "no-store");
  }
  CHECK(field(s.get("assets/index-D4f_x2Ab.js"), "Cache-Control").ends_with("immutable"));
  CHECK(field(s.get("assets/logo.svg"), "Cache-Control") == "no-store");
}

TEST_CASE("a folder without index.html is refused, and tokens never repeat") {
  const rgs::test::TemporaryFolder folder;
  ViewSite site(kToken, kPort);
  CHECK(!site.add_page(folder.path().string()));
  CHECK(!site.add_page(folder.file("nowhere")));
  const auto a = rgs::view::random_token(), b = rgs::view::random_token();
  REQUIRE((a && b));
  CHECK(a->size() == 32);
  CHECK(a->find_first_not_of("0123456789abcdef") == std::string::npos);
  CHECK(*a != *b);
}

TEST_CASE("errors are JSON with code, message and offset") {
  const HttpAnswer damaged =
      rgs::view::error_answer({rgs::Errc::checksum_mismatch, 4096, "the section is damaged", 1, 2});
  CHECK(damaged.status == 422);
  const json body = json::parse(damaged.body)["error"];
  CHECK(body["code"] == "checksum_mismatch");
  CHECK(body["offset"] == 4096);
  CHECK(std::string(body["message"]).find("the section is damaged") != std::string::npos);
  CHECK(json::parse(rgs::view::error_body("a", "b\xff"))["error"]["offset"] == nullptr);
  CHECK(rgs::view::error_answer({rgs::Errc::bad_camera}).status == 400);
  CHECK(rgs::view::error_answer({rgs::Errc::host_out_of_memory}).status == 503);
  CHECK(rgs::view::error_answer({rgs::Errc::device_failed}).status == 500);
}
