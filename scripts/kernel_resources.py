#!/usr/bin/env python3
"""What each kernel takes of a multiprocessor, by architecture: registers, spilled bytes, shared memory.

    python3 scripts/kernel_resources.py [--build build/cuda] [--architectures 75,80,86,89,90,100,120] [--json FILE]

Compiles every .cu file of kernels/ with the flags of the build folder (preset cuda, configured is enough) and prints ptxas'
report as a table in Markdown. Exit code 1 if a kernel spills more than 32 bytes a thread, has more than 48 KiB of static shared
memory, or any dynamic; 2 if something does not compile.
"""
# SPDX-License-Identifier: Apache-2.0
import argparse
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
ENTRY = re.compile(r"Compiling entry function '(\w+)' for 'sm_(\d+)'")
SPILL = re.compile(r"(\d+) bytes spill stores, (\d+) bytes spill loads")
USED = re.compile(r"Used (\d+) registers")
SHARED = re.compile(r"(\d+) bytes smem")


def compile_command(command, architecture):
    """nvcc's arguments for one architecture, without an output: a cubin that nobody keeps."""
    kept, arguments = [], iter(shlex.split(command))
    for argument in arguments:
        if argument in ("-c", "-x"):
            argument == "-x" and next(arguments)
        elif argument in ("-o", "-MF", "-MT"):
            next(arguments)
        elif not argument.startswith(("--generate-code", "-gencode", "--compress-mode", "-MD")):
            kept.append(argument)
    return kept + ["-cubin", f"-arch=sm_{architecture}", "-Xptxas", "-v", "-o", os.devnull]


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
        plain[name] = text
    return plain


def dynamic_shared(files):
    """Sources beside these files, headers included, that leave the size of their shared memory to the launch."""
    folders = {file[: file.index("/kernels/src/") + len("/kernels/src/")] for file in files}
    sources = sorted(s for folder in folders for s in Path(folder).rglob("*.cu*"))
    return [s for s in sources if re.search(r"\bextern\s+__shared__", s.read_text())]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--build", type=Path, default=Path("build/cuda"))
    parser.add_argument("--architectures", default="75,80,86,89,90,100,120")
    parser.add_argument("--json", type=Path, help="the same figures for programs")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    options = parser.parse_args()
    database = options.build / "compile_commands.json"
    if not database.is_file():
        print(f"{database} is missing: cmake --preset cuda -B {options.build}", file=sys.stderr)
        return 2
    units = {}
    for unit in json.loads(database.read_text()):
        # One target's: that of other cells compiles some files a second time.
        if "/kernels/src/" in unit["file"] and unit["file"].endswith(".cu") and "other_cells" not in unit["command"]:
            units.setdefault(unit["file"], unit)
    architectures = [int(a) for a in options.architectures.split(",")]

    def report_of(job):
        unit, architecture = job
        done = subprocess.run(compile_command(unit["command"], architecture), cwd=unit["directory"], text=True,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        if done.returncode != 0:
            print(f"{unit['file']} for sm_{architecture}:\n{done.stdout}", file=sys.stderr)
        return job, done

    jobs = [(unit, architecture) for unit in units.values() for architecture in architectures]
    table, failed = {}, not jobs
    with ThreadPoolExecutor(options.jobs) as pool:
        for (unit, architecture), done in pool.map(report_of, jobs):
            failed = failed or done.returncode != 0
            for name, registers, spilled, shared in kernels_in(done.stdout):
                # An anonymous namespace is named after a hash that differs between compilations.
                key = (Path(unit["file"]).name, re.sub(r"\d+_GLOBAL__N__[0-9a-f]+_\d+_\w+?_[0-9a-f]{8}", "", name))
                if "3rgs" in name:
                    entry = table.setdefault(key, {"name": name, "by": {}})
                    entry["by"][architecture] = (registers, spilled, shared)
    if failed or not table:
        return 2

    names = demangled([entry["name"] for entry in table.values()])
    rows = sorted((file, names[entry["name"]], entry["by"]) for (file, _), entry in table.items())
    rows = [row for row in rows if not row[1].startswith("cub::")]  # CUB's own, of our types
    print("Registers and bytes of shared memory; + bytes that are spilled.\n")
    print("| file | kernel | " + " | ".join(f"sm_{a}" for a in architectures) + " |")
    print("|---|---|" + "---|" * len(architectures))
    wrong = [f"{file} has shared memory of a size that only its launch knows" for file in dynamic_shared(units)]
    for file, kernel, by in rows:
        cells = []
        for architecture in architectures:
            registers, spilled, shared = by[architecture]
            cells.append(f"{registers}, {shared}" + (f" + {spilled}" if spilled else ""))
            if spilled > MOST_SPILLED_BYTES:
                wrong.append(f"{kernel} spills {spilled} bytes on sm_{architecture}")
            if shared > MOST_SHARED_BYTES:
                wrong.append(f"{kernel} has {shared} bytes of shared memory on sm_{architecture}")
        print(f"| {file} | `{kernel}` | " + " | ".join(cells) + " |")
    if options.json:
        options.json.write_text(json.dumps(
            [{"file": file, "kernel": kernel, "architecture": a, "registers": by[a][0], "spilled_bytes": by[a][1],
              "shared_bytes": by[a][2]} for file, kernel, by in rows for a in architectures], indent=1) + "\n")
    for line in wrong:
        print(line, file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
