// rad_write.cpp - writes .rad, which rad.cpp describes, with the encodings that Spark's own tool takes.
//
// Levels of an .rgs become a tree: a Gaussian's children are those of the page's children that share its cell of a k-d
// tree with one Gaussian of the page a cell. So each has children, and leaves are exactly the finest level. Gaussians
// are in the order of levels, coarse to fine, and in a level in that of their parents: a run of children, and a viewer
// that has only the first chunks draws all of the scene.
// SPDX-License-Identifier: Apache-2.0
#include <zlib.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <numbers>
#include <numeric>
#include <string>
#include <utility>

#include "parallel_jobs.hpp"
#include "quantised.hpp"
#include "rad.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/quantize.hpp"
#include "rgs/splat_edit.hpp"
#include "write_report.hpp"

namespace rgs {
namespace detail {
namespace {

using Json = nlohmann::ordered_json;
using Bytes = std::vector<std::byte>;

constexpr int kDeflateLevel = 6;

// What all chunks of a file share.
struct Ranges {
  float log_scale_low = kMinRadLogScale, log_scale_high = kMaxRadLogScale;
  float colour_low = 0, colour_high = 1;
  std::array<float, kMaxShDegree> sh{};
};

Ranges ranges_of(const SplatView& splats) {
  Ranges r;
  float low = kMaxRadLogScale, high = kMinRadLogScale;
  for (const float value : splats.log_scale) {
    if (std::isinf(value)) continue;  // a scale of 0 has a code of its own
    low = std::min(low, std::max(value, kMinRadLogScale));
    high = std::max(high, std::min(value, kMaxRadLogScale));
  }
  if (low < high) r.log_scale_low = low, r.log_scale_high = high;
  if (low == high) r.log_scale_low = low, r.log_scale_high = low + 1;
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(splats.sh_degree));
  for (std::uint64_t i = 0; i < splats.sh.size(); ++i) {
    const std::uint64_t k = i % floats;
    if (k < 3) {
      const auto colour = static_cast<float>(colour_from_dc(splats.sh[i]));
      r.colour_low = std::max(std::min(r.colour_low, colour), kMinRadColour);
      r.colour_high = std::min(std::max(r.colour_high, colour), kMaxRadColour);
    } else {
      float& most = r.sh[static_cast<std::size_t>(sh_degree_of(static_cast<int>(k / 3)) - 1)];
      most = std::min(std::max(most, std::abs(splats.sh[i])), kMaxRadSh);
    }
  }
  for (float& most : r.sh) most = most == 0 ? kMaxRadSh : most;
  return r;
}

Json splat_encoding(const Ranges& r, bool tree) {
  return {{"rgbMin", r.colour_low},
          {"rgbMax", r.colour_high},
          {"lnScaleMin", r.log_scale_low},
          {"lnScaleMax", r.log_scale_high},
          {"sh1Max", r.sh[0]},
          {"sh2Max", r.sh[1]},
          {"sh3Max", r.sh[2]},
          {"lodOpacity", tree}};
}

Bytes deflated(const Bytes& bytes) {
  z_stream stream{};
  constexpr int kRawDeflate = -15, kMemory = 8;
  if (deflateInit2(&stream, kDeflateLevel, Z_DEFLATED, kRawDeflate, kMemory, Z_DEFAULT_STRATEGY) != Z_OK)
    throw std::bad_alloc();
  Bytes out(deflateBound(&stream, static_cast<uLong>(bytes.size())));
  stream.next_in = reinterpret_cast<Bytef*>(const_cast<std::byte*>(bytes.data()));  // zlib does not write there
  stream.avail_in = static_cast<uInt>(bytes.size());
  stream.next_out = reinterpret_cast<Bytef*>(out.data());
  stream.avail_out = static_cast<uInt>(out.size());
  deflate(&stream, Z_FINISH);
  out.resize(stream.total_out);
  deflateEnd(&stream);
  return out;
}

// Of the codes above and below each number, those that decode nearest to the rotation: 0.010 rad (RMS), 0.022 at
// worst, in a scene of 50,000 Gaussians.
std::array<std::uint8_t, 3> encode_octahedral(const float* wxyz) {
  std::array<double, 4> q{};
  double squared = 0;
  for (std::size_t k = 0; k < 4; ++k) {
    q[k] = static_cast<double>(wxyz[k]) * (wxyz[0] < 0 ? -1 : 1);
    squared += q[k] * q[k];
  }
  if (squared == 0) return {255, 127, 0};
  for (double& x : q) x /= std::sqrt(squared);
  const double sum = std::abs(q[1]) + std::abs(q[2]) + std::abs(q[3]);
  std::array<double, 3> code{127.5, 127.5, 510 / std::numbers::pi * std::acos(std::min(q[0], 1.0))};
  if (sum > 0) {
    double x = q[1] / sum, y = q[2] / sum;
    if (q[3] < 0) x = std::copysign(1 - std::abs(y), x), y = std::copysign(1 - std::abs(q[1] / sum), y);
    code[0] = (x + 1) * 127.5, code[1] = (y + 1) * 127.5;
  }
  std::array<std::uint8_t, 3> nearest{};
  double best = -1;
  for (unsigned choice = 0; choice < 8; ++choice) {
    std::array<std::uint8_t, 3> tried{};
    for (std::size_t k = 0; k < 3; ++k)
      tried[k] = static_cast<std::uint8_t>(std::min(std::floor(code[k]) + (choice >> k & 1U), 255.0));
    const auto [x, y, z, w] = decode_octahedral(tried);
    const double cosine = std::abs(q[0] * static_cast<double>(w) + q[1] * static_cast<double>(x) +
                                   q[2] * static_cast<double>(y) + q[3] * static_cast<double>(z));
    if (cosine > best) best = cosine, nearest = tried;
  }
  return nearest;
}

class ChunkWriter {
 public:
  ChunkWriter(const SplatView& splats, std::uint64_t first, std::uint64_t n, const Ranges& ranges, const RadTree* tree)
      : s_(splats), first_(first), n_(n), r_(ranges), tree_(tree) {}

