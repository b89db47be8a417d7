// ksplat.cpp - .ksplat of github.com/mkkellogg/GaussianSplats3D: a header of 4,096 bytes, one of 1,024 for each
// section, then the sections.
//
//   header   0 u8 version 0, 1   4 u32 sections   8 u32 sections loaded   12 u32 Gaussians   16 u32 Gaussians loaded
//            20 u16 level   36 f32 smallest, 40 f32 largest SH of level 2 (0: -3/2, 3/2)
//   section  0 u32 Gaussians loaded   4 u32 Gaussians   8 u32 Gaussians a bucket   12 u32 buckets
//            16 f32 width of a bucket   20 u16 bytes a bucket   24 u32 code range   28 u32 bytes
//            32 u32 full buckets   36 u32 partly filled buckets   40 u16 SH degree
// Counts of what is loaded are those of the page that wrote the file, which may have streamed it: GaussianSplats3D itself
// reads all sections and all their places whatever these say. See choose_sections().
//   data     u32 lengths of the partly filled buckets; f32 centre [3] of each bucket; Gaussians
//   Gaussian mean, scale [3] (activated), rotation w, x, y, z; u8 red, green, blue, opacity; SH by degree, then channel
// Level 0 has floats; level 1 FP16, and means as u16 about the bucket's centre; level 2 SH as u8 besides.
// Level 1 is written, as GaussianSplats3D does unless told otherwise: half of level 0's size, and pictures as good.
// SPDX-License-Identifier: Apache-2.0
#include "ksplat.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <utility>
#include <vector>

#include "pieces.hpp"
#include "quantised.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kHeaderSize = 4096, kSectionHeaderBytes = 1024;
constexpr std::uint32_t kDefaultCodeRange = 32767;
constexpr float kDefaultShBound = 1.5F;
// As GaussianSplats3D writes them: cubes, each of whose sides has its codes, and Gaussians in one.
constexpr double kBucketWidth = 5;
constexpr std::uint32_t kBucketSize = 256, kCentreBytes = 12;

struct Section {
  // room: capacity in Gaussians; n: how many are loaded, later how many are read.
  std::uint64_t n = 0, room = 0, bucket_size = 0, n_buckets = 0, bucket_bytes = 0, n_full = 0, n_partial = 0;
  double bucket_width = 0, code_range = 1;
  int sh_degree = 0;
  std::uint64_t header = 0;   // in the file
  std::uint64_t start = 0;    // in the file
  std::uint64_t centres = 0;  // of the buckets
  std::uint64_t data = 0;     // first Gaussian
};

struct KsplatHeader {
  int level = 0;
  double sh_low = 0, sh_high = 0;
  std::vector<Section> sections;
  std::uint64_t n_sections_loaded = 0, room = 0, n = 0;
  std::uint64_t end = 0;  // of the last section
};

constexpr std::uint64_t number_bytes(int level) {
  return level == 0 ? 4 : 2;
}
constexpr std::uint64_t sh_number_bytes(int level) {
  return level == 0 ? 4 : level == 1 ? 2 : 1;
}
std::uint64_t splat_bytes(int level, int sh_degree) {
  return 10 * number_bytes(level) + 4 +
         sh_number_bytes(level) * 3 * (static_cast<std::uint64_t>(sh_coefficients(sh_degree)) - 1);
}

