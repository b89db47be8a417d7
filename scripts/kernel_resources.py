#!/usr/bin/env python3
"""What each kernel takes of a multiprocessor, by architecture: registers, spilled bytes, shared memory, resident warps.

    python3 scripts/kernel_resources.py [--build build/cuda] [--architectures 75,80,86,89,90,100,120] [--ptx 75]

Compiles every .cu file of kernels/ with the flags of the build folder (preset cuda, configured is enough) and prints a
table in Markdown; with --ptx what a driver makes of that architecture's PTX. Exit code 1 if a kernel spills more than
32 bytes a thread, has more than 48 KiB of static shared memory, or any dynamic; 2 if something does not compile.
"""
# SPDX-License-Identifier: Apache-2.0
import argparse
import functools
import itertools
import json
import os
import re
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

MOST_SHARED_BYTES = 48 * 1024
MOST_SPILLED_BYTES = 32
# Of a multiprocessor: warps, blocks, KiB of shared memory (CUDA C++ Programming Guide, "Technical Specifications per
# Compute Capability"). Registers and shared memory are dealt out as in cuda_occupancy.h, which the toolkit has.
LIMITS = {75: (32, 16, 64), 80: (64, 32, 164), 86: (48, 16, 100), 89: (48, 24, 100), 90: (64, 32, 228),
          100: (64, 32, 228), 120: (48, 24, 100)}
REGISTERS, PARTITIONS = 65536, 4
ENTRY = re.compile(r"Compiling entry function '(\w+)' for 'sm_(\d+)'")
SPILL = re.compile(r"(\d+) bytes spill stores, (\d+) bytes spill loads")
USED = re.compile(r"Used (\d+) registers")
SHARED = re.compile(r"(\d+) bytes smem")
THREADS = re.compile(r"\.entry (\w+)\([^{]*?\.maxntid (\d+)")
# An anonymous namespace is named after a hash that differs between compilations.
SPACE = re.compile(r"\d+_GLOBAL__N__[0-9a-f]+_\d+_\w+?_[0-9a-f]{8}")


