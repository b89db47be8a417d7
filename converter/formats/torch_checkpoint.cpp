// torch_checkpoint.cpp - a zip archive of data.pkl, a pickle of protocol 2, and a file of numbers for each storage
// (pytorch.org, "Serialization semantics"; docs.python.org, "pickletools"). Tensors are views of storages.
// SPDX-License-Identifier: Apache-2.0
#include "torch_checkpoint.hpp"

#include <algorithm>
#include <optional>
#include <string>
#include <string_view>
#include <unordered_map>
#include <utility>
#include <vector>

#include "gsplat_arrays.hpp"
#include "quantised.hpp"
#include "signature.hpp"
#include "zip_archive.hpp"

namespace rgs::detail {
namespace {

using Index = std::uint32_t;

constexpr std::uint64_t kMaxPickleBytes = std::uint64_t{1} << 18;  // a scene takes 2 kB; values take 64 times as much

struct Value {
  enum class Kind { plain, number, text, global, tuple, list, dictionary, storage, tensor };
  Kind kind = Kind::plain;
  std::int64_t number = 0;   // of a storage: the bytes of its numbers, 0 if they are no floats
  std::string_view text;     // of a storage: its file's name
  std::vector<Index> items;  // of a dictionary: keys and values in turn; of a tensor: storage, offset, sizes, strides
};

// Every instruction makes at most one value, so a pickle takes memory in proportion to its size.
class Pickle {
 public:
  explicit Pickle(std::span<const std::byte> bytes) : text_(text_of(bytes)) {}

  // The index of the whole.
  Result<Index> read() {
    if (text_.substr(0, 2) != "\x80\x02") return fail(Errc::unsupported_version, "data.pkl is no pickle of protocol 2");
    at_ = 2;
    for (;;) {
      op_ = at_;
      if (at_ == text_.size()) return fail(Errc::truncated, "data.pkl ends before its pickle");
      if (text_[at_] == '.') {
        if (++at_ != text_.size()) return fail(Errc::trailing_bytes, "data.pkl goes on after its pickle");
        if (stack_.size() != 1 || !marks_.empty()) return fail(Errc::bad_syntax, kDamaged);
        return stack_[0];
      }
      const char* problem = step(text_[at_++]);
      if (problem != nullptr) return fail(problem == kDamaged ? Errc::bad_syntax : Errc::unsupported_feature, problem);
    }
  }

  const Value& operator[](Index i) const { return values_[i]; }
  // A dictionary's value; null if there is none.
  const Value* find(const Value& dictionary, std::string_view key) const {
    if (dictionary.kind != Kind::dictionary) return nullptr;
    for (std::size_t i = dictionary.items.size(); i >= 2;) {  // of equal names the last counts
      i -= 2;
      const Value& name = values_[dictionary.items[i]];
      if (name.kind == Kind::text && name.text == key) return &values_[dictionary.items[i + 1]];
    }
    return nullptr;
  }

 private:
  using Kind = Value::Kind;
  static constexpr const char* kDamaged = "data.pkl is damaged";
  static constexpr const char* kForeign =
      "data.pkl holds more than tensors in dictionaries: save only these (torch.save of a state_dict)";

  tl::unexpected<Error> fail(Errc code, const char* what) const { return make_error(code, op_, what); }

