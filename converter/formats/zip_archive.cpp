// zip_archive.cpp - by libzip, which reads only through the archive's directory.
// SPDX-License-Identifier: Apache-2.0
#include "zip_archive.hpp"

#include <zip.h>

#include <new>

#include "quantised.hpp"

namespace rgs::detail {
namespace {

struct CloseEntry {
  void operator()(zip_file_t* file) const { zip_fclose(file); }
};

}  // namespace

void ZipArchive::Discard::operator()(zip* archive) const {
  zip_discard(archive);
}

Result<ZipArchive> ZipArchive::open(std::span<const std::byte> bytes) {
  zip_error_t error;
  zip_error_init(&error);
  zip_source_t* source = zip_source_buffer_create(bytes.data(), bytes.size(), 0, &error);
  if (source == nullptr) throw std::bad_alloc();
  ZipArchive archive(zip_open_from_source(source, ZIP_RDONLY, &error), bytes.size());
  if (archive.archive_ == nullptr) {
    const bool is_memory = zip_error_code_zip(&error) == ZIP_ER_MEMORY;
    zip_source_free(source);
    zip_error_fini(&error);
    if (is_memory) throw std::bad_alloc();
    return make_error(Errc::bad_header, Error::kNone, "the zip archive's directory is damaged or missing");
  }
  // Readers differ in which of two files of one name they take.
  const zip_int64_t n = zip_get_num_entries(archive.archive_.get(), 0);
  for (zip_int64_t i = 0; i < n; ++i) {
    const char* name = zip_get_name(archive.archive_.get(), static_cast<zip_uint64_t>(i), 0);
    if (name != nullptr && zip_name_locate(archive.archive_.get(), name, 0) != i)
      return make_error(Errc::bad_header, Error::kNone, "the zip archive holds two files of one name");
  }
  return archive;
}

std::vector<std::string> ZipArchive::names() const {
  std::vector<std::string> names;
  const zip_int64_t n = zip_get_num_entries(archive_.get(), 0);
  for (zip_int64_t i = 0; i < n; ++i) {
    const char* name = zip_get_name(archive_.get(), static_cast<zip_uint64_t>(i), 0);
    if (name != nullptr) names.emplace_back(name);
  }
  return names;
}

std::string ZipArchive::name_ending(std::string_view ending) const {
  for (const std::string& name : names()) {
    if (name.ends_with(ending)) return name;
  }
  return {};
}

bool ZipArchive::holds(const std::string& name) const {
  return zip_name_locate(archive_.get(), name.c_str(), 0) >= 0;
}

Result<std::vector<std::byte>> ZipArchive::read(const std::string& name, const DecodeLimits& limits,
                                                const char* missing) const {
  zip_stat_t info;
  if (zip_stat(archive_.get(), name.c_str(), 0, &info) != 0 || (info.valid & ZIP_STAT_SIZE) == 0)
    return make_error(Errc::missing_section, Error::kNone, missing);
  if (const Status s = check_expansion(info.size, bytes_, 0, limits); !s) return tl::unexpected(s.error());
  const std::unique_ptr<zip_file_t, CloseEntry> entry(zip_fopen(archive_.get(), name.c_str(), 0));
  const int code = entry == nullptr ? zip_error_code_zip(zip_get_error(archive_.get())) : ZIP_ER_OK;
  if (code == ZIP_ER_COMPNOTSUPP || code == ZIP_ER_ENCRNOTSUPP || code == ZIP_ER_NOPASSWD)
    return make_error(Errc::unsupported_feature, Error::kNone,
                      "a file in the zip archive is encrypted or compressed otherwise than by deflate");
  std::vector<std::byte> bytes(info.size);
  const zip_int64_t got = entry == nullptr ? -1 : zip_fread(entry.get(), bytes.data(), bytes.size());
  std::byte extra{};
  // One byte more: libzip compares its checksum only at the end of the entry.
  if (got < 0 || static_cast<std::uint64_t>(got) != info.size || zip_fread(entry.get(), &extra, 1) != 0)
    return make_error(Errc::checksum_mismatch, Error::kNone, "a file in the zip archive is damaged");
  return bytes;
}

std::vector<std::byte> zip_stored(std::span<const std::pair<std::string, std::vector<std::byte>>> entries,
                                  std::uint64_t alignment) {
  constexpr std::uint64_t kHeader = 30, kFieldHeader = 4;
  constexpr zip_uint16_t kPadding = 0x1986;                   // the id that OpenUSD's packages have
  constexpr zip_uint16_t kMidnight = 0, kFirstOf1980 = 0x21;  // any fixed time
  const auto require = [](bool ok) {
    if (!ok) throw std::bad_alloc();  // in memory, nothing else fails
  };
  zip_error_t error;
  zip_error_init(&error);
  zip_source_t* target = zip_source_buffer_create(nullptr, 0, 0, &error);
  require(target != nullptr);
  const std::unique_ptr<zip_source_t, decltype(&zip_source_free)> kept(target, zip_source_free);
  zip_source_keep(target);  // for the archive
  const auto discard = [](zip_t* open) { zip_discard(open); };
  std::unique_ptr<zip_t, decltype(discard)> archive(zip_open_from_source(target, ZIP_TRUNCATE, &error));
  if (archive == nullptr) zip_source_free(target);
  require(archive != nullptr);
  std::uint64_t offset = 0;
  for (const auto& [name, bytes] : entries) {
    std::unique_ptr<zip_source_t, decltype(&zip_source_free)> source(
        zip_source_buffer(archive.get(), bytes.data(), bytes.size(), 0), zip_source_free);
    const zip_int64_t added =
        source == nullptr ? -1 : zip_file_add(archive.get(), name.c_str(), source.get(), ZIP_FL_ENC_UTF_8);
    if (added >= 0) (void)source.release();  // the archive's now
    const auto index = static_cast<zip_uint64_t>(added);
    require(added >= 0 && zip_set_file_compression(archive.get(), index, ZIP_CM_STORE, 0) == 0 &&
            zip_file_set_dostime(archive.get(), index, kMidnight, kFirstOf1980, 0) == 0);
    offset += kHeader + name.size();
    if (alignment > 1) {
      offset += kFieldHeader;
      const std::vector<zip_uint8_t> zeros((alignment - offset % alignment) % alignment);
      require(zip_file_extra_field_set(archive.get(), index, kPadding, ZIP_EXTRA_FIELD_NEW, zeros.data(),
                                       static_cast<zip_uint16_t>(zeros.size()), ZIP_FL_LOCAL) == 0);
      offset += zeros.size();
    }
    offset += bytes.size();
  }
  require(zip_close(archive.get()) == 0);
  (void)archive.release();  // closed
  zip_stat_t info;
  require(zip_source_stat(target, &info) == 0 && zip_source_open(target) == 0);
  std::vector<std::byte> file(info.size);
  require(zip_source_read(target, file.data(), file.size()) == static_cast<zip_int64_t>(file.size()));
  zip_source_close(target);
  return file;
}

}  // namespace rgs::detail
