// fuzz_lcc.cpp - arbitrary bytes as the files of an LCC, LCC2 or tileset are an error or a scene. An input holds the JSON, index.bin,
// data.bin, shcoef.bin and 0.spz, each after its length (u32).
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <span>

#include "check_levels.hpp"
#include "rgs/file.hpp"
#include "rgs/interchange.hpp"
#include "temporary_folder.hpp"

namespace {

void require(bool condition) {
  if (!condition) std::abort();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const rgs::test::TemporaryFolder folder;
  std::span<const std::uint8_t> rest(data, size);
  for (const char* name : {"a.lcc", "index.bin", "data.bin", "shcoef.bin", "0.spz"}) {
    std::uint32_t length = 0;
    std::memcpy(&length, rest.data(), std::min(rest.size(), sizeof length));
    rest = rest.subspan(std::min(rest.size(), sizeof length));
    const auto file = rest.first(std::min<std::size_t>(rest.size(), length));
    std::ofstream(folder.file(name), std::ios::binary)
        .write(reinterpret_cast<const char*>(file.data()), std::ssize(file));
    rest = rest.subspan(file.size());
  }
  rgs::ReadOptions options;
  options.keep_axes = true;
  const auto file = rgs::read_splats(folder.file("a.lcc"), options);
  if (!file) {
    require(rgs::exit_code(file.error().code) >= 3 && file.error().what[0] != '\0');  // a chunk may have another name
    return 0;
  }
  require(file->cloud.view().consistent());
  if (file->format == rgs::SplatFormat::lcc) require(file->cloud.size() <= size / 32);
  const auto json = rgs::MappedFile::open(folder.file("a.lcc"));
  require(json.has_value());
  if (file->format != rgs::SplatFormat::tileset)
    rgs::test::check_levels(json->bytes(), folder.path().string(), file->cloud.size());
  options.level_of_detail = 1;
  const auto coarser = rgs::read_splats(folder.file("a.lcc"), options);
  if (coarser) require(coarser->cloud.view().consistent());
  return 0;
}
