#!/usr/bin/python3
# measure_workers.py - the gain of a second worker: the Snakefile on many small scenes with one job at a time, and with
# two.
# usage: RGS_BIN=build/release/bin python3 tests/cluster/measure_workers.py [--scenes 100] [--gaussians 20k] [--audit=OPTIONS]
# Ideal is half the time. "programs": time that rgs-convert and rgs-audit ran. "busy": their share of workers x wall
# time. On a shared machine, look at CPU: with two cores the second worker gains at most 2 x programs / (programs + the
# rest).
# SPDX-License-Identifier: Apache-2.0
import argparse
import os
import resource
import subprocess
import tempfile
import time

ROOT = os.path.realpath(os.path.join(os.path.dirname(__file__), "../.."))
SCENES = f"{ROOT}/samples/cluster/scenes"


def timed_programs(folder, programs, record):
    """Wrappers that record how long the programs run."""
    os.makedirs(folder)
    for name in ("rgs-convert", "rgs-audit"):
        with open(f"{folder}/{name}", "w", encoding="utf-8") as file:
            file.write(f'#!/bin/bash\n[ "$1" = --version ] && exec {programs}/{name} "$@"\nexec 3>>{record}\n'
                       f'TIMEFORMAT="%R %U %S"\n{{ time {programs}/{name} "$@" 2>&4; }} 4>&2 2>&3\n')
        os.chmod(f"{folder}/{name}", 0o755)


def run(workers, folder, out, arguments, environment):
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run(["snakemake", "--snakefile", f"{SCENES}/Snakefile", "--profile", f"{SCENES}/profiles/local", "--quiet",
                    "--cores", str(workers), "--config", f"out={out}", "max_threads=1", "fail_below=", f"audit={arguments.audit}"],
                   cwd=folder, env=environment, check=True, stderr=subprocess.DEVNULL)
    wall, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--gaussians", default="20k")
    parser.add_argument("--audit", default="--size 640x360")
    arguments = parser.parse_args()
    programs = os.path.realpath(os.environ.get("RGS_BIN", f"{ROOT}/build/release/bin"))
    with tempfile.TemporaryDirectory() as folder:
        os.makedirs(f"{folder}/scenes")
        for i in range(arguments.scenes):
            subprocess.run([f"{programs}/rgs-make-scene", "--quiet", "--no-sync", "--seed", str(i), "--gaussians",
                            arguments.gaussians, f"{folder}/scenes/{i:04}.ply"], check=True)
        walls = {}
        for workers in (1, 2):
            record = f"{folder}/record-{workers}"
            timed_programs(f"{folder}/bin-{workers}", programs, record)
            environment = dict(os.environ, PATH=f"{folder}/bin-{workers}:{os.environ['PATH']}")
            load = os.getloadavg()[0]
            wall, cpu = run(workers, folder, f"results-{workers}", arguments, environment)
            with open(record, encoding="utf-8") as file:
                busy, user, system = map(sum, zip(*(map(float, line.split()) for line in file)))
            walls[workers] = wall
            print(f"{workers} worker{'s' if workers > 1 else ''}: wall {wall:.1f} s, programs {busy:.1f} s, busy "
                  f"{busy / wall / workers:.1%}; CPU: programs {user + system:.1f} s, the rest "
                  f"{cpu - user - system:.1f} s; load before {load:.1f}", flush=True)
        print(f"{arguments.scenes} scenes: {walls[1] / walls[2]:.2f} times as fast, {walls[1] / walls[2] / 2:.1%} of ideal")


if __name__ == "__main__":
    main()
