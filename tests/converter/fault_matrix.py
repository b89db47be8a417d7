"""Kills every program that writes at each of its calls that change a file, and fills its disk at each of them. Whatever the
call, no output is torn, nothing stays that was not there, the exit code is right, and running again gives the same bytes.

    python3 tests/converter/fault_matrix.py build/release            # every call of every program
    python3 tests/converter/fault_matrix.py build/release --short    # a few calls of each, as ctest runs it

The calls are counted by tests/support/injected_faults.cpp, which is preloaded. A file system without unnamed files is
played too: there a kill may leave one NAME.tmp-XXXXXX. SPDX-License-Identifier: Apache-2.0
"""
import argparse
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

CAMERAS = [{"id": 0, "img_name": "a", "width": 64, "height": 48, "position": [0, 0, -8], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            "fx": 50, "fy": 50}]
UNFINISHED = re.compile(r"\.tmp-[a-z0-5]{6}$")


def runs(program, inputs):
    """Name, the command that writes into a folder, and whether its outputs hold times, which differ from run to run."""
    scene, asset, cameras, many = (str(inputs / name) for name in ("scene.ply", "scene.rgs", "cameras.json", "many"))
    convert = [program("rgs-convert"), "--quiet", "--threads", "1"]
    work = str(inputs / "work")
    return [
        ("make-scene", lambda out: [program("rgs-make-scene"), f"{out}/a.ply", "--gaussians", "500", "--quiet", "--threads", "1"], False),
        ("packed", lambda out: [*convert, scene, f"{out}/a.rgs"], False),
        ("direct", lambda out: [*convert, "--profile", "direct", scene, f"{out}/a.rgs"], False),
        ("archive", lambda out: [*convert, "--profile", "archive:high", scene, f"{out}/a.rgs"], False),
        ("target", lambda out: [*convert, "--profile", "archive", "--target-size", "12kB", scene, f"{out}/a.rgs"], False),
        ("levels", lambda out: [*convert, "--lod", scene, f"{out}/a.rgs"], False),
        ("to ply", lambda out: [*convert, asset, f"{out}/a.ply"], False),
        ("to spz", lambda out: [*convert, scene, f"{out}/a.spz"], False),
        ("to glb", lambda out: [*convert, scene, f"{out}/a.glb"], False),
        ("many", lambda out: [*convert, many, out, "--to", "rgs"], False),
        ("partition", lambda out: [*convert, "--lod-partition", f"{out}/w", "--ranges", "2", "--chunk-size", "32", scene, scene], False),
        ("assemble", lambda out: [*convert, "--lod-assemble", work, f"{out}/a.rgs"], False),
        ("assemble archive", lambda out: [*convert, "--lod-assemble", f"{work}_archive", f"{out}/a.rgs"], False),
        ("prune", lambda out: [program("rgs-prune"), scene, f"{out}/a.ply", "-c", cameras, "--keep", "50%", "--quiet", "--threads", "1"],
         False),
        ("audit", lambda out: [program("rgs-audit"), scene, asset, "--no-render", "--quiet", "--report", f"{out}/a.html", "--json",
                               f"{out}/a.json"], True),
        ("diff", lambda out: [program("rgs-diff"), scene, scene, "--quiet", "--json", f"{out}/a.json", "--ply", f"{out}/a.ply"], True),
        ("judge", lambda out: [program("rgs-judge"), scene, "--cameras", cameras, "--against", str(inputs / "pictures"), "--quiet", "--json",
                               f"{out}/a.json", "--report", f"{out}/a.html"], True),
        ("render", lambda out: [program("rgs-render"), asset, "-c", cameras, "-o", f"{out}/a.png", "--backend", "cpu", "--quiet"], False),
    ]


