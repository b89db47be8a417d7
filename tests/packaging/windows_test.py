# windows_test.py - programs for Windows, under Wine, do what those of Linux do: windows_test.py FOLDER_WITH_EXE NATIVE_BIN
# SPDX-License-Identifier: Apache-2.0
import json
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import foreign_test
from foreign_test import QUIET, foreign


class Windows(foreign_test.Foreign):
    def run_foreign(self, program, *arguments, data=None):
        """Once more if Wine itself failed: it ended with 1 and said nothing, where our programs say what is wrong."""
        before = set(self.folders[0].rglob("*"))
        ended = super().run_foreign(program, *arguments, data=data)
        if ended.returncode != 1 or ended.stdout or ended.stderr:
            return ended
        print(f"Wine ended with 1 and said nothing: {program} {' '.join(arguments)}", file=sys.stderr)
        for path in set(self.folders[0].rglob("*")) - before:
            if path.is_file():
                path.unlink()
        return super().run_foreign(program, *arguments, data=data)

    def test_pictures_are_the_same(self):
        self.scene(3000)
        self.both("rgs-convert", "in.ply", "out.rgs", *QUIET)
        self.both("rgs-convert", "in.ply", "levels.rgs", "--lod", *QUIET)
        small = ("--size", "96x64", "--quiet")
        self.both("rgs-render", "in.ply", "-o", "vectors.png", *small)
        self.both("rgs-render", "out.rgs", "-o", "scalar.png", "--scalar", *small)
        self.both("rgs-render", "out.rgs", "-o", "picture.jpg", *small)
        self.both("rgs-render", "levels.rgs", "-o", "streamed", "--orbit", "3", "--host-memory", "1GB", "--wait", "10", *small)
        exr = self.run_foreign("rgs-render", "in.ply", "-o", "picture.exr", *small)
        self.assertEqual(exr.returncode, 2, exr.stderr)
        self.assertIn(b"on Windows pictures are PNG and JPEG only", exr.stderr)
        self.same_files()

    def test_audits_are_the_same(self):
        self.scene(2000)
        camera = {"id": 0, "img_name": "a", "width": 64, "height": 48, "position": [0, 0, -20], "fx": 50, "fy": 50,
                  "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
        for folder in self.folders:
            (folder / "cameras.json").write_text(json.dumps([camera]))
        self.both("rgs-convert", "in.ply", "out.rgs", "--profile", "archive", *QUIET)
        quick = ("--views", "2", "--worst", "1", "--size", "64x48", "--no-distances", "--quiet")
        self.both("rgs-audit", "in.ply", "out.rgs", "--report", "audit.html", *quick)
        self.both("rgs-audit", "in.ply", "out.rgs", *quick[:-1])
        self.both("rgs-audit", "in.ply", "out.rgs", "--fail-below", "psnr=200", *quick, code=5)
        self.both("rgs-diff", "in.ply", "out.rgs", code=1)
        self.both("rgs-prune", "out.rgs", "pruned.rgs", "--cameras", "cameras.json", "--keep", "50%", "--quiet")
        self.same_files()

    def test_one_program_calls_another(self):
        self.scene(2000)
        self.both("rgs-convert", "in.ply", "Größe.rgs", "--audit", *QUIET)
        self.both("rgs-convert", "in.ply", "small.rgs", "--profile", "archive", "--target-psnr", "38", *QUIET)
        self.same_files()

    def test_a_file_that_is_being_read_can_be_replaced(self):
        self.scene(5000)
        self.both("rgs-convert", "in.ply", "out.rgs", "--profile", "direct", *QUIET)
        # More than a pipe holds: the program has the file open until somebody reads on.
        read = "rgs-convert", "out.rgs", "-", "--to", "ply", "--quiet"
        expected = self.run_foreign(*read).stdout
        self.assertGreater(len(expected), 1 << 20)
        with subprocess.Popen(foreign(*read), cwd=self.folders[0], stdout=subprocess.PIPE) as reader:
            begin = reader.stdout.read(1)
            self.both("rgs-convert", "in.ply", "out.rgs", "--overwrite", "--profile", "archive", *QUIET)
            self.assertEqual(begin + reader.stdout.read(), expected)
        self.assertEqual(reader.returncode, 0)
        self.same_files()

    def test_a_read_only_output_is_refused_at_once(self):
        self.scene(300)
        kept = self.folders[0] / "kept.rgs"
        kept.write_text("kept")
        kept.chmod(0o444)
        refused = self.run_foreign("rgs-convert", "in.ply", "kept.rgs", "--overwrite")
        self.assertEqual(refused.returncode, 3)
        self.assertIn(b"the output is read-only", refused.stderr)
        self.assertEqual(kept.read_text(), "kept")

    def test_folders_are_left_to_a_loop(self):
        (self.folders[0] / "scenes").mkdir()
        refused = self.run_foreign("rgs-convert", "scenes", "out", "--to", "rgs")
        self.assertEqual(refused.returncode, 2)
        self.assertIn(b"one scene at a time", refused.stderr)


if __name__ == "__main__":
    foreign_test.RUNNER = ["wine"]
    foreign_test.FOREIGN, foreign_test.NATIVE = (Path(argument).resolve() for argument in sys.argv[1:3])
    with tempfile.TemporaryDirectory() as prefix:
        # No windows, sound or .NET; of Wine's messages only errors.
        os.environ.update(WINEPREFIX=prefix, WINEDEBUG="-all,err+all", WINEDLLOVERRIDES="mscoree,mshtml=", LANG="C.UTF-8")
        # Services that a program starts would keep its output open as long as they run.
        for command in (["wineserver", "--persistent"], ["wineboot", "--init"]):
            subprocess.run(command, check=True, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            unittest.main(argv=[*sys.argv[:1], *sys.argv[3:]], verbosity=2)
        finally:
            subprocess.run(["wineserver", "--kill"], check=False)
