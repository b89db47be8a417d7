#!/usr/bin/python3
# plot_formats.py - a record of measure_formats.py as a picture and as a table.
# SPDX-License-Identifier: Apache-2.0
"""plot_formats.py RECORD.json --svg OUT.svg | --table

The picture shows bytes per Gaussian against PSNR; formats beyond its axes are named below it. The bytes of the output depend
on the record alone.
"""
import argparse
import json
import math
from pathlib import Path

from svg_picture import SvgPicture

WIDTH, HEIGHT = 760, 480
LEFT, RIGHT, TOP, BOTTOM = 62, 738, 44, 390     # of the axes, in pixels
BYTES, DB = (8, 256), (24, 72)                  # their ranges
STYLE = ("text{font:12px sans-serif;fill:#1f2328}.small{font-size:11px}.title{font-size:14px;font-weight:bold}"
         ".grid{stroke:#818b98;stroke-opacity:.3}.curve{fill:none;stroke-width:1.5}"
         "circle.s0,text.s0{fill:#0969da}circle.s1,text.s1{fill:#bc4c00}circle.s2,text.s2{fill:#1a7f37}"
         "circle.s3,text.s3{fill:#8250df}.curve.s0{stroke:#0969da}@media (prefers-color-scheme:dark){text{fill:#e6edf3}"
         "circle.s0,text.s0{fill:#58a6ff}circle.s1,text.s1{fill:#f0883e}circle.s2,text.s2{fill:#3fb950}"
         "circle.s3,text.s3{fill:#bc8cff}.curve.s0{stroke:#58a6ff}}")
SERIES = (("s0", "RoofGS profiles"), ("s2", "other formats by rgs-convert"), ("s1", "by splat-transform"),
          ("s3", "by GaussianSplats3D"))


def series(entry):
    if entry["format"].startswith("rgs "):
        return "s0"
    return {"rgs-convert": "s2", "GaussianSplats3D": "s3"}.get(entry["writer"].split(" ")[0], "s1")


def place(entry):
    """Pixels of an entry; None beyond the axes."""
    size, psnr = entry["bytes_per_gaussian"], entry["psnr_db"]
    if psnr is None or not (BYTES[0] <= size <= BYTES[1] and DB[0] <= psnr <= DB[1]):
        return None
    x = LEFT + (RIGHT - LEFT) * math.log(size / BYTES[0]) / math.log(BYTES[1] / BYTES[0])
    return x, BOTTOM - (BOTTOM - TOP) * (psnr - DB[0]) / (DB[1] - DB[0])


def overlap(a, b):
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def labels(points, curve):
    """(x, y, anchor) of the label of each (x, y, text): the first place that no point, label or curve [(x, y)] takes; above the
    point if that lies on the curve."""
    taken = [(x - 6, y - 6, x + 6, y + 6) for x, y, _ in points]
    for (x, y), (to_x, to_y) in zip(curve, curve[1:]):
        for t in (i / 64 for i in range(65)):
            at = x + t * (to_x - x), y + t * (to_y - y)
            taken.append((at[0] - 1, at[1] - 1, at[0] + 1, at[1] + 1))
    placed = []
    for x, y, text in points:
        width = 6.1 * len(text)
        options = [(x + 10, y + 4, "start"), (x - 10, y + 4, "end"), (x, y - 10, "middle"), (x, y + 19, "middle"),
                   (x + 8, y - 8, "start"), (x - 8, y - 8, "end"), (x + 8, y + 16, "start"), (x - 8, y + 16, "end")]
        if (x, y) in curve:
            options.insert(0, options.pop(2))

        def box(option):
            left = option[0] - width * {"start": 0, "middle": 0.5, "end": 1}[option[2]]
            return left, option[1] - 10, left + width, option[1] + 3

        def free(option):
            b = box(option)
            inside = b[0] >= LEFT and b[2] <= WIDTH and b[1] >= TOP - 8 and b[3] <= BOTTOM
            return inside and not any(overlap(b, other) for other in taken)

        best = next(filter(free, options), options[0])
        taken.append(box(best))
        placed.append(best)
    return placed


def svg(record):
    picture = SvgPicture(WIDTH, HEIGHT, "Bytes per Gaussian against PSNR", STYLE)
    at = LEFT
    for kind, words in SERIES:
        picture.add(f'<circle cx="{at + 5:.1f}" cy="18.0" r="5.0" class="{kind}"/>')
        picture.text(at + 16, 22, words)
        at += 40 + 6.4 * len(words)
    size = BYTES[0]
    while size <= BYTES[1]:
        x = place({"bytes_per_gaussian": size, "psnr_db": DB[0]})[0]
        picture.line(x, BOTTOM, x, TOP)
        picture.text(x, BOTTOM + 17, str(size), "middle", "small")
        size *= 2
    for psnr in range(math.ceil(DB[0] / 10) * 10, DB[1] + 1, 10):
        y = place({"bytes_per_gaussian": BYTES[0], "psnr_db": psnr})[1]
        picture.line(LEFT, y, RIGHT, y)
        picture.text(LEFT - 6, y + 4, str(psnr), "end", "small")
    picture.line(LEFT, BOTTOM, RIGHT, BOTTOM)
    picture.text((LEFT + RIGHT) / 2, BOTTOM + 36, "bytes per Gaussian", "middle")
    picture.add(f'<text transform="translate(20.0 {(TOP + BOTTOM) / 2:.1f}) rotate(-90)" text-anchor="middle">PSNR, dB</text>')

    shown = [entry for entry in record["entries"] if place(entry)]
    own = sorted((place(entry) for entry in shown if series(entry) == "s0"))
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in own)
    picture.add(f'<polyline points="{path}" class="curve s0"/>')
    points = [(*place(entry), entry["format"].removeprefix("rgs ")) for entry in shown]
    for entry, (x, y, words), (tx, ty, anchor) in zip(shown, points, labels(points, own)):
        picture.add(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5.0" class="{series(entry)}"/>')
        picture.text(tx, ty, words, anchor, "small " + series(entry))
    beyond = [f"{entry['format']} {entry['bytes_per_gaussian']:.0f} bytes" +
              ("" if entry["psnr_db"] is None else f", {entry['psnr_db']:.0f} dB")
              for entry in record["entries"] if not place(entry)]
    scene = f"{record['gaussians']:,} Gaussians, {record['views']} views of {record['size']}"
    picture.text(LEFT, HEIGHT - 26, f"{scene} against those of the PLY, {record['date']}", kind="small")
    picture.text(LEFT, HEIGHT - 10, f"beyond the axes: {'; '.join(beyond)}", kind="small")
    return picture.document()


def table(record):
    lines = ["| file | written by | bytes per Gaussian | PSNR, dB | worst view |", "|---|---|---|---|---|"]
    for entry in record["entries"]:
        psnr, worst = ("" if value is None else f"{value:.1f}" for value in (entry["psnr_db"], entry["worst_psnr_db"]))
        own = entry["format"].startswith("rgs ")
        name = f"**{entry['format']}**" if own else entry["format"]
        lines.append(f"| {name} | {entry['writer']} | {entry['bytes_per_gaussian']:.1f} | {psnr} | {worst} |")
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
