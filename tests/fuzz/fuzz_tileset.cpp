// fuzz_tileset.cpp - arbitrary bytes as the files of a tileset are an error or a scene, and so are its levels. An input
// holds tileset.json, two subtrees, a buffer and a content, each after its length (u32).
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"
#include "rgs/level_tree.hpp"
#include "temporary_folder.hpp"

namespace {

void require(bool condition) {
  if (!condition) std::abort();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const rgs::test::TemporaryFolder folder;
  std::span<const std::uint8_t> rest(data, size);
  std::span<const std::uint8_t> stated;
  for (const char* name : {"tileset.json", "0.0.0.subtree", "1.1.0.subtree", "bits.bin", "1.1.0.glb"}) {
    std::uint32_t length = 0;
    std::memcpy(&length, rest.data(), std::min(rest.size(), sizeof length));
    rest = rest.subspan(std::min(rest.size(), sizeof length));
    const auto file = rest.first(std::min<std::size_t>(rest.size(), length));
    if (stated.data() == nullptr) stated = file;
    std::ofstream(folder.file(name), std::ios::binary)
        .write(reinterpret_cast<const char*>(file.data()), std::ssize(file));
    rest = rest.subspan(file.size());
  }
  rgs::ReadOptions options;
  options.keep_axes = true;
  const auto file = rgs::read_splats(folder.file("tileset.json"), options);
  require(file ? file->cloud.view().consistent() : rgs::exit_code(file.error().code) >= 3);
  const auto tree = rgs::open_levels(std::as_bytes(stated), folder.path().string(), options);
  if (!tree || !tree->read) return 0;
  // Nodes without children hold what is read.
  std::vector<bool> is_leaf(tree->nodes.size(), true);
  std::uint64_t n = 0;
  for (std::size_t i = tree->nodes.size(); i-- > 0;) {
    if (is_leaf[i]) n += tree->nodes[i].n;
    if (tree->nodes[i].parent != rgs::LevelTree::kNoParent) is_leaf[tree->nodes[i].parent] = false;
  }
  require(tree->nodes.empty() || !file || n == file->cloud.size());
  (void)tree->read([&](std::uint32_t node, const rgs::SplatFile& piece) -> rgs::Status {
    require(node < tree->nodes.size() && piece.cloud.size() == tree->nodes[node].n);
    require(tree->nodes[node].parent == rgs::LevelTree::kNoParent || tree->nodes[node].parent < node);
    return {};
  });
  return 0;
}
