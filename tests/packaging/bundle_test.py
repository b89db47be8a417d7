# bundle_test.py - scripts/bundle.sh makes its archive and changes nothing else: bundle_test.py PROGRAM
# SPDX-License-Identifier: Apache-2.0
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import unittest
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "bundle.sh"
PROGRAM = Path()
SHELLS = ("bash", "zsh", "fish")


class Bundle(unittest.TestCase):
    def test_an_archive_is_made_and_nothing_else_is_touched(self):
        with tempfile.TemporaryDirectory() as name:
            root = Path(name)
            (root / "build/bin").mkdir(parents=True)
            (root / "temporary").mkdir()
            shutil.copy(PROGRAM, root / "build/bin/rgs-info")
            # A build's manual, and the caller's folders of the same names.
            for folder in ("build/manual/man1", *(f"build/manual/{shell}" for shell in SHELLS), *SHELLS):
                (root / folder).mkdir(parents=True)
                (root / folder / "rgs-info").write_text(folder)
            before = {path for path in root.rglob("*")}
            subprocess.run(["sh", SCRIPT, "build", "made.tar.gz"], cwd=root, check=True, stdout=subprocess.DEVNULL,
                           env={**os.environ, "TMPDIR": str(root / "temporary")})
            self.assertEqual({path for path in root.rglob("*")} - before, {root / "made.tar.gz"})
            self.assertEqual(before - {path for path in root.rglob("*")}, set())
            with tarfile.open(root / "made.tar.gz") as archive:
                names = archive.getnames()
            for wanted in ("bin/rgs-info", "share/man/man1/rgs-info", *(f"share/{shell}/rgs-info" for shell in SHELLS)):
                self.assertIn(f"made/{wanted}", names)


if __name__ == "__main__":
    PROGRAM = Path(sys.argv[1])
    unittest.main(argv=sys.argv[:1])
