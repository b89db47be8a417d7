# foreign_test.py - programs built for another machine do what those of this machine do:
#   foreign_test.py RUNNER FOREIGN_BIN NATIVE_BIN    RUNNER is what starts them, such as "qemu-aarch64 -L ROOT"
# SPDX-License-Identifier: Apache-2.0
import shlex
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import numpy

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
RUNNER, FOREIGN, NATIVE = [], Path(), Path()
QUIET = ("--quiet", "--no-sync")
PROFILES = (("packed",), ("packed", "--level", "19"), ("direct",), ("archive:high",), ("archive:small",), ("archive:tiny",))
SINGLE_FILES = ("compressed.ply", "ply", "spz", "spz.glb", "glb", "usda", "usdz", "npz", "sog", "rad", "ksplat", "splat")


def foreign(program, *arguments):
    path = FOREIGN / program
    return [*RUNNER, str(path if path.exists() else path.with_suffix(".exe")), *arguments]


def write_ply(path, n):
    """n Gaussians of degree 3 as 3DGS writes them, always the same."""
    random = numpy.random.default_rng(1)
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45)), "opacity",
             *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rows = random.normal(size=(n, len(names)))
    rows[:, :3] *= 5
    rows[:, 55:58] = rows[:, 55:58] * 0.5 - 4
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}", *(f"property float {name}" for name in names),
              "end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.astype("<f4").tobytes())


class Foreign(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        # The same names in two folders, one for the programs of each machine.
        self.folders = Path(temporary.name, "foreign"), Path(temporary.name, "native")
        for folder in self.folders:
            folder.mkdir()

    def run_foreign(self, program, *arguments, data=None):
        return subprocess.run(foreign(program, *arguments), cwd=self.folders[0], input=data, capture_output=True)

    def both(self, program, *arguments, code=0, data=None):
        """Runs both in folders of their own; returns what both printed."""
        theirs = self.run_foreign(program, *arguments, data=data)
        ours = subprocess.run([str(NATIVE / program), *arguments], cwd=self.folders[1], input=data, capture_output=True)
        self.assertEqual(ours.returncode, code, ours.stderr)
        self.assertEqual((theirs.returncode, theirs.stdout), (code, ours.stdout), theirs.stderr)
        return ours.stdout

    def same_files(self):
        def files(folder):
            return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        theirs, ours = map(files, self.folders)
        self.assertEqual(sorted(theirs), sorted(ours))
        self.assertEqual([name for name in ours if theirs[name] != ours[name]], [])

    def scene(self, n):
        for folder in self.folders:
            write_ply(folder / "in.ply", n)
        return (folder / "in.ply").read_bytes()

    def golden(self):
        for path in sorted(GOLDEN.glob("*.rgs")):
            for folder in self.folders:
                shutil.copy(path, folder)
            yield path

    def test_golden_files_are_written(self):
        for folder in self.folders:
            shutil.copytree(GOLDEN, folder, dirs_exist_ok=True)
        self.run_foreign("rgs_write_golden", ".").check_returncode()
        self.same_files()

    def test_golden_files_are_reported_alike(self):
        for path in self.golden():
            with self.subTest(path.name):
                self.both("rgs-info", path.name, "--json", "--verify")

    def test_golden_files_become_the_same_files(self):
        for path in self.golden():
            self.both("rgs-convert", path.name, path.stem + ".ply", *QUIET)
        self.same_files()

    def test_conversions_write_the_same_bytes(self):
        # More than one chunk, page and frame.
        self.scene(3000)
        for i, profile in enumerate(PROFILES):
            self.both("rgs-convert", "in.ply", f"{i}.rgs", "--chunk-size", "32", "--profile", *profile, *QUIET)
            self.both("rgs-convert", f"{i}.rgs", f"{i}.ply", *QUIET)
        for profile in ("packed", "archive:small"):
            self.both("rgs-convert", "in.ply", f"{profile[:6]}-levels.rgs", "--lod", "--profile", profile, *QUIET)
        for ending in SINGLE_FILES:
            self.both("rgs-convert", "in.ply", "out." + ending, "--max-count", "500", *QUIET)
            self.both("rgs-convert", "out." + ending, ending + ".rgs", *QUIET)
        # Palettes of many Gaussians take half a minute under an emulator.
        self.both("rgs-convert", "packed-levels.rgs", "colours.rgs", "--sh-degree", "0", "--lod", *QUIET)
        for ending in ("sog/lod-meta.json", "tiles/tileset.json", "levels.rad"):
            self.both("rgs-convert", "packed-levels.rgs" if "sog" not in ending else "colours.rgs", ending, *QUIET)
            self.both("rgs-convert", ending, ending[:5] + ".rgs", *QUIET)
        self.same_files()

    def test_standard_streams_are_binary(self):
        data = self.scene(300)
        self.assertIn(b"\n", self.both("rgs-convert", "-", "-", "--to", "rgs", "--quiet", data=data))

    def test_names_are_unicode_and_long(self):
        name = "Größe 物 \N{GRINNING FACE}"
        long = "/".join(["a-long-folder-" + "n" * 100] * 3)
        for folder in self.folders:
            (folder / name).mkdir()
            (folder / long).mkdir(parents=True)
        self.scene(300)
        self.both("rgs-convert", "in.ply", f"{name}/{name}.rgs", "--quiet")
        self.both("rgs-convert", f"{name}/{name}.rgs", f"{long}/out.rgs", "--lod", "--quiet")
        self.both("rgs-info", f"{long}/out.rgs", "--json")
        self.same_files()

    def test_what_is_wrong_has_the_same_exit_code(self):
        self.scene(300)
        for folder in self.folders:
            (folder / "folder.rgs").mkdir()
            (folder / "kept.rgs").write_text("kept")
            (folder / "broken.ply").write_text("ply\nformat ascii 1.0\nend_header\n")
        self.both("rgs-convert", "in.ply", "in.ply", "--overwrite", code=2)
        self.both("rgs-convert", "in.ply", "folder.rgs", "--overwrite", code=3)
        self.both("rgs-convert", "in.ply", "kept.rgs", code=3)
        self.both("rgs-convert", "none.ply", "out.rgs", code=3)
        self.both("rgs-convert", "broken.ply", "out.rgs", code=4)
        self.same_files()
        self.both("rgs-convert", "in.ply", "kept.rgs", "--overwrite", "--quiet")
        self.same_files()


if __name__ == "__main__":
    RUNNER, FOREIGN, NATIVE = shlex.split(sys.argv[1]), Path(sys.argv[2]).resolve(), Path(sys.argv[3]).resolve()
    unittest.main(argv=sys.argv[:1], verbosity=2)