  Bytes write() {
    add_bytes("center", "f32_lebytes", 12, [&](Bytes& to) {
      for (std::uint64_t i = 0; i < 3 * n_; ++i) {
        const auto bits = std::bit_cast<std::uint32_t>(s_.mean[3 * first_ + i]);
        for (std::uint64_t b = 0; b < 4; ++b)
          to[(3 * b + i % 3) * n_ + i / 3] = static_cast<std::byte>(bits >> 8 * b & 255);
      }
    });
    add_codes("alpha", "r8", 1, 0, 1, [&](std::uint64_t i, std::uint64_t) {
      return unit_code(static_cast<double>(opacity_from_logit(s_.opacity_logit[i])), 255);
    });
    const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(s_.sh_degree));
    add_codes("rgb", "r8_delta", 3, r_.colour_low, r_.colour_high, [&](std::uint64_t i, std::uint64_t c) {
      return unit_code(share(colour_from_dc(s_.sh[floats * i + c]), r_.colour_low, r_.colour_high), 255);
    });
    add_codes("scales", "ln_0r8", 3, r_.log_scale_low, r_.log_scale_high, [&](std::uint64_t i, std::uint64_t k) {
      const float value = s_.log_scale[3 * i + k];
      if (std::isinf(value) && value < 0) return 0U;
      return 1 + unit_code(share(static_cast<double>(value), r_.log_scale_low, r_.log_scale_high), 254);
    });
    add_bytes("orientation", "oct88r8", 3, [&](Bytes& to) {
      for (std::uint64_t i = 0; i < n_; ++i) {
        const auto code = encode_octahedral(&s_.rotation[4 * (first_ + i)]);
        for (std::uint64_t k = 0; k < 3; ++k) to[3 * i + k] = static_cast<std::byte>(code[k]);
      }
    });
    for (int d = 1; d <= s_.sh_degree; ++d) {
      const auto at = static_cast<std::uint64_t>(3 * sh_coefficients(d - 1)),
                 n = static_cast<std::uint64_t>(3 * sh_coefficients(d)) - at;
      const float most = r_.sh[static_cast<std::size_t>(d - 1)];
      add_codes(("sh" + std::to_string(d)).c_str(), "s8", n, -most, most, [&](std::uint64_t i, std::uint64_t k) {
        const double value = static_cast<double>(s_.sh[floats * i + at + k]) / static_cast<double>(most);
        const int code = static_cast<int>(unit_code(std::abs(value), 127));
        return static_cast<std::uint32_t>(value < 0 ? -code : code) & 255U;
      });
    }
    if (tree_ != nullptr) {
      add_array("child_count", "u16", std::span(tree_->n_children));
      add_array("child_start", "u32", std::span(tree_->first_child));
    }
    return whole();
  }

