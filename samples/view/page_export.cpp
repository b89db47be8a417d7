// page_export.cpp - inserts elements into the page.
// SPDX-License-Identifier: Apache-2.0
#include "page_export.hpp"

#include <fmt/format.h>

#include <span>

#include "encoding.hpp"

namespace rgs::view {
namespace {

constexpr std::string_view kViewTag = R"(<script type="application/json" id="rgs-view">)", kEndTag = "</script>\n";
constexpr std::size_t kBlock = 3 * 65536;  // a multiple of 3, so that base64 needs no padding

std::string file_tag(std::size_t index) {
  return fmt::format(R"(<script type="application/octet-stream;base64" id="rgs-file-{}">)", index);
}

std::string_view text_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

std::uint64_t base64_size(std::uint64_t bytes) {
  return (bytes + 2) / 3 * 4;
}

// Writes to a file from its beginning on.
class Appender {
 public:
  explicit Appender(AtomicFile& file) : file_(file) {}
  Status add(std::string_view text) {
    const Status written = file_.write_at(offset_, std::as_bytes(std::span(text)));
    offset_ += text.size();
    return written;
  }

 private:
  AtomicFile& file_;
  std::uint64_t offset_ = 0;
};

}  // namespace

std::string script_json(std::string_view json) {
  std::string out;
  for (const char c : json) {
    if (c == '<' || c == '>' || c == '&') {
      out += fmt::format("\\u{:04x}", static_cast<unsigned>(c));
    } else {
      out += c;
    }
  }
  return out;
}

Result<PageExport> PageExport::open(const std::string& page) {
  auto file = MappedFile::open(page);
  if (!file) return tl::unexpected(file.error());
  const std::string_view text = text_of(file->bytes());
  const std::size_t mark = text.find(kInsertMark);
  if (mark == text.npos || text.find(kInsertMark, mark + 1) != text.npos) {
    return make_error(
        Errc::bad_syntax, mark == text.npos ? Error::kNone : mark,
        "is not the viewer's single-file page: it does not have exactly one mark <!-- rgs-view:insert -->");
  }
  PageExport out;
  out.mark_ = mark;
  out.page_ = *std::move(file);
  return out;
}

std::string PageExport::add_part(Part part) {
  parts_.push_back(std::move(part));
  return fmt::format("#rgs-file-{}", parts_.size() - 1);
}

std::string_view PageExport::content(const Part& part) {
  const auto* file = std::get_if<MappedFile>(&part);
  return file != nullptr ? text_of(file->bytes()) : std::string_view(std::get<std::string>(part));
}

std::uint64_t PageExport::bytes() const {
  std::uint64_t n = page_.bytes().size() - kInsertMark.size() + kViewTag.size() + view_.size() + kEndTag.size();
  for (std::size_t i = 0; i < parts_.size(); ++i)
    n += file_tag(i).size() + base64_size(content(parts_[i]).size()) + kEndTag.size();
  return n;
}

std::vector<const MappedFile*> PageExport::inputs() const {
  std::vector<const MappedFile*> files{&page_};
  for (const Part& part : parts_)
    if (const auto* file = std::get_if<MappedFile>(&part)) files.push_back(file);
  return files;
}

Status PageExport::write(AtomicFile& out) const {
  Appender to(out);
  const std::string_view page = text_of(page_.bytes());
  for (const std::string_view text : {page.substr(0, mark_), kViewTag, std::string_view(view_), kEndTag})
    if (Status s = to.add(text); !s) return s;
  for (std::size_t i = 0; i < parts_.size(); ++i) {
    if (Status s = to.add(file_tag(i)); !s) return s;
    const std::string_view bytes = content(parts_[i]);
    for (std::size_t at = 0; at < bytes.size(); at += kBlock) {
      if (Status s = to.add(tool::base64(std::as_bytes(std::span(bytes.substr(at, kBlock))))); !s) return s;
    }
    if (Status s = to.add(kEndTag); !s) return s;
  }
  return to.add(page.substr(mark_ + kInsertMark.size()));
}

}  // namespace rgs::view
