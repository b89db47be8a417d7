#!/usr/bin/python3
# plot_flight.py - a flight of rgs-bench-flight as a picture: frame time, detail and bytes read, frame by frame.
# SPDX-License-Identifier: Apache-2.0
"""plot_flight.py RECORD.json OUT.svg

The record is made by shrink_record.py --tables flight_plot. The bytes of the output depend on the record alone.
"""
import argparse
import json
import math
from pathlib import Path

from svg_picture import SvgPicture

WIDTH, LEFT, RIGHT = 760, 62, 738
PANEL, GAP, TOP = 110, 34, 44  # px
STYLE = ("text{font:12px sans-serif;fill:#1f2328}.small{font-size:11px}.grid{stroke:#818b98;stroke-opacity:.3}"
         ".curve{fill:none;stroke:#0969da;stroke-width:1.2}"
         "@media (prefers-color-scheme:dark){text{fill:#e6edf3}.curve{stroke:#58a6ff}}")


def nice_ceiling(value):
    """The next of 1, 2, 5, 10, 20, ... from a value on; 1 from nothing."""
    if value <= 0:
        return 1
    power = 10 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= value * (1 - 1e-9))


def panels(flight, fps):
    """(title, values) of each panel."""
    frames = flight["frames"]
    window = max(1, round(fps / 2))  # half a second: a single frame reads all or nothing
    read = frames["bytes_read"]
    rate = [(b - a) / 1e6 / ((min(i, window)) / fps) if i else 0
            for i, (b, a) in enumerate(zip(read, [read[max(0, i - window)] for i in range(len(read))]))]
    return [("frame time, ms", frames["render_ms"]), ("detail reached, px", frames["detail_reached_px"]),
            ("read, MB a second", rate)]


def svg(record):
    record = record["runs"][0]
    flight, fps = record["flight"], record["fps"]
    shown = panels(flight, fps)
    height = TOP + len(shown) * (PANEL + GAP) + 24
    picture = SvgPicture(WIDTH, height, "A flight, frame by frame", STYLE)
    device = record["backend"].removeprefix("cuda ")
    detail = "" if record["detail_px"] is None else f", detail {record['detail_px']:g} px"
    picture.text(LEFT, 18, f"{record['scene']['gaussians']:,} Gaussians, {record['width']}x{record['height']}, {fps:g} frames a second{detail}; "
                 f"{device}, {record['date'][:10]}", kind="small")
    n = len(flight["frames"]["render_ms"])
    for k, (title, values) in enumerate(shown):
        top, bottom = TOP + k * (PANEL + GAP), TOP + k * (PANEL + GAP) + PANEL
        picture.text(LEFT, top - 6, title)
        # One frame in a hundred may lie beyond the axis; the largest is named.
        ordered = sorted(values)
        limit = nice_ceiling(ordered[min(n - 1, math.floor(0.99 * n))])
        if values and ordered[-1] > limit:
            picture.text(RIGHT, top - 6, f"at most {ordered[-1]:.3g}", "end", "small")
        for part in (0, 0.5, 1):
            y = bottom - part * PANEL
            picture.line(LEFT, y, RIGHT, y)
            picture.text(LEFT - 6, y + 4, f"{part * limit:g}", "end", "small")
        points = " ".join(f"{LEFT + (RIGHT - LEFT) * i / max(1, n - 1):.1f},{bottom - PANEL * min(v / limit, 1):.1f}"
                          for i, v in enumerate(values))
        picture.add(f'<polyline points="{points}" class="curve"/>')
    bottom = TOP + len(shown) * (PANEL + GAP) - GAP
    for i in range(0, n + 1, max(1, round(fps))):
        x = LEFT + (RIGHT - LEFT) * i / max(1, n - 1)
        if x <= RIGHT + 2:
            picture.text(x, bottom + 17, f"{i / fps:g}", "middle", "small")
    picture.text((LEFT + RIGHT) / 2, bottom + 34, "seconds", "middle")
    return picture.document()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("record", type=Path)
    parser.add_argument("svg", type=Path)
    arguments = parser.parse_args()
    arguments.svg.write_text(svg(json.loads(arguments.record.read_text())))


if __name__ == "__main__":
    main()
