// gltf_document.cpp - glTF 2.0 (registry.khronos.org/glTF): chunks of a .glb, buffer views and accessors.
// SPDX-License-Identifier: Apache-2.0
#include "gltf_document.hpp"

#include <algorithm>
#include <array>
#include <filesystem>
#include <limits>
#include <utility>

#include "json_member.hpp"
#include "meshopt.hpp"
#include "quantised.hpp"
#include "rgs/utf8_path.hpp"
#include "signature.hpp"

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

int digit_of(char c, std::string_view digits) {
  const std::size_t at = digits.find(c);
  return at == digits.npos ? -1 : static_cast<int>(at);
}

// The bytes of a base64 text, with or without its padding; nullopt if it is none.
std::optional<std::vector<std::byte>> decode_base64(std::string_view text) {
  for (int padding = 0; padding < 2 && text.ends_with('='); ++padding) text.remove_suffix(1);
  if (text.size() % 4 == 1) return std::nullopt;
  std::array<int, 256> digits;
  digits.fill(-1);
  constexpr std::string_view kDigits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  for (std::size_t i = 0; i < kDigits.size(); ++i) digits[static_cast<unsigned char>(kDigits[i])] = static_cast<int>(i);
  std::vector<std::byte> bytes;
  bytes.reserve(text.size() / 4 * 3 + 2);
  std::uint32_t code = 0;
  int bits = 0;
  for (const char c : text) {
    const int digit = digits[static_cast<unsigned char>(c)];
    if (digit < 0) return std::nullopt;
    code = code << 6 | static_cast<std::uint32_t>(digit);
    bits += 6;
    if (bits < 8) continue;
    bits -= 8;
    bytes.push_back(static_cast<std::byte>(code >> bits & 255));
  }
  return bytes;
}

}  // namespace

std::optional<std::string> file_within_folder(std::string_view uri) {
  std::string path;
  for (std::size_t i = 0; i < uri.size(); ++i) {
    char c = uri[i];
    if (c == '%') {
      constexpr std::string_view kDigits = "0123456789ABCDEF0123456789abcdef";
      const int high = i + 2 < uri.size() ? digit_of(uri[i + 1], kDigits) : -1;
      const int low = high < 0 ? -1 : digit_of(uri[i + 2], kDigits);
      if (low < 0) return std::nullopt;
      c = static_cast<char>((high % 16) * 16 + low % 16);
      i += 2;
    }
    if (c == '\0' || c == '\\' || c == ':') return std::nullopt;
    path += c;
  }
  if (path.empty() || path.front() == '/' || ("/" + path + "/").find("/../") != std::string::npos) return std::nullopt;
  return detail::path_of(path).lexically_normal().generic_string();
}

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

Result<GltfDocument> GltfDocument::open_glb(std::span<const std::byte> bytes, const DecodeLimits& limits) {
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
  document.json_offset_ = kGlbHeaderBytes + kChunkHeaderBytes;
  document.bytes_ = bytes.size();
  document.limits_ = limits;
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
      if (const Status s = document.parse(data); !s) return tl::unexpected(s.error());
    } else if (type == kChunkBin && document.bin_.offset == 0) {
      document.bin_ = {data, at + kChunkHeaderBytes, nullptr};
    }
    first = false;
    at += kChunkHeaderBytes + size;
  }
  return document;
}

Result<GltfDocument> GltfDocument::open_text(std::span<const std::byte> bytes, const DecodeLimits& limits,
                                             FetchFile fetch) {
  GltfDocument document;
  document.bytes_ = bytes.size();
  document.limits_ = limits;
  document.fetch_ = std::move(fetch);
  if (const Status s = document.parse(bytes); !s) return tl::unexpected(s.error());
  return document;
}

