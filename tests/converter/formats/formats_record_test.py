#!/usr/bin/python3
# formats_record_test.py - the documents state the record's sizes and quality of formats.
# SPDX-License-Identifier: Apache-2.0
"""formats_record_test.py SOURCE_FOLDER

docs/images/formats.svg is scripts/plot_formats.py's picture of docs/records/formats.json; docs/records/MEASUREMENTS.md has its
table; texts stay inside the picture and do not overlap.
"""
import itertools
import json
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

root = Path(sys.argv[1])
sys.path.insert(0, str(root / "scripts"))
import plot_formats  # noqa: E402  (found through the line above)

SVG = "{http://www.w3.org/2000/svg}"


def boxes(picture):
    """(words, box) of each upright text; the box is an upper bound."""
    for text in ElementTree.fromstring(picture).iter(f"{SVG}text"):
        if "transform" in text.attrib:
            continue
        x, y, width = float(text.get("x")), float(text.get("y")), 5.6 * len(text.text)
        left = x - width * {"start": 0, "middle": 0.5, "end": 1}[text.get("text-anchor")]
        yield text.text, (left, y - 9, left + width, y + 2)


def check(ok, words):
    if not ok:
        print(words)
        failures.append(words)


failures = []
record = json.loads((root / "docs/records/formats.json").read_text())
picture = (root / "docs/images/formats.svg").read_text()
check(picture == plot_formats.svg(record), "docs/images/formats.svg differs from the record; run plot_formats.py --svg")
lines = plot_formats.table(record)
check(lines in (root / "docs/records/MEASUREMENTS.md").read_text(), f"MEASUREMENTS.md lacks the record's table:\n{lines}")
for words, (left, top, right, bottom) in boxes(picture):
    inside = 0 <= left and right <= plot_formats.WIDTH and 0 <= top and bottom <= plot_formats.HEIGHT
    check(inside, f"'{words}' reaches outside the picture")
for (a, box), (b, other) in itertools.combinations(boxes(picture), 2):
    check(not plot_formats.overlap(box, other), f"'{a}' and '{b}' overlap")
worse = json.loads(json.dumps(record))
worse["scenes"][0]["entries"][1]["psnr_db"] -= 1
check(plot_formats.svg(worse) != picture and plot_formats.table(worse) != plot_formats.table(record), "the points do not move")
sys.exit(1 if failures else 0)
