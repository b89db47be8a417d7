// point_codec.cpp - Draco's kd-tree (Devillers and Gandoin 2000) behind a check of all that its decoder would believe.
// SPDX-License-Identifier: Apache-2.0
#include "archive/point_codec.hpp"

#include <draco/compression/decode.h>
#include <draco/compression/expert_encode.h>
#include <draco/point_cloud/point_cloud.h>

#include <algorithm>
#include <cassert>
#include <cstring>
#include <exception>
#include <new>

#include "file/byte_reader.hpp"

namespace rgs::detail {
namespace {

// What Draco 1.5 writes before and behind the number of points: see docs/ARCHIVE.md.
constexpr unsigned char kHead[11] = {'D', 'R', 'A', 'C', 'O', 2, 3, 0, 1, 0, 0};
constexpr unsigned char kAttribute[8] = {1, 1, 0, 6, 3, 0, 0, 6};
constexpr std::size_t kHeadBytes = sizeof kHead + 4 + sizeof kAttribute + 8;

bool has(std::span<const std::byte> stream, std::size_t at, std::span<const unsigned char> bytes) {
  return std::memcmp(stream.data() + at, bytes.data(), bytes.size()) == 0;
}

bool legal_head(std::span<const std::byte> stream, std::uint32_t n, std::uint32_t max_bits) {
  if (stream.size() < kHeadBytes || !has(stream, 0, kHead) || !has(stream, 15, kAttribute)) return false;
  ByteReader counts(stream.subspan(11)), tree(stream.subspan(23));
  return counts.u32() == n && tree.u32() <= max_bits && tree.u32() == n;
}

}  // namespace

Result<std::vector<std::byte>> encode_points(std::span<const GridPoint> points) {
  assert(!points.empty());
  const auto n = static_cast<std::uint32_t>(points.size());
  draco::PointCloud cloud;
  cloud.set_num_points(n);
  draco::GeometryAttribute position;
  position.Init(draco::GeometryAttribute::POSITION, nullptr, 3, draco::DT_UINT32, false, sizeof(GridPoint), 0);
  draco::PointAttribute& values = *cloud.attribute(cloud.AddAttribute(position, true, n));
  for (std::uint32_t i = 0; i < n; ++i) values.SetAttributeValue(draco::AttributeValueIndex(i), points[i].data());
  draco::ExpertEncoder encoder(cloud);
  encoder.SetEncodingMethod(draco::POINT_CLOUD_KD_TREE_ENCODING);
  encoder.SetSpeedOptions(0, 0);
  draco::EncoderBuffer buffer;
  if (!encoder.EncodeToBuffer(&buffer).ok())
    return make_error(Errc::internal, Error::kNone, "Draco cannot encode the means");
  const auto bytes = std::as_bytes(std::span(buffer.data(), buffer.size()));
  if (!legal_head(bytes, n, 32)) {
    return make_error(Errc::internal, Error::kNone,
                      "this version of Draco writes another stream than the format prescribes");
  }
  return std::vector<std::byte>(bytes.begin(), bytes.end());
}

Status decode_points(std::span<const std::byte> stream, std::uint64_t offset, std::uint32_t max_bits,
                     std::span<GridPoint> points) {
  const auto n = static_cast<std::uint32_t>(points.size());
  if (!legal_head(stream, n, max_bits)) {
    return make_error(Errc::corrupt_data, offset,
                      "a frame of means is not the Draco stream that the format prescribes");
  }
  draco::DecoderBuffer buffer;
  buffer.Init(reinterpret_cast<const char*>(stream.data()), stream.size());
  bool decoded = false;
  try {
    const auto result = draco::Decoder().DecodePointCloudFromBuffer(&buffer);
    const draco::PointAttribute* values =
        result.ok() ? result.value()->GetNamedAttribute(draco::GeometryAttribute::POSITION) : nullptr;
    decoded = values != nullptr && result.value()->num_points() == n && values->size() == n &&
              values->byte_stride() == sizeof(GridPoint) &&
              values->buffer()->data_size() >= points.size() * sizeof(GridPoint) && buffer.remaining_size() == 0;
    if (decoded) std::memcpy(points.data(), values->GetAddress(draco::AttributeValueIndex(0)), points.size_bytes());
  } catch (const std::bad_alloc&) {
    throw;
  } catch (const std::exception&) {  // of a damaged stream: its head allows no allocation that is out of proportion
    decoded = false;
  }
  if (!decoded) return make_error(Errc::corrupt_data, offset, "a frame of means is not accepted by Draco");
  const bool in_range =
      std::ranges::all_of(points, [max_bits](const GridPoint& p) { return ((p[0] | p[1] | p[2]) >> max_bits) == 0; });
  if (!in_range) return make_error(Errc::corrupt_data, offset, "a mean's coordinate is outside the grid");
  return {};
}

}  // namespace rgs::detail
