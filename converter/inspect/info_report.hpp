// info_report.hpp - the report of rgs-info, collected once and printed as text or JSON.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "levels_check.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"

namespace rgs::tool {

inline constexpr std::size_t kInfoBins = 32;

/// Values of files up to this size are counted by default: well below a second when cached.
inline constexpr std::uint64_t kStatisticsBytes = 1'000'000'000;

struct InfoOptions {
  bool verify = false;                 ///< check every checksum and every value
  double levels_share = 0;             ///< and then this share of the pages against their children, see check_levels()
  std::optional<bool> statistics;      ///< read the payload for ranges and histograms; absent: if the file is small
  std::optional<std::uint64_t> chunk;  ///< report this chunk instead of the file
  std::optional<std::uint64_t> page;   ///< or this page of a file with levels of detail
  DecodeLimits limits;
};

/// Smallest, median (the lower one of an even number) and largest of some numbers.
struct Spread {
  float min = 0, median = 0, max = 0;
};

/// Numbers >= 0. Bins are of equal width over [low, high], of the values or of their log10; logarithmic bins exclude
/// zeros.
struct Distribution {
  std::uint64_t n = 0, n_zero = 0;
  Spread spread;
  bool logarithmic = false;
  double low = 0, high = 1;
  std::array<std::uint64_t, kInfoBins> bins{};
};

/// The INT8 codes of one SH degree, all channels together.
struct ShCodes {
  std::uint64_t n = 0, n_zero = 0, n_limit = 0;     ///< codes; codes of 0; codes of +-127
  double entropy_bits = 0;                          ///< order 0, per code
  std::array<std::uint64_t, kInfoBins> bins{};      ///< of |code|, four magnitudes a bin
  std::array<float, 3> min{0, 0, 0}, max{0, 0, 0};  ///< values per channel
};

/// Statistics of the stored values of a range of Gaussians.
struct ValueStatistics {
  std::uint64_t first = 0, n = 0;  ///< the range
  std::uint64_t n_illegal = 0;     ///< stored numbers that the format does not allow; excluded below
  Distribution opacity, scale;
  std::vector<ShCodes> sh;  ///< [sh_degree + 1]
};

struct ChunkStatistics {
  Distribution diagonal;     ///< of the boxes of means, world units
  Distribution radius;       ///< world units
  Distribution max_opacity;  ///< [0, 1]
};

struct ChunkReport {
  std::uint64_t index = 0, first = 0;  ///< position in the table; first Gaussian
  ChunkEntry entry;
  ShStepSet steps;
};

/// One level of detail.
struct LevelReport {
  std::uint32_t n_pages = 0, n_present = 0;
  std::uint64_t n_gaussians = 0, stored_bytes = 0;
  float min_error = 0, max_error = 0;  ///< of its pages
};

using StepSpreads = std::array<std::array<Spread, 3>, 4>;  ///< by degree and channel

struct InfoReport {
  std::string path;
  std::uint64_t file_bytes = 0;
  std::optional<FileView> view;  ///< absent if the head of the file is damaged
  /// Of a file with levels of detail, whose head is `view`: its pages; its levels, finest first; and level 0 as a file
  /// without levels, absent if values are not read or the end of the file is missing.
  std::optional<PagedFile> paged;
  std::vector<LevelReport> levels;
  std::shared_ptr<const std::vector<std::byte>> leaf_bytes;
  std::optional<FileView> leaves;
  std::optional<std::uint64_t> chunk_asked, page_asked;
  std::optional<StepSpreads> steps;
  std::optional<ChunkStatistics> chunks;
  std::optional<ValueStatistics> values;
  std::optional<ChunkReport> chunk;
  std::vector<std::uint64_t> hashes;  ///< with verify: of the stored bytes of each section present, else 0
  bool verified = false;              ///< with verify: the whole file obeys the specification, and no page is refuted
  std::optional<LevelsCheck> levels_check;
  std::optional<Error> error;  ///< the first failure; whatever could be read is filled in
};

/// Whether the file holds the whole section: not always if the end of a file with levels is missing.
bool is_present(const InfoReport& report, const SectionEntry& section);
/// Reads what `options` ask for; `bytes` must outlive the report. A chunk or page that does not exist is bad_argument,
/// and so is levels_share without levels; a page whose error is refuted is bad_value at its record.
/// A file with levels whose end is missing gives pages_missing, unless another error comes first.
/// Memory: 16 bytes a chunk; with verify that of validate().
InfoReport inspect(const std::string& path, std::span<const std::byte> bytes, const InfoOptions& options);

/// The file's bytes that hold rows of a section: the rows themselves, or the whole frame around them.
struct StoredRows {
  std::uint64_t offset = 0, bytes = 0;
  std::optional<std::uint64_t> frame;  ///< index; absent if the section is stored as is
};
/// `count` rows of one chunk, from `row` on.
StoredRows stored_rows(const FileView& view, SectionType type, std::uint64_t first, std::uint64_t count,
                       std::uint64_t row_bytes);

/// The page that holds row `row` of the leaves.
std::uint32_t leaf_of_row(const PagedFile& file, std::uint64_t row);

/// Size of the scene as a 3DGS PLY of the same degree.
std::uint64_t ply_bytes(const Header& header);
double bytes_per_gaussian(std::uint64_t bytes, const Header& header);
/// Whether the axes are right-handed; absent if they are not declared.
std::optional<bool> right_handed(const std::array<Axis, 3>& axes);

struct Name {
  const char* id;
  const char* words;
};
Name name_of(Axis axis);
Name name_of(ColourSpace space);
Name name_of(ShBasis basis);
Name name_of(Kernel kernel);
Name name_of(AaMode mode);
Name name_of(SortMetric metric);
Name name_of(DepthMapping mapping);
Name name_of(DepthSource source);
Name name_of(Order order);
/// Profile::archive with the preset whose steps it has: "archive:high"; "archive" if none.
std::string archive_name(const ArchiveParameters& parameters);
/// Step of a class's ln(scale), and of its SH degree 0.
double scale_step(const ArchiveClass& c);
double dc_step(const ArchiveClass& c);
/// Content of a section; empty for unknown types.
const char* describe(SectionType type);
/// The four characters of a section's type as stored: untrusted.
std::string four_characters(std::uint32_t type);
/// "none", ...; "codec 7" for unknown ones, and for all but 0 in sections of unknown type.
std::string codec_name(const SectionEntry& section);

}  // namespace rgs::tool
