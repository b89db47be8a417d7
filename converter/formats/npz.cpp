// npz.cpp - NumPy's .npz: a zip archive of .npy files, each a header in Python's syntax and the numbers
// (numpy.org, "A simple file format for NumPy arrays", versions 1 to 3). The arrays are those of gsplat's training.
// SPDX-License-Identifier: Apache-2.0
#include "npz.hpp"

#include <array>
#include <cmath>
#include <cstring>
#include <string>
#include <string_view>
#include <utility>

#include "gsplat_arrays.hpp"
#include "quantised.hpp"
#include "rgs/quantize.hpp"
#include "signature.hpp"
#include "zip_archive.hpp"

namespace rgs::detail {
namespace {

using Bytes = std::vector<std::byte>;

constexpr std::string_view kMagicNpy = "\x93NUMPY";

// The header's text, a Python dictionary. After a failure, at() is where the text is not as expected.
class Header {
 public:
  Header(std::string_view text, std::uint64_t offset) : text_(text), offset_(offset) {}

  std::uint64_t at() {
    skip_spaces();
    return offset_ + at_;
  }
  // After spaces, `word`.
  bool take(std::string_view word) {
    skip_spaces();
    if (!text_.substr(at_).starts_with(word)) return false;
    at_ += word.size();
    return true;
  }
  bool take_string(std::string_view& value) {
    const bool quoted = take("'");
    const std::size_t end = quoted ? text_.find('\'', at_) : text_.npos;
    if (end == text_.npos) return false;
    value = text_.substr(at_, end - at_);
    at_ = end + 1;
    return true;
  }
  bool take_number(std::uint64_t& value) {
    constexpr std::uint64_t kMost = std::uint64_t{1} << 53;
    skip_spaces();
    const std::size_t first = at_;
    for (value = 0; at_ < text_.size() && text_[at_] >= '0' && text_[at_] <= '9' && value <= kMost; ++at_)
      value = 10 * value + static_cast<std::uint64_t>(text_[at_] - '0');
    return at_ > first && value <= kMost;
  }
  bool ends() {
    skip_spaces();
    return text_.substr(at_) == "\n" || at_ == text_.size();
  }

