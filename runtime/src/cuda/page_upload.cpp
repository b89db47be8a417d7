// page_upload.cpp - host threads decode pages of a file with levels of detail into page-locked memory, batch by batch.
//
// One batch is copied to the device while the other is decoded.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/page_upload.hpp"

#include <tbb/task_arena.h>

#include <algorithm>
#include <memory>
#include <mutex>
#include <optional>
#include <utility>

#include "cuda/cuda_objects.hpp"
#include "cuda/uploader.hpp"
#include "page_sections.hpp"
#include "parallel.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kBatchRows = std::uint64_t{1} << 18;  // 20 MB at SH degree 3, twice, page-locked

// Pages begin .. end - 1 of the file.
struct Batch {
  std::uint32_t begin, end;
};

struct Worker {
  explicit Worker(const PagedFile& file) : decoder(file), memory(file.largest_decoded_bytes() + 16) {}

  Result<PageRows> decode(const PagedFile& file, std::uint32_t page) {
    void* aligned = memory.data();
    std::size_t room = memory.size();
    std::align(16, file.decoded_bytes(page), aligned, room);
    return decoder.decode(page, file.bytes(page), {static_cast<std::byte*>(aligned), file.decoded_bytes(page)});
  }

  PageDecoder decoder;
  std::vector<std::byte> memory;
};

class PageUpload {
 public:
  PageUpload(const PagedFile& file, const PagePlan& plan, const SectionPlaces& places, CudaStream stream)
      : file_(file),
        plan_(plan),
        places_(places),
        stream_(stream),
        sh_degree_(file.head().header().sh_degree),
        row_bytes_(section_row_bytes(sh_degree_)) {}
  PageUpload(const PageUpload&) = delete;
  PageUpload& operator=(const PageUpload&) = delete;
  ~PageUpload() { cudaStreamSynchronize(stream_); }  // copies in progress read what is freed now

  Status run();

 private:
  void cut_batches();
  // Bytes of section k of a batch, and where it is staged.
  std::uint64_t bytes(std::size_t k, const Batch& batch) const {
    return rows(k, batch.begin, batch.end).second * row_bytes_[k];
  }
  std::uint64_t staged_at(std::size_t k, const Batch& batch) const {
    return k == 0 ? 0 : staged_at(k - 1, batch) + staged_section_bytes(bytes(k - 1, batch));
  }
  Status fill(const Batch& batch, std::byte* staged);
  Status fill_page(std::uint32_t page, const Batch& batch, std::byte* staged, Worker& worker) const;
  Status copy(const Batch& batch, const std::byte* staged) const;
  // First row and rows of section k of pages begin .. end - 1.
  std::pair<std::uint64_t, std::uint64_t> rows(std::size_t k, std::uint32_t begin, std::uint32_t end) const {
    const std::vector<std::uint64_t>& first = k == 3 ? plan_.first_set : plan_.first_chunk;
    const std::uint64_t unit = k < 3 ? plan_.chunk_size : 1;
    return {first[begin] * unit, (first[end] - first[begin]) * unit};
  }

  const PagedFile& file_;
  const PagePlan& plan_;
  const SectionPlaces& places_;
  CudaStream stream_;
  int sh_degree_;
  std::array<std::uint64_t, 5> row_bytes_;
  std::vector<Batch> batches_;
  Uploader ring_;
  std::mutex mutex_;  // of the idle workers
  std::vector<std::unique_ptr<Worker>> idle_;
};

void PageUpload::cut_batches() {
  for (std::uint32_t page = 0; page < plan_.n_pages; ++page) {
    if (batches_.empty() || rows(0, batches_.back().begin, page + 1).second > kBatchRows) {
      batches_.push_back({page, page});
    }
    batches_.back().end = page + 1;
  }
}

Status PageUpload::fill_page(std::uint32_t page, const Batch& batch, std::byte* staged, Worker& worker) const {
  const auto decoded = worker.decode(file_, page);
  if (!decoded) return tl::unexpected(decoded.error());
  if (Status s = check_page_values(file_, page, *decoded); !s) return s;
  std::array<std::byte*, 5> places{};
  for (std::size_t k = 0; k < places.size(); ++k)
    places[k] = staged + staged_at(k, batch) + bytes(k, {batch.begin, page});
  write_page_sections(*decoded, plan_.chunk_size, plan_.first_set[page], places);
  return {};
}

