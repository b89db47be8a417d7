// draco_points.hpp - points with integer coordinates through Draco's library, whose streams Codec::archive_draco has.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>
#include <draco/compression/decode.h>
#include <draco/compression/expert_encode.h>
#include <draco/point_cloud/point_cloud.h>

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace rgs::test {

using DracoPoint = std::array<std::uint32_t, 3>;

inline std::vector<std::byte> draco_encode(std::span<const DracoPoint> points) {
  const auto n = static_cast<std::uint32_t>(points.size());
  draco::PointCloud cloud;
  cloud.set_num_points(n);
  draco::GeometryAttribute position;
  position.Init(draco::GeometryAttribute::POSITION, nullptr, 3, draco::DT_UINT32, false, sizeof(DracoPoint), 0);
  draco::PointAttribute& values = *cloud.attribute(cloud.AddAttribute(position, true, n));
  for (std::uint32_t i = 0; i < n; ++i) values.SetAttributeValue(draco::AttributeValueIndex(i), points[i].data());
  draco::ExpertEncoder encoder(cloud);
  encoder.SetEncodingMethod(draco::POINT_CLOUD_KD_TREE_ENCODING);
  encoder.SetSpeedOptions(0, 0);
  draco::EncoderBuffer buffer;
  REQUIRE(encoder.EncodeToBuffer(&buffer).ok());
  const auto bytes = std::as_bytes(std::span(buffer.data(), buffer.size()));
  return {bytes.begin(), bytes.end()};
}

inline std::vector<DracoPoint> draco_decode(std::span<const std::byte> stream) {
  draco::DecoderBuffer buffer;
  buffer.Init(reinterpret_cast<const char*>(stream.data()), stream.size());
  draco::Decoder decoder;
  auto cloud = decoder.DecodePointCloudFromBuffer(&buffer);
  REQUIRE(cloud.ok());
  const draco::PointAttribute& values = *cloud.value()->GetNamedAttribute(draco::GeometryAttribute::POSITION);
  std::vector<DracoPoint> points(cloud.value()->num_points());
  for (std::uint32_t i = 0; i < points.size(); ++i) {
    values.GetMappedValue(draco::PointIndex(i), points[i].data());
  }
  return points;
}

}  // namespace rgs::test