 private:
  static double share(double value, float low, float high) {
    return (value - static_cast<double>(low)) / (static_cast<double>(high) - static_cast<double>(low));
  }

  void add(const char* property, const char* encoding, const Bytes& bytes) {
    const Bytes stored = deflated(bytes);
    properties_.push_back({{"offset", payload_.size()},
                           {"bytes", stored.size()},
                           {"property", property},
                           {"encoding", encoding},
                           {"compression", "gz"}});
    payload_.insert(payload_.end(), stored.begin(), stored.end());
    payload_.resize((payload_.size() + 7) / 8 * 8);
  }
  void add_bytes(const char* property, const char* encoding, std::uint64_t each, const auto& fill) {
    Bytes bytes(each * n_);
    fill(bytes);
    add(property, encoding, bytes);
  }
  void add_codes(const char* property, const char* encoding, std::uint64_t dimensions, float low, float high,
                 const auto& code) {
    Bytes bytes(dimensions * n_);
    const bool delta = std::string_view(encoding).ends_with("_delta");
    for (std::uint64_t k = 0; k < dimensions; ++k) {
      std::uint32_t last = 0;
      for (std::uint64_t i = 0; i < n_; ++i) {
        const std::uint32_t value = code(first_ + i, k);
        bytes[k * n_ + i] = static_cast<std::byte>((value - last) & 255U);
        if (delta) last = value;
      }
    }
    add(property, encoding, bytes);
    properties_.back()["min"] = low;
    properties_.back()["max"] = high;
  }
  template <class T>
  void add_array(const char* property, const char* encoding, std::span<const T> values) {
    const auto bytes = std::as_bytes(values.subspan(first_, n_));
    add(property, encoding, Bytes(bytes.begin(), bytes.end()));
  }

  Bytes whole() const {
    Json meta{
        {"version", 1}, {"base", first_}, {"count", n_}, {"payloadBytes", payload_.size()}, {"maxSh", s_.sh_degree}};
    if (tree_ != nullptr) meta["lodTree"] = true;
    meta["splatEncoding"] = splat_encoding(r_, tree_ != nullptr);
    meta["properties"] = properties_;
    Bytes chunk = head(kRadChunkMagic, meta.dump());
    const std::uint64_t at = chunk.size();
    chunk.resize(at + 8);
    store(chunk, at, std::uint64_t{payload_.size()});
    chunk.insert(chunk.end(), payload_.begin(), payload_.end());
    return chunk;
  }

 public:
  static Bytes head(std::string_view magic, const std::string& json) {
    Bytes bytes(8 + (json.size() + 7) / 8 * 8);
    std::memcpy(bytes.data(), magic.data(), magic.size());
    store(bytes, 4, static_cast<std::uint32_t>(json.size()));
    std::memcpy(bytes.data() + 8, json.data(), json.size());
    return bytes;
  }

