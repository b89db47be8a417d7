// write_golden.cpp - writes the golden files that this version writes, and the files with one defect, into a folder that
// has those of earlier versions: rgs_write_golden FOLDER
// SPDX-License-Identifier: Apache-2.0
#include <cstdio>
#include <filesystem>
#include <fstream>

#include "golden_levels.hpp"
#include "golden_scenes.hpp"
#include "reject_cases.hpp"

namespace {

bool write(const std::filesystem::path& path, const std::vector<std::byte>& bytes) {
  std::ofstream out(path, std::ios::binary);
  out.write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
  return static_cast<bool>(out.flush());
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fputs("usage: rgs_write_golden FOLDER\n", stderr);
    return 2;
  }
  const std::filesystem::path folder = argv[1];
  for (const auto& scene : rgs::test::golden_scenes()) {
    if (scene.earlier) continue;
    const auto bytes = rgs::encode(scene.cloud.view(), scene.options);
    if (!bytes || !write(folder / (scene.name + ".rgs"), *bytes)) {
      std::fprintf(stderr, "%s.rgs: %s\n", scene.name.c_str(), bytes ? "cannot be written" : bytes.error().what);
      return 1;
    }
  }
  for (const auto& scene : rgs::test::all_golden_levels()) {
    if (scene.earlier) continue;
    const auto bytes = rgs::test::encode_levels(scene);
    if (bytes.empty() || !write(folder / (scene.name + ".rgs"), bytes)) {
      std::fprintf(stderr, "%s.rgs cannot be written\n", scene.name.c_str());
      return 1;
    }
  }
  const std::filesystem::path reject = folder / "reject";
  std::filesystem::create_directories(reject);
  std::ofstream list(reject / "reject.txt", std::ios::binary);
  list << "# file, error, byte offset\n";
  for (const auto& c : rgs::test::reject_cases(folder)) {
    if (!write(reject / (c.name + ".rgs"), c.bytes)) return 1;
    list << c.name << ".rgs " << rgs::errc_name(c.code) << ' ' << c.offset << '\n';
  }
  return list.flush() ? 0 : 1;
}
