# svg_picture.py - text and lines of plots, for light and dark pages.
# SPDX-License-Identifier: Apache-2.0
from xml.sax.saxutils import escape


class SvgPicture:
    """Elements in the order in which they are added; coordinates in px from the upper left corner."""

    def __init__(self, width, height, title, style):
        self._out = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
                     'role="img">', f"<title>{title}</title>", f"<style>{style}</style>"]

    def add(self, element):
        self._out.append(element)

    def text(self, x, y, words, anchor="start", kind=""):
        self.add(f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" class="{kind}">{escape(words)}</text>')

    def line(self, x1, y1, x2, y2):
        self.add(f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" class="grid"/>')

    def document(self):
        return "\n".join(self._out) + "\n</svg>\n"
