// audit_source.cpp - a PLY file, or a cloud.
// SPDX-License-Identifier: Apache-2.0
#include "audit_source.hpp"

#include <cassert>
#include <utility>

#include "rgs/file.hpp"
#include "rgs/splat_edit.hpp"
#include "scene_file.hpp"

namespace rgs::audit {

Result<Source> Source::open(const std::string& path, ReadOptions options, const std::optional<Axes>& axes) {
  const auto mapped = MappedFile::open(path);
  if (!mapped) return tl::unexpected(mapped.error());
  const auto turns = [](const Axes& from, const Axes& to) {
    return to[0] != Axis::undeclared && from[0] != Axis::undeclared && from != to;
  };
  Source source;
  if (detect_format(mapped->bytes()) == SplatFormat::ply) {
    auto ply = PlyFile::open(path);
    if (!ply) return tl::unexpected(ply.error());
    const Axes& stated = ply->declarations().axes;
    if (!turns(stated, axes.value_or(stated))) {
      source.owned_ = std::make_shared<const PlyFile>(*std::move(ply));
      source.ply_ = source.owned_.get();
      return source;
    }
  }
  options.keep_axes = true;
  auto file = read_splats(path, options);
  if (!file) return tl::unexpected(file.error());
  if (const Axes to = axes.value_or(kAxes3dgs); turns(file->axes, to)) {
    convert_axes(file->cloud, file->axes, to);
    convert_axes(file->origin, file->axes, to);
    file->axes = to;
  } else if (file->format == SplatFormat::rgs) {
    source.stored_path_ = path;
    source.limits_ = options.limits;
  }
  source.stated_ = declarations_of(*file);
  source.file_ = std::make_shared<const SplatFile>(*std::move(file));
  return source;
}

Result<Source> Source::relative_to(const Origin& origin) const {
  Source source;
  if (ply_ != nullptr) {
    auto again = PlyFile::open(ply_->source());
    if (!again) return tl::unexpected(again.error());
    again->rebase(origin);
    source.owned_ = std::make_shared<const PlyFile>(*std::move(again));
    source.ply_ = source.owned_.get();
    return source;
  }
  SplatFile file = *file_;
  file.cloud.mean_rest.resize(file.cloud.mean.size());
  rebase_exactly(file.cloud.mean, file.cloud.mean_rest, file.origin, origin);
  file.origin = origin;
  source.stated_ = stated_;
  source.stated_.origin = origin;
  source.file_ = std::make_shared<const SplatFile>(std::move(file));
  return source;
}

void Source::read(std::uint64_t first, std::span<Splat> out) const {
  if (ply_ != nullptr) return ply_->read(first, out);
  const SplatView view = file_->cloud.view();
  for (std::size_t i = 0; i < out.size(); ++i) out[i] = view.splat(first + i);
}

void Source::gather(std::span<const std::uint32_t> indices, std::span<Splat> out) const {
  assert(indices.size() == out.size());
  if (ply_ != nullptr) return ply_->gather(indices, out);
  const SplatView view = file_->cloud.view();
  for (std::size_t i = 0; i < out.size(); ++i) out[i] = view.splat(indices[i]);
}

}  // namespace rgs::audit
