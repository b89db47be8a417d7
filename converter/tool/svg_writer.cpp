// svg_writer.cpp - writes an SVG document, shape by shape.
// SPDX-License-Identifier: Apache-2.0
#include "svg_writer.hpp"

#include <fmt/format.h>

namespace rgs::tool {
namespace {

// Colours follow the page's theme, also where the picture is embedded as an image.
constexpr const char* kStyle =
    "text{font:12px sans-serif;fill:#1f2328}.small{font-size:11px}.title{font-size:14px;font-weight:bold}"
    ".grid{stroke:#818b98;stroke-opacity:.3}.roof{stroke:#1f2328;stroke-width:1.5}.dashed{stroke-dasharray:5 4}"
    ".track{fill:#818b98;fill-opacity:.2}.s0{fill:#0969da}.s1{fill:#bc4c00}.s2{fill:#1a7f37}.s3{fill:#8250df}"
    "@media (prefers-color-scheme:dark){text{fill:#e6edf3}.roof{stroke:#e6edf3}"
    ".s0{fill:#58a6ff}.s1{fill:#f0883e}.s2{fill:#3fb950}.s3{fill:#bc8cff}}";

std::string escaped(std::string_view text) {
  std::string out;
  for (const char c : text) {
    switch (c) {
      case '&': out += "&amp;"; break;
      case '<': out += "&lt;"; break;
      case '>': out += "&gt;"; break;
      case '"': out += "&quot;"; break;
      default: out += static_cast<unsigned char>(c) < ' ' ? ' ' : c;  // XML knows no other control characters
    }
  }
  return out;
}

const char* name_of(SvgWriter::Anchor anchor) {
  switch (anchor) {
    case SvgWriter::Anchor::start: return "start";
    case SvgWriter::Anchor::middle: return "middle";
    case SvgWriter::Anchor::end: return "end";
  }
  return "";
}

}  // namespace

SvgWriter::SvgWriter(double width, double height, std::string_view title)
    : shapes_(fmt::format("<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {0:g} {1:g}\" width=\"{0:g}\" "
                          "height=\"{1:g}\" role=\"img\">\n<title>{2}</title>\n<style>{3}</style>\n",
                          width, height, escaped(title), kStyle)) {}

SvgWriter SvgWriter::in_page(double width, double height, std::string_view label) {
  SvgWriter svg;
  svg.shapes_ = fmt::format("<svg class=\"chart\" viewBox=\"0 0 {:g} {:g}\" role=\"img\" aria-label=\"{}\">", width,
                            height, escaped(label));
  return svg;
}

void SvgWriter::text(double x, double y, std::string_view text, Anchor anchor, std::string_view style) {
  shapes_ += fmt::format("<text x=\"{:.1f}\" y=\"{:.1f}\" text-anchor=\"{}\" class=\"{}\">{}</text>\n", x, y,
                         name_of(anchor), escaped(style), escaped(text));
}

void SvgWriter::text_upwards(double x, double y, std::string_view text) {
  shapes_ += fmt::format("<text transform=\"translate({:.1f} {:.1f}) rotate(-90)\" text-anchor=\"middle\">{}</text>\n",
                         x, y, escaped(text));
}

void SvgWriter::line(double x1, double y1, double x2, double y2, std::string_view style) {
  shapes_ += fmt::format("<line x1=\"{:.1f}\" y1=\"{:.1f}\" x2=\"{:.1f}\" y2=\"{:.1f}\" class=\"{}\"/>\n", x1, y1, x2,
                         y2, escaped(style));
}

void SvgWriter::rectangle(double x, double y, double width, double height, std::string_view style) {
  shapes_ += fmt::format("<rect x=\"{:.1f}\" y=\"{:.1f}\" width=\"{:.1f}\" height=\"{:.1f}\" class=\"{}\"/>\n", x, y,
                         width, height, escaped(style));
}

void SvgWriter::circle(double x, double y, double radius, std::string_view style) {
  shapes_ +=
      fmt::format("<circle cx=\"{:.1f}\" cy=\"{:.1f}\" r=\"{:.1f}\" class=\"{}\"/>\n", x, y, radius, escaped(style));
}

void SvgWriter::path(std::string_view commands, std::string_view style) {
  shapes_ += fmt::format("<path d=\"{}\" class=\"{}\"/>\n", escaped(commands), escaped(style));
}

std::string SvgWriter::finish() const {
  return shapes_ + "</svg>\n";
}

}  // namespace rgs::tool