 private:
  const SplatView& s_;
  std::uint64_t first_, n_;
  const Ranges& r_;
  const RadTree* tree_;
  Json properties_ = Json::array();
  Bytes payload_;
};

// ---- tree -----------------------------------------------------------------------------------------------------------

constexpr std::uint32_t kNone = std::numeric_limits<std::uint32_t>::max();
constexpr std::uint64_t kMostChildren = std::numeric_limits<std::uint16_t>::max();

// Gives each of the `fine` rows one of the `coarse` as its parent, in halves of the coarse: those of a cell of a k-d
// tree, of which none is empty unless the fine are fewer.
void share_out(const SplatCloud& cloud, std::span<std::uint32_t> coarse, std::span<std::uint32_t> fine,
               std::vector<std::uint32_t>& parent) {
  if (coarse.size() <= 1 || fine.empty()) {
    for (const std::uint32_t row : fine) parent[row] = coarse.front();
    return;
  }
  std::size_t axis = 0;
  float widest = -1;
  for (std::size_t k = 0; k < 3; ++k) {
    float low = std::numeric_limits<float>::max(), high = -low;
    for (const std::uint32_t row : coarse) {
      low = std::min(low, cloud.mean[3 * std::size_t{row} + k]);
      high = std::max(high, cloud.mean[3 * std::size_t{row} + k]);
    }
    if (high - low > widest) axis = k, widest = high - low;
  }
  const auto at = [&](std::uint32_t row) { return cloud.mean[3 * std::size_t{row} + axis]; };
  const auto before = [&](std::uint32_t a, std::uint32_t b) { return std::pair(at(a), a) < std::pair(at(b), b); };
  const std::size_t half = coarse.size() / 2, other = coarse.size() - half, n = fine.size();
  const auto middle = coarse.begin() + static_cast<std::ptrdiff_t>(half);
  std::nth_element(coarse.begin(), middle, coarse.end(), before);
  const float below = at(*std::max_element(coarse.begin(), middle, before));
  const float plane = below + (at(*middle) - below) / 2;
  std::size_t left =
      static_cast<std::size_t>(std::ranges::count_if(fine, [&](std::uint32_t row) { return at(row) < plane; }));
  if (n < coarse.size()) {
    left = n * half / coarse.size();
  } else {
    left = std::clamp(left, std::max(half, n - std::min(n, kMostChildren * other)),
                      std::min(n - other, kMostChildren * half));
  }
  std::nth_element(fine.begin(), fine.begin() + static_cast<std::ptrdiff_t>(left), fine.end(), before);
  share_out(cloud, coarse.first(half), fine.first(left), parent);
  share_out(cloud, coarse.subspan(half), fine.subspan(left), parent);
}

// One Gaussian for all of `rows`: their mean and variance along the axes, and their mean colour.
Splat merged(const SplatView& splats, std::span<const std::uint32_t> rows) {
  Splat one;
  double total = 0, most = 0;
  std::array<double, 3> mean{}, square{};
  std::array<double, 48> sh{};
  for (const std::uint32_t row : rows) {
    const Splat s = splats.splat(row);
    double norm = 0, size = 0;
    for (const float x : s.rotation) norm += static_cast<double>(x) * static_cast<double>(x);
    std::array<double, 3> scale{};
    for (std::size_t k = 0; k < 3; ++k) scale[k] = static_cast<double>(scale_from_log(s.log_scale[k]));
    size = scale[0] * scale[1] + scale[1] * scale[2] + scale[2] * scale[0];
    const auto opacity = static_cast<double>(opacity_from_logit(s.opacity_logit));
    const double weight = opacity * size + 1e-30;
    const double w = static_cast<double>(s.rotation[0]),
                 v[3] = {static_cast<double>(s.rotation[1]), static_cast<double>(s.rotation[2]),
                         static_cast<double>(s.rotation[3])};
    for (std::size_t k = 0; k < 3; ++k) {
      const std::size_t a = (k + 1) % 3, b = (k + 2) % 3;
      // Row k of the rotation's matrix.
      std::array<double, 3> along{};
      along[k] = (w * w + v[k] * v[k] - v[a] * v[a] - v[b] * v[b]) / norm;
      along[a] = 2 * (v[k] * v[a] - w * v[b]) / norm;
      along[b] = 2 * (v[k] * v[b] + w * v[a]) / norm;
      const auto x = static_cast<double>(s.mean[k]);
      double variance = 0;
      for (std::size_t i = 0; i < 3; ++i) variance += along[i] * along[i] * scale[i] * scale[i];
      mean[k] += weight * x;
      square[k] += weight * (x * x + variance);
    }
    for (std::size_t k = 0; k < sh.size(); ++k) sh[k] += weight * static_cast<double>(s.sh[k]);
    total += weight;
    most = std::max(most, opacity);
  }
  for (std::size_t k = 0; k < 3; ++k) {
    one.mean[k] = static_cast<float>(mean[k] / total);
    const double variance = square[k] / total - mean[k] / total * (mean[k] / total);
    one.log_scale[k] = static_cast<float>(std::log(std::max(variance, 1e-20)) / 2);
  }
  for (std::size_t k = 0; k < sh.size(); ++k) one.sh[k] = static_cast<float>(sh[k] / total);
  one.opacity_logit = logit_from_opacity(static_cast<float>(most));
  return one;
}

struct Forest {
  SplatCloud cloud;  // in the order of the file
  RadTree tree;
  bool has_root = false;  // one Gaussian above the coarsest page's
};

Result<Forest> build_tree(const SplatCloud& cloud, const std::vector<lod::Page>& pages) {
  std::vector<std::uint32_t> parent(cloud.size(), kNone);
  std::vector<std::uint32_t> n_children(cloud.size() + 1);
  const auto is_left_out = [&](const lod::Page& page, std::uint32_t row) {
    return page.level != 0 && n_children[row] == 0;
  };
  const auto rows_of = [&](const lod::Page& page) {
    std::vector<std::uint32_t> rows(page.count);
    std::iota(rows.begin(), rows.end(), static_cast<std::uint32_t>(page.first));
    std::erase_if(rows, [&](std::uint32_t row) { return is_left_out(page, row); });
    return rows;
  };
  for (std::size_t i = pages.size(); i-- > 0;) {  // children come after their page
    const lod::Page& page = pages[i];
    if (page.level == 0) continue;
    std::vector<std::uint32_t> coarse(page.count), fine;
    std::iota(coarse.begin(), coarse.end(), static_cast<std::uint32_t>(page.first));
    for (std::uint32_t k = 0; k < page.n_children; ++k) {
      const std::vector<std::uint32_t> rows = rows_of(pages[page.first_child + k]);
      fine.insert(fine.end(), rows.begin(), rows.end());
    }
    if (fine.size() > kMostChildren * coarse.size())
      return make_error(Errc::limit_exceeded, Error::kNone,
                        "a page has more Gaussians below it than a .rad's tree can hold", kMostChildren, fine.size());
    share_out(cloud, coarse, fine, parent);
    for (const std::uint32_t row : fine) ++n_children[parent[row]];
  }
  const std::vector<std::uint32_t> top = rows_of(pages.front());
  if (top.size() > kMostChildren)
    return make_error(Errc::limit_exceeded, Error::kNone,
                      "the coarsest page has more Gaussians than a .rad's tree can hold below one; write levels with "
                      "smaller chunks (--lod --chunk-size)",
                      kMostChildren, top.size());
  Forest forest;
  forest.has_root = top.size() > 1;
  const auto root = static_cast<std::uint32_t>(cloud.size());  // a row of its own
  n_children[root] = static_cast<std::uint32_t>(top.size());
  std::vector<std::uint64_t> begin(cloud.size() + 2);
  std::inclusive_scan(n_children.begin(), n_children.end(), begin.begin() + 1);
  std::vector<std::uint32_t> children(begin.back());
  std::vector<std::uint64_t> next(begin.begin(), begin.end() - 1);
  for (const std::uint32_t row : top) children[next[root]++] = row;
  for (std::uint32_t row = 0; row < root; ++row)
    if (parent[row] != kNone) children[next[parent[row]]++] = row;
  std::vector<std::uint32_t> order{forest.has_root ? root : top.front()};
  for (std::size_t k = 0; k < order.size(); ++k) {
    const std::uint32_t row = order[k];
    forest.tree.first_child.push_back(n_children[row] == 0 ? 0 : static_cast<std::uint32_t>(order.size()));
    forest.tree.n_children.push_back(static_cast<std::uint16_t>(n_children[row]));
    for (std::uint64_t c = begin[row]; c < begin[row + 1]; ++c) order.push_back(children[c]);
  }
  forest.cloud.resize(order.size(), cloud.sh_degree);
  const SplatView view = cloud.view();
  for (std::size_t k = 0; k < order.size(); ++k)
    forest.cloud.set(k, order[k] == root ? merged(view, top) : view.splat(order[k]));
  return forest;
}

}  // namespace

