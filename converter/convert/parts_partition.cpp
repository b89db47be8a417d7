// parts_partition.cpp - scans inputs and, once the curve is cut into bins, places their Gaussians.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <sys/stat.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <utility>

#include "batch_plan.hpp"
#include "convert_steps.hpp"
#include "parts.hpp"
#include "parts_rows.hpp"
#include "parts_scan.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kSampleOfBin = 128;  // means that locate a bin's ends: sizes are off by a tenth

constexpr Error kInputChanged{.code = Errc::read_failed,
                              .what = "the input changed since the work began; begin again with --overwrite"};

std::string modified_of(const std::string& path) {
  struct stat status {};
  if (::stat(path.c_str(), &status) != 0) return {};
  return fmt::format("{}.{:09}", status.st_mtim.tv_sec, status.st_mtim.tv_nsec);
}

// One input, opened and transformed as in the whole scene.
class OpenInput {
 public:
  Outcome<void> open(const PartsJob& job, const PartsInput& part) {
    if (const Status s = input_.open(part.path); !s) return failed(part.path, s.error());
    const auto bytes = input_.file().bytes();
    if (bytes.size() != part.bytes || hash_of_prefix(bytes) != part.prefix_xxh3)
      return failed(part.path, kInputChanged);
    auto tile = input_.tile(part.format, job.read);
    if (!tile) return failed(part.path, tile.error());
    if (tile->ply && (tile->ply->size() != part.facts.n || tile->ply->sh_degree() != part.facts.sh_degree))
      return failed(part.path, kInputChanged);
    tile->axes = part.axes;
    tile->placed = part.placed;
    tiles_ = TileStream::of_one(std::move(*tile), part.facts, job.encode.axes, job.encode.origin, job.sh_degree);
    return {};
  }
  const TileStream& tiles() const { return tiles_; }
  const SceneInput& input() const { return input_; }
  std::uint64_t row_offset(std::uint64_t i) const {
    const auto& ply = tiles_.tiles().front().ply;
    return ply && i != Error::kNone ? ply->row_offset(i) : Error::kNone;
  }

 private:
  SceneInput input_;
  TileStream tiles_;
};

// Whether the input is the one that was scanned.
Outcome<bool> is_unchanged(const PartsInput& part, const SceneInput& input, const ScannedInput& scanned) {
  if (input.file().bytes().size() != part.bytes) return false;
  return modified_of(part.path) == scanned.modified || input.hash() == scanned.xxh3;
}

// Selects one in `stride` Gaussians by position alone.
bool is_sampled(std::uint64_t position, std::uint64_t stride) {
  std::uint64_t x = position + 0x9E3779B97F4A7C15u;  // SplitMix64 (Steele, Lea, Flood 2014)
  x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9u;
  x = (x ^ x >> 27) * 0x94D049BB133111EBu;
  return (x ^ x >> 31) % stride == 0;
}

Status sample_rows(std::uint64_t first, std::span<const Splat> rows, std::uint64_t stride, std::vector<float>& means) {
  for (std::size_t i = 0; i < rows.size(); ++i) {
    if (!is_sampled(first + i, stride)) continue;
    const float* const mean = rows[i].mean;
    if (std::isfinite(mean[0]) && std::isfinite(mean[1]) && std::isfinite(mean[2]))
      means.insert(means.end(), mean, mean + 3);
  }
  return {};
}

Status unreadable() {
  return make_error(Errc::bad_value, Error::kNone,
                    "a table of this file is damaged; remove the file and run its step again");
}

