#!/usr/bin/env python3
# bench_tables.py - Markdown tables of docs/KERNELS.md from what rgs-bench --json wrote: bench_tables.py FILE.json...
# SPDX-License-Identifier: Apache-2.0
import json
import sys


def row(cells):
    return "| " + " | ".join(cells) + " |"


def table(head, rows):
    return "\n".join([row(head), "|" + "---|" * len(head)] + [row(cells) for cells in rows])


def count(n):
    return f"{n / 1e6:,.0f} M" if n >= 1e8 else f"{n / 1e6:.1f} M" if n >= 1e7 else f"{n / 1e6:.2f} M"


def quality_of(bench, mode):
    quality = next(m for m in bench["modes"] if m["name"] == mode).get("quality") or {}
    if quality.get("psnr") is None:
        return ["", "", "", ""]
    loss = quality.get("photo_loss")
    return [f"{quality['psnr']:.2f}", f"{quality['worst_psnr']:.2f}", f"{quality['largest_difference']:.3f}",
            "" if loss is None else f"{loss:.4f}"]


def times(bench, size):
    stages = ["project", "bin", "sort", "blend"]
    head = [f"{size['width']}x{size['height']}, ms", *stages, "total", "speed-up", "pairs", "evaluated", "moved",
            "peak memory"]
    rows = []
    for r in size["results"]:
        rows.append([r["mode"], *(f"{r['stages'][s]['ms']:.3f}" for s in stages), f"{r['total_ms']:.3f}",
                     f"{r['speedup']:.2f}", count(r["instances"]), count(r["evaluated"]), f"{r['bytes'] / 1e6:,.0f} MB",
                     f"{r['peak_bytes'] / 1e6:,.0f} MB"])
    return table(head, rows)


def qualities(bench):
    head = ["", "PSNR, dB", "worst view", "largest error", "loss against photographs, dB"]
    return table(head, [[m["name"], *quality_of(bench, m["name"])] for m in bench["modes"] if m["name"] != "baseline"])


def floors(size, modes):
    head = [f"{size['width']}x{size['height']}", "stage", "ms", "moved", "GB/s", "GFLOP/s", "flop/B", "floor, ms",
            "limit", "time / floor"]
    rows = []
    for r in size["results"]:
        if r["mode"] not in modes:
            continue
        for name, s in r["stages"].items():
            if s["floor_ms"] < 1e-4:
                continue  # nothing that the cost model counts
            rows.append([r["mode"] if name == "project" else "", name, f"{s['ms']:.3f}", f"{s['bytes'] / 1e6:,.0f} MB",
                         f"{s['bytes_per_second'] / 1e9:,.0f}", f"{s['flops_per_second'] / 1e9:,.0f}",
                         f"{s['intensity']:.1f}", f"{s['floor_ms']:.3f}", s["limit"], f"{s['time_over_floor']:.2f}"])
    return table(head, rows)


def main():
    for path in sys.argv[1:]:
        with open(path, encoding="utf-8") as file:
            bench = json.load(file)
        print(f"<!-- {path}: {bench['device']['name']}, {bench['date']} -->\n")
        for size in bench["sizes"]:
            print(times(bench, size) + "\n")
        print(qualities(bench) + "\n")
        if "rates" in bench:
            for size in bench["sizes"]:
                print(floors(size, {"baseline", "+ fast exp = paper", "paper", "turbo"}) + "\n")


if __name__ == "__main__":
    main()
