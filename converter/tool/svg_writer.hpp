// svg_writer.hpp - lines, shapes and text as an SVG picture for light and dark pages, or as a chart in the colours of
// its HTML page.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace rgs::tool {

/// Collects shapes; sizes and positions are px from the upper left corner. `style` names classes of the page's or the
/// picture's style sheet: text "", "small", "title"; lines "grid", "roof", "roof dashed"; shapes "s0" .. "s3", the
/// colours of series, and "track", the background of a bar. The picture has no background.
class SvgWriter {
 public:
  /// A standalone picture. `title` is for screen readers.
  SvgWriter(double width, double height, std::string_view title);
  /// A chart of class "chart" inside an HTML page, as wide as the page makes it; `label` is for screen readers.
  static SvgWriter in_page(double width, double height, std::string_view label);

  enum class Anchor { start, middle, end };
  void text(double x, double y, std::string_view text, Anchor anchor = Anchor::start, std::string_view style = "");
  void text_upwards(double x, double y, std::string_view text);  ///< rotated left, centred at y
  void line(double x1, double y1, double x2, double y2, std::string_view style);
  void rectangle(double x, double y, double width, double height, std::string_view style);
  void circle(double x, double y, double radius, std::string_view style);

  void path(std::string_view commands, std::string_view style);

  std::string finish() const;  ///< the document, UTF-8

 private:
  SvgWriter() = default;
  std::string shapes_;
};

}  // namespace rgs::tool
