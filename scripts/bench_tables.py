#!/usr/bin/env python3
# bench_tables.py - Markdown tables from what the benchmarks wrote with --json, and from the records made of it.
# SPDX-License-Identifier: Apache-2.0
"""bench_tables.py BENCH.json...                                           ablation, quality and floors
bench_tables.py --orthogonality FULL.json PRUNED.json [--audit AUDIT.json] pruning and turbo, alone and together
bench_tables.py --scaling BENCH.json...                                    scenes of several sizes
bench_tables.py docs/records/RECORD.json...                                the tables that the records name
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
    """In millions."""
    return f"{n / 1e6:,.{0 if n >= 1e8 else 1 if n >= 1e7 else 2}f}"


def quality_of(bench, mode):
    quality = next(m for m in bench["modes"] if m["name"] == mode).get("quality") or {}
    if quality.get("psnr") is None:
        return ["", "", "", ""]
    loss = quality.get("photo_loss")
    return [f"{quality['psnr']:.2f}", f"{quality['worst_psnr']:.2f}", f"{quality['largest_difference']:.3f}",
            "" if loss is None else f"{loss:.4f}"]


def times(size):
    stages = ["project", "bin", "sort", "blend"]
    view = f"{size['view']}, " if "view" in size else ""
    head = [f"{view}{size['width']}x{size['height']}, ms", *stages, "total", "speed-up", "pairs, M",
            "evaluated, M", "moved, MB", "peak memory, MB"]
    rows = []
    for r in size["results"]:
        rows.append([r["mode"], *(f"{r['stages'][s]['ms']:.3f}" for s in stages), f"{r['total_ms']:.3f}",
                     f"{r['speedup']:.2f}", count(r["instances"]), count(r["evaluated"]), f"{r['bytes'] / 1e6:,.0f}",
                     f"{r['peak_bytes'] / 1e6:,.0f}"])
    return table(head, rows)


def qualities(bench):
    head = ["", "PSNR, dB", "worst view", "largest error", "loss against photographs, dB"]
    return table(head, [[m["name"], *quality_of(bench, m["name"])] for m in bench["modes"] if m["name"] != "baseline"])


def floors(size, modes):
    head = [f"{size['width']}x{size['height']}", "stage", "ms", "floor, ms", "limit", "time / floor"]
    rows = []
    for r in size["results"]:
        if r["mode"] not in modes:
            continue
        for name, s in r["stages"].items():
            if s["floor_ms"] < 1e-4:
                continue  # nothing that the cost model counts
            rows.append([r["mode"] if name == "project" else "", name, f"{s['ms']:.3f}", f"{s['floor_ms']:.3f}", s["limit"],
                         f"{s['time_over_floor']:.2f}"])
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
            f"visible, {fast}, M", f"peak memory, {fast}, MB"]
    rows = []
    for bench in benches:
        n = bench["scene"]["gaussians"]
        for size in bench["sizes"]:
            results = {r["mode"]: r for r in size["results"]}
            last = results[fast]
            rows.append([f"{n / 1e6:.3g} M" if size is bench["sizes"][0] else "", f"{size['width']}x{size['height']}",
                         f"{results[modes[0]]['total_ms']:.3f}",
                         *(f"{results[m]['total_ms']:.3f} ({results[m]['speedup']:.1f}x)" for m in modes[1:]),
                         count(last["visible"]), f"{last['peak_bytes'] / 1e6:,.0f}"])
    lines = [f"{benches[0]['device']['name']}, {benches[0]['date']}; {benches[0]['frames']} frames a camera, "
             f"{benches[0]['cameras']} cameras.\n", table(head, rows)]
    for bench in benches:
        n = bench["scene"]["gaussians"]
        slower = [f"{n / 1e6:.3g} M at {s['width']}x{s['height']}" for s in bench["sizes"]
                  if "paper" in rates(s) and rates(s)[fast] > rates(s)["paper"]]
        if slower and fast != "paper":
            lines.append(f"\n{fast} is slower than paper: {', '.join(slower)}.")
    return "\n".join(lines)


def stress(benches):
    rows = []
    for size in (size for bench in benches for size in bench["sizes"]):
        paper, turbo = (next(r for r in size["results"] if r["mode"] == mode) for mode in ("paper", "turbo"))
        rows.append([size["view"], f"{size['width']}x{size['height']}", f"{paper['total_ms']:.3f}", f"{turbo['total_ms']:.3f}",
                     f"{paper['total_ms'] / turbo['total_ms']:.2f}"])
    return table(["view", "image", "paper, ms", "turbo, ms", "ratio"], rows)


def towns(benches):
    """Scenes with levels of detail: what is drawn, and how fast."""
    rows = []
    for bench in benches:
        for size in bench["sizes"]:
            paper, turbo = (next(r for r in size["results"] if r["mode"] == mode) for mode in ("paper", "turbo"))
            n = bench["scene"]["gaussians"]
            rows.append([f"{n / 1e6:.0f} M", f"{bench['detail_px']:g}", f"{size['width']}x{size['height']}",
                         f"{turbo['gaussians'] / n:.2f}", count(turbo["visible"]), f"{turbo['total_ms']:.2f}",
                         f"{paper['total_ms']:.2f}", f"{turbo['peak_bytes'] / 1e9:.1f}"])
    return table(["town", "detail", "image", "drawn", "visible, M", "turbo, ms", "paper, ms", "device memory, GB"], rows)


def flights(runs):
    """rgs-bench-flight: the frames of a flight."""
    rows = []
    for run in runs:
        flight = run.get("flight")
        if not flight:
            continue
        compared = flight.get("compared")
        rows.append([run["name"], f"{flight['render_ms_median']:.2f}, {flight['render_ms_p99']:.2f}",
                     f"{flight['frames_late']} of {flight['frames_drawn']}", f"{flight['detail_px_median']:.1f}",
                     f"{compared['equal']} of {compared['pictures']}" if compared else "",
                     f"{flight['read_bytes_per_second'] / 1e6:.0f}, {flight['decoded_bytes_per_second'] / 1e6:.0f}",
                     f"{run['driver_bytes'] / 1e9:.2f}, {flight['workspace_bytes'] / 1e9:.2f}"])
    return table(["", "a frame, median and 99 of 100, ms", "late", "detail, median, px", "equal to complete pictures",
                  "read and decoded, MB/s", "device memory and workspace, GB"], rows)


def arrivals(runs):
    """rgs-bench-flight: how soon the pictures of an opening and of jumps are good."""
    def ms(value):
        return "-" if value is None else f"{value:.0f}"

    rows, steps = [], ["ms_to_35_db", "ms_to_40_db", "ms_to_complete"]
    for run in runs:
        start, jumps = run["opening"], run.get("teleports") or []
        slowest = {key: max((jump[key] for jump in jumps if jump[key] is not None), default=None) for key in ["first_ms", *steps]}
        worst = min((jump["first_psnr"] for jump in jumps if jump["first_psnr"] is not None), default=None)
        rows.append([run["name"], ms(start["first_ms"]), f"{start['first_bytes_read'] / 1e3:.0f}",
                     ", ".join(ms(start[key]) for key in steps), ms(slowest["first_ms"]) if jumps else "",
                     "" if worst is None else f"{worst:.1f}", ", ".join(ms(slowest[key]) for key in steps) if jumps else ""])
    return table(["", "first picture, ms", "read for it, kB", "35 dB, 40 dB, complete, ms", "first picture of a jump, ms", "worst, dB",
                  "jump: 35 dB, 40 dB, complete, ms"], rows)


def decoded(runs):
    """rgs-bench-flight: how soon openings are complete and how much was decoded until then, by name and commit."""
    commits = list(dict.fromkeys(run["commit"] for run in runs))
    rows = []
    for name in dict.fromkeys(run["name"] for run in runs):
        rows.append([name])
        for commit in commits:
            same = [run["opening"] for run in runs if (run["name"], run["commit"]) == (name, commit)]
            rows[-1] += [", ".join(f"{o['ms_to_complete']:.0f}" for o in same),
                         ", ".join(f"{o['bytes_decoded'] / o['ms_to_complete'] / 1e6:.1f}" for o in same)]
    return table(["", *(head for commit in commits for head in (f"complete, ms ({commit})", "decoded, GB/s"))], rows)


def each_size(one):
    return lambda benches: "\n\n".join(one(size) for bench in benches for size in bench["sizes"])


# Tables that a record may name: how it is made, and what of a report it needs, which is all that shrink_record.py keeps.
RUN = "name commit date device.name backend scene.gaussians cameras frames modes.name "
SIZE = RUN + "sizes.view sizes.width sizes.height " + " ".join(f"sizes.results.{key}" for key in ("mode", "total_ms", "speedup")) + " "
FLIGHT = RUN + "processors width height fps detail_px cold device_memory "
STAGES = [f"sizes.results.stages.{stage}." for stage in ("project", "bin", "sort", "blend")]
ARRIVALS = ("first_ms", "first_bytes_read", "first_psnr", "ms_to_35_db", "ms_to_40_db", "ms_to_complete")


def within(prefixes, keys):
    return " ".join(prefix + key for prefix in prefixes for key in keys)


KINDS = {
    "times": (each_size(times),
              SIZE + within(["sizes.results."], ("instances", "evaluated", "bytes", "peak_bytes")) + " " + within(STAGES, ("ms",))),
    "quality": (lambda benches: "\n\n".join(map(qualities, benches)), RUN + "modes.quality"),
    "floors": (lambda benches: floors(benches[0]["sizes"][0], SHOWN),
               SIZE + "rates " + within(STAGES, ("ms", "floor_ms", "limit", "time_over_floor"))),
    "scaling": (scaling, SIZE + "sizes.results.visible sizes.results.peak_bytes"),
    "orthogonality": (lambda benches: orthogonality(*benches), SIZE + "scene.name modes.quality"),
    "stress": (stress, SIZE),
    "towns": (towns, SIZE + "detail_px " + within(["sizes.results."], ("gaussians", "visible", "peak_bytes"))),
    "flights": (flights, FLIGHT + "driver_bytes " + within(["flight."], (
        "frames_drawn", "render_ms_median", "render_ms_p99", "frames_late", "detail_px_median", "read_bytes_per_second",
        "decoded_bytes_per_second", "workspace_bytes", "compared.pictures", "compared.equal"))),
    "arrivals": (arrivals, FLIGHT + within(["opening.", "teleports."], ARRIVALS)),
    "decoded": (decoded, FLIGHT + "opening.ms_to_complete opening.bytes_decoded"),
    "flight_plot": (None, FLIGHT + within(["flight.frames."], ("render_ms", "detail_reached_px", "bytes_read"))),  # plot_flight.py
}
SHOWN = {"baseline", "+ fast exp = paper", "paper", "turbo"}


def tables(record):
    """Text of each table of a record."""
    return [KINDS[kind][0](record["runs"]) for kind in record["tables"] if KINDS[kind][0]]


def ablations(paths, benches):
    for path, bench in zip(paths, benches, strict=True):
        if "tables" in bench:
            print(f"<!-- {path} -->\n\n" + "\n\n".join(tables(bench)) + "\n")
            continue
        print(f"<!-- {path}: {bench['device']['name']}, {bench['date']} -->\n")
        for size in bench["sizes"]:
            print(times(size) + "\n")
        print(qualities(bench) + "\n")
        if "rates" in bench:
            for size in bench["sizes"]:
                print(floors(size, SHOWN) + "\n")


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
