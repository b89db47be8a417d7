// gltf_document.hpp - the JSON of a glTF 2.0 asset and the arrays that its accessors describe.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <nlohmann/json.hpp>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "quantised.hpp"
#include "rgs/decode.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

inline constexpr std::uint32_t kMagicGlb = 0x46546C67, kChunkJson = 0x4E4F534A, kChunkBin = 0x004E4942;
inline constexpr std::uint64_t kGlbHeaderBytes = 12, kChunkHeaderBytes = 8;

/// A member that is a count or an offset; `otherwise` if absent, nullopt if it is anything else or above 2^32.
std::optional<std::uint64_t> gltf_whole(const nlohmann::json& object, const char* name,
                                        std::optional<std::uint64_t> otherwise);

/// The file that a relative URI names, in one spelling; nullopt if it may leave the folder, or is an address on the web.
std::optional<std::string> file_within_folder(std::string_view uri);

enum class GltfComponent : std::uint64_t { i8 = 5120, u8 = 5121, i16 = 5122, u16 = 5123, u32 = 5125, f32 = 5126 };

/// Elements of an accessor as floats; integers that it calls normalised become 0..1 or -1..1.
class GltfArray {
 public:
  std::uint64_t size() const { return n_; }
  float at(std::uint64_t i, std::uint64_t component) const {
    const bool usual = component_ == GltfComponent::f32 && n_sparse_ == 0 && !bytes_.empty();
    return usual ? load<float>(bytes_, i * stride_ + 4 * component) : unusual_at(i, component);
  }
  /// The indices of sparse elements ascend and are in range, which at() relies on. Errors: bad_value; its offset is the
  /// index's.
  Status check() const;

 private:
  friend class GltfDocument;
  float unusual_at(std::uint64_t i, std::uint64_t component) const;
  std::uint64_t sparse_index(std::uint64_t i) const;

  std::uint64_t n_ = 0, stride_ = 0, element_bytes_ = 0;
  GltfComponent component_ = GltfComponent::f32, index_component_ = GltfComponent::u32;
  bool normalized_ = false;
  std::span<const std::byte> bytes_;  // empty: zeros
  std::uint64_t n_sparse_ = 0, indices_at_ = 0;
  std::span<const std::byte> indices_, values_;  // of sparse elements, which replace others
};

/// What an attribute may be besides 32-bit floats.
struct GltfTypes {
  bool signed_integers = false, unsigned_integers = false;  ///< of 8 or 16 bits
  bool plain = false, normalized = false;                   ///< how integers count
};

class GltfDocument {
 public:
  /// Returns the bytes of a file in the document's folder, which must outlive the document.
  using FetchFile = std::function<Result<std::span<const std::byte>>(const std::string& name)>;

  /// A whole .glb, which must outlive the document. Errors: truncated, bad_magic, unsupported_version, trailing_bytes,
  /// bad_header, bad_syntax.
  static Result<GltfDocument> open_glb(std::span<const std::byte> bytes, const DecodeLimits& limits);
  /// A .gltf. Errors: bad_syntax.
  static Result<GltfDocument> open_text(std::span<const std::byte> bytes, const DecodeLimits& limits, FetchFile fetch);

  const nlohmann::json& root() const { return root_; }
  /// Element `index` of the root's array `name`; null if either is absent or of another type.
  const nlohmann::json* element(const char* name, const nlohmann::json* index) const;
  std::uint64_t bytes() const { return bytes_; }  ///< of the file and of files that arrays were in so far
  /// Counts a compressed buffer view. Errors: limit_exceeded (they overlap, so that a little file holds many).
  Status add_unpacked(std::uint64_t stored_bytes, std::uint64_t bytes_as_floats);
  std::uint64_t unpacked_bytes() const { return unpacked_bytes_; }  ///< of these, as floats
  /// What further compressed data may decode to, within the document's limits; add_decoded() counts it.
  std::uint64_t decodable_bytes() const {
    const std::uint64_t all = limits_.decoded_bytes(bytes_);
    return all - std::min(all, decoded_bytes_);
  }
  void add_decoded(std::uint64_t bytes) { decoded_bytes_ += bytes; }
  /// An error at the JSON's begin.
  tl::unexpected<Error> bad(const char* what, Errc code = Errc::bad_syntax, std::uint64_t expected = Error::kNone,
                            std::uint64_t found = Error::kNone) const;

  struct View {
    std::span<const std::byte> bytes;
    std::uint64_t offset = 0;  ///< in the .glb or buffer
    const nlohmann::json* stated = nullptr;
  };
  /// The buffer view `index`, decompressed. Errors: bad_syntax, unsupported_feature (outside the document's folder),
  /// truncated, limit_exceeded, those of FetchFile and decode_meshopt().
  Result<View> view(const nlohmann::json* index);
  /// The array of the accessor `index`, whose elements have `n_components`. Errors: bad_syntax, unsupported_feature (of
  /// another type than `types` and floats), those of view().
  Result<GltfArray> array(const nlohmann::json* index, std::uint64_t n_components, const GltfTypes& types);

 private:
  Status parse(std::span<const std::byte> bytes);
  Result<View> buffer(const nlohmann::json* index);
  Result<View> decode_data(const std::string& uri);
  Result<View> open_file(const std::string& uri);
  /// What `object`, a buffer view or the object of an extension of it, shows of its buffer.
  Result<View> stored_view(const nlohmann::json& object);
  Result<View> unpack(const nlohmann::json& view, const nlohmann::json& meshopt);
  /// `n` elements of `element_bytes` each from the member byteOffset of `object` on.
  Result<View> elements(const View& view, const nlohmann::json& object, std::uint64_t n, std::uint64_t element_bytes,
                        std::uint64_t stride) const;
  Status add_sparse(const nlohmann::json& sparse, GltfArray& array);

  nlohmann::json root_;
  std::uint64_t json_offset_ = 0, bytes_ = 0, packed_bytes_ = 0, unpacked_bytes_ = 0, decoded_bytes_ = 0;
  DecodeLimits limits_;
  View bin_;  // of a .glb
  FetchFile fetch_;
  std::map<std::uint64_t, View> buffers_;       // by number: comparing data: URIs would take time
  std::map<std::string, View> files_;           // by path, so that each counts once
  std::map<std::uint64_t, View> unpacked_;      // by buffer view
  std::deque<std::vector<std::byte>> decoded_;  // data URIs and compressed buffer views
};

}  // namespace rgs::detail
