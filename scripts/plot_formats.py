#!/usr/bin/python3
# plot_formats.py - a record of measure_formats.py as a picture and as tables.
# SPDX-License-Identifier: Apache-2.0
"""plot_formats.py RECORD.json [--svg OUT.svg] [--table]

The picture shows bytes per Gaussian against PSNR and SSIM, a column for each scene. The bytes of the output depend on the record alone.
"""
import argparse
import json
import math
from pathlib import Path

from svg_picture import SvgPicture

WIDTH, HEIGHT = 960, 664
LEFT, TOP, PANEL_WIDTH, PANEL_HEIGHT, GAP = 60, 84, 284, 232, 16  # of the panels, in pixels
BYTES, DB, SSIM = (2.2, 180), (20, 72), (0.8, 0.99999)            # their ranges
ROWS = (("psnr_db", "PSNR, dB", (20, 30, 40, 50, 60, 70)), ("ssim", "SSIM", (0.9, 0.99, 0.999, 0.9999)))
# class, words of the legend, how formats begin; colours for light and dark pages
SERIES = (("s0", "RoofGS archive", "rgs archive", "#0969da", "#58a6ff"), ("s1", "RoofGS packed, direct", "rgs ", "#0550ae", "#a5d6ff"),
          ("s2", "SPZ 2 to 4", "spz", "#1a7f37", "#3fb950"), ("s3", "SOG", "sog", "#bc4c00", "#f0883e"),
          ("s4", "L-GSC", "L-GSC", "#8250df", "#bc8cff"), ("s5", "compressed PLY", "compressed.ply", "#9a6700", "#e3b341"),
          ("s6", "ksplat", "ksplat", "#bf3989", "#f778ba"), ("s7", "splat", "splat", "#59636e", "#9198a1"))
STYLE = ("text{font:12px sans-serif;fill:#1f2328}.small{font-size:11px}.title{font-size:13px;font-weight:bold}"
         ".grid{stroke:#818b98;stroke-opacity:.3}.curve{fill:none;stroke-width:1.5}.s0.curve{stroke-width:2.5}circle{stroke-width:1.5}"
         ".other{fill-opacity:0}")
for scheme in (3, 4):
    colours = "".join(f"circle.{s[0]}{{fill:{s[scheme]};stroke:{s[scheme]}}}.curve.{s[0]}{{stroke:{s[scheme]}}}"
                      f"text.{s[0]}{{fill:{s[scheme]}}}" for s in SERIES)
    STYLE += colours if scheme == 3 else f"@media (prefers-color-scheme:dark){{text{{fill:#e6edf3}}{colours}}}"


def series(entry):
    return next(kind for kind, _, start, *_ in SERIES if entry["format"].startswith(start))


def fraction(key, value):
    """0 to 1 along an axis, beyond it outside of these."""
    if key == "psnr_db":
        return (value - DB[0]) / (DB[1] - DB[0])
    if key == "ssim":
        return math.log((1 - SSIM[0]) / max(1 - value, 1e-9)) / math.log((1 - SSIM[0]) / (1 - SSIM[1]))
    return math.log(value / BYTES[0]) / math.log(BYTES[1] / BYTES[0])


def place(entry, column, row):
    """Pixels of an entry; None if it has no such value or lies beyond the axes."""
    key = ROWS[row][0]
    if entry[key] is None:
        return None
    x, y = fraction("bytes", entry["bytes_per_gaussian"]), fraction(key, entry[key])
    if not (0 <= x <= 1 and 0 <= y <= 1):
        return None
    return LEFT + column * (PANEL_WIDTH + GAP) + x * PANEL_WIDTH, TOP + row * (PANEL_HEIGHT + GAP) + (1 - y) * PANEL_HEIGHT


def overlap(a, b):
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def own(entry):
    return entry["writer"] == "rgs-convert"


