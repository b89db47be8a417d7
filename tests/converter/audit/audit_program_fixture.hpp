// audit_program_fixture.hpp - rgs-audit as a child process, a scene to audit, and a browser for its pages.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "audit_scenes_fixture.hpp"
#include "rgs/checksum.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

namespace rgs::test {

inline ProgramResult run_audit(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), built("rgs-audit"));
  return run_program(arguments);
}

// A folder with scene.ply, scene.rgs and three cameras of 96x72 pixels.
struct SceneFolder : TemporaryFolder {
  SplatCloud cloud = audit_cloud();
  std::string ply = write_ply(file("scene.ply"), cloud);
  std::string rgs;
  std::string cameras = write_cameras(file("cameras.json"), 3);

  SceneFolder() {
    EncodeOptions options;
    options.provenance = Provenance{std::filesystem::file_size(ply), 0, "scene.ply", "a test"};
    options.provenance->source_xxh3 = xxh3(MappedFile::open(ply)->bytes());
    rgs = write_rgs(file("scene.rgs"), cloud, options);
  }
  nlohmann::json result(std::vector<std::string> more = {}) const {
    std::vector<std::string> arguments{ply, rgs, "--cameras", cameras, "--json", "-", "--quiet"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    const ProgramResult run = run_audit(arguments);
    INFO(run.err);
    REQUIRE((run.exit_code == 0 || run.exit_code == 5));
    return nlohmann::json::parse(run.out);
  }
};

inline std::string browser() {
  for (const char* path : {"/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"})
    if (::access(path, X_OK) == 0) return path;
  return {};
}

// Opens a page with its own test enabled; checks the verdict that it leaves in the document, and that the console stays
// empty.
inline void check_in_browser(const TemporaryFolder& folder, const std::string& page, const std::string& expected) {
  const std::string program = browser();
  for (const char* window : {"--window-size=1280,900", "--window-size=500,900"}) {
    const ProgramResult run =
        run_program({program, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
                     "--no-first-run", "--enable-logging=stderr", "--user-data-dir=" + folder.file("profile"), window,
                     "--virtual-time-budget=4000", "--dump-dom", "file://" + page + "#self-test"},
                    [&] { ::setenv("HOME", folder.path().c_str(), 1); });
    const std::size_t at = run.out.find("data-self-test=\"");
    REQUIRE(at != std::string::npos);
    CHECK(run.out.substr(at + 16, run.out.find('"', at + 16) - at - 16) == expected);
    CHECK_MESSAGE(run.err.find("CONSOLE") == std::string::npos, run.err);
  }
}

}  // namespace rgs::test
