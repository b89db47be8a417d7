#!/usr/bin/env python3
"""check_links.py - checks that every relative link and anchor of a folder of pages resolves, and that no element of a page loads from
another host. Style sheets are not read.

SPDX-License-Identifier: Apache-2.0
"""
import pathlib
import sys
from html.parser import HTMLParser
from urllib.parse import unquote, urlsplit

# What a page loads by itself, rather than on a click.
LOADED = {"audio", "embed", "iframe", "img", "input", "link", "object", "script", "source", "video"}


class Page(HTMLParser):
    def __init__(self, path):
        super().__init__()
        self.anchors, self.links = {""}, []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name == "id" or (tag == "a" and name == "name"):
                self.anchors.add(value)
            elif name in ("href", "src", "data") and value is not None:
                self.links.append((tag, value))


def main(folder):
    root = pathlib.Path(folder).resolve()
    pages = {path: Page(path) for path in sorted(root.rglob("*.html"))}
    n, broken = 0, []
    for path, page in pages.items():
        for tag, link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                if tag in LOADED and parts.scheme != "data":
                    broken.append((path, link, "loads from another host"))
                continue
            n += 1
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if parts.path.startswith("/") or not target.is_relative_to(root) or not target.is_file():
                broken.append((path, link, "no such file"))
            elif target in pages and unquote(parts.fragment) not in pages[target].anchors:
                broken.append((path, link, "no such anchor"))
    for path, link, why in broken:
        print(f"{path.relative_to(root)}: {link}: {why}", file=sys.stderr)
    print(f"{len(pages)} pages, {n} links, {len(broken)} broken")
    return bool(broken) or n == 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
