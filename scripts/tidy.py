#!/usr/bin/python3
# tidy.py - clang-tidy over the sources of BUILD's compile_commands.json: python3 scripts/tidy.py BUILD
# A file is not looked at again while its text, its headers, its command and the checks are those of a file that was found
# clean; $XDG_CACHE_HOME/roofgs/tidy remembers. The tests' macros are not worth the time, nor are the programs' own files:
# they hold arguments, and the argument parser's templates take minutes each. SPDX-License-Identifier: Apache-2.0
import functools
import hashlib
import json
import os
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SEEN = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "roofgs/tidy"
# One of Highway's instruction sets stands for all.
FLAGS = ["-DHWY_COMPILE_ONLY_STATIC"]
GLOBS = ["format/*.cpp", "runtime/*.cpp", "converter/*.cpp", "samples/*.cpp", ":!*/rgs_*.cpp"]


@functools.cache
def version():
    return subprocess.run(["clang-tidy", "--version"], check=True, capture_output=True).stdout


@functools.cache
def digest(path):
    return hashlib.sha256(Path(path).read_bytes()).digest()


def check(entry):
    """What clang-tidy says of a file; empty if that is nothing."""
    command = shlex.split(entry["command"])
    output = command.index("-o")
    command = [*command[:output], *FLAGS]
    listed = subprocess.run([*command, "-M", entry["file"]], cwd=entry["directory"], capture_output=True, text=True)
    if listed.returncode != 0:
        return f"{entry['file']}: {command[0]} ended with {listed.returncode}\n{listed.stderr}"
    state = hashlib.sha256(" ".join(command).replace(str(ROOT), "").encode() + version())
    state.update(digest(ROOT / ".clang-tidy") + digest(__file__))
    for header in listed.stdout.replace("\\\n", " ").split()[1:]:
        path = os.path.join(entry["directory"], header)
        state.update(path.replace(str(ROOT), "").encode() + digest(path))
    stamp = SEEN / state.hexdigest()
    if stamp.exists():
        return ""
    result = subprocess.run(["clang-tidy", "--quiet", entry["file"], "--", *command[1:]], cwd=entry["directory"],
                            capture_output=True, text=True)
    if result.returncode != 0:
        return f"{entry['file']}: clang-tidy ended with {result.returncode}\n{result.stdout}{result.stderr}"
    stamp.touch()
    return ""


def main():
    build = sys.argv[1]
    SEEN.mkdir(parents=True, exist_ok=True)
    ours = subprocess.run(["git", "ls-files", *GLOBS], cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()
    commands = json.loads(Path(build, "compile_commands.json").read_text())
    entries = {str(Path(entry["file"]).resolve()): entry for entry in reversed(commands)}  # the first: the library, then its portable twin
    chosen = [entries[file] for file in (f"{ROOT}/{name}" for name in ours) if file in entries]
    with ThreadPoolExecutor(int(os.environ.get("RGS_JOBS") or os.cpu_count() or 1)) as pool:
        said = [text for text in pool.map(check, chosen) if text]
    print("".join(said) or f"tidy: {len(chosen)} files, nothing found")
    sys.exit(1 if said or not chosen else 0)


if __name__ == "__main__":
    main()
