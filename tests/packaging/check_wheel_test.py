# check_wheel_test.py - packaging/check_wheel.py finds each defect of a wheel, and make_wheel.py packs no old files:
# check_wheel_test.py C_COMPILER
# SPDX-License-Identifier: Apache-2.0
import hashlib
import subprocess
import sys
import tempfile
import unittest
import zipfile
from base64 import urlsafe_b64encode
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "packaging"))
import check_wheel  # noqa: E402
import make_wheel  # noqa: E402

COMPILER = ["cc"]


class CheckWheel(unittest.TestCase):
    def setUp(self):
        self.folder = tempfile.TemporaryDirectory()
        self.root = Path(self.folder.name)
        self.addCleanup(self.folder.cleanup)

    def library(self, name, code="int f(void) { return 1; }", *options):
        path = self.root / name
        (self.root / "code.c").write_text(code)
        subprocess.run([*COMPILER, "-shared", "-fPIC", self.root / "code.c", "-o", path, f"-Wl,-soname,{name}", *options], check=True)
        return path

    def problems(self, *bundled, options=(), tag="manylinux_2_36_x86_64", spoil=lambda files: None, stated=None):
        """The check's output for a wheel of an extension linked with `options`, and bundled libraries."""
        extension = self.library("libroofgs.so", "int f(void); int g(void) { return f(); }",
                                 "-Wl,--disable-new-dtags", *options)
        info = "roofgs-1.0.dist-info"
        files = {f"roofgs/{extension.name}": extension.read_bytes(), f"{info}/WHEEL": f"\nTag: py3-none-{stated or tag}\n".encode(),
                 **{f"roofgs.libs/{path.name}": path.read_bytes() for path in bundled}}
        record = "".join(f"{name},sha256={urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b'=').decode()},\n"
                         for name, data in files.items())
        files[f"{info}/RECORD"] = (record + f"{info}/RECORD,,\n").encode()
        spoil(files)
        wheel = self.root / f"roofgs-1.0-py3-none-{tag}.whl"
        with zipfile.ZipFile(wheel, "w") as archive:
            for name, data in files.items():
                archive.writestr(name, data)
        return "\n".join(check_wheel.problems(wheel))

    def test_sound(self):
        own = self.library("libown-0123abcd.so.1")
        self.assertEqual(self.problems(own, options=(own, "-Wl,-rpath,$ORIGIN/../roofgs.libs")), "")
        self.assertEqual(self.problems(), "")

    def test_files_that_the_package_no_longer_has_are_not_packed(self):
        stale, cache = self.root / "python/package/roofgs/stale.py", self.root / "CMakeCache.txt"
        stale.parent.mkdir(parents=True)
        stale.touch()
        cache.touch()
        with mock.patch.object(make_wheel.subprocess, "run"):
            programs = make_wheel.build(self.root, True, [])
        self.assertEqual((stale.exists(), cache.exists()), (False, True))
        self.assertNotIn("rgs-view", programs)

    def test_commands(self):
        program, site = self.root / "site/roofgs/bin/rgs-info", self.root / "site/roofgs"
        program.parent.mkdir(parents=True)
        (site / "__init__.py").write_text("raise ImportError('a command loads no package')\n")
        program.write_text("#!/bin/sh\nprintf '%s|' \"$@\"\nexit 4\n")
        program.chmod(0o755)
        command = make_wheel.COMMAND.format(name="rgs-info")
        run = subprocess.run([sys.executable, "-c", command, "-a", "b c", b"\xe9"], env={"PYTHONPATH": str(site.parent)},
                             capture_output=True)
        self.assertEqual((run.returncode, run.stdout), (4, b"-a|b c|\xe9|"), run.stderr)

    def test_libraries(self):
        own = self.library("libown-0123abcd.so.1")
        there = "-Wl,-rpath,$ORIGIN/../roofgs.libs"
        self.assertIn("needs libown-0123abcd.so.1, which is neither", self.problems(options=(own, there)))
        self.assertIn("needs libown-0123abcd.so.1, which is neither", self.problems(own, options=(own,)))
        for outside in ("/usr/lib", "$ORIGIN/../../.."):
            self.assertIn(f"looks for libraries in {outside}", self.problems(options=(f"-Wl,-rpath,{outside}",)))
        plain = self.library("libown.so.1")
        self.assertIn("libown.so.1 has no hash in its name", self.problems(plain, options=(plain, there)))

    def test_symbols(self):
        new = "#include <stdlib.h>\n#include <pthread.h>\nint f(void) { return pthread_create(0, 0, 0, 0); }"
        own = self.library("libown-0123abcd.so.1", new)
        self.assertIn("needs GLIBC_2.34; the tag allows 2.17",
                      self.problems(own, options=(own, "-Wl,-rpath,$ORIGIN/../roofgs.libs"), tag="manylinux_2_17_x86_64"))
        self.assertIn("newer than 2.36", self.problems(tag="manylinux_2_40_x86_64"))
        self.assertEqual(check_wheel.oldest_glibc([own]), (2, 34))

    def test_records(self):
        self.assertIn("has no tag", self.problems(tag="linux_x86_64"))
        self.assertIn("WHEEL does not say", self.problems(stated="linux_x86_64"))
        self.assertIn("another hash of roofgs/libroofgs", self.problems(spoil=lambda files: files.update(
            {name: data + b"x" for name, data in files.items() if name.endswith(".so")})))
        self.assertIn("alone: rgs-info", self.problems(spoil=lambda files: files.update({"roofgs/bin/rgs-info": b""})))
        self.assertIn("other files than are there", self.problems(spoil=lambda files: files.update({"roofgs/more.py": b""})))


if __name__ == "__main__":
    COMPILER = sys.argv[1:]
    unittest.main(argv=sys.argv[:1])
