// svg_writer_test.cpp - text from outside stays text, in pictures and in pages. Whole pictures are parsed as XML with
// rgs-bench's, whole pages opened in a browser with rgs-audit's. SPDX-License-Identifier: Apache-2.0
#include "svg_writer.hpp"

#include <doctest/doctest.h>

#include <string>

using rgs::tool::SvgWriter;

TEST_CASE("SVG text is escaped") {
  SvgWriter picture(10, 20, "a<b");
  picture.text(1, 2, "x & y \"z\" <w> \x01", SvgWriter::Anchor::end);
  const std::string svg = picture.finish();
  CHECK(svg.find("<title>a&lt;b</title>") != std::string::npos);
  CHECK(svg.find("text-anchor=\"end\" class=\"\">x &amp; y &quot;z&quot; &lt;w&gt;  </text>") != std::string::npos);

  SvgWriter chart = SvgWriter::in_page(10, 20, "\" onload=\"alert(1)");
  chart.path("M0 0\"", "bars");
  CHECK(chart.finish() ==
        "<svg class=\"chart\" viewBox=\"0 0 10 20\" role=\"img\" aria-label=\"&quot; onload=&quot;alert(1)\">"
        "<path d=\"M0 0&quot;\" class=\"bars\"/>\n</svg>\n");
}
