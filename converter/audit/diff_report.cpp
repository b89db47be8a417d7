// diff_report.cpp - differences of two files as a table and as JSON.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include <nlohmann/json.hpp>

#include "audit_json.hpp"
#include "diff.hpp"
#include "rgs/version.hpp"
#include "text_lines.hpp"

namespace rgs::audit {
namespace {

using Json = nlohmann::ordered_json;
using tool::format_count;

Json json_of(const Diff::Side& side) {
  return {{"file", side.path},
          {"format", side.format},
          {"bytes", side.bytes},
          {"gaussians", side.n},
          {"sh_degree", side.sh_degree}};
}

std::string line_of(const Diff::Side& side) {
  return fmt::format("{} ({}, {} Gaussians, SH degree {})", tool::printable(side.path), side.format,
                     format_count(side.n), side.sh_degree);
}

class Text : private tool::TextLines {
 public:
  std::string all(const Diff& d) {
    line("A  {}", line_of(d.a));
    line("B  {}", line_of(d.b));
    line("  matched   {} by {}; equal {}, reshaped {}", format_count(d.pairs.n_paired), name_of(d.pairs.by),
         format_count(d.n_equal), format_count(d.n_reshaped));
    line("  removed   {} only in A", format_count(d.pairs.n_source_only));
    line("  added     {} only in B", format_count(d.pairs.n_asset_only));
    line("            {:>12} {:>11} {:>11} {:<14} {:>10} {:>10}", "changed", "largest", "RMS", "unit", "in A", "in B");
    for (const Change& c : d.changes) {
      if (c.n == 0)
        line("  {:<9} {:>12}", c.key, 0);
      else
        line("  {:<9} {:>12} {:>11.4g} {:>11.4g} {:<14} {:>10} {:>10}", c.key, format_count(c.n), c.largest, c.rms,
             c.unit, c.a, c.b);
    }
    for (const DeclaredDifference& x : d.declared) line("  declared  {}: {}; in B {}", x.name, x.source, x.asset);
    for (const DiffView& v : d.views)
      line("  picture   {}: {:.1f} dB, {:.0f} levels at most", tool::printable(v.name), v.psnr, 255 * v.largest);
    line("{}", d.same() ? "same" : "different");
    return take();
  }
};

}  // namespace

std::string diff_json(const Diff& d) {
  Json changes = Json::object(), declared = Json::array();
  for (const Change& c : d.changes) {
    Json& row = changes[c.key];
    row = {{"changed", c.n}, {"unit", c.unit}, {"largest", c.largest}, {"rms", c.rms}};
    if (c.n != 0) {
      row["a"] = c.a;
      row["b"] = c.b;
    }
  }
  for (const DeclaredDifference& x : d.declared) {
    Json row = {{"key", x.key}, {"a", x.source}, {"b", x.asset}};
    declared.push_back(std::move(row));
  }
  Json json{{"schema", "rgs-diff/1"},
            {"tool", "rgs-diff " RGS_VERSION},
            {"same", d.same()},
            {"a", json_of(d.a)},
            {"b", json_of(d.b)},
            {"tolerance", d.tolerance},
            {"matched_by", name_of(d.pairs.by)},
            {"matched", d.pairs.n_paired},
            {"equal", d.n_equal},
            {"reshaped", d.n_reshaped},
            {"removed", d.pairs.n_source_only},
            {"added", d.pairs.n_asset_only},
            {"changes", changes},
            {"declared_differences", declared}};
  for (const DiffView& v : d.views) {
    Json row = {{"name", v.name}, {"psnr", v.psnr}, {"largest", v.largest}};
    json["views"].push_back(std::move(row));
  }
  return json.dump(2, ' ', true, Json::error_handler_t::replace) + "\n";
}

std::string diff_text(const Diff& diff) {
  return Text().all(diff);
}

}  // namespace rgs::audit
