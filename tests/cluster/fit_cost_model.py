#!/usr/bin/python3
# fit_cost_model.py - fits each step's cost per Gaussian to measure_city.py's JSON, and predicts runs on many nodes.
# usage: python3 tests/cluster/fit_cost_model.py measured.json [--disk-gb-s 1.0] [--shared-gb-s 10] [--cores 16] [--without-moves]
# A step's CPU is fixed (per job) plus linear (per million Gaussians), by least squares weighted by one over CPU: the
# largest scene counts most, because predictions go beyond it. A run is the sum of its serial steps (begin, plan,
# assemble) and its parallel ones (scan, place, build); each takes the longer of its CPU time and its bytes over the
# disk's rate. The tables state the assumptions.
# SPDX-License-Identifier: Apache-2.0
import argparse
import json

SERIAL = ("begin", "plan", "assemble")
STRETCH = 1_572_864


def fit(points):
    """[(millions, jobs, seconds)] to seconds per job and per million, neither negative."""
    best = None
    for weights in ((1, 1), (0, 1), (1, 0)):
        # Weighted normal equations of y = a * jobs + b * millions.
        aa = ab = bb = ay = by = 0.0
        for millions, jobs, y in points:
            w = 1 / max(y, 1e-3)
            j, m = jobs * weights[0], millions * weights[1]
            aa, ab, bb, ay, by = aa + w * j * j, ab + w * j * m, bb + w * m * m, ay + w * j * y, by + w * m * y
        if weights == (1, 1):
            det = aa * bb - ab * ab
            if det <= 1e-12:
                continue
            a, b = (ay * bb - by * ab) / det, (by * aa - ay * ab) / det
        else:
            a, b = (ay / aa if aa else 0), (by / bb if bb else 0)
        if a < 0 or b < 0:
            continue
        error = sum((a * j + b * m - y) ** 2 / max(y, 1e-3) for m, j, y in points)
        if best is None or error < best[2]:
            best = (a, b, error)
    millions, jobs, y = points[-1]
    return best[0], best[1], abs(best[0] * jobs + best[1] * millions - y) / max(y, 1e-3)


def jobs_of(step, run):
    """Jobs with work to do: a range has at least one stretch."""
    jobs = run["steps"][step]["jobs"]
    return min(jobs, -(-run["gaussians"] // STRETCH)) if step == "build" else jobs


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("measured")
    parser.add_argument("--disk-gb-s", type=float, default=1.0, help="of one process to the shared disk")
    parser.add_argument("--shared-gb-s", type=float, default=10.0, help="of all together")
    parser.add_argument("--cores", type=int, default=16, help="of a node")
    parser.add_argument("--tile-millions", type=float, default=10, help="of a tile")
    parser.add_argument("--without-moves", action="store_true",
                        help="tiles are where they belong: no --translate, for which begin reads them (measure_city.py gives it)")
    arguments = parser.parse_args()
    with open(arguments.measured, encoding="utf-8") as file:
        measured = json.load(file)
    runs = [run for run in measured["runs"] if run["workers"] == min(r["workers"] for r in measured["runs"])]
    print(f"{measured['processor']}, commit {measured['commit']}, {len(runs)} runs of "
          f"{', '.join(str(run['gaussians'] / 1e6) for run in runs)} M, degree {runs[0]['degree']}")
    model, written = {}, {}
    print("\n| step | jobs | s of CPU a job | s of CPU a million | bytes a Gaussian | error at the largest |\n|---|---|---|---|---|---|")
    for step in runs[0]["steps"]:
        points = [(run["gaussians"] / 1e6, jobs_of(step, run), run["steps"][step]["cpu_s"]) for run in runs]
        a, b, error = fit(points)
        if step == "begin" and arguments.without_moves:
            b = 0.0
        model[step], written[step] = (a, b), runs[-1]["steps"][step]["bytes"] / runs[-1]["gaussians"]
        jobs = "one" if step in SERIAL else "tiles" if step in ("scan", "place") else "ranges"
        print(f"| {step} | {jobs} | {a:.3f} | {b:.3f} | {written[step]:.1f} | {error:.0%} |")
    source = runs[-1]["source_bytes"] / runs[-1]["gaussians"]
    moved = {"scan": source, "place": source + written["place"], "build": written["place"] + written["build"],
             "assemble": written["build"] + written["assemble"], "begin": 0, "plan": written["scan"]}
    print(f"\nDisk {arguments.disk_gb_s:g} GB/s a process, {arguments.shared_gb_s:g} GB/s in all; nodes of {arguments.cores} "
          f"cores; tiles of {arguments.tile_millions:g} M")
    print("\n| Gaussians | nodes | scan | place | build | one process | in all | longest |\n|---|---|---|---|---|---|---|---|")
    for billions in (1, 10, 100):
        for nodes in (16, 64, 256, 1024):
            millions, cores = billions * 1e3, nodes * arguments.cores
            seconds = {}
            for step, (a, b) in model.items():
                pieces = {"scan": millions / arguments.tile_millions, "place": millions / arguments.tile_millions,
                          "build": millions * 1e6 / STRETCH}.get(step, 1)
                side_by_side = 1 if step in SERIAL else min(cores, max(1, pieces))
                rounds = -(-pieces // side_by_side) if step not in SERIAL else 1  # whole jobs
                cpu = rounds * (a + b * millions / pieces)
                disk = moved[step] * millions / 1e3 / min(arguments.shared_gb_s, arguments.disk_gb_s * side_by_side)
                seconds[step] = (max(cpu, disk), "CPU" if cpu >= disk else "disk")
            alone = sum(seconds[step][0] for step in SERIAL)
            total = sum(s for s, _ in seconds.values())
            longest = max(seconds, key=lambda step: seconds[step][0])
            print(f"| {billions} G | {nodes} | {seconds['scan'][0]:.0f} | {seconds['place'][0]:.0f} | {seconds['build'][0]:.0f} | "
                  f"{alone:.0f} | {total:.0f} s | {longest} ({seconds[longest][1]}) |")


if __name__ == "__main__":
    main()