// Parses a section's header at `at`; its data begin at `start` and must fit into the file.
Result<Section> parse_section(std::span<const std::byte> bytes, std::uint64_t at, std::uint64_t start, int level) {
  const auto u32 = [&](std::uint64_t offset) { return load<std::uint32_t>(bytes, at + offset); };
  Section s;
  s.header = at;
  s.n = u32(0);
  s.room = u32(4);
  s.bucket_size = u32(8);
  s.n_buckets = u32(12);
  s.bucket_width = static_cast<double>(load<float>(bytes, at + 16));
  s.bucket_bytes = load<std::uint16_t>(bytes, at + 20);
  s.code_range = u32(24) != 0 ? u32(24) : kDefaultCodeRange;
  s.n_full = u32(32);
  s.n_partial = u32(36);
  const int degree = load<std::uint16_t>(bytes, at + 40);
  if (degree > kMaxShDegree) {
    return make_error(Errc::unsupported_feature, at + 40, "the SH degree is not 0 to 3", kMaxShDegree,
                      static_cast<std::uint64_t>(degree));
  }
  s.sh_degree = degree;
  if (s.n > s.room) {
    return make_error(Errc::bad_header, at, "a section has more Gaussians than its capacity", s.room, s.n);
  }
  if (level == 0 || s.room == 0) {  // buckets, if any, take space but mean nothing
  } else if (s.bucket_bytes < kCentreBytes || !std::isfinite(s.bucket_width)) {
    return make_error(Errc::bad_header, at + 16, "a section's buckets are too short for a centre, or have no width");
  } else if (s.n_full > s.n_buckets || s.n_partial > s.n_buckets - s.n_full || (s.n_full != 0 && s.bucket_size == 0)) {
    return make_error(Errc::bad_header, at + 32, "a section's numbers of buckets contradict each other", s.n_buckets,
                      s.n_full + s.n_partial);
  }
  s.start = start;
  s.centres = start + 4 * s.n_partial;  // all counts are below 2^32: no sum wraps
  s.data = s.centres + s.bucket_bytes * s.n_buckets;
  const std::uint64_t end = s.data + splat_bytes(level, s.sh_degree) * s.room;
  if (end > bytes.size())
    return make_error(Errc::truncated, at + 4, "a section ends past the end of the file", end, bytes.size());
  return s;
}

Result<KsplatHeader> parse_header(std::span<const std::byte> bytes) {
  if (bytes.size() < kHeaderSize) {
    return make_error(Errc::truncated, bytes.size(), "the file ends inside its header", kHeaderSize, bytes.size());
  }
  if (load_u8(bytes, 0) != 0 || load_u8(bytes, 1) < 1) {
    return make_error(Errc::unsupported_version, 0, "a .ksplat version before 0.1 or from 1 on");
  }
  KsplatHeader header;
  header.level = load<std::uint16_t>(bytes, 20);
  if (header.level > 2) {
    return make_error(Errc::unsupported_feature, 20, "the compression level is not 0 to 2", 2,
                      static_cast<std::uint64_t>(header.level));
  }
  const std::uint64_t n_sections = load<std::uint32_t>(bytes, 4);
  header.n_sections_loaded = load<std::uint32_t>(bytes, 8);
  header.room = load<std::uint32_t>(bytes, 12);
  header.n = load<std::uint32_t>(bytes, 16);
  if (header.n_sections_loaded > n_sections) {
    return make_error(Errc::bad_header, 8, "more sections than the header has room for", n_sections,
                      header.n_sections_loaded);
  }
  if (n_sections > (bytes.size() - kHeaderSize) / kSectionHeaderBytes) {
    return make_error(Errc::truncated, 4, "the file ends inside its section headers",
                      (bytes.size() - kHeaderSize) / kSectionHeaderBytes, n_sections);
  }
  const float low = load<float>(bytes, 36), high = load<float>(bytes, 40);
  header.sh_low = static_cast<double>(low != 0 ? low : -kDefaultShBound);
  header.sh_high = static_cast<double>(high != 0 ? high : kDefaultShBound);
  header.end = kHeaderSize + n_sections * kSectionHeaderBytes;
  for (std::uint64_t i = 0; i < n_sections; ++i) {
    const auto section = parse_section(bytes, kHeaderSize + i * kSectionHeaderBytes, header.end, header.level);
    if (!section) return tl::unexpected(section.error());
    header.end = section->data + splat_bytes(header.level, section->sh_degree) * section->room;
    header.sections.push_back(*section);
  }
  return header;
}