Status PageUpload::fill(const Batch& batch, std::byte* staged) {
  std::mutex failing;
  Status status;
  std::uint32_t failed = batch.end;  // the first damaged page, whichever thread finds one first
  const auto one = [&](std::uint64_t k) {
    const std::uint32_t page = batch.begin + static_cast<std::uint32_t>(k);
    std::unique_ptr<Worker> worker;
    {
      const std::scoped_lock lock(mutex_);
      if (!idle_.empty()) worker = std::move(idle_.back()), idle_.pop_back();
    }
    if (worker == nullptr) worker = std::make_unique<Worker>(file_);
    const Status ok = fill_page(page, batch, staged, *worker);
    {
      const std::scoped_lock lock(mutex_);
      idle_.push_back(std::move(worker));
    }
    if (ok) return;
    const std::scoped_lock lock(failing);
    if (page < failed) failed = page, status = ok;
  };
  tbb::this_task_arena::isolate([&] { parallel_blocks(batch.end - batch.begin, one); });
  return status;
}

Status PageUpload::copy(const Batch& batch, const std::byte* staged) const {
  Status ok;
  for (std::size_t k = 0; k < row_bytes_.size() && ok; ++k) {
    ok = device_status(cudaMemcpyAsync(places_[k] + rows(k, batch.begin, batch.begin).first * row_bytes_[k],
                                       staged + staged_at(k, batch), bytes(k, batch), cudaMemcpyHostToDevice, stream_),
                       "a scene could not be copied to the device");
  }
  return ok;
}

Status PageUpload::run() {
  cut_batches();
  std::uint64_t largest = 0;
  for (const Batch& batch : batches_) largest = std::max(largest, staged_at(row_bytes_.size(), batch));
  Status ok = ring_.create(std::min<std::uint64_t>(batches_.size(), 2) * largest, 2);
  for (const Batch& batch : batches_) {
    std::optional<Uploader::Place> place;
    while (ok && !(place = ring_.take(largest))) ok = ring_.release(true);
    if (ok) ok = fill(batch, place->memory);
    if (ok) ok = copy(batch, place->memory);
    if (ok) ok = ring_.send(place->ticket, stream_);
    if (!ok) return ok;
  }
  return device_status(cudaStreamSynchronize(stream_), "a scene could not be copied to the device");
}

}  // namespace

// Whether the file has all children of a page, so that they can replace it.
bool PagePlan::has_children(const PagedFile& file, std::uint32_t page) const {
  const lod::Page& p = file.pages()[page];
  return p.n_children != 0 && std::uint64_t{p.first_child} + p.n_children <= n_pages;
}

PagePlan::PagePlan(const PagedFile& file) : n_pages(file.n_present()), chunk_size(file.head().header().chunk_size) {
  first_chunk.resize(std::size_t{n_pages} + 1), first_set.resize(std::size_t{n_pages} + 1);
  for (std::uint32_t page = 0; page < n_pages; ++page) {
    const lod::Page& p = file.pages()[page];
    const std::uint64_t chunks = (std::uint64_t{p.count} + chunk_size - 1) / chunk_size;
    first_chunk[page + 1] = first_chunk[page] + chunks;
    first_set[page + 1] = first_set[page] + file.stored(page).n_step_sets;
    // The finest pages: themselves without children, and their parent replaced by them.
    if (page == 0 ? !has_children(file, 0) : !has_children(file, page) && has_children(file, p.parent)) {
      n_finest += p.count;
    }
  }
}

std::array<std::uint64_t, 5> PagePlan::section_bytes(int sh_degree) const {
  const std::array<std::uint64_t, 5> of = section_row_bytes(sh_degree);
  return {n_rows() * of[0], n_rows() * of[1], n_rows() * of[2], first_set.back() * of[3], n_chunks() * of[4]};
}

std::vector<cuda::CutPage> PagePlan::table(const PagedFile& file) const {
  std::vector<cuda::CutPage> table;
  struct Place {
    std::uint32_t page, parent;  // the parent's place in the table
  };
  std::vector<Place> open{{0, cuda::kNoCutPage}};
  while (!open.empty()) {
    const Place next = open.back();
    open.pop_back();
    const lod::Page& page = file.pages()[next.page];
    for (std::uint32_t child = page.first_child + page.n_children; child-- > page.first_child;) {
      if (child < n_pages) open.push_back({child, static_cast<std::uint32_t>(table.size())});
    }
    const auto& [low, high] = page.core;
    table.push_back({{low[0], low[1], low[2]},
                     has_children(file, next.page) ? page.error : 0.0F,
                     {high[0], high[1], high[2]},
                     next.parent,
                     static_cast<std::uint32_t>(first_chunk[next.page]),
                     static_cast<std::uint32_t>(first_chunk[next.page + 1] - first_chunk[next.page]),
                     page.count,
                     0});
  }
  return table;
}

Status upload_pages(const PagedFile& file, const PagePlan& plan, const SectionPlaces& places, CudaStream stream) {
  return PageUpload(file, plan, places, stream).run();
}

}  // namespace rgs::detail
