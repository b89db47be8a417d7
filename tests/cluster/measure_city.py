#!/usr/bin/python3
# measure_city.py - CPU, peak memory and bytes of each step of one scene by many processes, for several sizes, as JSON
# for fit_cost_model.py; and the gain of a second worker.
# usage: RGS_BIN=build/release/bin python3 tests/cluster/measure_city.py --gaussians 1M 2M [--degree 0] [--tiles 4] [--ranges 4]
#        [--memory 2GiB] [--workers 1 2] [--folder DIR] --out measured.json
# Every process has one thread. On a shared machine wall times, and the gain with them, mean little; CPU seconds grow
# somewhat as well.
# SPDX-License-Identifier: Apache-2.0
import argparse
import concurrent.futures
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time

ROOT = os.path.realpath(os.path.join(os.path.dirname(__file__), "../.."))
BIN = os.path.realpath(os.environ.get("RGS_BIN", f"{ROOT}/build/release/bin"))


def count_of(text):
    return int(float(text[:-1]) * {"k": 1e3, "M": 1e6, "G": 1e9}[text[-1]]) if text[-1] in "kMG" else int(text)


def run(arguments, folder):
    began = time.monotonic()
    child = subprocess.Popen([f"{BIN}/rgs-convert", *arguments, "--quiet", "--threads", "1"], cwd=folder, stdin=subprocess.DEVNULL)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    assert child.returncode == 0, arguments
    return {"user": used.ru_utime, "system": used.ru_stime, "wall": time.monotonic() - began, "peak_mb": used.ru_maxrss / 1024}


def bytes_of(folder, prefix):
    return sum(os.path.getsize(f"{folder}/city.work/{name}") for name in os.listdir(f"{folder}/city.work") if name.startswith(prefix))


def convert(folder, tiles, arguments, workers):
    """Each step's resources by process, and the wall time of all steps."""
    shutil.rmtree(f"{folder}/city.work", ignore_errors=True)
    memory = ["--memory", arguments.memory]
    moves = [word for i in range(len(tiles)) for word in ("--translate", f"{40 * (i % 8)},0,{40 * (i // 8)}")]
    each = [[str(i)] for i in range(len(tiles))]
    steps = [
        ("begin", "job", [["--lod-partition", "city.work", "--ranges", str(arguments.ranges), "--lod-input", "none", *moves, *tiles]]),
        ("scan", "scan.", [["--lod-partition", "city.work", "--lod-input", *i] for i in each]),
        ("plan", "plan", [["--lod-partition", "city.work", "--lod-input", "none"]]),
        ("place", "rows.", [["--lod-partition", "city.work", "--lod-input", *i] for i in each]),
        ("build", "range.", [["--lod-build", "city.work", "--lod-input", str(i)] for i in range(arguments.ranges)]),
        ("assemble", "", [["--lod-assemble", "city.work", "city.rgs", "--overwrite"]]),
    ]
    out = {}
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        for name, prefix, commands in steps:
            began = time.monotonic()
            used = list(pool.map(lambda words: run([*words, *memory], folder), commands))
            out[name] = {"jobs": len(used), "cpu_s": sum(u["user"] + u["system"] for u in used),
                         "longest_cpu_s": max(u["user"] + u["system"] for u in used),
                         "peak_mb": max(u["peak_mb"] for u in used), "wall_s": time.monotonic() - began,
                         "bytes": bytes_of(folder, prefix) if prefix else os.path.getsize(f"{folder}/city.rgs")}
    return out


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--gaussians", nargs="+", default=["1M"])
    parser.add_argument("--degree", default="0")
    parser.add_argument("--tiles", type=int, default=4)
    parser.add_argument("--ranges", type=int, default=4)
    parser.add_argument("--memory", default="2GiB")
    parser.add_argument("--workers", type=int, nargs="+", default=[1])
    parser.add_argument("--folder")
    parser.add_argument("--out", required=True, help="written anew after each run")
    arguments = parser.parse_args()
    processor = next((line.split(":")[1].strip() for line in open("/proc/cpuinfo", encoding="utf-8") if "model name" in line),
                     platform.processor())
    commit = subprocess.run(["git", "-C", ROOT, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    runs = []
    for size in arguments.gaussians:
        n = count_of(size)
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            tiles = [f"{i}.ply" for i in range(arguments.tiles)]
            for i, tile in enumerate(tiles):
                subprocess.run([f"{BIN}/rgs-make-scene", "--quiet", "--no-sync", "--seed", str(i), "--gaussians",
                                str(n // arguments.tiles), "--degree", arguments.degree, f"{folder}/{tile}"], check=True)
            source = sum(os.path.getsize(f"{folder}/{tile}") for tile in tiles)
            for workers in arguments.workers:
                load = os.getloadavg()[0]
                steps = convert(folder, tiles, arguments, workers)
                wall = sum(step["wall_s"] for step in steps.values())
                runs.append({"gaussians": n, "degree": int(arguments.degree), "workers": workers, "source_bytes": source,
                             "load_before": load, "wall_s": wall, "steps": steps})
                print(f"{size}, {workers} workers: wall {wall:.1f} s, CPU {sum(s['cpu_s'] for s in steps.values()):.1f} s, peak "
                      f"{max(s['peak_mb'] for s in steps.values()):.0f} MB, load before {load:.1f}", file=sys.stderr, flush=True)
                with open(arguments.out, "w", encoding="utf-8") as file:
                    json.dump({"processor": processor, "commit": commit.stdout.strip(), "ranges": arguments.ranges,
                               "tiles": arguments.tiles, "memory": arguments.memory, "runs": runs}, file, indent=1)
                    file.write("\n")


if __name__ == "__main__":
    main()