// The header's count must match the sections: their loaded counts, those of the loaded sections alone, or all their
// capacity, which is all that GaussianSplats3D reads. Its loaded counts are stale when a page streamed the scene: a
// section's are then those of its first piece, or 0 like the header's. Sets Section::n to what is read.
Status choose_sections(KsplatHeader& header) {
  std::uint64_t n_all = 0, n_loaded = 0, n_room = 0;
  for (std::size_t i = 0; i < header.sections.size(); ++i) {
    n_all += header.sections[i].n;
    n_loaded += i < header.n_sections_loaded ? header.sections[i].n : 0;
    n_room += header.sections[i].room;
  }
  if (header.n != 0 && header.n == n_all) return {};
  if (header.n != 0 && header.n == n_loaded) {
    for (std::size_t i = header.n_sections_loaded; i < header.sections.size(); ++i) header.sections[i].n = 0;
    return {};
  }
  const std::uint64_t promised = header.n != 0 ? header.n : header.room;
  if (promised != n_room) {
    return make_error(Errc::bad_header, header.n != 0 ? 16 : 12,
                      "the sections hold another number of Gaussians than the header promises", promised,
                      header.n != 0 ? n_all : n_room);
  }
  for (Section& section : header.sections) section.n = section.room;
  header.n = n_room;
  return {};
}

// Buckets must hold exactly the section's Gaussians: those read, or its capacity.
Status check_buckets(std::span<const std::byte> bytes, const Section& section) {
  std::uint64_t n = section.n_full * section.bucket_size;  // 32-bit factors
  for (std::uint64_t i = 0; i < section.n_partial && n <= section.room; ++i) {
    n += load<std::uint32_t>(bytes, section.start + 4 * i);
  }
  if (n == section.n || n == section.room) return {};
  return make_error(Errc::bad_header, section.header + 32,
                    "a section's buckets hold another number of Gaussians than the section", section.room, n);
}

// Walks a section's buckets as its Gaussians are read in order.
class Buckets {
 public:
  Buckets(std::span<const std::byte> bytes, const Section& section) : bytes_(bytes), section_(section) {}

  /// Centre of the next Gaussian's bucket, which check_buckets() has validated.
  const std::array<double, 3>& next() {
    while (left_ == 0) {
      left_ = bucket_ < section_.n_full ? section_.bucket_size
                                        : load<std::uint32_t>(bytes_, section_.start + 4 * (bucket_ - section_.n_full));
      const std::uint64_t at = section_.centres + bucket_ * section_.bucket_bytes;
      for (std::uint64_t k = 0; k < 3; ++k) centre_[k] = static_cast<double>(load<float>(bytes_, at + 4 * k));
      ++bucket_;
    }
    --left_;
    return centre_;
  }

 private:
  std::span<const std::byte> bytes_;
  const Section& section_;
  std::uint64_t bucket_ = 0, left_ = 0;
  std::array<double, 3> centre_{};
};

class RecordReader {
 public:
  RecordReader(const KsplatHeader& header, const Section& section) : header_(header), section_(section) {}

  Splat read(std::span<const std::byte> record, const std::array<double, 3>& centre) const {
    Splat s;
    const std::uint64_t size = number_bytes(header_.level);
    for (std::uint64_t k = 0; k < 3; ++k) {
      s.mean[k] = mean(record, k, centre[k]);
      s.log_scale[k] = log_from_scale(number(record, (3 + k) * size), 0);
      s.sh[k] = dc_from_colour(load_u8(record, 10 * size + k) / 255.0);
    }
    for (std::uint64_t k = 0; k < 4; ++k) s.rotation[k] = number(record, (6 + k) * size);
    s.opacity_logit = logit_from_opacity(static_cast<float>(load_u8(record, 10 * size + 3)) / 255.F);
    std::uint64_t at = 10 * size + 4;
    for (int degree = 1; degree <= section_.sh_degree; ++degree) {
      for (int c = 0; c < 3; ++c) {
        for (int k = sh_coefficients(degree - 1); k < sh_coefficients(degree); ++k) {
          s.sh[3 * k + c] = harmonic(record, at);
          at += sh_number_bytes(header_.level);
        }
      }
    }
    return s;
  }

 private:
  float number(std::span<const std::byte> record, std::uint64_t at) const {
    return header_.level == 0 ? load<float>(record, at) : float_from_half(load<std::uint16_t>(record, at));
  }
  float mean(std::span<const std::byte> record, std::uint64_t k, double centre) const {
    if (header_.level == 0) return load<float>(record, 4 * k);
    const double code = load<std::uint16_t>(record, 2 * k);
    return static_cast<float>(centre +
                              (code - section_.code_range) * (section_.bucket_width / 2 / section_.code_range));
  }
  float harmonic(std::span<const std::byte> record, std::uint64_t at) const {
    if (header_.level < 2) return number(record, at);
    return static_cast<float>(header_.sh_low + load_u8(record, at) / 255.0 * (header_.sh_high - header_.sh_low));
  }

