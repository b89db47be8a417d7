#!/usr/bin/env python3
# bench_convert.py - time and memory of rgs-convert as a whole process, beside a peer program in the same run.
# SPDX-License-Identifier: Apache-2.0
"""Runs each command in turn, A B A B ..., and prints wall and CPU seconds and peak memory, with ratios to rgs-convert.

Anonymous memory (RssAnon), which leaves out pages of a mapped input, is sampled: the kernel keeps no peak of it.

  bench_convert.py scene.ply                                         # rgs-convert alone, both directions
  bench_convert.py scene.ply --peer 'splat-transform -w {input} {folder}/peer.compressed.ply'
  bench_convert.py --gaussians 20M                                   # on a generated scene
"""
import argparse
import json
import os
import pathlib
import shlex
import statistics
import subprocess
import sys
import tempfile
import time


def measure(command: list[str]) -> dict[str, float]:
    """Wall and CPU seconds, peak RssAnon and peak RSS in MB of one run."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    anonymous = 0
    status_file = f"/proc/{process.pid}/status"
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            break
        try:
            with open(status_file, encoding="ascii") as file:
                for line in file:
                    if line.startswith("RssAnon:"):
                        anonymous = max(anonymous, int(line.split()[1]))
        except OSError:
            pass
        time.sleep(0.002)
    wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        sys.exit(f"{shlex.join(command)}: exit {process.returncode}\n{process.stderr.read().decode()}")
    process.stderr.close()
    return {"wall_s": wall, "cpu_s": usage.ru_utime + usage.ru_stime, "anonymous_mb": anonymous / 1e3 * 1.024,
            "rss_mb": usage.ru_maxrss / 1e3 * 1.024}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", help="PLY to convert; default: a generated scene")
    parser.add_argument("--gaussians", default="1M", help="size of the generated scene")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--peer", help="command to compare with; {input} and {folder} are replaced")
    parser.add_argument("--bin", default="build/release/bin", help="folder of the programs")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    binaries = pathlib.Path(options.bin)
    with tempfile.TemporaryDirectory(prefix="rgs-bench-") as folder:
        scene = options.scene
        if scene is None:
            scene = f"{folder}/scene.ply"
            subprocess.run([binaries / "rgs-make-scene", "--quiet", "--no-sync", "--gaussians", options.gaussians, scene],
                           check=True)
        convert = [str(binaries / "rgs-convert"), "--quiet", "--no-sync", "--overwrite"]
        commands = {"ply to rgs": convert + [scene, f"{folder}/scene.rgs"],
                    "ply to direct": convert + ["--profile", "direct", scene, f"{folder}/direct.rgs"],
                    "rgs to ply": convert + [f"{folder}/scene.rgs", f"{folder}/back.ply"]}
        if options.peer:
            commands["peer"] = shlex.split(options.peer.format(input=scene, folder=folder))
        runs: dict[str, list[dict[str, float]]] = {name: [] for name in commands}
        for turn in range(options.runs + 1):  # the first warms the page cache
            for name, command in commands.items():
                for leftover in pathlib.Path(folder).glob("peer*"):
                    leftover.unlink()
                result = measure(command)
                if turn:
                    runs[name].append(result)
        with open(scene, "rb") as file:
            header = file.read(1 << 16).split(b"end_header")[0]
        gaussians = int(header.split(b"element vertex ")[1].split()[0])
    medians = {name: {key: statistics.median(run[key] for run in results) for key in results[0]}
               for name, results in runs.items()}
    own = medians["ply to rgs"]
    if options.json:
        print(json.dumps({"gaussians": gaussians, "runs": options.runs, "median": medians}, indent=2))
        return
    print(f"{scene}: {gaussians:,} Gaussians, median of {options.runs} runs, warm page cache")
    print(f"{'':14} {'wall s':>8} {'CPU s':>8} {'anonymous MB':>13} {'RSS MB':>8}  {'wall ratio':>10} {'RSS ratio':>10}")
    for name, m in medians.items():
        print(f"{name:14} {m['wall_s']:8.3f} {m['cpu_s']:8.3f} {m['anonymous_mb']:13.1f} {m['rss_mb']:8.1f}  "
              f"{m['wall_s'] / own['wall_s']:10.2f} {m['rss_mb'] / own['rss_mb']:10.2f}")
    bound = 64 + 48e-6 * gaussians
    print(f"anonymous memory bound 64 MB + 48 B per Gaussian: {bound:.1f} MB, "
          f"{'kept' if own['anonymous_mb'] <= bound else 'BROKEN'}")


if __name__ == "__main__":
    main()