// Reads an input's scan and sample, which follow each other in its file.
Outcome<SceneScan> read_scan(const PartsRun& run, std::size_t input, const ScannedInput& scanned,
                             std::vector<float>& means) {
  const std::string path = run.scan_path(input);
  auto file = WorkFile::open(path, WorkKind::scan);
  if (!file) return failed(path, file.error());
  std::vector<std::byte> bytes(file->end() - kWorkHeadBytes);
  if (const Status s = file->read(kWorkHeadBytes, bytes); !s) return failed(path, s.error());
  const bool fits =
      scanned.scan_bytes <= bytes.size() && (bytes.size() - scanned.scan_bytes) % (3 * sizeof(float)) == 0;
  if (!fits || xxh3(bytes) != scanned.content_xxh3) return failed(path, unreadable().error());
  const auto sample = std::span<const std::byte>(bytes).subspan(scanned.scan_bytes);
  const std::size_t before = means.size();
  means.resize(before + sample.size() / sizeof(float));
  std::ranges::copy(
      sample, std::as_writable_bytes(std::span(means)).begin() + static_cast<std::ptrdiff_t>(before * sizeof(float)));
  auto scan = SceneScan::from_bytes(std::span<const std::byte>(bytes).first(scanned.scan_bytes));
  if (!scan) return failed(path, scan.error());
  return std::move(*scan);
}

// All inputs in order; `failed_input` is the one that an error is about.
lod::SplatStream all_inputs(const PartsJob& job, std::string& failed_input) {
  return {job.n, job.sh_degree, [&job, &failed_input](const lod::SplatStream::Visit& visit) -> Status {
            for (const PartsInput& part : job.inputs) {
              failed_input = part.path;
              OpenInput input;
              if (const auto opened = input.open(job, part); !opened) return tl::unexpected(opened.error().error);
              const Status read = input.tiles().stream().read(
                  [&](std::uint64_t first, std::span<const Splat> rows) { return visit(part.first + first, rows); });
              if (!read) return read;
            }
            return {};
          }};
}

std::vector<std::uint64_t> cut_bins(const PartsJob& job, const SceneScan& scan, std::span<const float> means) {
  const MortonKey key(scan.robust());
  std::vector<std::uint64_t> keys(means.size() / 3);
  for (std::size_t i = 0; i < keys.size(); ++i) keys[i] = key(&means[3 * i]);
  std::ranges::sort(keys);
  const std::uint64_t n_bins = (scan.n_kept() + job.bin_rows - 1) / job.bin_rows;
  std::vector<std::uint64_t> bins{0};
  for (std::uint64_t i = 1; i < n_bins && !keys.empty(); ++i) {
    const std::uint64_t begin = keys[i * keys.size() / n_bins] >> (63 - kCellKeyBits) << (63 - kCellKeyBits);
    if (begin > bins.back()) bins.push_back(begin);
  }
  return bins;
}

}  // namespace

Outcome<std::optional<ScannedInput>> find_scan(const PartsRun& run, const PartsJob& job, std::size_t input) {
  const std::string path = run.scan_path(input);
  const auto file = WorkFile::find(path, WorkKind::scan, job.identity);
  if (!file) return failed(path, file.error());
  if (!*file) return std::nullopt;
  auto scanned = read_about([&]() -> Result<ScannedInput> {
    const nlohmann::json& j = (*file)->about();
    return ScannedInput{j.at("xxh3"),          j.at("modified"),
                        j.at("first_damaged"), {j.at("lost_rounding"), j.at("rest")},
                        j.at("scan_bytes"),    j.at("content_xxh3")};
  });
  if (!scanned) return failed(path, scanned.error());
  return std::move(*scanned);
}

std::uint64_t basis_of_plan(const PartsJob& job, std::span<const ScannedInput> scans) {
  std::vector<std::uint64_t> hashes{job.identity};
  for (const ScannedInput& scanned : scans) hashes.insert(hashes.end(), {scanned.xxh3, scanned.content_xxh3});
  return xxh3(std::as_bytes(std::span(hashes)));
}

Outcome<std::optional<std::uint64_t>> find_basis_of_plan(const PartsRun& run, const PartsJob& job) {
  std::vector<ScannedInput> scans;
  for (std::size_t i = 0; i < job.inputs.size(); ++i) {
    auto scanned = find_scan(run, job, i);
    if (!scanned) return tl::unexpected(scanned.error());
    if (!*scanned) return std::nullopt;
    scans.push_back(std::move(**scanned));
  }
  return basis_of_plan(job, scans);
}