class Matrix:
    def __init__(self, build, short):
        self.short = short
        self.faults = str(build / "lib/librgs_injected_faults.so")
        self.counts = {"kill": 0, "full": 0}
        self.wrong = []

    def run(self, command, **faults):
        environment = {**os.environ, **{name: str(value) for name, value in faults.items()}}
        if faults:
            environment["LD_PRELOAD"] = self.faults
        return subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace", check=False)

    def files(self, folder):
        return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(Path(folder).rglob("*"))
                if path.is_file() and not path.name.startswith(".rgs-convert")}

    def check(self, holds, what):
        if not holds:
            self.wrong.append(what)
            print("WRONG", what, flush=True)

    def calls(self):
        """1, 2, 3, ...: all, or ever fewer."""
        n = 1
        while True:
            yield n
            n += max(1, n // 2) if self.short else 1

    def row(self, name, command, timed, folder, kills, unnamed, old):
        """One program with one kind of fault, at each call in turn until a run is not hit any more."""
        out = Path(folder) / "out"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        clean = self.run(command(out))
        self.check(clean.returncode == 0, f"{name}: a run without faults ends with {clean.returncode}: {clean.stderr}")
        whole = self.files(out)
        self.check(whole, f"{name}: writes nothing")
        multiple = name in ("many", "partition")  # outputs appear one after the other; their steps are continued
        for n in self.calls():
            shutil.rmtree(out)
            out.mkdir()
            before = {}
            if old and not multiple:
                before = {file: b"the output of an earlier run" for file in whole}
                for file, content in before.items():
                    (out / file).write_bytes(content)
            asked = command(out) + (["--overwrite"] if before else [])
            hit = self.run(asked, RGS_FAULT_AT=n, **({"RGS_FAULT_KILLS": 1} if kills else {}),
                           **({} if unnamed else {"RGS_NO_UNNAMED_FILES": 1}))
            cell = f"{name}, {'kill' if kills else 'full disk'} at call {n}, {'un' if unnamed else ''}named, {'old' if old else 'new'}"
            if hit.returncode == 0:
                break
            self.counts["kill" if kills else "full"] += 1
            expected = (-signal.SIGKILL, 3) if kills and name == "many" else (-signal.SIGKILL,) if kills else (3,)
            self.check(hit.returncode in expected, f"{cell}: exit code {hit.returncode}: {hit.stderr}")
            if not kills:
                self.check("No space left" in hit.stderr, f"{cell}: does not say why: {hit.stderr}")
            left = self.files(out)
            for file, content in left.items():
                if UNFINISHED.search(file):
                    # Named files, and the instant in which a file is replaced.
                    self.check(kills and (not unnamed or bool(before)), f"{cell}: leaves {file}")
                else:
                    good = content == before.get(file) or content == whole.get(file) or (timed and file in whole and b"</html>" in content) \
                        or (timed and file.endswith(".json") and json.loads(content))
                    self.check(good, f"{cell}: {file} is torn")
            self.check(set(before) <= set(left), f"{cell}: an earlier output is gone")
            again = self.run(command(out) + ([] if multiple else ["--overwrite"]))
            self.check(again.returncode == 0, f"{cell}: running again ends with {again.returncode}: {again.stderr}")
            made = {file: content for file, content in self.files(out).items() if not UNFINISHED.search(file)}
            self.check(set(made) == set(whole) and (timed or made == whole), f"{cell}: running again gives other bytes")
            if self.wrong and len(self.wrong) > 20:
                return


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("build", type=Path)
    parser.add_argument("--short", action="store_true", help="a few calls of each program")
    parser.add_argument("--only", help="this run alone")
    arguments = parser.parse_args()
    matrix = Matrix(arguments.build, arguments.short)

    def program(name):
        return str(arguments.build / "bin" / name)

    with tempfile.TemporaryDirectory(prefix="rgs-faults-") as folder:
        inputs = Path(folder) / "in"
        (inputs / "many").mkdir(parents=True)
        (inputs / "cameras.json").write_text(json.dumps(CAMERAS))
        for path in ("scene.ply", "many/a.ply", "many/b.ply"):
            subprocess.run([program("rgs-make-scene"), str(inputs / path), "--gaussians", "600", "--seed", str(len(path)), "--quiet"],
                           check=True)
        subprocess.run([program("rgs-convert"), "--quiet", str(inputs / "scene.ply"), str(inputs / "scene.rgs")], check=True)
        subprocess.run([program("rgs-render"), str(inputs / "scene.rgs"), "-c", str(inputs / "cameras.json"), "-o", str(inputs / "pictures"),
                        "--quiet"], check=True)
        for work, profile in ((str(inputs / "work"), "packed"), (str(inputs / "work_archive"), "archive")):
            begin = ["--lod-partition", work, "--ranges", "2", "--chunk-size", "32", "--profile", profile, str(inputs / "scene.ply")]
            for step in (begin, ["--lod-build", work]):
                subprocess.run([program("rgs-convert"), "--quiet", *step], check=True)
        for name, command, timed in runs(program, inputs):
            if arguments.only not in (None, name) or not os.path.exists(command("")[0]):
                continue
            for kills in (True, False):
                for unnamed, old in ((True, False), (False, True)) if arguments.short else itertools.product((True, False), repeat=2):
                    matrix.row(name, command, timed, folder, kills, unnamed, old)
    print(f"{matrix.counts['kill']} kills, {matrix.counts['full']} full disks, {len(matrix.wrong)} wrong")
    return 1 if matrix.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
