#!/usr/bin/python3
# check_wheel.py - checks that wheels are what their platform tag says: python3 packaging/check_wheel.py WHEEL...
# By PEP 600: no symbol newer than those of the tag's glibc, libstdc++ and libgcc; every library is in the wheel or on every Linux; run paths
# find those in the wheel; each program is a command. SPDX-License-Identifier: Apache-2.0
import csv
import hashlib
import io
import re
import subprocess
import sys
import tempfile
import zipfile
from base64 import urlsafe_b64encode
from pathlib import Path, PurePosixPath

# Libraries of the system that a wheel may use: the part of PEP 600's list that is needed here.
SYSTEM = {"libc.so.6", "libm.so.6", "libdl.so.2", "librt.so.1", "libpthread.so.0", "ld-linux-x86-64.so.2", "libstdc++.so.6",
          "libgcc_s.so.1", "libresolv.so.2"}
# The newest symbols of gcc's libraries that a distribution with this glibc has, newest first: its gcc is 12, 11, 9.
NEWEST = {(2, 35): {"GLIBCXX": (3, 4, 30), "CXXABI": (1, 3, 13), "GCC": (12, 0, 0)},
          (2, 34): {"GLIBCXX": (3, 4, 29), "CXXABI": (1, 3, 13), "GCC": (7, 0, 0)},
          (2, 31): {"GLIBCXX": (3, 4, 28), "CXXABI": (1, 3, 12), "GCC": (7, 0, 0)}}


def versions(text):
    return tuple(int(part) for part in text.split("."))


def readelf(option, path):
    return subprocess.run(["readelf", "--wide", option, path], check=True, capture_output=True, text=True).stdout


def needed_symbols(path):
    """(library, version) of a shared library's or program's symbols."""
    found = re.findall(r"\b(GLIBC|GLIBCXX|CXXABI|GCC)_(\d+(?:\.\d+)+)\b", readelf("--version-info", path))
    return sorted({(name, versions(version)) for name, version in found})


def newest_symbols(glibc):
    """By library, where glibc is this one."""
    return {"GLIBC": glibc, **next((newest for least, newest in NEWEST.items() if glibc >= least), NEWEST[min(NEWEST)])}


def oldest_glibc(paths):
    """The oldest glibc beside which all symbols are that these need."""
    needed = {symbol for path in paths for symbol in needed_symbols(path)}
    candidates = sorted({*NEWEST, *(version[:2] for name, version in needed if name == "GLIBC")})
    return next(glibc for glibc in candidates if all(version <= newest_symbols(glibc)[name] for name, version in needed))


def problems_of_library(path, root, glibc):
    """Breaches of one shared library of the wheel that is unpacked at `root`."""
    dynamic = readelf("--dynamic", path)
    needed = re.findall(r"\(NEEDED\).*\[(.*)\]", dynamic)
    run_paths = [part for found in re.findall(r"\((?:RUNPATH|RPATH)\).*\[(.*)\]", dynamic) for part in found.split(":")]
    for run_path in run_paths:
        folder = Path(run_path.replace("$ORIGIN", str(path.parent))).resolve()
        if not run_path.startswith("$ORIGIN") or not folder.is_relative_to(root):
            yield f"looks for libraries in {run_path}, outside the wheel"
    for library in needed:
        bundled = [Path(run_path.replace("$ORIGIN", str(path.parent))) / library for run_path in run_paths]
        if library not in SYSTEM and not any(candidate.exists() for candidate in bundled):
            yield f"needs {library}, which is neither in the wheel nor on every Linux"
    newest = newest_symbols(glibc)
    for name, version in needed_symbols(path):
        if version > newest[name]:
            yield f"needs {name}_{'.'.join(map(str, version))}; the tag allows {'.'.join(map(str, newest[name]))}"
    if "GLIBC_PRIVATE" in readelf("--version-info", path):
        yield "needs private symbols of glibc"


def problems(wheel):
    match = re.fullmatch(r"([A-Za-z0-9_]+)-([^-]+)(?:-\d[^-]*)?-py3-none-manylinux_(\d+)_(\d+)_x86_64\.whl", wheel.name)
    if not match:
        yield "the name has no tag py3-none-manylinux_A_B_x86_64"
        return
    glibc = (int(match[3]), int(match[4]))
    if glibc > (2, 36):
        yield "the tag asks for a glibc newer than 2.36"
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(wheel) as archive:
        root = Path(folder).resolve()
        archive.extractall(root)
        info = f"{match[1]}-{match[2]}.dist-info"
        tag = f"py3-none-manylinux_{match[3]}_{match[4]}_x86_64"
        if f"\nTag: {tag}\n" not in archive.read(f"{info}/WHEEL").decode():
            yield f"WHEEL does not say {tag}"
        recorded = {row[0]: row[1] for row in csv.reader(io.StringIO(archive.read(f"{info}/RECORD").decode()))}
        for name in archive.namelist():
            digest = "sha256=" + urlsafe_b64encode(hashlib.sha256(archive.read(name)).digest()).rstrip(b"=").decode()
            if name != f"{info}/RECORD" and recorded.get(name) != digest:
                yield f"RECORD has another hash of {name}, or none"
        if set(recorded) != set(archive.namelist()):
            yield "RECORD names other files than are there"
        programs, commands = ({name.rpartition("/")[2] for name in archive.namelist() if name.startswith(folder)}
                              for folder in ("roofgs/bin/", f"{match[1]}-{match[2]}.data/scripts/"))
        if programs != commands:
            yield f"these are in one of roofgs/bin and .data/scripts alone: {', '.join(sorted(programs ^ commands))}"
        libraries = [path for path in root.rglob("*") if path.is_file() and path.read_bytes()[:4] == b"\x7fELF"]
        if not any(path.name == "libroofgs.so" for path in libraries):
            yield "there is no libroofgs.so"
        for path in sorted(libraries):
            if path.parent.name.endswith(".libs") and not re.search(r"-[0-9a-f]{8}\.so", path.name):
                yield f"{path.name} has no hash in its name: another wheel's library of that name may be taken for it"
            for problem in problems_of_library(path, root, glibc):
                yield f"{PurePosixPath(path.relative_to(root))} {problem}"


if __name__ == "__main__":
    found = [f"{wheel}: {problem}" for wheel in sys.argv[1:] for problem in problems(Path(wheel))]
    print("\n".join(found) or "wheels: in order")
    sys.exit(1 if found or len(sys.argv) < 2 else 0)
