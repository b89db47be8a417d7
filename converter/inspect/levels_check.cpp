// levels_check.cpp - draws pages, chosen by a hash, and their children.
// SPDX-License-Identifier: Apache-2.0
#include "levels_check.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <span>
#include <utility>

#include "check_error.hpp"
#include "rgs/checksum.hpp"

namespace rgs::tool {
namespace {

constexpr std::uint64_t kMostRows = std::uint64_t{1} << 19;  // of a page and its children: of four of the largest, too
constexpr std::uint64_t kTableHeadBytes = 64, kRecordBytes = 112;  // docs/format/FORMAT.md, LODS

SplatView rows(const SplatView& all, std::uint64_t first, std::uint64_t n) {
  SplatView some = all;
  some.n = n;
  some.mean = all.mean.subspan(3 * first, 3 * n);
  some.log_scale = all.log_scale.subspan(3 * first, 3 * n);
  some.rotation = all.rotation.subspan(4 * first, 4 * n);
  some.opacity_logit = all.opacity_logit.subspan(first, n);
  const std::uint64_t n_sh = all.n == 0 ? 0 : all.sh.size() / all.n;
  some.sh = all.sh.subspan(n_sh * first, n_sh * n);
  return some;
}

std::uint64_t hash_of(std::uint64_t table, std::uint32_t page) {
  std::array<std::byte, 12> key;  // little-endian everywhere
  for (std::size_t k = 0; k < 8; ++k) key[k] = static_cast<std::byte>(table >> (8 * k));
  for (std::size_t k = 0; k < 4; ++k) key[8 + k] = static_cast<std::byte>(page >> (8 * k));
  return xxh3(key);
}

// Pages in an order that looks random and that the hash of the table decides, which covers all pages' hashes.
std::vector<std::uint32_t> draw(const PagedFile& file, double share, std::uint32_t& n_inner) {
  const std::uint64_t table = file.head().find(SectionType::levels)->xxh3;
  const std::uint32_t n_present = file.n_present();
  std::vector<std::pair<std::uint64_t, std::uint32_t>> inner;
  for (std::uint32_t i = 0; i < n_present; ++i) {
    const lod::Page& page = file.pages()[i];
    if (page.n_children == 0 || page.first_child + page.n_children > n_present) continue;
    inner.emplace_back(hash_of(table, i), i);
  }
  n_inner = static_cast<std::uint32_t>(inner.size());
  const auto wanted =
      static_cast<std::size_t>(std::max(1.0, std::ceil(share * static_cast<double>(inner.size()) - 1e-9)));
  std::ranges::sort(inner);
  inner.resize(std::min(wanted, inner.size()));
  std::vector<std::uint32_t> pages(inner.size());
  std::ranges::transform(inner, pages.begin(), [](const auto& each) { return each.second; });
  std::ranges::sort(pages);
  return pages;
}

}  // namespace

std::uint64_t record_offset(const PagedFile& file, std::uint32_t page) {
  return file.head().find(SectionType::levels)->offset + kTableHeadBytes + kRecordBytes * page;
}

Result<LevelsCheck> check_levels(const PagedFile& file, double share) {
  LevelsCheck check;
  check.share = share;
  check.tolerance = is_archive(file.codec()) ? lod::kLossyErrorTolerance : lod::kErrorTolerance;
  for (const std::uint32_t i : draw(file, share, check.n_inner)) {
    const lod::Page& page = file.pages()[i];
    std::vector<std::uint32_t> group{i};
    std::uint64_t n_rows = page.count;
    for (std::uint32_t k = 0; k < page.n_children; ++k) {
      group.push_back(page.first_child + k);
      n_rows += file.pages()[group.back()].count;
    }
    if (n_rows > kMostRows) continue;
    const auto splats = read_pages(file, group, {.validate = false});
    if (!splats) return tl::unexpected(splats.error());
    const SplatView all = splats->view();
    const float measured =
        lod::error_against(rows(all, page.count, all.n - page.count), rows(all, 0, page.count), page.error);
    if (measured > check.tolerance * page.error) check.refuted.push_back({i, measured});
    ++check.n_checked;
  }
  return check;
}

}  // namespace rgs::tool