Status GltfDocument::parse(std::span<const std::byte> bytes) {
  const std::string_view text = text_of(bytes);
  root_ = json::parse(text, nullptr, false);
  if (!root_.is_object()) return bad("the glTF's JSON does not parse");
  return {};
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

Result<GltfDocument::View> GltfDocument::decode_data(const std::string& uri) {
  const std::size_t comma = uri.find(',');
  auto bytes = comma == uri.npos || !uri.substr(0, comma).ends_with(";base64")
                   ? std::nullopt
                   : decode_base64(std::string_view(uri).substr(comma + 1));
  if (!bytes) return bad("a data: URI of a buffer is not base64");
  return View{decoded_.emplace_back(std::move(*bytes)), 0, nullptr};
}

Result<GltfDocument::View> GltfDocument::buffer(const json* index) {
  const json* stated = element("buffers", index);
  if (stated == nullptr) return bad("a buffer is missing");
  const auto number = index->get<std::uint64_t>();
  if (const auto known = buffers_.find(number); known != buffers_.end()) return known->second;
  const json* uri = json_member(*stated, "uri");
  if (uri == nullptr && number == 0 && bin_.offset != 0) return bin_;
  if (uri == nullptr || !uri->is_string())
    return bad("a buffer has no data here: another extension compresses it", Errc::unsupported_feature);
  const auto& name = uri->get_ref<const std::string&>();
  const auto found = name.starts_with("data:") ? decode_data(name) : open_file(name);
  if (found) buffers_.emplace(number, *found);
  return found;
}

Result<GltfDocument::View> GltfDocument::open_file(const std::string& uri) {
  if (!fetch_) {
    return bad("a buffer is in a file of its own: name the .gltf's file, or pack both into one .glb",
               Errc::unsupported_feature);
  }
  const auto path = file_within_folder(uri);
  if (!path) {
    return bad("a buffer is outside the .gltf's folder: copy it there, or pack both into one .glb",
               Errc::unsupported_feature);
  }
  if (const auto known = files_.find(*path); known != files_.end()) return known->second;
  const auto bytes = fetch_(*path);
  if (!bytes) return tl::unexpected(bytes.error());
  bytes_ += bytes->size();
  return files_.emplace(*path, View{*bytes, 0, nullptr}).first->second;
}

Result<GltfDocument::View> GltfDocument::stored_view(const json& object) {
  const auto whole = buffer(json_member(object, "buffer"));
  if (!whole) return whole;
  const auto offset = gltf_whole(object, "byteOffset", 0), bytes = gltf_whole(object, "byteLength", std::nullopt);
  if (!offset || !bytes) return bad("a number of a buffer view is missing or out of range");
  if (*offset > whole->bytes.size() || *bytes > whole->bytes.size() - *offset) {
    return make_error(Errc::truncated, whole->offset, "a buffer view ends past the end of its buffer", *offset + *bytes,
                      whole->bytes.size());
  }
  return View{whole->bytes.subspan(*offset, *bytes), whole->offset + *offset, &object};
}

Result<GltfDocument::View> GltfDocument::view(const json* index) {
  const json* stated = element("bufferViews", index);
  if (stated == nullptr) return bad("a buffer view is missing");
  if (const json* extensions = json_member(*stated, "extensions")) {
    for (const char* name : {"KHR_meshopt_compression", "EXT_meshopt_compression"}) {
      const json* meshopt = json_member(*extensions, name);
      if (meshopt == nullptr) continue;
      const auto number = index->get<std::uint64_t>();
      if (const auto known = unpacked_.find(number); known != unpacked_.end()) return known->second;
      const auto unpacked = unpack(*stated, *meshopt);
      if (unpacked) unpacked_.emplace(number, *unpacked);
      return unpacked;
    }
  }
  return stored_view(*stated);
}

Status GltfDocument::add_unpacked(std::uint64_t stored_bytes, std::uint64_t bytes_as_floats) {
  packed_bytes_ += stored_bytes;
  unpacked_bytes_ += bytes_as_floats;
  if (packed_bytes_ <= bytes_) return {};
  return bad("compressed buffer views overlap", Errc::limit_exceeded, bytes_, packed_bytes_);
}

Result<GltfDocument::View> GltfDocument::unpack(const json& view, const json& meshopt) {
  const auto stored = stored_view(meshopt);
  if (!stored) return stored;
  const json *mode = json_member(meshopt, "mode"), *named = json_member(meshopt, "filter");
  const auto n = gltf_whole(meshopt, "count", std::nullopt), stride = gltf_whole(meshopt, "byteStride", std::nullopt);
  const json none = "NONE";
  const auto filter = named != nullptr && !named->is_string()
                          ? std::nullopt
                          : meshopt_filter_of_text((named == nullptr ? none : *named).get_ref<const std::string&>());
  if (mode == nullptr || *mode != "ATTRIBUTES" || !filter)
    return bad("a meshopt buffer view has a mode or filter that splats have not", Errc::unsupported_feature);
  if (!n || !stride || *stride > 256 || gltf_whole(view, "byteLength", std::nullopt) != *n * *stride)
    return bad("a meshopt buffer view has not as many bytes as its elements");
  decoded_bytes_ += *n * *stride;
  if (const Status s = check_expansion(decoded_bytes_, bytes_, stored->offset, limits_); !s)
    return tl::unexpected(s.error());
  constexpr std::uint64_t kMostFloats = 4;  // of a byte
  if (const Status s = add_unpacked(stored->bytes.size(), kMostFloats * *n * *stride); !s)
    return tl::unexpected(s.error());
  auto elements = decode_meshopt(stored->bytes, *n, *stride, *filter, stored->offset);
  if (!elements) return tl::unexpected(elements.error());
  return View{decoded_.emplace_back(std::move(*elements)), stored->offset, &view};
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

Status GltfDocument::add_sparse(const json& sparse, GltfArray& array) {
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

Result<GltfArray> GltfDocument::array(const json* index, std::uint64_t n_components, const GltfTypes& types) {
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