def resident_warps(architecture, threads, registers, shared):
    """Warps of blocks of so many threads that a multiprocessor holds at a time. `shared`: bytes a block, static."""
    most_warps, most_blocks, kib = LIMITS[architecture]
    warps = -(-threads // 32)
    of_warp = -(-32 * registers // 256) * 256
    by_registers = REGISTERS // PARTITIONS // of_warp * PARTITIONS // warps if of_warp else most_blocks
    unit, reserved = (256, 0) if architecture < 80 else (128, 1024)
    of_block = -(-(shared + reserved) // unit) * unit
    by_shared = kib * 1024 // of_block if of_block else most_blocks
    return warps * min(most_blocks, most_warps // warps, by_registers, by_shared)


def compile_command(command, virtual, *output):
    """nvcc's arguments for one virtual architecture, with another output."""
    kept, arguments = [], iter(shlex.split(command))
    for argument in arguments:
        if argument in ("-c", "-x"):
            argument == "-x" and next(arguments)
        elif argument in ("-o", "-MF", "-MT"):
            next(arguments)
        elif not argument.startswith(("--generate-code", "-gencode", "--compress-mode", "-MD")):
            kept.append(argument)
    return kept + [f"-arch=compute_{virtual}", *output]


def kernels_in(report):
    """(mangled name, registers, spilled bytes, shared bytes) of each kernel of ptxas' report."""
    name = spilled = None
    for line in report.splitlines():
        if found := ENTRY.search(line):
            name, spilled = found[1], 0
        elif name and (found := SPILL.search(line)):
            spilled = max(int(found[1]), int(found[2]))
        elif name and (found := USED.search(line)):
            shared = SHARED.search(line)
            yield name, int(found[1]), spilled, int(shared[1]) if shared else 0
            name = None


def demangled(names):
    """Kernel names without namespaces, return types and parameters."""
    out = subprocess.run(["c++filt"], input="\n".join(names), capture_output=True, text=True, check=True).stdout
    plain = {}
    for name, text in zip(names, out.splitlines()):
        text = text.replace("(anonymous namespace)::", "").replace("rgs::", "").replace("cuda::", "").replace("math::", "")
        text = re.sub(r"_GLOBAL__N__\w+::", "", text).removeprefix("void ")
        depth = 0
        for at, letter in enumerate(text):
            depth += {"<": 1, ">": -1}.get(letter, 0)
            if letter == "(" and depth == 0 and at > 0:
                text = text[:at]
                break
        plain[name] = re.sub(r"\((\w+)\)(\d+)", lambda cast: enumerators()[cast[1]][int(cast[2])], text)
    return plain


@functools.cache
def enumerators():
    """Names of the values of the enumerations that kernels are templates of."""
    text = re.sub(r"//.*", "", (Path(__file__).parents[1] / "kernels/math/include/rgs/math/options.hpp").read_text())
    declared = re.findall(r"enum class (\w+)[^{]*\{([^}]*)\}", text)
    return {name: re.findall(r"\w+", values) for name, values in declared}


def merged(rows):
    """Rows (arguments, shared bytes, cells) of a template, together where only shared bytes and an argument differ."""
    rows = [(tuple({a} for a in arguments), {shared}, cells) for arguments, shared, cells in rows]
    every = [set().union(*values) for values in zip(*(arguments for arguments, _, _ in rows))]
    for at in range(len(every)):
        together = {}
        for arguments, shared, cells in rows:
            key = (str([sorted(a) for k, a in enumerate(arguments) if k != at]), cells)
            if key in together:
                together[key][0][at].update(arguments[at])
                together[key][1].update(shared)
            else:
                together[key] = (arguments, shared, cells)
        rows = list(together.values())
    for arguments, shared, cells in rows:
        named = ["any" if len(a) > 1 and a == all_of else " or ".join(sorted(a)) for a, all_of in zip(arguments, every)]
        yield f"<{', '.join(named)}>" if named else "", shared, cells


def dynamic_shared(files):
    """Sources beside these files, headers included, that leave the size of their shared memory to the launch."""
    folders = {file[: file.index("/kernels/src/") + len("/kernels/src/")] for file in files}
    sources = sorted(s for folder in folders for s in Path(folder).rglob("*.cu*"))
    return [s for s in sources if re.search(r"\bextern\s+__shared__", s.read_text())]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--build", type=Path, default=Path("build/cuda"))
    parser.add_argument("--architectures", default="75,80,86,89,90,100,120")
    parser.add_argument("--ptx", type=int, help="compile for this architecture, and its PTX for the others")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    options = parser.parse_args()
    database = options.build / "compile_commands.json"
    if not database.is_file():
        print(f"{database} is missing: cmake --preset cuda -B {options.build}", file=sys.stderr)
        return 2
    architectures = [int(a) for a in options.architectures.split(",")]
    if unknown := [a for a in architectures if a not in LIMITS]:
        print(f"limits of {unknown} are missing: add them to LIMITS", file=sys.stderr)
        return 2
    units = {}
    for unit in json.loads(database.read_text()):
        # One target's: that of other cells compiles some files a second time.
        if "/kernels/src/" in unit["file"] and unit["file"].endswith(".cu") and "other_cells" not in unit["command"]:
            units.setdefault(unit["file"], unit)

    def report_of(job):
        unit, architecture = job
        virtual = options.ptx or architecture or architectures[0]
        output = ["-ptx", "-o", "/dev/stdout"]
        if architecture:
            output = [f"-code=sm_{architecture}", "-cubin", "-Xptxas", "-v", "-o", os.devnull]
        done = subprocess.run(compile_command(unit["command"], virtual, *output), cwd=unit["directory"], text=True,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        if done.returncode != 0:
            print(f"{unit['file']} for {virtual}:\n{done.stdout}", file=sys.stderr)
        return job, done

    # PTX, which has the number of threads, then each architecture.
    jobs = [(unit, architecture) for unit in units.values() for architecture in [None, *architectures]]
    table, threads, failed = {}, {}, not jobs
    with ThreadPoolExecutor(options.jobs) as pool:
        for (unit, architecture), done in pool.map(report_of, jobs):
            failed = failed or done.returncode != 0
            if architecture is None:
                for name, n in THREADS.findall(done.stdout):
                    threads[unit["file"], SPACE.sub("", name)] = int(n)
            for name, *resources in kernels_in(done.stdout):
                if "3rgs" in name:
                    entry = table.setdefault((unit["file"], SPACE.sub("", name)), {"name": name, "by": {}})
                    entry["by"][architecture] = resources
    if failed or not table:
        return 2

    names = demangled([entry["name"] for entry in table.values()])
    wrong = [f"{file} has shared memory of a size that only its launch knows" for file in dynamic_shared(units)]
    rows = []
    for key, entry in table.items():
        kernel = names[entry["name"]]
        if kernel.startswith("cub::"):  # CUB's own, of our types
            continue
        cells = []
        for architecture in architectures:
            registers, spilled, shared = entry["by"][architecture]
            cells.append(str(registers) + (f" + {spilled}" if spilled else ""))
            if key in threads:
                cells[-1] += f", {resident_warps(architecture, threads[key], registers, shared)}"
            if spilled > MOST_SPILLED_BYTES:
                wrong.append(f"{kernel} spills {spilled} bytes on sm_{architecture}")
            if shared > MOST_SHARED_BYTES:
                wrong.append(f"{kernel} has {shared} bytes of shared memory on sm_{architecture}")
        most_shared = max(shared for _, _, shared in entry["by"].values())
        name, _, arguments = kernel.rstrip(">").partition("<")
        place = (Path(key[0]).name, name, threads.get(key, "any"))
        rows.append((place, (tuple(filter(None, arguments.split(", "))), most_shared, " | ".join(cells))))
    rows.sort(key=lambda row: (str(row[0]), row[1]))
    print("Block: threads, bytes of shared memory. Below an architecture and the most warps that are resident there:\n"
          "registers + bytes that are spilled, resident warps.\n")
    print("| file | kernel | block | " + " | ".join(f"sm_{a}: {LIMITS[a][0]}" for a in architectures) + " |")
    print("|---|---|---|" + "---|" * len(architectures))
    for (file, name, n), group in itertools.groupby(rows, key=lambda row: row[0]):
        for arguments, shared, cells in merged([row for _, row in group]):
            span = " to ".join(str(s) for s in sorted({min(shared), max(shared)}))
            print(f"| {file} | `{name}{arguments}` | {n}, {span} | {cells} |")
    for line in wrong:
        print(line, file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
