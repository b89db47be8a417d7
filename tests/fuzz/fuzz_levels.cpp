// fuzz_levels.cpp - arbitrary bytes as an .rgs file with levels of detail or a prefix of one: read whole, read in pieces,
// and drawn from memory and streamed.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <glm/gtc/matrix_transform.hpp>
#include <limits>
#include <random>

#include "edit_file.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/renderer.hpp"
#include "rgs/scene.hpp"

#if defined(RGS_LIBFUZZER)
#include "rgs_mutator.hpp"

// libFuzzer's counters of the code that ran. In assembly, since clang renames what it uses itself.
extern std::uint8_t* const counters[2] __asm__("counters");
__asm__(".data; counters: .quad __start___sancov_cntrs, __stop___sancov_cntrs; .text");

extern "C" std::size_t LLVMFuzzerCustomMutator(std::uint8_t* data, std::size_t size, std::size_t max_size,
                                               unsigned seed) {
  return rgs::fuzz::mutate_rgs(data, size, max_size, seed);
}
#endif

namespace {

// What threads run depends on their turns. libFuzzer must not see it, so that the same runs follow from the same code.
class UncountedCode {
#if defined(RGS_LIBFUZZER)
 public:
  ~UncountedCode() {
    std::ranges::copy(before_, counters[0]);
  }

 private:
  std::vector<std::uint8_t> before_{counters[0], counters[1]};
#endif
};

class MemorySource final : public rgs::ByteSource {
 public:
  explicit MemorySource(std::span<const std::byte> bytes) : bytes_(bytes) {}
  std::uint64_t size() const override { return bytes_.size(); }
  rgs::Status read(std::uint64_t offset, std::span<std::byte> out) override {
    if (offset > bytes_.size() || out.size() > bytes_.size() - offset) std::abort();  // callers stay inside
    std::ranges::copy(bytes_.subspan(offset, out.size()), out.begin());
    return {};
  }
  void cancel() noexcept override {}
  Traits traits() const override { return {.reads_at_once = 1}; }

