// format_table.cpp - what --formats prints, and docs/user/INTERCHANGE.md repeats.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "rgs_convert.hpp"

namespace rgs {
namespace {

using Row = std::vector<std::string>;

// In Markdown, cells one below the other.
std::string table(const std::vector<Row>& rows) {
  std::vector<std::size_t> widths(rows.front().size());
  for (const Row& row : rows)
    for (std::size_t i = 0; i < row.size(); ++i) widths[i] = std::max(widths[i], row[i].size());
  std::string text;
  for (const Row& row : rows) {
    for (std::size_t i = 0; i < row.size(); ++i)
      text += "| " + row[i] + std::string(widths[i] - row[i].size() + 1, ' ');
    text += "|\n";
    if (&row != &rows.front()) continue;
    for (const std::size_t width : widths) text += "|" + std::string(width + 2, '-');
    text += "|\n";
  }
  return text;
}

}  // namespace

std::string format_table() {
  std::vector<Row> keeps{
      {"format", "written", "frame", "SH", "levels", "origin", "anti-aliasing", "declarations", "in parts", "of"}};
  std::vector<Row> precision{{"format", "precision"}};
  const auto mark = [](bool keeps_it) { return keeps_it ? "yes" : "-"; };
  for (const FormatInfo& f : all_formats()) {
    const char* frame = f.axes == kAxesGltf      ? "gltf"
                        : f.axes == kAxesOpenGl  ? "opengl"
                        : f.axes == kAxesLcc     ? "lcc"
                        : f.axes == kAxes3dTiles ? "3dtiles"
                        : f.keeps.declarations   ? "3dgs or declared"
                                                 : "3dgs";
    const std::string names = std::string(".") + f.name + (*f.other_name == 0 ? "" : ", ") + f.other_name;
    keeps.push_back({names, f.writable ? "yes" : "read only", frame, std::to_string(f.sh_degree), mark(f.keeps.levels),
                     mark(f.keeps.origin), mark(f.keeps.aa_mode), mark(f.keeps.declarations), mark(f.in_parts),
                     f.title});
    precision.push_back({std::string(".") + f.name, f.precision});
  }
  return table(keeps) + "\n" + table(precision);
}

}  // namespace rgs
