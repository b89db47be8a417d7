// scene_input.cpp - opens inputs by path, or spools standard input.
// SPDX-License-Identifier: Apache-2.0
#include "scene_input.hpp"

#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <filesystem>
#include <numeric>
#include <string_view>
#include <system_error>
#include <utility>
#include <vector>

#include "input_files.hpp"
#include "rgs/checksum.hpp"
#include "rgs/layout.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/splat_edit.hpp"
#include "rgs/utf8_path.hpp"

namespace rgs {
namespace {

// The text of a .prj, as ESRI's programs and many others write; empty: there is none, or it is not WKT.
std::string read_prj(const std::string& path) {
  constexpr std::string_view kBlank = " \t\r\n", kBom = "\xEF\xBB\xBF";
  std::error_code ignored;
  if (!std::filesystem::is_regular_file(detail::path_of(path), ignored)) return {};
  const auto file = MappedFile::open(path);
  if (!file || file->bytes().size() > 2 * std::size_t{kMaxCrsText}) return {};
  std::string text(reinterpret_cast<const char*>(file->bytes().data()), file->bytes().size());
  if (text.starts_with(kBom)) text.erase(0, kBom.size());
  std::ranges::replace_if(
      text, [&](char c) { return kBlank.find(c) != kBlank.npos; }, ' ');
  text.erase(text.find_last_not_of(' ') + 1);
  text.erase(0, text.find_first_not_of(' '));
  return is_crs_text(text) && text.find('[') != text.npos && text.ends_with(']') ? text : std::string();
}

}  // namespace

Status SceneInput::open(const std::string& path) {
  path_ = path;
  if (path != "-") {
    auto file = MappedFile::open(path);
    if (!file) return tl::unexpected(file.error());
    file_ = std::move(*file);
    bytes_ = file_.bytes();
    if (const std::string prj = tool::prj_of(path); !prj.empty()) prj_ = read_prj(prj);
    return {};
  }
  constexpr unsigned kAtOnce = 1U << 20;
  std::vector<std::byte> buffer(kAtOnce);
  for (;;) {
    const ssize_t n = ::read(STDIN_FILENO, buffer.data(), kAtOnce);
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) {
      return make_error(Errc::read_failed, Error::kNone, "cannot read standard input", Error::kNone, Error::kNone,
                        errno);
    }
    if (n == 0) break;
    if (Status s = spool_.append(std::span(buffer).first(static_cast<std::size_t>(n))); !s) return s;
  }
  if (Status s = spool_.finish(); !s) return s;
  bytes_ = spool_.bytes();
  return {};
}

std::string SceneInput::name() const {
  std::string name = path_ == "-" ? "stdin" : detail::path_of(path_).filename().string();
  name.resize(std::min<std::size_t>(name.size(), kMaxProvenanceText));
  return name;
}

std::uint64_t SceneInput::hash() const {
  constexpr std::size_t kPart = std::size_t{16} << 20;
  Hasher hash;
  for (std::size_t first = 0; first < bytes_.size(); first += kPart) {
    hash.update(bytes_.subspan(first, std::min(kPart, bytes_.size() - first)));
    file_.advise(MappedFile::Access::done, first, kPart);
  }
  return hash.digest();
}

Result<SplatFile> SceneInput::read(ReadOptions options) const {
  options.keep_axes = true;
  // Read the hashed bytes, not the path, unless files beside it belong to it; a .glb begins with its name.
  const bool folder = path_ != "-" && format_info(detect_format(bytes_)).in_folder && bytes_.front() != std::byte{'g'};
  return folder ? read_splats(path_, options) : read_splats(bytes_, options);
}

Result<LevelTree> SceneInput::levels(const ReadOptions& options) const {
  if (path_ == "-") {  // nothing lies beside; a zip archive or a .rad may need nothing
    const bool alone = !bytes_.empty() && (bytes_.front() == std::byte{'P'} || bytes_.front() == std::byte{'R'});
    return alone ? open_levels(bytes_, "", options) : LevelTree();
  }
  const std::string folder = detail::path_of(path_).parent_path().string();
  return open_levels(bytes_, folder.empty() ? "." : folder, options);
}

Result<std::vector<std::uint32_t>> SceneInput::count_in_pages(const DecodeLimits& limits,
                                                              const Passing& passing) const {
  constexpr std::uint32_t kAtOnce = 64;  // pages
  std::vector<std::uint32_t> counts;
  if (!has_levels(bytes_)) return counts;
  const auto paged = PagedFile::open(bytes_, limits);
  if (!paged) return tl::unexpected(paged.error());
  for (const lod::Page& page : paged->pages()) counts.push_back(page.count);
  const std::uint32_t n = paged->n_present();
  for (std::uint32_t first = 0; first < n; first += kAtOnce) {
    std::vector<std::uint32_t> some(std::min(kAtOnce, n - first));
    std::iota(some.begin(), some.end(), first);
    auto cloud = read_pages(*paged, some, {.validate = false});
    if (!cloud) return tl::unexpected(cloud.error());
    strip_sh(*cloud, 0);  // colours do not matter for counting
    SplatFile file;
    file.axes = paged->head().declarations().axes;
    file.origin = paged->head().declarations().origin;
    file.cloud = std::move(*cloud);
    const std::vector<std::uint64_t> kept = passing(std::move(file));
    std::uint64_t begin = 0;
    for (const std::uint32_t page : some) {
      const std::uint64_t end = begin + paged->pages()[page].count;
      counts[page] =
          static_cast<std::uint32_t>(std::ranges::lower_bound(kept, end) - std::ranges::lower_bound(kept, begin));
      begin = end;
    }
  }
  return counts;
}

Result<Tile> SceneInput::tile(SplatFormat format, const ReadOptions& options) const {
  Tile tile;
  if (format != SplatFormat::ply) {
    tile.read = [this, options](const auto& visit) {
      ReadOptions with_visit = options;
      with_visit.visit = visit;
      return read(with_visit);
    };
    return tile;
  }
  auto ply = PlyFile::open(bytes_);
  if (!ply) return tl::unexpected(ply.error());
  tile.ply.emplace(std::move(*ply));
  if (file_.bytes().data() == bytes_.data()) tile.file = &file_;
  return tile;
}

std::uint64_t hash_of_sources(std::span<const std::uint64_t> hashes) {
  return hashes.size() == 1 ? hashes.front() : xxh3(std::as_bytes(hashes));
}

}  // namespace rgs