 private:
  std::span<const std::byte> bytes_;
};

// Looks at the root's core from in front of it, or from its middle.
rgs::Camera camera_of(const rgs::Box& core, bool is_inside) {
  const glm::dvec3 least(core.min[0], core.min[1], core.min[2]), most(core.max[0], core.max[1], core.max[2]);
  const glm::dvec3 middle = (least + most) / 2.0, sides = most - least;
  glm::dmat4 world_to_camera = glm::translate(glm::dmat4(1), -middle);
  if (!is_inside) world_to_camera[3].z += 2 * std::max({sides.x, sides.y, sides.z});
  return *rgs::make_camera(world_to_camera, {16, 16, 16, 16, 8, 8});
}

struct Picture {
  std::vector<float> rgb = std::vector<float>(16 * 16 * 3), alpha = std::vector<float>(16 * 16);
  bool operator==(const Picture& other) const {
    return std::memcmp(rgb.data(), other.rgb.data(), rgb.size() * sizeof(float)) == 0 &&
           std::memcmp(alpha.data(), other.alpha.data(), alpha.size() * sizeof(float)) == 0;
  }
};

// Draws the first frame; of a valid file also the complete one, which is the picture of the scene in memory.
void draw_streamed(std::span<const std::byte> bytes, const rgs::PagedFile& file, bool valid) {
  [[maybe_unused]] const UncountedCode uncounted;
  static rgs::Renderer renderer = *rgs::Renderer::create({.backend = rgs::Backend::cpu, .threads = 1});
  const auto streamed = rgs::Scene::open(std::make_unique<MemorySource>(bytes), {.pool = *rgs::StreamPool::create()});
  if (!streamed) {
    if (valid && file.n_present() > 0) std::abort();
    return;
  }
  const rgs::RenderOptions options{.detail_px = static_cast<float>(bytes.size() % 64)};
  for (const bool is_inside : {false, true}) {
    const rgs::Camera camera = camera_of(file.pages().front().core, is_inside);
    Picture first, complete, whole;
    const bool drawn =
        renderer.render(*streamed, camera, {.rgb = first.rgb, .alpha = first.alpha}, options).has_value();
    if (!valid) continue;
    const auto refined = renderer.refine(*streamed, camera, std::numeric_limits<double>::infinity(), options);
    const bool cut_off = !file.complete() && !refined && refined.error().code == rgs::Errc::truncated;
    if (!drawn || !(cut_off || (refined && *refined))) std::abort();
    if (!renderer.render(*streamed, camera, {.rgb = complete.rgb, .alpha = complete.alpha}, options)) std::abort();
    if (!file.complete()) continue;
    const auto scene = rgs::Scene::load(bytes);
    if (!scene || !renderer.render(*scene, camera, {.rgb = whole.rgb, .alpha = whole.alpha}, options)) std::abort();
    if (!(whole == complete)) std::abort();
  }
}

// Decodes all pages, then draws.
void read_levels(std::span<const std::byte> bytes) {
  const auto file = rgs::PagedFile::open(bytes);
  if (!file) return;
  const bool valid = rgs::validate(*file, 1).has_value();
  rgs::PageDecoder decoder(*file);
  std::vector<std::byte> memory(file->largest_decoded_bytes());
  bool read = true;
  for (std::uint32_t i = 0; i < file->n_present(); ++i) {
    const auto rows = decoder.decode(i, file->bytes(i), std::span(memory).first(file->decoded_bytes(i)));
    read = read && rows;
    if (!rows) continue;
    std::vector<rgs::Splat> splats(rows->n);
    std::vector<rgs::ActivatedSplat> activated(rows->n);
    const bool checked = rgs::check_page_values(*file, i, *rows).has_value();
    const bool page_read = rgs::read_page(*file, i, *rows, 0, std::span(splats)).has_value() &&
                           rgs::read_page(*file, i, *rows, 0, std::span(activated)).has_value();
    if (checked && !page_read) std::abort();
    read = read && page_read;
  }
  for (std::uint64_t i = 0; i < file->head().header().n_gaussians; ++i) static_cast<void>(file->source_index(i));
  const auto cut = rgs::lod::finest_cut(file->pages(), bytes.size() % 1000, file->n_present());
  const auto of_cut = rgs::read_pages(*file, cut, {.validate = false, .threads = 1});
  const auto plain = rgs::leaves_as_file(*file, {.validate = false, .threads = 1});
  const auto cloud = rgs::decode(bytes);
  if (cloud && !cloud->view().consistent()) std::abort();
  if (valid && (!read || !of_cut || (file->complete() && !(plain && cloud && rgs::decode(*plain))))) std::abort();
  draw_streamed(bytes, *file, valid);
}

// An exact-size copy, freed after the call.
rgs::Status extend(rgs::PagedFile& file, std::uint64_t offset, std::span<const std::byte> bytes,
                   std::uint32_t below = rgs::lod::kNoPage) {
  const std::vector<std::byte> copy(bytes.begin(), bytes.end());
  return file.extend({offset, copy}, below);
}

// The table below any known page, in an order cut by `random`: the pages of `whole`, or an error.
void read_anywhere(rgs::PagedFile file, std::span<const std::byte> bytes, const rgs::Result<rgs::PagedFile>& whole,
                   std::mt19937_64& random) {
  if (file.n_pages_in_all() > bytes.size() || !file.reserve()) return;
  const auto is_known = [&](std::uint64_t page) { return file.pages()[page].count > 0; };
  while (!file.is_verified()) {
    const auto n = static_cast<std::uint32_t>(file.pages().size());
    auto page = static_cast<std::uint32_t>(random() % n), n_looks = n;
    const auto is_wanted = [&] {
      const rgs::lod::Page& one = file.pages()[page];
      return one.n_children > 0 && !is_known(one.first_child + one.n_children - 1);
    };
    for (; n_looks > 0 && !is_wanted(); --n_looks) page = (page + 1) % n;
    const rgs::FileRange unread = n_looks > 0 ? file.unread_table(page, 112 + random() % 2000) : rgs::FileRange();
    if (unread.offset >= bytes.size() || unread.bytes > bytes.size() - unread.offset) break;
    if (n_looks == 0 || !extend(file, unread.offset, bytes.subspan(unread.offset, unread.bytes), page)) break;
    const auto drawn = rgs::lod::drawn_pages(file.pages(), {.position = {}}, 1);
    if (drawn.empty() || !std::ranges::all_of(drawn, is_known)) std::abort();
  }
  if (whole && whole->complete() && !file.is_verified()) std::abort();
  if (file.is_verified() && !rgs::lod::check_pages(file.pages(), file.head().header().chunk_size)) std::abort();
}

// The same file or prefix, fetched in pieces cut by `seed`: the same pages, or an error.
void read_in_pieces(std::span<const std::byte> bytes, std::uint64_t seed) {
  std::mt19937_64 random(seed);
  std::vector<std::vector<std::byte>> pieces;
  std::vector<rgs::FilePart> parts;
  const auto fetch = [&](std::uint64_t offset, std::uint64_t n) {
    if (offset > bytes.size() || n > bytes.size() - offset) return false;
    const auto range = bytes.subspan(offset, n);
    pieces.emplace_back(range.begin(), range.end());
    parts.push_back({offset, pieces.back()});
    return true;
  };
  fetch(0, random() % (bytes.size() + 1));
  const auto whole = rgs::PagedFile::open(bytes);
  for (auto needs = rgs::PagedFile::needs(parts); !needs || !needs->empty(); needs = rgs::PagedFile::needs(parts)) {
    const bool there =
        needs && std::ranges::all_of(*needs, [&](const auto& range) { return fetch(range.offset, range.bytes); });
    if (there) continue;
    if (whole || rgs::PagedFile::open_beginning(parts)) std::abort();
    return;
  }
  auto file = rgs::PagedFile::open_beginning(parts);
  if (!file && whole) std::abort();
  if (!file) return;
  pieces.clear();
  read_anywhere(*file, bytes, whole, random);
  rgs::Status extended;
  while (extended && !file->is_verified()) {
    const rgs::FileRange unread = file->unread_table();
    const std::uint64_t first = unread.offset - random() % std::min<std::uint64_t>(unread.offset, 300),
                        end = std::min<std::uint64_t>(unread.offset + 112 + random() % 2000, bytes.size());
    const std::uint32_t before = file->n_pages();
    if (first >= end) break;
    extended = extend(*file, first, bytes.subspan(first, end - first));
    if (file->n_pages() < before || (!extended && file->n_pages() != before)) std::abort();
    if (extended && file->n_pages() == before) break;  // the file ends inside the table
  }
  if (whole && !file->is_verified()) std::abort();
  const auto cut = rgs::lod::finest_cut(file->pages(), bytes.size() % 1000);
  const auto drawn = rgs::lod::drawn_pages(file->pages(), {.position = {}}, 1);
  if (drawn.empty() || (file->pages().front().count <= bytes.size() % 1000 && cut.empty())) std::abort();
  if (file->memory_bytes() > file->whole_memory_bytes() || file->largest_decoded_bytes() > file->most_decoded_bytes()) {
    std::abort();
  }
  if (file->is_verified() && !rgs::lod::check_pages(file->pages(), file->head().header().chunk_size)) std::abort();
  rgs::PageDecoder decoder(*file);
  std::vector<std::byte> memory(file->largest_decoded_bytes()), expected(memory.size());
  for (std::uint32_t i = 0; i < file->n_within(bytes.size()); ++i) {
    const auto stored = bytes.subspan(file->stored(i).offset, file->stored(i).stored_bytes);
    const auto out = std::span(memory).first(file->decoded_bytes(i));
    const auto rows = decoder.decode(i, stored, out);
    if (!whole) continue;
    const auto of_whole = std::span(expected).first(whole->decoded_bytes(i));
    const bool same = rgs::PageDecoder(*whole).decode(i, whole->bytes(i), of_whole).has_value() == rows.has_value() &&
                      out.size() == of_whole.size() && (!rows || std::ranges::equal(out, of_whole));
    if (!same) std::abort();
  }
}

void read_all(std::span<const std::byte> bytes) {
  read_in_pieces(bytes, rgs::xxh3(bytes));
  read_levels(bytes);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const auto bytes = std::as_bytes(std::span(data, size));
  read_all(bytes);
  read_all(rgs::test::repaired(bytes));
  return 0;
}