Done scan_input(const PartsRun& run, const PartsJob& job, std::size_t input) {
  const PartsInput& part = job.inputs[input];
  const std::string path = run.scan_path(input);
  OpenInput open;
  if (const auto opened = open.open(job, part); !opened) return tl::unexpected(opened.error());
  // An unreadable scan is made again.
  if (const auto old = find_scan(run, job, input); old && *old) {
    const auto same = is_unchanged(part, open.input(), **old);
    if (!same) return tl::unexpected(same.error());
    if (!*same) return failed(part.path, kInputChanged);  // the job's facts about it may have changed as well
    return false;
  }
  ScannedInput scanned;
  scanned.modified = modified_of(part.path);
  SceneScan scan(job.output_degree(), job.encode.on_bad, true);
  std::vector<float> means;
  const std::uint64_t stride = std::max<std::uint64_t>(1, job.bin_rows / kSampleOfBin);
  lod::SplatStream stream = open.tiles().stream();
  stream.read = [&, read = stream.read](const lod::SplatStream::Visit& visit) {
    return read([&](std::uint64_t first, std::span<const Splat> rows) -> Status {
      if (Status s = sample_rows(part.first + first, rows, stride, means); !s) return s;
      return visit(first, rows);
    });
  };
  run.observer.begin("scan", part.facts.n, "Gaussians");
  std::uint64_t first_damaged = Error::kNone;
  if (const Status s = lod::scan_stream(stream, run.stream_options(job.quality), scan, first_damaged); !s)
    return failed(part.path, s.error());
  if (scan.n_source() != part.facts.n) return failed(part.path, kInputChanged);
  EncodeOptions encode = job.encode;
  const auto rounding = choose_page_origins(encode, open.tiles().rounding(), job.allow_rounding);
  if (!rounding) return failed(part.path, rounding.error());
  scanned.xxh3 = open.input().hash();
  if (const Status s = open.input().file().check_unchanged(); !s) return failed(part.path, s.error());
  run.observer.finish();

  std::vector<std::byte> content = scan.to_bytes();
  scanned.scan_bytes = content.size();
  const auto sample = std::as_bytes(std::span(means));
  content.insert(content.end(), sample.begin(), sample.end());
  auto writer = WorkWriter::create(path, WorkKind::scan, job.identity, run.sync);
  if (!writer) return failed(path, writer.error());
  if (const Status s = writer->append(content); !s) return failed(path, s.error());
  const Status written = writer->finish({{"xxh3", scanned.xxh3},
                                         {"modified", scanned.modified},
                                         {"first_damaged", open.row_offset(first_damaged)},
                                         {"lost_rounding", open.tiles().rounding().lost},
                                         {"rest", open.tiles().rounding().rest},
                                         {"scan_bytes", scanned.scan_bytes},
                                         {"content_xxh3", xxh3(content)}});
  if (!written) return failed(path, written.error());
  return true;
}

