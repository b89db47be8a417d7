#!/usr/bin/env python3
# shrink_record.py - of what benchmarks wrote with --json, one small record: what its tables need, and where it comes from.
# SPDX-License-Identifier: Apache-2.0
"""shrink_record.py OUT.json --tables KIND... --command "rgs-bench ..." --run COMMIT NAME RUN.json [--run ...] [--modes MODE...]
shrink_record.py RECORD.json      what is small already (measure_formats.py, measure_city.py), rewritten in few lines

KIND is a table of bench_tables.py, which prints it from the record, or flight_plot (plot_flight.py). Numbers keep eight digits;
frames of a flight become columns. Paths such as RUN.json:detail 4 name a report inside a file.
"""
import argparse
import json
from pathlib import Path

from bench_tables import KINDS

LINE = 400  # what fits is one line


def reduced(value, fields, path=""):
    """Of objects, the members that are named by `fields` or lie above or below one."""
    if isinstance(value, float):
        short = float(f"{value:.8g}")
        return int(short) if short.is_integer() else short
    if isinstance(value, list):
        return [reduced(item, fields, path) for item in value]
    if not isinstance(value, dict):
        return value
    kept = {}
    for key, item in value.items():
        at = f"{path}.{key}" if path else key
        whole = any(at == field or at.startswith(field + ".") for field in fields)
        if whole or (isinstance(item, (dict, list)) and any(field.startswith(at + ".") for field in fields)):
            kept[key] = reduced(item, fields, at)
    return kept


def text(value, indent=0):
    """JSON of short lines, with no more of them than that takes."""
    line = json.dumps(value, ensure_ascii=False)
    nested = isinstance(value, dict) or (isinstance(value, list) and value and isinstance(value[0], (dict, list)))
    if len(line) + indent <= LINE or not nested:
        return line
    lines, ends = [], "[]"
    if isinstance(value, list):
        lines = [text(item, indent + 1) for item in value]
    else:
        ends = "{}"
        for key, item in value.items():
            words = json.dumps(key, ensure_ascii=False) + ": " + text(item, indent + 1)
            if lines and "\n" not in lines[-1] + words and len(lines[-1] + words) + indent <= LINE / 2:
                lines[-1] += ", " + words
            else:
                lines.append(words)
    pad = "\n" + " " * (indent + 1)
    return ends[0] + pad + ("," + pad).join(lines) + "\n" + " " * indent + ends[1]


def columns(run):
    """Frames as one list for each of their numbers."""
    frames = run.get("flight", {}).get("frames")
    if frames:
        run["flight"]["frames"] = {key: [frame[key] for frame in frames] for key in frames[0]}
    return run


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--tables", nargs="+", default=[], choices=KINDS)
    parser.add_argument("--command", help="how the runs were made")
    parser.add_argument("--run", nargs=3, action="append", default=[], metavar=("COMMIT", "NAME", "RUN.json"))
    parser.add_argument("--modes", nargs="+", help="of rgs-bench, these alone")
    options = parser.parse_args()
    if not options.run:
        options.out.write_text(text(json.loads(options.out.read_text())) + "\n")
        return
    fields = {field for kind in options.tables for field in KINDS[kind][1].split()}
    runs = []
    for commit, name, where in options.run:
        path, *inside = where.split(":")
        report = json.loads(Path(path).read_text())
        for key in inside:
            report = report[key]
        if options.modes:
            report["modes"] = [mode for mode in report["modes"] if mode["name"] in options.modes]
            for size in report["sizes"]:
                size["results"] = [result for result in size["results"] if result["mode"] in options.modes]
        head = {"name": name, "commit": commit}
        runs.append(columns(reduced(head | report | head, fields)))
    options.out.write_text(text({"tables": options.tables, "command": options.command, "runs": runs}) + "\n")


if __name__ == "__main__":
    main()
