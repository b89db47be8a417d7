// cut.hpp - launches that choose, on the device, which pages of a scene with levels of detail a frame draws, leave out what is not
// in view, and put the rest in tie order.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// What the choice needs of a page: lod::Page, and where its Gaussians are.
struct alignas(16) CutPage {
  float low[3];  ///< box
  /// 0 of a page of whose children some are not there: it stands for them at any distance.
  float error;
  float high[3];
  std::uint32_t parent;                 ///< kNoCutPage: the root
  std::uint32_t first_chunk, n_chunks;  ///< of all chunks of PagedAttributes
  std::uint32_t n;                      ///< Gaussians
  std::uint32_t unused;
};
static_assert(sizeof(CutPage) == 48);
inline constexpr std::uint32_t kNoCutPage = ~0u;

/// lod::Eye, and the detail.
struct CutEye {
  double position[3];
  double focal_px, z_near;
  float detail_px;
};

/// How much a frame draws.
struct CutCounts {
  std::uint64_t gaussians;
  std::uint32_t pages, chunks;
};

/// Chooses among n_pages > 0 pages by lod::is_fine_enough(), each by itself from its own record and its parent's: those that
/// lod::drawn_pages() chooses. Writes their chunks, page after page. Errors: device_failed.
struct CutArguments {
  const CutPage* pages;  ///< [n_pages]
  std::uint32_t n_pages;
  CutEye eye;
  CutCounts* sums;        ///< [cut_blocks(n_pages)]
  CutCounts* counts;      ///< of the frame
  std::uint32_t* chunks;  ///< [all chunks]
};
Status launch_cut(const CutArguments& arguments, Stream stream);
std::uint32_t cut_blocks(std::uint32_t n_pages);

/// The chunks of the chosen pages that are in view, in their order. Where there are more than `capacity`, there is no list: nothing
/// is drawn.
struct DrawnChunks {
  const std::uint32_t* chunks = nullptr;  ///< [capacity]
  const CutCounts* counts = nullptr;      ///< .chunks: how many
  std::uint32_t capacity = 0;
};

/// Leaves out chunks in which no Gaussian can be listed in a tile. Errors: device_failed.
struct CullArguments {
  const std::uint32_t* chosen;   ///< [counts->chunks]
  const CutCounts* counts;       ///< of what is chosen
  std::uint32_t n_chunks;        ///< of the scene
  const std::uint32_t* entries;  ///< CHNK [n_chunks, 12]
  ViewParameters view;
  bool by_view;         ///< false: leaves out none
  std::uint32_t* sums;  ///< [cull_blocks(n_chunks)]
  CutCounts*
      listed;  ///< pages and Gaussians that are chosen, chunks that are in view; also if the list has no room for them
  CutCounts* seen;        ///< a copy for the host: page-locked memory that the device reaches
  std::uint32_t* chunks;  ///< [capacity]
  std::uint32_t capacity;
  std::uint32_t* places;  ///< [n_chunks] place in `chunks`, of those that are listed
};
Status launch_cull(const CullArguments& arguments, Stream stream);
std::uint32_t cull_blocks(std::uint32_t n_chunks);

/// The tie order of what is drawn, from that of all rows, which is `all`. Row j of drawn chunk k counts as drawn row
/// k chunk_size + j. Errors: device_failed.
struct DrawnTiesArguments {
  DrawnChunks drawn;
  const std::uint32_t* places;  ///< see CullArguments
  std::uint32_t chunk_size;
  TieOrder all;          ///< [n_rows] each
  std::uint32_t n_rows;  ///< of all pages; < 2^31
  std::uint32_t* bits;   ///< [drawn_ties_words(n_rows)]
  std::uint32_t* sums;   ///< [drawn_ties_blocks(n_rows)]
  /// [capacity * chunk_size] what is drawn in tie order: drawn rows, and their places in `rank`; or, if that is null, rows of
  /// the scene.
  std::uint32_t *order, *rank;
};
Status launch_drawn_ties(const DrawnTiesArguments& arguments, Stream stream);
std::uint64_t drawn_ties_words(std::uint32_t n_rows);
std::uint32_t drawn_ties_blocks(std::uint32_t n_rows);

}  // namespace rgs::cuda
