#!/usr/bin/python3
# portable_test.py - the decoding part needs no exceptions, threads, mapped files or Draco, and decodes to the same
# bytes.
# SPDX-License-Identifier: Apache-2.0
"""portable_test.py GOLDEN_FOLDER RGS_DUMP_FILE RGS_DUMP_FILE_PORTABLE "OBJECT;OBJECT..."

Both programs print the same for every golden file, of every profile, and give the same error for those of reject/; the
objects, RGS_FORMAT_PORTABLE of format/CMakeLists.txt, ask for nothing that a host without these things lacks. NM in the
environment names the program that lists symbols.
"""
from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

# The linker's symbols of libraries: C, C++ (mangled), Draco.
HOST = re.compile(r"""(
    __?(cxa_(throw|rethrow|begin_catch|allocate_exception)|Unwind_.*)
  | pthread_.* | thrd_.* | call_once | sem_.*
  | _ZN?K?St\d*(6thread|5mutex|18condition_variable|4async).* | .*St\d*_?_once.*
  | m(un)?map | madvise | mprotect | u?mask | open | openat | read | pread | write | pwrite | sysconf | fstat | stat | fork
  | .*5draco.*
)(@.*)?""", re.VERBOSE)


def undefined(objects: list[str]) -> set[str]:
    run = subprocess.run([os.environ.get("NM", "nm"), "--undefined-only", "--format=posix", *objects],
                         capture_output=True, check=True, text=True)
    return {fields[0] for fields in map(str.split, run.stdout.splitlines()) if len(fields) > 1 and fields[1] in "Uwv"}


def main(golden: str, whole: str, portable: str, objects: str) -> None:
    symbols = undefined(objects.split(";"))
    assert any("ZSTD_decompress" in symbol for symbol in symbols), "the list of symbols is empty or unreadable"
    host = sorted(filter(HOST.fullmatch, symbols))
    assert not host, f"RGS_FORMAT_PORTABLE asks the host for {', '.join(host)}"

    files = sorted(Path(golden).glob("**/*.rgs"))
    valid = 0
    for path in files:
        runs = [subprocess.run([program, path], capture_output=True, check=False) for program in (whole, portable)]
        valid += runs[1].returncode == 0
        assert runs[0].returncode == runs[1].returncode, f"{path}: {runs[1].returncode}, not {runs[0].returncode}"
        assert runs[0].stdout == runs[1].stdout, f"{path} decodes differently"
    profiles = {path.stem.split("_")[0] for path in files}
    assert valid >= 20 and profiles >= {"packed", "archive"}, "golden files are missing"
    print(f"{valid} files decode to the same bytes, {len(files) - valid} are refused alike")


if __name__ == "__main__":
    main(*sys.argv[1:])
