#!/usr/bin/env python3
# bench_tables.py - Markdown tables of the documents from what rgs-bench --json wrote.
# SPDX-License-Identifier: Apache-2.0
"""bench_tables.py BENCH.json...                                           ablation, quality and floors
bench_tables.py --orthogonality FULL.json PRUNED.json [--audit AUDIT.json] pruning and turbo, alone and together
bench_tables.py --scaling BENCH.json...                                    scenes of several sizes
"""
import argparse
import json
import sys


def load(path):
    with open(path, encoding="utf-8") as file:
        return json.load(file)


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
    view = f"{size['view']}, " if "view" in size else ""
    head = [f"{view}{size['width']}x{size['height']}, ms", *stages, "total", "speed-up", "pairs", "evaluated", "moved",
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


def rates(size):
    """Milliseconds by mode, steps between modes included."""
    return {r["mode"]: r["total_ms"] for r in size["results"]}


def orthogonality(full, pruned, audit=None):
    """Pruning and the pruned file's last mode, alone and together: the layout of the RoofGS paper's table with PUP 3D-GS."""
    scenes = {"": full, "pruned ": pruned}
    fast = pruned["modes"][-1]["name"]
    head, rows = [""], []
    for size in full["sizes"]:
        head += [f"{size['width']}x{size['height']}, FPS", "speed-up"]
    head += ["PSNR against the unpruned baseline, dB", "PSNR against photographs, dB"]
    for prefix, bench in scenes.items():
        for mode in ("baseline", fast):
            cells = [prefix + mode]
            for size, reference in zip(bench["sizes"], full["sizes"], strict=True):
                if (size["width"], size["height"]) != (reference["width"], reference["height"]):
                    sys.exit("the two files measure different sizes")
                ms, first = rates(size)[mode], rates(reference)["baseline"]
                cells += [f"{1e3 / ms:,.0f}", f"{first / ms:.1f}x"]
            quality = next(m for m in bench["modes"] if m["name"] == mode).get("quality") or {}
            to_baseline = quality.get("psnr") if bench is full and mode != "baseline" else None
            to_photos = quality.get("photo_psnr")
            if audit and bench is pruned and mode == "baseline":
                to_baseline = audit["rendered"]["psnr"]
                to_photos = to_photos or (audit["rendered"]["photos"] or {}).get("asset_psnr")
            cells += ["" if v is None else f"{v:.2f}" for v in (to_baseline, to_photos)]
            rows.append(cells)
    kept = pruned["scene"]["gaussians"] / full["scene"]["gaussians"]
    lines = [f"{full['scene']['name']}: {full['scene']['gaussians']:,} Gaussians, pruned to "
             f"{pruned['scene']['gaussians']:,} ({100 * kept:.0f} %); {full['device']['name']}, {full['date']}.\n",
             table(head, rows)]
    together = []
    for size, small in zip(full["sizes"], pruned["sizes"], strict=True):
        a, b = rates(size), rates(small)
        product = (a["baseline"] / a[fast]) * (a["baseline"] / b["baseline"])
        together.append(f"{100 * a['baseline'] / b[fast] / product:.0f} % at {size['width']}x{size['height']}")
    lines.append(f"\nBoth together reach {', '.join(together)} of the product of their speed-ups.")
    if audit:
        photos = audit["rendered"]["photos"]
        lost = f", {photos['loss']:.2f} dB lost against photographs" if photos else ""
        lines.append(f"Pruning alone: {audit['rendered']['psnr']:.2f} dB, worst view {audit['rendered']['worst_psnr']:.2f}"
                     f"{lost}.")
    return "\n".join(lines)


def scaling(benches):
    """How times grow with Gaussians and pixels: one line a scene and size, scenes by size."""
    benches = sorted(benches, key=lambda bench: bench["scene"]["gaussians"])
    modes = [m["name"] for m in benches[0]["modes"]]
    fast = modes[-1]
    head = ["Gaussians", "image", *(f"{m}, ms" if m == modes[0] else f"{m}, ms (ratio)" for m in modes),
            f"visible, {fast}", f"ns a Gaussian, {fast}", f"ns a pixel, {fast}", f"peak memory, {fast}"]
    rows = []
    for bench in benches:
        n = bench["scene"]["gaussians"]
        for size in bench["sizes"]:
            results = {r["mode"]: r for r in size["results"]}
            last, pixels = results[fast], size["width"] * size["height"]
            rows.append([f"{n / 1e6:.3g} M" if size is bench["sizes"][0] else "", f"{size['width']}x{size['height']}",
                         f"{results[modes[0]]['total_ms']:.3f}",
                         *(f"{results[m]['total_ms']:.3f} ({results[m]['speedup']:.1f}x)" for m in modes[1:]),
                         count(last["visible"]), f"{1e6 * last['total_ms'] / n:.3f}",
                         f"{1e6 * last['total_ms'] / pixels:.3f}", f"{last['peak_bytes'] / 1e6:,.0f} MB"])
    lines = [f"{benches[0]['device']['name']}, {benches[0]['date']}; {benches[0]['frames']} frames a camera, "
             f"{benches[0]['cameras']} cameras.\n", table(head, rows)]
    for bench in benches:
        n = bench["scene"]["gaussians"]
        slower = [f"{n / 1e6:.3g} M at {s['width']}x{s['height']}" for s in bench["sizes"]
                  if "paper" in rates(s) and rates(s)[fast] > rates(s)["paper"]]
        if slower and fast != "paper":
            lines.append(f"\n{fast} is slower than paper: {', '.join(slower)}.")
    return "\n".join(lines)


def ablations(paths, benches):
    for path, bench in zip(paths, benches, strict=True):
        print(f"<!-- {path}: {bench['device']['name']}, {bench['date']} -->\n")
        for size in bench["sizes"]:
            print(times(bench, size) + "\n")
        print(qualities(bench) + "\n")
        if "rates" in bench:
            for size in bench["sizes"]:
                print(floors(size, {"baseline", "+ fast exp = paper", "paper", "turbo"}) + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", metavar="BENCH.json")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--orthogonality", action="store_true", help="two files: the whole scene, then the pruned one")
    kind.add_argument("--scaling", action="store_true", help="scenes of several sizes")
    parser.add_argument("--audit", help="rgs-audit SCENE PRUNED --json, for --orthogonality")
    options = parser.parse_args()
    benches = [load(path) for path in options.files]
    if options.orthogonality:
        if len(benches) != 2:
            parser.error("--orthogonality takes two files")
        print(orthogonality(*benches, load(options.audit) if options.audit else None))
    elif options.scaling:
        print(scaling(benches))
    else:
        ablations(options.files, benches)


if __name__ == "__main__":
    main()