def draw(picture, scene, column, row):
    left, top = LEFT + column * (PANEL_WIDTH + GAP), TOP + row * (PANEL_HEIGHT + GAP)
    right, bottom = left + PANEL_WIDTH, top + PANEL_HEIGHT
    for size in (4, 8, 16, 32, 64, 128):
        x = left + fraction("bytes", size) * PANEL_WIDTH
        picture.line(x, bottom, x, top)
        if row == 1:
            picture.text(x, bottom + 17, str(size), "middle", "small")
    for value in ROWS[row][2]:
        y = bottom - fraction(ROWS[row][0], value) * PANEL_HEIGHT
        picture.line(left, y, right, y)
        if column == 0:
            picture.text(left - 6, y + 4, str(value), "end", "small")
    shown = [(entry, place(entry, column, row)) for entry in scene["entries"]]
    shown = [(entry, at) for entry, at in shown if at]
    for kind, *_ in SERIES:
        for writer in sorted({entry["writer"] for entry, _ in shown}):
            points = sorted(at for entry, at in shown if series(entry) == kind and entry["writer"] == writer)
            if kind != "s1" and len(points) > 1:
                path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
                picture.add(f'<polyline points="{path}" class="curve {kind}"/>')
    for entry, (x, y) in shown:
        picture.add(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4.0" class="{series(entry)}{"" if own(entry) else " other"}"/>')
        words = entry["format"].removeprefix("rgs archive").split(",")[0].lstrip(":").removeprefix("rgs ")
        if series(entry) in ("s0", "s1") and words:
            dx, dy, anchor = {"packed": (-8, 4, "end"), "direct": (8, 4, "start")}.get(words, (-8, -5, "end"))
            picture.text(x + dx, y + dy, words, anchor, "small " + series(entry))


def svg(record):
    picture = SvgPicture(WIDTH, HEIGHT, "Bytes per Gaussian against PSNR and SSIM", STYLE)
    at = LEFT
    for kind, words, *_ in SERIES:
        picture.add(f'<circle cx="{at + 4:.1f}" cy="18.0" r="4.0" class="{kind}"/>')
        picture.text(at + 13, 22, words)
        at += 34 + 6.3 * len(words)
    for i, (kind, words) in enumerate((("", "written by rgs-convert"), (" other", "by another program"))):
        picture.add(f'<circle cx="{LEFT + 4 + 170 * i:.1f}" cy="38.0" r="4.0" class="s7{kind}"/>')
        picture.text(LEFT + 13 + 170 * i, 42, words)
    for column, scene in enumerate(record["scenes"]):
        words = f"{scene['scene']}: {scene['gaussians']:,} Gaussians, {scene['views']} views"
        picture.text(LEFT + column * (PANEL_WIDTH + GAP), TOP - 10, words, kind="title")
        for row in range(2):
            draw(picture, scene, column, row)
    bottom = TOP + 2 * PANEL_HEIGHT + GAP
    picture.text(LEFT + 1.5 * PANEL_WIDTH + GAP, bottom + 38, "bytes per Gaussian", "middle")
    notes = []
    for column, scene in enumerate(record["scenes"]):
        notes += [f"beyond the axes: {scene['scene']}, {e['format']} by {e['writer']}, {e['psnr_db']:.0f} dB"
                  for e in scene["entries"] if not place(e, column, 0)]
        notes += [f"of {e['date']}, without SSIM: {scene['scene']}, {e['format']}" for e in scene["entries"] if e["ssim"] is None]
    words = f"{record['scenes'][0]['date']}, views against those of the PLY; up and left is better"
    picture.text(LEFT, bottom + 60, words, kind="small")
    picture.text(LEFT, bottom + 77, "; ".join(notes), kind="small")
    for row, (_, words, _) in enumerate(ROWS):
        y = TOP + row * (PANEL_HEIGHT + GAP) + PANEL_HEIGHT / 2
        picture.add(f'<text transform="translate(15.0 {y:.1f}) rotate(-90)" text-anchor="middle">{words}</text>')
    return picture.document()


def table(record):
    def cell(entry, key, digits):
        return "" if entry is None or entry[key] is None else f"{entry[key]:.{digits}f}"

    scenes = record["scenes"]
    lines = ["| file | written by |" + "".join(f" {scene['scene']}: bytes | PSNR, worst | SSIM |" for scene in scenes),
             "|---|---|" + "---|---|---|" * len(scenes)]
    rows = {(entry["format"], entry["writer"]): None for scene in scenes for entry in scene["entries"]}
    for kind, writer in rows:
        cells = [f"**{kind}**" if kind.startswith("rgs ") else kind.replace(", level", ""), writer]
        for scene in scenes:
            entry = next((e for e in scene["entries"] if (e["format"], e["writer"]) == (kind, writer)), None)
            psnr = ", ".join(filter(None, (cell(entry, "psnr_db", 1), cell(entry, "worst_psnr_db", 1))))
            cells += [cell(entry, "bytes_per_gaussian", 1), psnr, cell(entry, "ssim", 5)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("record", type=Path)
    parser.add_argument("--svg", type=Path)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    record = json.loads(arguments.record.read_text())
    if arguments.svg:
        arguments.svg.write_text(svg(record))
    if arguments.table:
        print(table(record), end="")


if __name__ == "__main__":
    main()
