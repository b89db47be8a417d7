# release_test.py - what a release states and refuses, in a copy of the checkout; no package is built: release_test.py
# SPDX-License-Identifier: Apache-2.0
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import unittest
import zipfile
from pathlib import Path

from skip import skip_without_tool

ROOT = Path(__file__).resolve().parents[2]
OLD = re.search(r"^roofgs \(([\d.]+)-", (ROOT / "packaging/debian/changelog").read_text())[1]
STATING = {"CHANGELOG.md", "format/include/rgs/version.hpp", "packaging/debian/changelog", "packaging/vcpkg/roofgs/vcpkg.json",
           "samples/consumer/CMakeLists.txt", "samples/minimal/CMakeLists.txt", "web/package-lock.json",
           *(f"web/{name}/package.json" for name in ("clients", "convert", "playcanvas", "reader", "spark", "viewer", "webgpu"))}
ENVIRONMENT = {**os.environ, "SOURCE_DATE_EPOCH": "1000000000", "GIT_CONFIG_GLOBAL": "/dev/null", "GIT_CONFIG_SYSTEM": "/dev/null",
               **{f"GIT_{who}_{what}": "a@b" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}}


def run(folder, *command):
    return subprocess.run(command, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True)


def files_of_checkout():
    listed = run(ROOT, "git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    if listed.returncode != 0:
        skip_without_tool("releases: this is no git checkout")
    return [name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


class Release(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        temporary = tempfile.TemporaryDirectory()
        cls.addClassCleanup(temporary.cleanup)
        cls.root = Path(temporary.name)
        for name in FILES:
            (cls.root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, cls.root / name)
        # A release that is not refused ends here.
        (cls.root / "packaging/deb.sh").write_text("exit 9\n")
        for words in (("init", "--quiet"), ("add", "--all"), ("commit", "--quiet", "--message", "All")):
            run(cls.root, "git", *words)

    def setUp(self):
        self.edit("CHANGELOG.md", r"## Unreleased\n", "## Unreleased\n\n- A new word\n\n")
        self.commit()

    def tearDown(self):
        self.git("reset", "--quiet", "--hard", self.git("rev-list", "--max-parents=0", "HEAD").strip())
        self.git("clean", "--quiet", "-d", "--force", "-x")
        for tag in self.git("tag").split():
            self.git("tag", "--delete", tag)

    def git(self, *words):
        done = run(self.root, "git", *words)
        self.assertEqual(done.returncode, 0, done.stderr)
        return done.stdout

    def commit(self):
        self.git("add", "--all")
        self.git("commit", "--quiet", "--message", "A change")

    def edit(self, name, pattern, new):
        path = self.root / name
        text, n = re.subn(pattern, new, path.read_text(), count=1)
        self.assertEqual(n, 1, name)
        path.write_text(text)

    def script(self, name, *arguments, code=0):
        done = run(self.root, "sh" if name.endswith(".sh") else "/usr/bin/python3", f"scripts/{name}", *arguments)
        self.assertEqual(done.returncode, code, done.stdout + done.stderr)
        return done.stdout + done.stderr

    def test_the_version_agrees_in_all_places(self):
        self.assertEqual(self.script("set_version.py"), OLD + "\n")
        for name in sorted(STATING - {"CHANGELOG.md", "format/include/rgs/version.hpp", "packaging/debian/changelog"}):
            with self.subTest(name):
                # MAJOR.MINOR, and in most places .PATCH.
                self.edit(name, rf"(rgs |\"){re.escape(OLD.rpartition('.')[0])}(?=[\". ])", r"\g<1>7.7")
                self.assertIn(name, self.script("set_version.py", code=4))
                self.git("checkout", "--quiet", ".")
        self.edit("packaging/debian/changelog", r"\(", "(7.")
        self.assertIn("packaging/debian/changelog", self.script("set_version.py", code=4))

    def test_a_new_version_changes_all_places_and_nothing_else(self):
        self.script("set_version.py", "7.8.9")
        self.assertEqual(set(self.git("diff", "--name-only").split()), STATING)
        self.assertEqual(self.script("set_version.py"), "7.8.9\n")
        minor = OLD.rpartition(".")[0]
        for name in STATING - {"CHANGELOG.md", "packaging/debian/changelog", "format/include/rgs/version.hpp"}:
            before, after = self.git("show", f"HEAD:{name}").split("\n"), (self.root / name).read_text().split("\n")
            self.assertEqual(len(before), len(after), name)
            for one, other in zip(before, after):
                self.assertIn(other, (one, one.replace(f'"{OLD}"', '"7.8.9"'), one.replace(f"rgs {minor}", "rgs 7.8")), name)
        self.assertIn("## Unreleased\n\n## 7.8.9 (2001-09-09)\n\n- A new word\n", (self.root / "CHANGELOG.md").read_text())
        self.assertRegex((self.root / "packaging/debian/changelog").read_text(), r"\Aroofgs \(7\.8\.9-1\) unstable; .*\n\n"
                         r"  \* .*\n\n -- .+ <.+>  Sun, 09 Sep 2001 01:46:40 \+0000\n\nroofgs \(")

    def test_what_cannot_be_released_is_refused(self):
        for version in ("", "1", "1.2", "v1.2.3", "1.02.3", "1.2.3-rc1", "0.0.1"):
            self.assertIn(version, self.script("release.sh", version, code=2))
        for tag in ("v8.0.0", "v8.0.0-rc1", "v2030"):
            self.git("tag", tag)
        for version in ("7.9.9", "8.0.0"):
            self.assertIn("not newer than 8.0.0", self.script("release.sh", version, code=2))
        (self.root / "build/release-8.0.1").mkdir(parents=True)
        self.assertIn("there already", self.script("release.sh", "8.0.1", code=3))
        (self.root / "new").write_text("")
        self.assertIn("not committed", self.script("release.sh", "8.1.0", code=2))
        self.script("set_version.py", "8.1.0")
        self.assertIn("lists nothing", self.script("set_version.py", "8.2.0", code=2))
        self.edit("CHANGELOG.md", r"## Unreleased\n", "## Unreleased\n\n- More\n")
        self.assertIn("has a part of 8.1.0", self.script("set_version.py", "8.1.0", code=2))

    def test_a_release_is_committed_in_a_clone_and_nowhere_else(self):
        def state():
            return [self.git(*words) for words in (("rev-parse", "HEAD"), ("status", "--porcelain"), ("tag",), ("branch",))]

        before = state()
        self.script("release.sh", "7.8.9", code=9)
        made = self.git("-C", "build/releasing", "log", "-1", "--format=%s, %at, %ct, %P")
        self.assertEqual(made, f"Release 7.8.9, 1000000000, 1000000000, {before[0]}")
        self.assertEqual(state(), before)

    def test_a_source_distribution_has_one_date_and_no_umask(self):
        (self.root / "LICENSE").chmod(0o660)
        (self.root / "scripts/sbom.py").chmod(0o700)
        done = run(self.root, "/usr/bin/python3", "-c", "import sys; sys.path.insert(0, 'packaging'); import make_wheel; "
                   "print(make_wheel.build_sdist('.'))")
        self.assertEqual(done.returncode, 0, done.stderr)
        made = self.root / done.stdout.strip()
        self.assertEqual(int.from_bytes(made.read_bytes()[4:8], "little"), 1000000000)
        with tarfile.open(made) as archive:
            self.assertEqual({(each.mtime, each.uid, each.uname) for each in archive}, {(1000000000, 0, "")})
            self.assertEqual({each.mode for each in archive}, {0o644, 0o755})

    def test_notes_say_what_has_changed(self):
        self.script("set_version.py", "7.8.9")
        self.commit()
        notes = self.script("release_notes.py")
        self.assertRegex(notes, r"\A# RoofGS 7\.8\.9\n\n- A new word\n\n")
        self.assertIn("nothing is compared", notes)
        for tag in ("v7.8.9", "v7.8.9-rc1", "v7"):
            self.git("tag", tag)
        self.edit("CHANGELOG.md", r"## Unreleased\n", "## Unreleased\n\n- More\n")
        self.script("set_version.py", "7.9.0")
        self.edit("format/include/rgs/layout.hpp", r"kVersionMinor = \d+", "kVersionMinor = 77")
        self.edit("converter/inspect/rgs_info.cpp", '"--json', '"--quite-new')
        self.edit("python/roofgs/__init__.py", '"__version__"', '"novelty", "__version__"')
        (self.root / "format/include/rgs/novel.hpp").write_text("")
        self.commit()
        notes = self.script("release_notes.py")
        self.assertNotIn("A new word", notes)
        for wanted in ("- More", "version 1.77", "Compared with v7.8.9, ", "- new: `format/include/rgs/novel.hpp`", "- new: `novelty`",
                       "changed: `format/include/rgs/layout.hpp`, `format/include/rgs/version.hpp`\n",
                       "- new: `converter/inspect: --quite-new`", "- gone: `converter/inspect: --json`"):
            self.assertIn(wanted, notes)

    def test_the_sbom_has_what_spdx_requires_and_what_is_inside(self):
        folder = self.root / "made"
        (folder / "deb/DEBIAN").mkdir(parents=True)
        (folder / "deb/usr/viewer").mkdir(parents=True)
        # Entries are in the order of file names: those of libroofgs before those of the bundle.
        for name, depends in (("libroofgs", "libmade1:any | libother1"), ("roofgs", "libc6 (>= 2.36), libroofgs (= 1)")):
            (folder / "deb/DEBIAN/control").write_text(f"Package: {name}\nVersion: 1\nArchitecture: all\nMaintainer: a <a@b>\n"
                                                       f"Description: d\nDepends: {depends}\n")
            subprocess.run(["dpkg-deb", "--build", folder / "deb", folder / f"{name}_1.deb"], check=True, stdout=subprocess.DEVNULL)
            (folder / "deb/usr/viewer/single.html").write_text("")
        shutil.rmtree(folder / "deb")
        (self.root / "web/viewer/NOTICE").write_text("==== Zstandard\n\n==== Debian libmade3\n\nThe PlayCanvas engine\n")
        header = self.root / "web/node_modules/zstd-napi/deps/zstd/lib/zstd.h"
        header.parent.mkdir(parents=True)
        header.write_text("".join(f"#define ZSTD_VERSION_{part}    {i}\n" for i, part in enumerate(("MAJOR", "MINOR", "RELEASE"), 1)))
        status = self.root / "build/roots/arm64-1/var/lib/dpkg/status"
        status.parent.mkdir(parents=True)
        status.write_text("".join(f"Package: libmade4\nStatus: install ok installed\nArchitecture: {name}\nMulti-Arch: same\n"
                                  "Maintainer: a <a@b>\nDescription: d\nVersion: 1.5\n\n" for name in ("amd64", "arm64")))

        def archive(name, members):
            with tarfile.open(folder / name, "w:gz") as out:
                for member, text in members.items():
                    entry = tarfile.TarInfo(member)
                    entry.size = len(text.encode())
                    out.addfile(entry, io.BytesIO(text.encode()))

        archive("roofgs-1-linux.tar.gz", {"r/licenses/roofgs": "", "r/licenses/libmade1": "License: Expat\n text\nLicense: Zlib\n",
                                          "r/licenses/dpkg": "", "r/share/roofgs/viewer/single.html": ""})
        archive("roofgs-1-linux-arm64.tar.gz", {"r/licenses/libmade4": ""})
        archive("roofgs-reader-1.tgz", {"package/package.json": '{"peerDependencies": {"playcanvas": "^2"}}',
                                        "package/NOTICE": "==== Zstandard\n\n==== Debian libmade1\n"})
        with zipfile.ZipFile(folder / "roofgs-1.whl", "w") as wheel:
            wheel.writestr("roofgs-1.dist-info/METADATA", "Name: roofgs\nRequires-Dist: numpy>=1.22\n")
            wheel.writestr("roofgs-1.dist-info/licenses/libmade2+x", "")
            wheel.writestr("roofgs/share/roofgs/viewer/single.html", "")
        with zipfile.ZipFile(folder / "roofgs-1-windows.zip", "w") as windows:
            windows.writestr("roofgs-1-windows/viewer.html", "")
        made = json.loads(self.script("sbom.py", "made", "1.2.3"))

        self.assertEqual((made["spdxVersion"], made["dataLicense"], made["SPDXID"]), ("SPDX-2.3", "CC0-1.0", "SPDXRef-DOCUMENT"))
        self.assertTrue(made["name"])
        self.assertRegex(made["documentNamespace"], r"\A[a-z]+://[^#\s]+\Z")
        self.assertEqual(made["creationInfo"]["created"], "2001-09-09T01:46:40Z")
        for creator in made["creationInfo"]["creators"]:
            self.assertRegex(creator, r"\A(Tool|Organization|Person): .")
        names = {package["SPDXID"]: package["name"] for package in made["packages"]}
        self.assertEqual(len(names), len(made["packages"]))
        for package in made["packages"]:
            self.assertRegex(package["SPDXID"], r"\ASPDXRef-[A-Za-z0-9.-]+\Z")
            self.assertTrue(package["name"])
            self.assertEqual((package["downloadLocation"], package["filesAnalyzed"]), ("NOASSERTION", False))
            self.assertRegex(package.get("licenseDeclared", "MIT"), r"\A[\w.+-]+\Z")
            self.assertRegex(package.get("supplier", "Organization: x"), r"\A(Organization|Person): .")
            for checksum in package.get("checksums", []):
                self.assertEqual(checksum["algorithm"], "SHA256")
                self.assertRegex(checksum["checksumValue"], r"\A[0-9a-f]{64}\Z")
        names["SPDXRef-DOCUMENT"] = "document"
        found = {(names[each["spdxElementId"]], each["relationshipType"], names[each["relatedSpdxElement"]])
                 for each in made["relationships"]}
        library, deb, bundle, arm = "libroofgs_1.deb", "roofgs_1.deb", "roofgs-1-linux.tar.gz", "roofgs-1-linux-arm64.tar.gz"
        tgz, wheel, windows = "roofgs-reader-1.tgz", "roofgs-1.whl", "roofgs-1-windows.zip"
        self.assertEqual(found, {
            *(("document", "DESCRIBES", name) for name in (library, deb, bundle, arm, tgz, wheel, windows)),
            *((name, "CONTAINS", part) for name in (deb, bundle, wheel, windows)
              for part in ("@roofgs/viewer", "zstd", "playcanvas", "libmade3")),
            (library, "DEPENDS_ON", "libmade1"), (deb, "DEPENDS_ON", "libc6"), (deb, "DEPENDS_ON", library),
            (bundle, "CONTAINS", "libmade1"), (bundle, "CONTAINS", "dpkg"), (arm, "CONTAINS", "libmade4"),
            (tgz, "CONTAINS", "zstd"), (tgz, "CONTAINS", "libmade1"), (tgz, "DEPENDS_ON", "playcanvas"),
            (wheel, "DEPENDS_ON", "numpy"), (wheel, "CONTAINS", "libmade2+x")})
        by_name = {package["name"]: package for package in made["packages"] if "licenseComments" in package or "versionInfo" in package}
        self.assertEqual(by_name["libmade1"]["licenseComments"], "Debian's copyright file names: Expat, Zlib")
        self.assertIn("versionInfo", by_name["dpkg"])
        self.assertEqual((by_name["zstd"]["versionInfo"], by_name["zstd"]["licenseDeclared"]), ("1.2.3", "BSD-3-Clause"))
        self.assertEqual(by_name["libmade4"]["versionInfo"], "1.5")
        self.assertEqual(by_name["@roofgs/viewer"]["versionInfo"], OLD)
        self.assertEqual(by_name["playcanvas"]["licenseDeclared"], "MIT")


if __name__ == "__main__":
    if shutil.which("dpkg-deb") is None or shutil.which("git") is None:
        skip_without_tool("releases: neither git nor dpkg, or one of them only")
    FILES = files_of_checkout()
    unittest.main()
