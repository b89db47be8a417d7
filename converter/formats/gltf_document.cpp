// gltf_document.cpp - glTF 2.0 (registry.khronos.org/glTF): chunks of a .glb, buffer views and accessors.
// SPDX-License-Identifier: Apache-2.0
#include "gltf_document.hpp"

#include <algorithm>
#include <array>
#include <limits>
#include <utility>

#include "json_member.hpp"
#include "quantised.hpp"

namespace rgs::detail {
namespace {

using nlohmann::json;

std::uint64_t component_bytes(GltfComponent component) {
  switch (component) {
    case GltfComponent::i8:
    case GltfComponent::u8: return 1;
    case GltfComponent::i16:
    case GltfComponent::u16: return 2;
    default: return 4;
  }
}

std::uint64_t load_index(GltfComponent component, std::span<const std::byte> bytes, std::uint64_t i) {
  switch (component) {
    case GltfComponent::u8: return load_u8(bytes, i);
    case GltfComponent::u16: return load<std::uint16_t>(bytes, 2 * i);
    default: return load<std::uint32_t>(bytes, 4 * i);
  }
}

float load_component(GltfComponent component, bool normalized, std::span<const std::byte> bytes, std::uint64_t offset) {
  float value = 0, one = 1;
  switch (component) {
    case GltfComponent::i8: value = load<std::int8_t>(bytes, offset), one = 127; break;
    case GltfComponent::u8: value = load<std::uint8_t>(bytes, offset), one = 255; break;
    case GltfComponent::i16: value = load<std::int16_t>(bytes, offset), one = 32767; break;
    case GltfComponent::u16: value = load<std::uint16_t>(bytes, offset), one = 65535; break;
    default: return load<float>(bytes, offset);
  }
  return normalized ? std::max(value / one, -1.F) : value;
}

}  // namespace

std::optional<std::uint64_t> gltf_whole(const json& object, const char* name, std::optional<std::uint64_t> otherwise) {
  const json* value = json_member(object, name);
  if (value == nullptr) return otherwise;
  if (!value->is_number_unsigned()) return std::nullopt;
  const auto number = value->get<std::uint64_t>();
  return number <= std::numeric_limits<std::uint32_t>::max() ? std::optional(number) : std::nullopt;
}

// ---- arrays ---------------------------------------------------------------------------------------------------------

// Of element `i` among the sparse ones, n_sparse_ if it is none.
std::uint64_t GltfArray::sparse_index(std::uint64_t i) const {
  std::uint64_t first = 0, end = n_sparse_;
  while (first < end) {
    const std::uint64_t middle = (first + end) / 2;
    if (load_index(index_component_, indices_, middle) < i) {
      first = middle + 1;
    } else {
      end = middle;
    }
  }
  return first < n_sparse_ && load_index(index_component_, indices_, first) == i ? first : n_sparse_;
}

float GltfArray::unusual_at(std::uint64_t i, std::uint64_t component) const {
  const std::uint64_t within = component * component_bytes(component_), sparse = n_sparse_ == 0 ? 0 : sparse_index(i);
  if (sparse < n_sparse_) return load_component(component_, normalized_, values_, sparse * element_bytes_ + within);
  return bytes_.empty() ? 0.F : load_component(component_, normalized_, bytes_, i * stride_ + within);
}

Status GltfArray::check() const {
  for (std::uint64_t k = 0, next = 0; k < n_sparse_; ++k) {
    const std::uint64_t index = load_index(index_component_, indices_, k);
    if (index < next || index >= n_) {
      return make_error(Errc::bad_value, indices_at_ + k * component_bytes(index_component_),
                        "an index of a sparse accessor is out of range or does not ascend", next, index);
    }
    next = index + 1;
  }
  return {};
}

// ---- the document ---------------------------------------------------------------------------------------------------

Result<GltfDocument> GltfDocument::open_glb(std::span<const std::byte> bytes) {
  if (bytes.size() < kGlbHeaderBytes + kChunkHeaderBytes) {
    return make_error(Errc::truncated, bytes.size(), "the file ends inside its header",
                      kGlbHeaderBytes + kChunkHeaderBytes, bytes.size());
  }
  if (load<std::uint32_t>(bytes, 0) != kMagicGlb) return make_error(Errc::bad_magic, 0, "is not a binary glTF file");
  if (load<std::uint32_t>(bytes, 4) != 2) {
    return make_error(Errc::unsupported_version, 4, "a glTF version other than 2", 2, load<std::uint32_t>(bytes, 4));
  }
  const std::uint64_t length = load<std::uint32_t>(bytes, 8);
  if (length > bytes.size())
    return make_error(Errc::truncated, 8, "the file is shorter than its header says", length, bytes.size());
  if (length < bytes.size())
    return make_error(Errc::trailing_bytes, length, "bytes after the end that the header states");
  GltfDocument document;
  bool first = true;
  for (std::uint64_t at = kGlbHeaderBytes; at < length;) {
    if (length - at < kChunkHeaderBytes)
      return make_error(Errc::truncated, at, "the file ends inside a chunk's header");
    const std::uint64_t size = load<std::uint32_t>(bytes, at);
    const auto type = load<std::uint32_t>(bytes, at + 4);
    if (size > length - at - kChunkHeaderBytes) {
      return make_error(Errc::truncated, at, "a chunk ends past the end of the file", size,
                        length - at - kChunkHeaderBytes);
    }
    const auto data = bytes.subspan(at + kChunkHeaderBytes, size);
    if (first) {
      if (type != kChunkJson) return make_error(Errc::bad_header, at + 4, "the first chunk is not JSON");
      const char* text = reinterpret_cast<const char*>(data.data());
      document.root_ = json::parse(text, text + data.size(), nullptr, false);
      if (!document.root_.is_object()) return document.bad("the glTF's JSON does not parse");
    } else if (type == kChunkBin && document.bin_offset_ == 0) {
      document.bin_ = data;
      document.bin_offset_ = at + kChunkHeaderBytes;
    }
    first = false;
    at += kChunkHeaderBytes + size;
  }
  return document;
}

tl::unexpected<Error> GltfDocument::bad(const char* what, Errc code, std::uint64_t expected,
                                        std::uint64_t found) const {
  return make_error(code, json_offset_, what, expected, found);
}

const json* GltfDocument::element(const char* name, const json* index) const {
  const json* array = json_member(root_, name);
  if (array == nullptr || !array->is_array() || index == nullptr || !index->is_number_unsigned()) return nullptr;
  const auto i = index->get<std::uint64_t>();
  return i < array->size() ? &(*array)[i] : nullptr;
}

Result<GltfDocument::View> GltfDocument::view(const json* index) const {
  const json* stated = element("bufferViews", index);
  if (stated == nullptr) return bad("a buffer view is missing");
  if (gltf_whole(*stated, "buffer", std::nullopt) != std::uint64_t{0})
    return bad("an attribute is outside the file's binary chunk", Errc::unsupported_feature);
  const auto offset = gltf_whole(*stated, "byteOffset", 0), bytes = gltf_whole(*stated, "byteLength", std::nullopt);
  if (!offset || !bytes) return bad("a number of a buffer view is missing or out of range");
  if (*offset > bin_.size() || *bytes > bin_.size() - *offset) {
    return make_error(Errc::truncated, bin_offset_, "a buffer view ends past the end of the binary chunk",
                      *offset + *bytes, bin_.size());
  }
  return View{bin_.subspan(*offset, *bytes), bin_offset_ + *offset, stated};
}

Result<GltfDocument::View> GltfDocument::elements(const View& view, const json& object, std::uint64_t n,
                                                  std::uint64_t element_bytes, std::uint64_t stride) const {
  const auto offset = gltf_whole(object, "byteOffset", 0);
  if (!offset || stride < element_bytes) return bad("a number of an accessor or buffer view is out of range");
  const std::uint64_t needed = n == 0 ? 0 : (n - 1) * stride + element_bytes;  // below 2^64: 32-bit factors
  if (*offset > view.bytes.size() || needed > view.bytes.size() - *offset) {
    return make_error(Errc::truncated, view.offset, "an accessor ends past the end of its buffer view",
                      *offset + needed, view.bytes.size());
  }
  return View{view.bytes.subspan(*offset, needed), view.offset + *offset, view.stated};
}

Status GltfDocument::add_sparse(const json& sparse, GltfArray& array) const {
  const json *indices = json_member(sparse, "indices"), *values = json_member(sparse, "values");
  const auto n = gltf_whole(sparse, "count", std::nullopt);
  if (indices == nullptr || values == nullptr || !n || *n > array.n_) return bad("a sparse accessor is incomplete");
  array.index_component_ = static_cast<GltfComponent>(gltf_whole(*indices, "componentType", 0).value_or(0));
  constexpr std::array kAllowed{GltfComponent::u8, GltfComponent::u16, GltfComponent::u32};
  if (std::ranges::find(kAllowed, array.index_component_) == kAllowed.end())
    return bad("the indices of a sparse accessor are no unsigned integers");
  const auto bytes_each = component_bytes(array.index_component_);
  const auto index_view = view(json_member(*indices, "bufferView")),
             value_view = view(json_member(*values, "bufferView"));
  if (!index_view) return tl::unexpected(index_view.error());
  if (!value_view) return tl::unexpected(value_view.error());
  const auto index_bytes = elements(*index_view, *indices, *n, bytes_each, bytes_each);
  if (!index_bytes) return tl::unexpected(index_bytes.error());
  const auto value_bytes = elements(*value_view, *values, *n, array.element_bytes_, array.element_bytes_);
  if (!value_bytes) return tl::unexpected(value_bytes.error());
  array.n_sparse_ = *n;
  array.indices_ = index_bytes->bytes;
  array.indices_at_ = index_bytes->offset;
  array.values_ = value_bytes->bytes;
  return {};
}

Result<GltfArray> GltfDocument::array(const json* index, std::uint64_t n_components, const GltfTypes& types) const {
  const json* accessor = element("accessors", index);
  if (accessor == nullptr) return bad("a splat primitive lacks an attribute of KHR_gaussian_splatting");
  GltfArray array;
  const json *normalized = json_member(*accessor, "normalized"), *type = json_member(*accessor, "type");
  array.component_ = static_cast<GltfComponent>(gltf_whole(*accessor, "componentType", 0).value_or(0));
  array.normalized_ = normalized != nullptr && *normalized == true;
  const bool is_signed = array.component_ == GltfComponent::i8 || array.component_ == GltfComponent::i16;
  const bool is_unsigned = array.component_ == GltfComponent::u8 || array.component_ == GltfComponent::u16;
  const bool is_allowed = ((is_signed && types.signed_integers) || (is_unsigned && types.unsigned_integers)) &&
                          (array.normalized_ ? types.normalized : types.plain);
  constexpr std::array kTypes{"", "SCALAR", "VEC2", "VEC3", "VEC4"};
  if ((array.component_ != GltfComponent::f32 && !is_allowed) || type == nullptr || *type != kTypes[n_components])
    return bad("an attribute is of a type that KHR_gaussian_splatting does not allow", Errc::unsupported_feature);
  const auto n = gltf_whole(*accessor, "count", std::nullopt);
  if (!n) return bad("an accessor's count is missing or out of range");
  array.n_ = *n;
  array.element_bytes_ = n_components * component_bytes(array.component_);
  const json *at = json_member(*accessor, "bufferView"), *sparse = json_member(*accessor, "sparse");
  if (at == nullptr && sparse == nullptr)
    return bad("an attribute has no data here: another extension compresses it", Errc::unsupported_feature);
  if (at != nullptr) {
    const auto shown = view(at);
    if (!shown) return tl::unexpected(shown.error());
    const auto stride = gltf_whole(*shown->stated, "byteStride", array.element_bytes_);
    const auto found = elements(*shown, *accessor, *n, array.element_bytes_, stride.value_or(0));
    if (!found) return tl::unexpected(found.error());
    array.stride_ = *stride;
    array.bytes_ = found->bytes;
  }
  if (sparse != nullptr) {
    if (const Status s = add_sparse(*sparse, array); !s) return tl::unexpected(s.error());
  }
  return array;
}

}  // namespace rgs::detail
