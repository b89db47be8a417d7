// point_encode.cpp - encodes Draco's kd-tree (Devillers and Gandoin 2000) with its library.
// SPDX-License-Identifier: Apache-2.0
#include <draco/compression/expert_encode.h>
#include <draco/point_cloud/point_cloud.h>

#include <cassert>

#include "archive/point_codec.hpp"

namespace rgs::detail {

bool can_encode_points() {
  return true;
}

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
  if (!legal_point_head(bytes, n, 32)) {
    return make_error(Errc::internal, Error::kNone,
                      "this version of Draco writes another stream than the format prescribes");
  }
  return std::vector<std::byte>(bytes.begin(), bytes.end());
}

}  // namespace rgs::detail