  // Bytes of an argument; none if the pickle ends before.
  std::optional<std::string_view> take(std::uint64_t size) {
    if (size > text_.size() - at_) return std::nullopt;
    at_ += size;
    return text_.substr(at_ - size, size);
  }
  // A little-endian number of up to 8 bytes.
  std::optional<std::uint64_t> take_number(std::uint64_t size) {
    const auto bytes = take(size);
    if (!bytes) return std::nullopt;
    std::uint64_t number = 0;
    for (std::size_t i = size; i-- > 0;) number = number << 8 | static_cast<unsigned char>((*bytes)[i]);
    return number;
  }
  const char* push(Value value) {
    stack_.push_back(static_cast<Index>(values_.size()));
    values_.push_back(std::move(value));
    return nullptr;
  }
  const char* push_number(std::uint64_t size, bool is_signed) {
    const auto number = take_number(size);
    if (!number) return kDamaged;
    const bool negative = is_signed && size > 0 && (*number >> (8 * size - 1) & 1) != 0;
    const std::uint64_t above = negative && size < 8 ? ~std::uint64_t{0} << (8 * size) : 0;
    return push({Kind::number, static_cast<std::int64_t>(*number | above), {}, {}});
  }
  // The values above the last mark, or the last `count`; none if there are not as many.
  std::optional<std::vector<Index>> pop(std::optional<std::size_t> count = std::nullopt) {
    const std::size_t floor = marks_.empty() ? 0 : marks_.back();
    if (count ? stack_.size() - floor < *count : marks_.empty()) return std::nullopt;
    const auto first = stack_.end() - static_cast<std::ptrdiff_t>(count ? *count : stack_.size() - floor);
    std::vector<Index> items(first, stack_.end());
    stack_.erase(first, stack_.end());
    if (!count) marks_.pop_back();
    return items;
  }
  const char* push_tuple(std::optional<std::vector<Index>> items) {
    return items ? push({Kind::tuple, 0, {}, std::move(*items)}) : kDamaged;
  }
  const char* append(Kind kind, std::optional<std::vector<Index>> items) {
    const std::size_t floor = marks_.empty() ? 0 : marks_.back();
    if (!items || stack_.size() <= floor) return kDamaged;
    Value& onto = values_[stack_.back()];
    if (onto.kind != kind || (kind == Kind::dictionary && items->size() % 2 != 0)) return kDamaged;
    onto.items.insert(onto.items.end(), items->begin(), items->end());
    return nullptr;
  }
  const char* remember(std::optional<std::uint64_t> key) {
    if (!key || stack_.size() <= (marks_.empty() ? 0 : marks_.back())) return kDamaged;
    memo_[*key] = stack_.back();
    return nullptr;
  }
  const char* recall(std::optional<std::uint64_t> key) {
    const auto found = key ? memo_.find(*key) : memo_.end();
    if (found == memo_.end()) return kDamaged;
    stack_.push_back(found->second);
    return nullptr;
  }
  const char* push_text(std::optional<std::uint64_t> size) {
    const auto text = size ? take(*size) : std::nullopt;
    return text ? push({Kind::text, 0, *text, {}}) : kDamaged;
  }
  const char* push_global() {
    const std::size_t first = text_.find('\n', at_);
    const std::size_t second = first == text_.npos ? first : text_.find('\n', first + 1);
    if (second == text_.npos) return kDamaged;
    const std::string_view name = text_.substr(at_, second - at_);
    const bool is_storage = name.starts_with("torch\n") && name.ends_with("Storage");
    if (name != kTensor && name != kParameter && name != kOrdered && !is_storage) return kForeign;
    at_ = second + 1;
    return push({Kind::global, 0, name, {}});
  }
  const char* push_storage() {
    const auto id = pop(1);
    if (!id || values_[id->front()].kind != Kind::tuple || values_[id->front()].items.size() != 5) return kForeign;
    const std::vector<Index>& items = values_[id->front()].items;  // "storage", type, key, device, numbers
    const Value &type = values_[items[1]], &key = values_[items[2]];
    if (values_[items[0]].text != "storage" || type.kind != Kind::global || key.kind != Kind::text) return kForeign;
    const std::int64_t bytes = type.text == "torch\nFloatStorage"    ? 4
                               : type.text == "torch\nDoubleStorage" ? 8
                               : type.text == "torch\nHalfStorage"   ? 2
                                                                     : 0;
    return push({Kind::storage, bytes, key.text, {}});
  }
  const char* call() {
    const auto called = pop(2);
    if (!called) return kDamaged;
    const Value &function = values_[called->front()], &arguments = values_[called->back()];
    if (function.kind != Kind::global || arguments.kind != Kind::tuple) return kForeign;
    const std::vector<Index>& items = arguments.items;
    if (function.text == kOrdered && items.empty()) return push({Kind::dictionary, 0, {}, {}});
    if (function.text == kParameter && items.size() == 3 && values_[items[0]].kind == Kind::tensor) {
      stack_.push_back(items[0]);
      return nullptr;
    }
    if (function.text != kTensor || items.size() < 6 || values_[items[0]].kind != Kind::storage) return kForeign;
    return push({Kind::tensor, 0, {}, {items.begin(), items.begin() + 4}});
  }
  const char* step(char op) {
    switch (op) {
      case '}': return push({Kind::dictionary, 0, {}, {}});
      case ']': return push({Kind::list, 0, {}, {}});
      case ')': return push({Kind::tuple, 0, {}, {}});
      case '(': marks_.push_back(stack_.size()); return nullptr;
      case 't': return push_tuple(pop());
      case '\x85': return push_tuple(pop(1));
      case '\x86': return push_tuple(pop(2));
      case '\x87': return push_tuple(pop(3));
      case 'X': return push_text(take_number(4));
      case 'K': return push_number(1, false);
      case 'M': return push_number(2, false);
      case 'J': return push_number(4, true);
      case '\x8a': {
        const auto size = take_number(1);
        return size && *size <= 8 ? push_number(*size, true) : kForeign;
      }
      case 'G': return take(8) ? push({}) : kDamaged;
      case 'N':
      case '\x88':
      case '\x89': return push({});
      case 'q': return remember(take_number(1));
      case 'r': return remember(take_number(4));
      case 'h': return recall(take_number(1));
      case 'j': return recall(take_number(4));
      case 'c': return push_global();
      case 'Q': return push_storage();
      case 'R': return call();
      case 's': return append(Kind::dictionary, pop(2));
      case 'u': return append(Kind::dictionary, pop());
      case 'a': return append(Kind::list, pop(1));
      case 'e': return append(Kind::list, pop());
      case 'b': return pop(1) ? append(Kind::dictionary, std::vector<Index>()) : kDamaged;  // a state_dict's metadata
      default: return kForeign;
    }
  }

