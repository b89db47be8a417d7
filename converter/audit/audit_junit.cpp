// audit_junit.cpp - test suites, test cases, failures and errors.
// SPDX-License-Identifier: Apache-2.0
#include "audit_junit.hpp"

#include <fmt/format.h>

#include <iterator>

#include "audit_gate.hpp"
#include "audit_page.hpp"

namespace rgs::audit {
namespace {

constexpr std::string_view kBegin = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites name=\"rgs-audit\"";

// html() leaves two code points that XML forbids.
std::string xml(const std::string& text) {
  std::string out = html(text);
  for (const char* banned : {"\xEF\xBF\xBE", "\xEF\xBF\xBF"})
    for (std::size_t at; (at = out.find(banned)) != out.npos;) out.replace(at, 3, "?");
  return out;
}

struct Counts {
  std::size_t tests = 0, failures = 0, errors = 0;
  double seconds = 0;

  std::string attributes() const {
    return fmt::format("tests=\"{}\" failures=\"{}\" errors=\"{}\" skipped=\"0\" time=\"{:.3f}\"", tests, failures,
                       errors, seconds);
  }
};

bool has_result(const FolderRow& row) {
  return row.status == FolderRow::Status::passed || row.status == FolderRow::Status::gate_failed;
}

Counts count(const FolderRow& row) {
  Counts counts{std::max<std::size_t>(1, row.gate.size()), 0, has_result(row) ? 0U : 1U, row.seconds};
  if (!has_result(row)) counts.tests = 1;
  for (const Condition& c : row.gate) counts.failures += c.holds ? 0 : 1;
  return counts;
}

}  // namespace

std::string junit_xml(std::span<const FolderRow> rows) {
  Counts all;
  std::string suites;
  for (const FolderRow& row : rows) {
    const Counts own = count(row);
    all.tests += own.tests, all.failures += own.failures, all.errors += own.errors, all.seconds += own.seconds;
    const std::string name = xml(row.stem);
    fmt::format_to(std::back_inserter(suites), "  <testsuite name=\"{}\" {}>\n", name, own.attributes());
    const auto test = [&](const char* what, const std::string& inside) {
      fmt::format_to(std::back_inserter(suites), "    <testcase classname=\"{}\" name=\"{}\"{}\n", name, xml(what),
                     inside.empty() ? "/>" : ">" + inside + "</testcase>");
    };
    if (!has_result(row)) {
      test("audit", fmt::format("<error type=\"{}\" message=\"{}\"/>",
                                row.status == FolderRow::Status::unpaired ? "unpaired" : "error", xml(row.error)));
    } else if (row.gate.empty()) {
      test("audit", "");
    }
    for (const Condition& c : row.gate)
      test(c.name.c_str(), c.holds ? ""
                                   : fmt::format("<failure type=\"condition\" message=\"{}\">{}</failure>",
                                                 xml(describe(c)), xml(row.headline)));
    suites += "  </testsuite>\n";
  }
  return std::string(kBegin) + " " + all.attributes() + ">\n" + suites + "</testsuites>\n";
}

bool is_junit_of_audit(std::string_view text) {
  return text.starts_with(kBegin);
}

}  // namespace rgs::audit
