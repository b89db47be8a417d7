// cut.hpp - launches that choose the pages that a frame draws of a scene with levels of detail and drop chunks out of
// view.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/frame.hpp"
#include "rgs/footprint.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// lod::Page as the choice needs it, and its chunks.
struct alignas(16) CutPage {
  float low[3];  ///< core
  /// 0 if some children are missing: the page then stands for them at any distance.
  float error;
  float high[3];
  std::uint32_t parent;                 ///< kNoCutPage: the root
  std::uint32_t first_chunk, n_chunks;  ///< among all chunks of PagedAttributes
  std::uint32_t n;                      ///< Gaussians
  std::uint32_t unused;
};
static_assert(sizeof(CutPage) == 48);
inline constexpr std::uint32_t kNoCutPage = ~0u;

inline constexpr std::uint64_t kNoLimit = ~std::uint64_t{0};

/// lod::Eye and the detail.
struct CutEye {
  double position[3];
  double focal_px, z_near;
  float detail_px;
  std::uint64_t max_gaussians = kNoLimit;  ///< the detail is lod::finest_detail()
};

struct CutCounts {
  std::uint64_t gaussians;
  std::uint32_t pages, chunks;
  float detail_px;  ///< at which the device chose the pages
  std::uint32_t unused;
};

/// How a limit of Gaussians finds its detail.
struct CutLimit {
  unsigned long long changes[lod::kDetailSteps];  ///< lod::finest_fitting_step()
  float detail_px;                                ///< found
};

/// Chooses among n_pages > 0 pages by lod::is_fine_enough(), each by its own record and its parent's: the pages of
/// lod::drawn_pages(). Writes their chunks, page after page. With max_gaussians finds the detail first. Errors:
/// device_failed.
struct CutArguments {
  /// [n_pages] a page before its children and what is below them: the pages of a cut are then in the order of leaves.
  const CutPage* pages;
  std::uint32_t n_pages;
  CutEye eye;
  CutCounts* sums;        ///< [cut_blocks(n_pages)]
  CutCounts* counts;      ///< of the frame
  std::uint32_t* chunks;  ///< [all chunks]
  CutLimit* limit;        ///< unused without eye.max_gaussians
};
Status launch_cut(const CutArguments& arguments, Stream stream);
std::uint32_t cut_blocks(std::uint32_t n_pages);

/// The chosen chunks that are in view, in the order of the scene; row j of drawn chunk k is drawn row k chunk_size + j.
/// If there are more than `capacity` the list is empty and nothing is
/// drawn.
struct DrawnChunks {
  const std::uint32_t* chunks = nullptr;  ///< [capacity]
  const CutCounts* counts = nullptr;      ///< .chunks: how many
  std::uint32_t capacity = 0;
};

/// Drops chunks of which no tile can list a Gaussian. Errors: device_failed.
struct CullArguments {
  const std::uint32_t* chosen;   ///< [counts->chunks]
  const CutCounts* counts;       ///< of the chosen pages
  std::uint32_t n_chunks;        ///< of the scene
  const std::uint32_t* entries;  ///< CHNK [n_chunks, 12]
  ViewParameters view;
  bool by_view;           ///< false: drops none
  std::uint32_t* sums;    ///< [cull_blocks(n_chunks)]
  CutCounts* listed;      ///< pages and Gaussians chosen, chunks in view; also if they do not fit
  CutCounts* seen;        ///< copy in page-locked memory, which the device writes
  std::uint32_t* chunks;  ///< [capacity]
  std::uint32_t capacity;
};
Status launch_cull(const CullArguments& arguments, Stream stream);
std::uint32_t cull_blocks(std::uint32_t n_chunks);

}  // namespace rgs::cuda