  static constexpr std::string_view kTensor = "torch._utils\n_rebuild_tensor_v2";
  static constexpr std::string_view kParameter = "torch._utils\n_rebuild_parameter";
  static constexpr std::string_view kOrdered = "collections\nOrderedDict";
  std::string_view text_;
  std::size_t at_ = 0, op_ = 0;
  std::vector<Value> values_;
  std::vector<Index> stack_;
  std::vector<std::size_t> marks_;  // sizes of the stack
  std::unordered_map<std::uint64_t, Index> memo_;
};

constexpr const char* kBadTensor = "a tensor of the checkpoint is not a view of its storage";

// The view of its storage; its bytes are still missing.
Result<Array> view_of(const Pickle& pickle, const Value& tensor) {
  constexpr std::int64_t kMost = std::int64_t{1} << 53;
  Array array;
  const Value& storage = pickle[tensor.items[0]];
  if (storage.number == 0)
    return make_error(Errc::unsupported_feature, 0, "a tensor of the checkpoint is not float16, float32 or float64");
  array.item_bytes = static_cast<std::uint64_t>(storage.number);
  std::vector<std::uint64_t> numbers;  // offset, sizes, strides
  std::vector<Index> items{tensor.items[1]};
  for (const std::size_t i : {std::size_t{2}, std::size_t{3}}) {
    const Value& tuple = pickle[tensor.items[i]];
    if (tuple.kind != Value::Kind::tuple || tuple.items.empty() || tuple.items.size() > 3)
      return make_error(Errc::unsupported_feature, 0, "a tensor of the checkpoint has not one to three dimensions");
    items.insert(items.end(), tuple.items.begin(), tuple.items.end());
  }
  for (const Index item : items) {
    const Value& value = pickle[item];
    if (value.kind != Value::Kind::number || value.number < 0 || value.number > kMost)
      return make_error(Errc::bad_value, 0, kBadTensor);
    numbers.push_back(static_cast<std::uint64_t>(value.number));
  }
  array.n_dims = pickle[tensor.items[2]].items.size();
  if (numbers.size() != 1 + 2 * array.n_dims) return make_error(Errc::bad_value, 0, kBadTensor);
  const std::uint64_t *size = &numbers[1], *stride = size + array.n_dims;
  const std::size_t last = array.n_dims - 1;
  array.first = numbers[0] * array.item_bytes;
  array.shape = {size[0], last == 2 ? size[1] : 1, last == 0 ? 1 : size[last]};
  array.stride = {stride[0], last == 2 ? stride[1] : 0, last == 0 ? 0 : stride[last]};
  return array;
}

// Whether every number of the view is in its storage.
bool fits(const Array& array) {
  if (std::ranges::find(array.shape, std::uint64_t{0}) != array.shape.end()) return true;
  std::uint64_t left = array.bytes.size() / array.item_bytes;
  const std::uint64_t first = array.first / array.item_bytes;
  if (first >= left) return false;
  left -= first + 1;
  for (std::size_t d = 0; d < 3; ++d) {
    const std::uint64_t steps = array.shape[d] - 1, stride = array.stride[d];
    if (stride != 0 && steps > left / stride) return false;
    left -= steps * stride;
  }
  return true;
}

}  // namespace

bool is_torch_checkpoint(std::span<const std::byte> bytes) {
  return is_zip_with(bytes, "data.pkl");
}

Result<SplatFile> decode_torch_checkpoint(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const char* const lacking = "the checkpoint's archive lacks data.pkl or a storage";
  const auto archive = ZipArchive::open(bytes);
  if (!archive) return tl::unexpected(archive.error());
  const std::string name = archive->name_ending("data.pkl");
  const std::string folder = name.substr(0, name.size() - std::min(name.size(), std::string_view("data.pkl").size()));
  const auto text = archive->read(name, limits, lacking);
  if (!text) return tl::unexpected(text.error());
  if (archive->holds(folder + "byteorder")) {
    const auto order = archive->read(folder + "byteorder", limits, lacking);
    if (!order) return tl::unexpected(order.error());
    if (text_of(*order) != "little")
      return make_error(Errc::unsupported_feature, 0, "the checkpoint's numbers are not little-endian");
  }
  if (text->size() > kMaxPickleBytes) return make_error(Errc::limit_exceeded, 0, "data.pkl is longer than 256 KiB");
  Pickle pickle(*text);
  const auto whole = pickle.read();
  if (!whole) return tl::unexpected(whole.error());
  const Value& root = pickle[*whole];
  const Value* splats = pickle.find(root, "splats");
  if (splats == nullptr) splats = &root;
  Arrays arrays;
  std::uint64_t total = 0;
  for (std::size_t p = 0; p < arrays.size(); ++p) {
    const Value* tensor = pickle.find(*splats, kParameterNames[p]);
    if (tensor == nullptr && p == kHigherSh) break;
    if (tensor == nullptr || tensor->kind != Value::Kind::tensor)
      return make_error(Errc::missing_section, 0,
                        "the checkpoint lacks one of gsplat's tensors means, scales, quats, opacities and sh0");
    auto array = view_of(pickle, *tensor);
    if (!array) return tl::unexpected(array.error());
    auto file = archive->read(folder + "data/" + std::string(pickle[tensor->items[0]].text), limits, lacking);
    if (!file) return tl::unexpected(file.error());
    total += file->size();
    if (const Status s = check_expansion(total, bytes.size(), 0, limits); !s) return tl::unexpected(s.error());
    array->bytes = std::move(*file);
    if (!fits(*array)) return make_error(Errc::bad_value, 0, kBadTensor);
    arrays[p] = std::move(*array);
    if (const Status s = check_array(p, arrays, limits); !s) return tl::unexpected(s.error());
  }
  return scene_of(arrays, bytes.size(), limits);
}

}  // namespace rgs::detail
