// validate.cpp - checks the payload of a file against the specification.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstring>

#include "file/chunk_summary.hpp"
#include "file/repeated_index.hpp"
#include "file/row_kernels.hpp"
#include "file/value_checks.hpp"
#include "file/workers.hpp"
#include "rgs/checksum.hpp"
#include "rgs/decode.hpp"
#include "rgs/frame_content.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"
#include "rgs/stored_values.hpp"

namespace rgs {
namespace {

using detail::run_jobs;
using detail::threads_for;
using detail::worker_count;
using Totals = detail::ValueTotals;

// `place` maps a byte of the row to its offset in the file.
template <class Place>
Status check_geometry(const std::uint16_t codes[8], const Place& place, detail::RowSummary& found) {
  if (!is_unit_quaternion(codes)) {
    return make_error(Errc::bad_value, place(0), "a rotation is not a unit quaternion");
  }
  if (has_sign_bit(codes[0])) return make_error(Errc::bad_value, place(0), "a rotation's w has its sign bit set");
  for (int i = 4; i < 7; ++i) {
    if (!is_stored_scale(codes[i])) {
      return make_error(Errc::bad_value, place(2 * static_cast<std::uint64_t>(i)), "a scale is negative or not finite");
    }
    found.largest_scale = std::max(found.largest_scale, codes[i]);
  }
  if (!is_stored_opacity(codes[7])) return make_error(Errc::bad_value, place(14), "an opacity is not between 0 and 1");
  found.counts.add(codes);
  found.largest_opacity = std::max(found.largest_opacity, codes[7]);
  return {};
}

template <class Place>
Status check_sh(const std::int8_t* codes, const Place& place, const ShStepSet& steps, int degree) {
  const int floats = 3 * sh_coefficients(degree);
  for (int i = 0; i < floats; ++i) {
    if (codes[i] == -128) {
      return make_error(Errc::bad_value, place(static_cast<std::uint64_t>(i)), "an SH code is -128, which is not used");
    }
    if (codes[i] != 0 && steps.of_value(i) == 0) {
      return make_error(Errc::bad_value, place(static_cast<std::uint64_t>(i)),
                        "an SH code is not 0 though its step is 0");
    }
  }
  for (int i = floats; i < static_cast<int>(sh_bytes(degree)); ++i) {
    if (codes[i] != 0) {
      return make_error(Errc::reserved_bits, place(static_cast<std::uint64_t>(i)), "SH padding is not zero");
    }
  }
  return {};
}

// Checks and summarises the rows of a chunk; on failure finds the first illegal value.
Result<detail::RowSummary> check_rows(const detail::ChunkRows& rows, std::uint64_t n, const ShStepSet& steps) {
  detail::RowSummary found;
  Box& box = found.means;
  for (std::uint64_t i = 0; i < n; ++i) {
    float mean[3];
    std::memcpy(mean, rows.means + i * kMeanBytes, kMeanBytes);
    for (std::size_t k = 0; k < 3; ++k) {
      if (!is_finite(mean[k])) {
        return make_error(Errc::bad_value, rows.place(SectionType::means, i, 4 * k), "a mean is not finite");
      }
      box.min[k] = i == 0 ? mean[k] : std::min(box.min[k], mean[k]);
      box.max[k] = i == 0 ? mean[k] : std::max(box.max[k], mean[k]);
    }
    std::uint16_t codes[8];
    std::memcpy(codes, rows.geometry + i * kGeometryBytes, kGeometryBytes);
    const auto* sh = reinterpret_cast<const std::int8_t*>(rows.sh + i * sh_bytes(rows.sh_degree));
    const auto geometry_at = [&](std::uint64_t byte) { return rows.place(SectionType::geometry, i, byte); };
    const auto sh_at = [&](std::uint64_t byte) { return rows.place(SectionType::sh, i, byte); };
    if (Status s = check_geometry(codes, geometry_at, found); !s) return tl::unexpected(s.error());
    if (Status s = check_sh(sh, sh_at, steps, rows.sh_degree); !s) return tl::unexpected(s.error());
  }
  return found;
}

}  // namespace

Status detail::check_chunk_rows(const ChunkRows& rows, const ChunkEntry& entry, const ShStepSet& steps,
                                ValueTotals& totals) {
  RowSummary found;
  const std::uint64_t n = entry.count;
  const RowKernels& kernels = row_kernels();
  if (n == 0 || !kernels.check(rows.means, rows.geometry, n, found) ||
      !kernels.check_sh(rows.sh, n * sh_bytes(rows.sh_degree), ShRowMask(steps, rows.sh_degree))) {
    const auto checked = check_rows(rows, n, steps);
    if (!checked) return tl::unexpected(checked.error());
    found = *checked;
  }
  totals.counts.add(found.counts);

  const auto at = [&](std::uint64_t byte) { return rows.place(SectionType::chunks, 0, byte); };
  if (found.means.min != entry.means.min || found.means.max != entry.means.max) {
    return make_error(Errc::bad_value, at(0), "a chunk's box differs from that of its means");
  }
  if (entry.radius != 3.f * dequantize_scale(found.largest_scale, rows.scale_exponent)) {
    return make_error(Errc::bad_value, at(12), "a chunk's radius is not three times its largest scale");
  }
  if (entry.max_opacity != float_from_half(found.largest_opacity)) {
    return make_error(Errc::bad_value, at(28), "a chunk's largest opacity differs from that of its Gaussians");
  }
  totals.add({{}, found.means, false});
  return {};
}

namespace {

Status check_chunk(const DirectData& data, std::uint64_t index, Totals& totals) {
  const FileView& view = data.file();
  const auto entry = view.chunk(index);
  if (!entry) return tl::unexpected(entry.error());
  const auto steps = view.step_set(entry->step_set);
  if (!steps) return tl::unexpected(steps.error());
  const Header& h = view.header();
  const std::uint64_t first = index * h.chunk_size, row = first - data.first();
  const auto place = [&](SectionType type, std::uint64_t i, std::uint64_t byte) {
    return view.place(type, type == SectionType::chunks ? index : first + i, byte);
  };
  return detail::check_chunk_rows(
      {data.means().data() + row * kMeanBytes, data.geometry().data() + row * kGeometryBytes,
       data.sh().data() + row * sh_bytes(h.sh_degree), h.sh_degree, h.scale_exponent, place},
      *entry, *steps, totals);
}

// Checks every value of the range, a few thousand Gaussians at a time.
Status check_chunks(const DirectData& data, unsigned threads, Totals& totals) {
  const std::uint64_t chunks_a_job = std::max<std::uint64_t>(1, 8192 / data.header().chunk_size);
  const std::uint64_t n_jobs = (data.n_chunks() + chunks_a_job - 1) / chunks_a_job;
  threads = threads_for(data.size() * (kMeanBytes + kGeometryBytes + sh_bytes(data.header().sh_degree)), threads);
  std::vector<Totals> parts(worker_count(n_jobs, threads));
  const Status status = run_jobs(n_jobs, threads, [&](unsigned worker, std::uint64_t job) -> Status {
    const std::uint64_t end = std::min(data.n_chunks(), (job + 1) * chunks_a_job);
    for (std::uint64_t i = job * chunks_a_job; i < end; ++i) {
      if (Status s = check_chunk(data, data.first_chunk() + i, parts[worker]); !s) return s;
    }
    return {};
  });
  for (const Totals& part : parts) totals.add(part);
  return status;
}

Status check_step_sets(const FileView& view) {
  for (std::uint64_t i = 0; i < view.header().n_step_sets; ++i) {
    if (const auto set = view.step_set(i); !set) return tl::unexpected(set.error());
  }
  return {};
}

}  // namespace

Status detail::check_declarations(const FileView& view, const ValueTotals& totals) {
  const Declarations& d = view.declarations();
  const std::uint64_t at = view.find(SectionType::declarations)->offset;
  if (d.full.min != totals.full.min || d.full.max != totals.full.max) {
    return make_error(Errc::bad_value, at + 44, "the declared full box differs from that of the means");
  }
  for (std::size_t k = 0; k < 3; ++k) {
    if (d.robust.min[k] < totals.full.min[k] || d.robust.max[k] > totals.full.max[k]) {
      return make_error(Errc::bad_value, at + 68, "the declared robust box reaches beyond the full box");
    }
  }
  const ValueCounts& counts = totals.counts;
  const std::uint64_t found[4] = {counts.scale_subnormal, counts.scale_zero, counts.opacity_zero, counts.opacity_one};
  const std::uint64_t declared[4] = {d.n_scale_subnormal, d.n_scale_zero, d.n_opacity_zero, d.n_opacity_one};
  for (std::size_t i = 0; i < 4; ++i) {
    if (declared[i] != found[i]) {
      return make_error(Errc::bad_value, at + 120 + 8 * i, "a declared count differs from the file's", declared[i],
                        found[i]);
    }
  }
  return {};
}

Status detail::check_permutation(const FileView& view) {
  const SectionEntry* entry = view.find(SectionType::permutation);
  if (entry == nullptr) return {};
  const std::uint64_t n = view.header().n_gaussians;
  const std::uint64_t entry_bytes = n == 0 ? 0 : entry->stored_bytes / n;
  const std::uint64_t n_source = view.declarations().n_source;
  for (std::uint64_t i = 0; i < n; ++i) {
    const std::uint64_t index = view.source_index(i);
    if (index >= n_source) {
      return make_error(Errc::bad_value, entry->offset + i * entry_bytes,
                        "the permutation names a Gaussian beyond the source", n_source, index);
    }
  }
  if (detail::has_repeated_index(n, n_source, [&view](std::uint64_t i) { return view.source_index(i); })) {
    return make_error(Errc::bad_value, entry->offset, "the permutation names a source Gaussian twice");
  }
  return {};
}

namespace {

// Checks hashes of sections; of coded ones only if `coded`.
Status check_sections(const FileView& view, unsigned threads, bool coded) {
  threads = threads_for(view.bytes().size(), threads);
  return run_jobs(view.sections().size(), threads, [&](unsigned, std::uint64_t i) -> Status {
    const SectionEntry& s = view.sections()[i];
    if (!coded && view.frames(static_cast<SectionType>(s.type)).rows != 0) return {};
    const std::uint64_t hash = xxh3(view.stored(s));
    if (hash == s.xxh3) return {};
    return make_error(Errc::checksum_mismatch, s.offset, "a section's checksum does not match", s.xxh3, hash);
  });
}

}  // namespace

namespace detail {

Status check_values(const DirectData& data, unsigned threads) {
  Totals totals;
  return check_chunks(data, threads, totals);
}

Status check_file(const DirectData& data, unsigned threads) {
  const FileView& view = data.file();
  if (Status s = check_sections(view, threads, false); !s) return s;
  if (Status s = check_step_sets(view); !s) return s;
  Totals totals;
  if (Status s = check_chunks(data, threads, totals); !s) return s;
  if (Status s = check_declarations(view, totals); !s) return s;
  return check_permutation(view);
}

}  // namespace detail

Validation::Validation(const FileView& view) : view_(&view), totals_(std::make_unique<detail::ValueTotals>()) {}
Validation::Validation(Validation&&) noexcept = default;
Validation& Validation::operator=(Validation&&) noexcept = default;
Validation::~Validation() = default;

Result<Validation> Validation::begin(const FileView& view) {
  return detail::guard_memory([&]() -> Result<Validation> {
    if (const Status s = check_sections(view, 0, true); !s) return tl::unexpected(s.error());
    if (const Status s = check_step_sets(view); !s) return tl::unexpected(s.error());
    return Validation(view);
  });
}

Result<Validation> Validation::begin_early(const FileView& view) {
  return detail::guard_memory([&]() -> Result<Validation> {
    if (const Status s = check_step_sets(view); !s) return tl::unexpected(s.error());
    Validation validation(view);
    validation.hashes_last_ = true;
    return validation;
  });
}

Status Validation::check(const DirectData& next) {
  return detail::guard_memory([&] { return check_chunks(next, 0, *totals_); });
}

Status Validation::finish() const {
  return detail::guard_memory([&]() -> Status {
    if (hashes_last_) {
      if (Status s = check_sections(*view_, 0, true); !s) return s;
    }
    if (Status s = detail::check_declarations(*view_, *totals_); !s) return s;
    return detail::check_permutation(*view_);
  });
}

std::uint64_t Validation::chunks_at_a_time() const {
  const Header& h = view_->header();
  return std::max<std::uint64_t>(1, view_->coded() ? (1u << 19) / h.chunk_size : h.n_chunks);
}

Status validate_tables(const FileView& view, unsigned threads) {
  return detail::guard_memory([&]() -> Status {
    if (Status s = check_sections(view, threads, false); !s) return s;
    if (Status s = check_step_sets(view); !s) return s;
    for (std::uint64_t i = 0; i < view.header().n_chunks; ++i) {
      if (const auto entry = view.chunk(i); !entry) return tl::unexpected(entry.error());
    }
    return detail::check_permutation(view);
  });
}

Status validate_declarations(const FileView& view, const ValueCounts& counts) {
  Totals totals;
  totals.counts = counts;
  for (std::uint64_t i = 0; i < view.header().n_chunks; ++i) {
    const auto entry = view.chunk(i);
    if (!entry) return tl::unexpected(entry.error());
    totals.add({{}, entry->means, false});
  }
  return detail::check_declarations(view, totals);
}

Status validate(const FileView& view) {
  auto validation = Validation::begin(view);
  if (!validation) return tl::unexpected(validation.error());
  const std::uint64_t n_chunks = view.header().n_chunks, piece = validation->chunks_at_a_time();
  for (std::uint64_t first = 0; first < n_chunks; first += piece) {
    const auto data = read_chunks(view, first, std::min(piece, n_chunks - first), {.validate = false});
    if (!data) return tl::unexpected(data.error());
    if (Status s = validation->check(*data); !s) return s;
  }
  return validation->finish();
}

}  // namespace rgs