  const KsplatHeader& header_;
  const Section& section_;
};

// ---- writing --------------------------------------------------------------------------------------------------------

struct Bucket {
  std::array<float, 3> centre{};
  std::vector<std::uint32_t> members;  // Gaussians, in the view's order
};

// Full buckets in the order in which they fill up, then the others from cube to cube along x, y and z. Returns them and
// the number of full ones. Cubes count from the smallest coordinates, but not from one so far out that FP64 would round
// the others.
std::pair<std::vector<Bucket>, std::uint32_t> fill_buckets(const SplatView& splats) {
  constexpr double kFarthest = -0x1p30;
  std::array<double, 3> low;
  low.fill(std::numeric_limits<double>::infinity());
  for (std::size_t i = 0; i < splats.mean.size(); ++i) {
    low[i % 3] = std::min(low[i % 3], std::max(static_cast<double>(splats.mean[i]), kFarthest));
  }
  std::vector<Bucket> buckets;
  std::map<std::array<double, 3>, Bucket> open;
  for (std::uint32_t i = 0; i < splats.n; ++i) {
    std::array<double, 3> cube{};
    for (std::size_t k = 0; k < 3; ++k) {
      cube[k] = std::floor((static_cast<double>(splats.mean[3 * std::size_t{i} + k]) - low[k]) / kBucketWidth);
    }
    Bucket& bucket = open[cube];
    for (std::size_t k = 0; k < 3 && bucket.members.empty(); ++k) {
      bucket.centre[k] = static_cast<float>((cube[k] + 0.5) * kBucketWidth + low[k]);
    }
    bucket.members.push_back(i);
    if (bucket.members.size() == kBucketSize) buckets.push_back(std::exchange(bucket, {}));
  }
  const auto n_full = static_cast<std::uint32_t>(buckets.size());
  for (auto& [cube, bucket] : open) {
    if (!bucket.members.empty()) buckets.push_back(std::move(bucket));
  }
  return {std::move(buckets), n_full};
}

std::uint16_t half_within(float value, float low) {
  return half_from_float(std::clamp(value, low, kMaxKsplatHalf));
}

void write_record(const Splat& s, const std::array<float, 3>& centre, int degree, std::span<std::byte> record) {
  double squared = 0;
  for (const float x : s.rotation) squared += static_cast<double>(x) * static_cast<double>(x);
  for (std::uint64_t k = 0; k < 3; ++k) {
    const double offset = static_cast<double>(s.mean[k]) - static_cast<double>(centre[k]);
    const double code = std::floor(offset / (kBucketWidth / 2 / kDefaultCodeRange) + 0.5) + kDefaultCodeRange;
    store(record, 2 * k, static_cast<std::uint16_t>(std::clamp(code, 0.0, 65535.0)));
    store(record, 6 + 2 * k, half_within(scale_from_log(s.log_scale[k]), kMinKsplatScale));
    store(record, 20 + k, static_cast<std::uint8_t>(unit_code(colour_from_dc(s.sh[k]), 255)));
  }
  for (std::uint64_t k = 0; k < 4; ++k) {
    store(record, 12 + 2 * k,
          half_from_float(static_cast<float>(static_cast<double>(s.rotation[k]) / std::sqrt(squared))));
  }
  const auto opacity = static_cast<double>(opacity_from_logit(s.opacity_logit));
  store(record, 23, static_cast<std::uint8_t>(unit_code(opacity, 255)));
  std::uint64_t at = 24;
  for (int d = 1; d <= degree; ++d) {
    for (int c = 0; c < 3; ++c) {
      for (int k = sh_coefficients(d - 1); k < sh_coefficients(d); ++k, at += 2) {
        store(record, at, half_within(s.sh[3 * k + c], -kMaxKsplatHalf));
      }
    }
  }
}

}  // namespace

bool looks_like_ksplat(std::span<const std::byte> bytes) {
  const auto header = parse_header(bytes);
  return header && !header->sections.empty();
}