std::vector<std::byte> encode_rad_chunks(const SplatView& splats, const RadTree* tree, unsigned threads) {
  const Ranges ranges = ranges_of(splats);
  std::vector<Bytes> chunks((splats.n + kRadChunk - 1) / kRadChunk);
  run_in_parallel(chunks.size(), threads, [&](std::size_t i) {
    const std::uint64_t first = kRadChunk * i;
    chunks[i] = ChunkWriter(splats, first, std::min(kRadChunk, splats.n - first), ranges, tree).write();
  });
  Json meta{{"version", 1}, {"type", "gsplat"}, {"count", splats.n}, {"maxSh", splats.sh_degree}};
  if (tree != nullptr) meta["lodTree"] = true;
  meta["chunkSize"] = kRadChunk;
  std::uint64_t total = 0;
  Json list = Json::array();
  for (const Bytes& chunk : chunks) {
    list.push_back({{"offset", total}, {"bytes", chunk.size()}});
    total += chunk.size();
  }
  meta["allChunkBytes"] = total;
  meta["chunks"] = std::move(list);
  meta["splatEncoding"] = splat_encoding(ranges, tree != nullptr);
  meta["comment"] = "RoofGS";
  Bytes file = ChunkWriter::head(kRadMagic, meta.dump());
  file.reserve(file.size() + total);
  for (Bytes& chunk : chunks) {
    file.insert(file.end(), chunk.begin(), chunk.end());
    chunk = {};
  }
  return file;
}