 private:
  void skip_spaces() {
    while (at_ < text_.size() && text_[at_] == ' ') ++at_;
  }
  std::string_view text_;
  std::uint64_t offset_;
  std::size_t at_ = 0;
};

std::string file_of(std::size_t parameter) {
  return std::string(kParameterNames[parameter]) + ".npy";
}

// Fills the array's shape and strides; [n] and [n, channels] get sizes of 1 between.
Status lay_out(std::span<const std::uint64_t> dims, bool fortran, std::uint64_t offset, Array& array) {
  if (dims.empty() || dims.size() > 3)
    return make_error(Errc::unsupported_feature, offset, "an array has not one to three dimensions", 3, dims.size());
  array.n_dims = dims.size();
  array.shape = {dims[0], dims.size() == 3 ? dims[1] : 1, dims.size() == 1 ? 1 : dims.back()};
  const auto& [n, rows, channels] = array.shape;
  array.stride =
      fortran ? std::array{std::uint64_t{1}, n, n * rows} : std::array{rows * channels, channels, std::uint64_t{1}};
  const std::uint64_t stored = (array.bytes.size() - array.first) / array.item_bytes;
  std::uint64_t items = n == 0 || rows == 0 || channels == 0 ? 0 : 1;
  for (const std::uint64_t size : array.shape) items = size != 0 && items > stored / size ? stored + 1 : items * size;
  if (items * array.item_bytes != array.bytes.size() - array.first)
    return make_error(Errc::size_mismatch, array.first, "an array's shape does not fit the bytes of its numbers",
                      items * array.item_bytes, array.bytes.size() - array.first);
  return {};
}

Status parse_dictionary(Header& header, Array& array) {
  const auto bad = [&header] {
    return make_error(Errc::bad_syntax, header.at(), "the header of a .npy is not descr, fortran_order and shape");
  };
  std::string_view key, type;
  bool fortran = false, has_type = false, has_order = false, has_shape = false;
  std::vector<std::uint64_t> dims;
  if (!header.take("{")) return bad();
  while (!header.take("}")) {
    if (!header.take_string(key) || !header.take(":")) return bad();
    if (key == "descr" && !std::exchange(has_type, true)) {
      const std::uint64_t at = header.at();
      if (!header.take_string(type) || (type != "<f2" && type != "<f4" && type != "<f8"))
        return make_error(Errc::unsupported_feature, at,
                          "an array is not float16, float32 or float64 in little-endian order: astype('<f4')");
      array.item_bytes = static_cast<std::uint64_t>(type[2] - '0');
    } else if (key == "fortran_order" && !std::exchange(has_order, true)) {
      fortran = header.take("True");
      if (!fortran && !header.take("False")) return bad();
    } else if (key == "shape" && !std::exchange(has_shape, true)) {
      if (!header.take("(")) return bad();
      while (!header.take(")")) {
        if (dims.size() == 32 || !header.take_number(dims.emplace_back())) return bad();
        if (header.take(",")) continue;
        if (dims.size() == 1 || !header.take(")")) return bad();  // (3) is no tuple
        break;
      }
    } else {
      return bad();
    }
    if (header.take(",")) continue;
    if (!header.take("}")) return bad();
    break;
  }
  if (!has_type || !has_order || !has_shape || !header.ends()) return bad();
  return lay_out(dims, fortran, header.at(), array);
}

Result<Array> parse_array(Bytes bytes) {
  Array array;
  array.bytes = std::move(bytes);
  const std::uint64_t size = array.bytes.size();
  if (!begins_with(array.bytes, kMagicNpy)) return make_error(Errc::bad_magic, 0, "a file of the .npz is not a .npy");
  if (size < 12) return make_error(Errc::truncated, size, "a .npy ends in its header", 12, size);
  const int version = load_u8(array.bytes, 6);
  if (version < 1 || version > 3 || load_u8(array.bytes, 7) != 0)
    return make_error(Errc::unsupported_version, 6, "a .npy is not of version 1.0, 2.0 or 3.0");
  const std::uint64_t text = version == 1 ? 10 : 12;
  const std::uint64_t text_bytes =
      version == 1 ? load<std::uint16_t>(array.bytes, 8) : load<std::uint32_t>(array.bytes, 8);
  if (text_bytes > size - text)
    return make_error(Errc::truncated, 8, "a .npy ends in its header", text + text_bytes, size);
  array.first = text + text_bytes;
  const std::string_view all = text_of(array.bytes);
  Header header(all.substr(text, text_bytes), text);
  if (const Status s = parse_dictionary(header, array); !s) return tl::unexpected(s.error());
  return array;
}

Result<Arrays> read_arrays(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto archive = ZipArchive::open(bytes);
  if (!archive) return tl::unexpected(archive.error());
  Arrays arrays;
  std::uint64_t total = 0;
  for (std::size_t p = 0; p < arrays.size(); ++p) {
    if (p == kHigherSh && !archive->holds(file_of(p))) break;
    auto file = archive->read(file_of(p), limits,
                              "the .npz lacks one of gsplat's arrays means, scales, quats, opacities and sh0");
    if (!file) return tl::unexpected(file.error());
    total += file->size();
    if (const Status s = check_expansion(total, bytes.size(), 0, limits); !s) return tl::unexpected(s.error());
    auto array = parse_array(std::move(*file));
    if (!array) return tl::unexpected(array.error());
    arrays[p] = std::move(*array);
    if (const Status s = check_array(p, arrays, limits); !s) return tl::unexpected(s.error());
  }
  return arrays;
}

// A .npy of version 1 for `shape` of `type`, its numbers still 0.
Bytes npy(const char* type, std::uint64_t item_bytes, std::span<const std::uint64_t> shape) {
  constexpr std::size_t kBeforeText = 10, kAlignment = 64;
  std::string text = std::string("{'descr': '") + type + "', 'fortran_order': False, 'shape': (";
  std::uint64_t items = 1;
  for (const std::uint64_t size : shape) {
    text += (&size == shape.data() ? "" : " ") + std::to_string(size) + ",";
    items *= size;
  }
  if (shape.size() > 1) text.pop_back();
  text += "), }";
  text.resize((kBeforeText + text.size() + kAlignment) / kAlignment * kAlignment - kBeforeText - 1, ' ');
  text += '\n';
  const std::string head = std::string(kMagicNpy) + '\1' + '\0' + static_cast<char>(text.size() & 255) +
                           static_cast<char>(text.size() >> 8) + text;
  Bytes bytes(head.size() + items * item_bytes);
  std::memcpy(bytes.data(), head.data(), head.size());
  return bytes;
}

}  // namespace

bool is_npz(std::span<const std::byte> bytes) {
  return is_zip_with(bytes, ".npy");
}

Result<SplatFile> decode_npz(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto arrays = read_arrays(bytes, limits);
  if (!arrays) return tl::unexpected(arrays.error());
  return scene_of(*arrays, bytes.size(), limits);
}

Result<std::vector<std::byte>> encode_npz(const SplatView& splats, const WriteOptions& options) {
  const Origin& origin = options.origin;
  const std::uint64_t n = splats.n, above_0 = static_cast<std::uint64_t>(sh_coefficients(splats.sh_degree)) - 1;
  const bool far = origin != kNoOrigin;
  const std::array<std::vector<std::uint64_t>, kParameterNames.size()> shapes{
      {{n, 3}, {n, 3}, {n, 4}, {n}, {n, 1, 3}, {n, above_0, 3}}};
  std::vector<std::pair<std::string, Bytes>> files;
  for (std::size_t p = 0; p < shapes.size(); ++p)
    files.emplace_back(file_of(p), p == kMeans && far ? npy("<f8", 8, shapes[p]) : npy("<f4", 4, shapes[p]));
  std::array<std::byte*, kParameterNames.size()> at;
  for (std::size_t p = 0; p < at.size(); ++p) {
    std::uint64_t items = far && p == kMeans ? 2 : 1;
    for (const std::uint64_t size : shapes[p]) items *= size;
    at[p] = files[p].second.data() + files[p].second.size() - 4 * items;
  }
  const auto put = [&at](Parameter p, const auto* values, std::size_t count) {
    std::memcpy(at[p], values, count * sizeof(*values));
    at[p] += count * sizeof(*values);
  };
  for (std::uint64_t i = 0; i < n; ++i) {
    const Splat s = splats.splat(i);
    double mean[3];
    for (std::size_t k = 0; k < 3; ++k) mean[k] = origin[k] + static_cast<double>(s.mean[k]);
    far ? put(kMeans, mean, 3) : put(kMeans, s.mean, 3);
    put(kScales, s.log_scale, 3);
    put(kQuats, s.rotation, 4);
    put(kOpacities, &s.opacity_logit, 1);
    put(kConstantSh, s.sh, 3);
    put(kHigherSh, s.sh + 3, 3 * above_0);
  }
  return zip_stored(files);
}

}  // namespace rgs::detail