Result<SplatFile> decode_ksplat(std::span<const std::byte> bytes, const ReadOptions& options) {
  auto header = parse_header(bytes);
  if (!header) return tl::unexpected(header.error());
  if (const Status s = choose_sections(*header); !s) return tl::unexpected(s.error());
  if (header->end != bytes.size()) {
    return make_error(Errc::trailing_bytes, header->end, "bytes after the last section", header->end, bytes.size());
  }
  if (header->n > options.limits.max_gaussians) {
    return make_error(Errc::limit_exceeded, 16, "more Gaussians than the caller allows", options.limits.max_gaussians,
                      header->n);
  }
  int degree = 0;
  for (const Section& section : header->sections) degree = std::max(degree, section.sh_degree);
  SplatFile file;
  file.format = SplatFormat::ksplat;
  file.bytes = bytes.size();
  PieceFiller filler(file, header->n, degree, options);
  for (const Section& section : header->sections) {
    const std::uint64_t stride = splat_bytes(header->level, section.sh_degree);
    const RecordReader reader(*header, section);
    if (header->level > 0) {
      if (const Status s = check_buckets(bytes, section); !s) return tl::unexpected(s.error());
    }
    Buckets buckets(bytes, section);
    for (std::uint64_t i = 0; i < section.n; ++i) {
      const auto centre = header->level == 0 ? std::array<double, 3>() : buckets.next();
      const Status filled = filler.add(reader.read(bytes.subspan(section.data + stride * i, stride), centre));
      if (!filled) return tl::unexpected(filled.error());
    }
  }
  return file;
}

Result<std::vector<std::byte>> encode_ksplat(const SplatView& splats, const WriteOptions&) {
  const int degree = std::min(splats.sh_degree, kKsplatShDegree);
  const auto [buckets, n_full] = fill_buckets(splats);
  const auto n = static_cast<std::uint32_t>(splats.n), n_buckets = static_cast<std::uint32_t>(buckets.size());
  const std::uint64_t start = kHeaderSize + kSectionHeaderBytes, stride = splat_bytes(1, degree);
  const std::uint64_t centres = start + 4 * std::uint64_t{n_buckets - n_full};
  std::uint64_t at = centres + std::uint64_t{kCentreBytes} * n_buckets;
  std::vector<std::byte> file(at + stride * n);
  float low = 0, high = 0;
  for (std::size_t b = 0; b < buckets.size(); ++b) {
    const auto& [centre, members] = buckets[b];
    if (b >= n_full) store(file, start + 4 * (b - n_full), static_cast<std::uint32_t>(members.size()));
    store(file, centres + kCentreBytes * b, centre);
    for (const std::uint32_t i : members) {
      const Splat s = splats.splat(i);
      write_record(s, centre, degree, std::span(file).subspan(at, stride));
      for (int k = 3; k < 3 * sh_coefficients(degree); ++k)
        low = std::min(low, s.sh[k]), high = std::max(high, s.sh[k]);
      at += stride;
    }
  }
  const auto u32 = [&file](std::uint64_t offset, std::uint64_t value) {
    store(file, offset, static_cast<std::uint32_t>(value));
  };
  file[1] = std::byte{1};  // version 0.1
  u32(4, 1);
  u32(8, 1);
  u32(12, n);
  u32(16, n);
  store(file, 20, std::uint16_t{1});  // level
  // The viewer, asked for SH of 8 bits, makes them of this range.
  store(file, 36, low < 0 ? low : -kDefaultShBound);
  store(file, 40, high > 0 ? high : kDefaultShBound);
  const std::uint64_t section = kHeaderSize;
  u32(section, n);
  u32(section + 4, n);
  u32(section + 8, kBucketSize);
  u32(section + 12, n_buckets);
  store(file, section + 16, static_cast<float>(kBucketWidth));
  store(file, section + 20, std::uint16_t{kCentreBytes});
  u32(section + 24, kDefaultCodeRange);
  u32(section + 28, file.size() - start);
  u32(section + 32, n_full);
  u32(section + 36, n_buckets - n_full);
  store(file, section + 40, static_cast<std::uint16_t>(degree));
  return file;
}

}  // namespace rgs::detail