Result<std::vector<std::byte>> encode_rad(const SplatView& splats, const WriteOptions& options) {
  return encode_rad_chunks(splats, nullptr, options.threads);
}

}  // namespace detail

Result<LevelsReport> write_rad(const PagedFile& file, const WriteOptions& options, int sh_degree, const PutFile& put) {
  return detail::guard_memory([&]() -> Result<LevelsReport> {
    if (!file.complete())
      return make_error(Errc::pages_missing, Error::kNone, "the end of the file is missing, and pages with it");
    if (file.n_stored() >= detail::kNone)
      return make_error(Errc::limit_exceeded, Error::kNone, "more than 2^32 - 1 Gaussians; split the scene",
                        detail::kNone, file.n_stored());
    std::vector<std::uint32_t> all(file.pages().size());
    std::iota(all.begin(), all.end(), 0U);
    auto cloud = read_pages(file, all);
    if (!cloud) return tl::unexpected(cloud.error());
    strip_sh(*cloud, sh_degree);
    convert_axes(*cloud, options.axes, kAxes3dgs);
    Origin origin = options.origin;
    convert_axes(origin, options.axes, kAxes3dgs);
    if (origin != kNoOrigin && options.strict)
      return make_error(Errc::bad_value, Error::kNone,
                        "the format holds no origin: positions would be rounded to FP32; drop --strict");
    const auto rounding = position_rounding(cloud->view(), SplatFormat::rad, {.origin = origin});
    if (!rounding) return tl::unexpected(rounding.error());
    if (origin != kNoOrigin) {
      for (std::size_t i = 0; i < cloud->mean.size(); ++i)
        cloud->mean[i] = static_cast<float>(origin[i % 3] + static_cast<double>(cloud->mean[i]));
    }
    auto forest = detail::build_tree(*cloud, file.pages());
    if (!forest) return tl::unexpected(forest.error());
    *cloud = {};
    const WriteReport clamped = detail::measure_clamping(forest->cloud.view(), SplatFormat::rad);
    if (Status s = detail::refuse_clamping(clamped); options.strict && !s) return tl::unexpected(s.error());
    const auto bytes = detail::encode_rad_chunks(forest->cloud.view(), &forest->tree, options.threads);
    if (const Status s = put("", bytes); !s) return tl::unexpected(s.error());
    return LevelsReport{file.n_levels() + (forest->has_root ? 1 : 0), 0, forest->cloud.size(), *rounding, clamped};
  });
}

}  // namespace rgs