Done make_plan(const PartsRun& run, const PartsJob& job) {
  const auto old = find_plan(run, job);
  if (old && *old) return false;
  PartsPlan plan;
  plan.encode = job.encode;
  plan.scan = SceneScan(job.output_degree(), job.encode.on_bad);
  std::vector<float> means;
  std::vector<ScannedInput> scans;
  std::vector<std::uint64_t> hashes;
  Failure damage{"", {}};
  MeanRounding rounding;
  for (std::size_t i = 0; i < job.inputs.size(); ++i) {
    auto scanned = find_scan(run, job, i);
    if (!scanned) return tl::unexpected(scanned.error());
    if (!*scanned) {
      return failed(run.scan_path(i),
                    {Errc::open_failed, Error::kNone,
                     "missing, or from other work; run --lod-partition for this input first", Error::kNone, i, 0});
    }
    const auto scan = read_scan(run, i, **scanned, means);
    if (!scan) return tl::unexpected(scan.error());
    if (scan->sh_degree() != plan.scan.sh_degree()) return failed(run.scan_path(i), unreadable().error());
    plan.scan.merge(*scan);
    hashes.push_back((*scanned)->xxh3);
    rounding.add((*scanned)->rounding);
    if (damage.file.empty() && scan->n_kept() != scan->n_source())
      damage = {job.inputs[i].path, damaged_gaussian((*scanned)->first_damaged, *scan).value()};
    scans.push_back(std::move(**scanned));
  }
  const std::string& first_path = job.inputs.front().path;
  if (job.encode.on_bad == BadPolicy::refuse && !damage.file.empty()) return tl::unexpected(damage);
  if (const Status s = check_encodable(plan.scan, plan.encode); !s) return failed(first_path, s.error());
  if (plan.scan.n_kept() == 0) return failed(first_path, nothing_for_levels().value());
  if (const auto left = choose_page_origins(plan.encode, rounding, job.allow_rounding); !left)
    return failed(first_path, left.error());
  if (plan.encode.provenance) plan.encode.provenance->source_xxh3 = hash_of_sources(hashes);
  ConvertOptions views;
  views.z_near = job.z_near;
  views.z_far = job.z_far;
  std::vector<float> even;
  if (!job.cameras.empty()) {
    const auto hash = options_hash({}, job.cameras);
    if (!hash) return failed(job.cameras, hash.error());
    if (*hash != job.cameras_hash) return failed(job.cameras, kInputChanged);
    auto cameras = read_cameras(job.cameras);
    if (!cameras) return failed(job.cameras, cameras.error());
    views.cameras = std::move(*cameras);
    std::string input;
    run.observer.begin("sample", job.n, "Gaussians");
    const Status s = lod::sample_means(all_inputs(job, input), run.stream_options(job.quality), plan.scan,
                                       job.encode.on_bad, kDepthSample, even);
    if (!s) return failed(input, s.error());
    run.observer.finish();
  }
  if (const Status s = find_views(plan.encode, views, plan.scan, even); !s)
    return failed(job.cameras.empty() ? first_path : job.cameras, s.error());
  plan.bins = cut_bins(job, plan.scan, means);
  // Based on the scans that were read: another may have replaced one meanwhile.
  if (const Status s = write_plan(run, plan, basis_of_plan(job, scans)); !s) return failed(run.plan_path(), s.error());
  return true;
}

Done place_input(const PartsRun& run, const PartsJob& job, const PartsPlan& plan, std::size_t input) {
  const PartsInput& part = job.inputs[input];
  const std::string path = run.rows_path(input);
  if (const auto old = WorkFile::find(path, WorkKind::rows, plan.identity); old && *old) return false;
  const auto scanned = find_scan(run, job, input);
  if (!scanned) return tl::unexpected(scanned.error());
  OpenInput open;
  if (const auto opened = open.open(job, part); !opened) return tl::unexpected(opened.error());
  const auto same = *scanned ? is_unchanged(part, open.input(), **scanned) : Outcome<bool>(false);
  if (!same) return tl::unexpected(same.error());
  if (!*same) return failed(part.path, kInputChanged);

  auto writer = WorkWriter::create(path, WorkKind::rows, plan.identity, run.sync);
  if (!writer) return failed(path, writer.error());
  run.observer.begin("place", part.facts.n, "Gaussians");
  RowsWriter rows(*writer, plan, run.memory_bytes);
  Error of_rows{};
  bool is_of_rows = false;
  const Status read =
      lod::each_kept(open.tiles().stream(), plan.scan.sh_degree(), job.encode.on_bad,
                     [&](std::span<const std::uint32_t> positions, std::span<const Splat> kept) -> Status {
                       const Status added = rows.add(part.first, positions, kept);
                       if (!added) {
                         of_rows = added.error();
                         is_of_rows = true;
                       }
                       run.observer.advance(kept.size());
                       return added;
                     });
  if (is_of_rows) return failed(path, of_rows);
  if (!read) return failed(part.path, read.error());
  if (const Status s = open.input().file().check_unchanged(); !s) return failed(part.path, s.error());
  if (const Status s = rows.finish(); !s) return failed(path, s.error());
  run.observer.finish();
  return true;
}

}  // namespace rgs
