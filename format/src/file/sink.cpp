// sink.cpp - bytes to a file on disk, or into memory.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cassert>

#include "rgs/file.hpp"
#include "rgs/scene_writer.hpp"

namespace rgs {

Status Sink::reserve(std::uint64_t size) {
  if (file_ != nullptr) return file_->reserve(size);
  memory_->reserve(size);
  return {};
}

Status Sink::write_at(std::uint64_t offset, std::span<const std::byte> bytes) {
  if (file_ != nullptr) return file_->write_at(offset, bytes);
  if (memory_->size() < offset + bytes.size()) memory_->resize(offset + bytes.size());
  std::ranges::copy(bytes, memory_->begin() + static_cast<std::ptrdiff_t>(offset));
  return {};
}

Status Sink::read_at(std::uint64_t offset, std::span<std::byte> bytes) const {
  if (file_ != nullptr) return file_->read_at(offset, bytes);
  assert(offset + bytes.size() <= memory_->size());
  std::ranges::copy_n(memory_->begin() + static_cast<std::ptrdiff_t>(offset), static_cast<std::ptrdiff_t>(bytes.size()),
                      bytes.begin());
  return {};
}

Status Sink::truncate(std::uint64_t size) {
  if (file_ != nullptr) return file_->truncate(size);
  memory_->resize(size);
  memory_->shrink_to_fit();
  return {};
}

}  // namespace rgs
