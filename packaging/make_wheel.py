#!/usr/bin/python3
# make_wheel.py - a wheel of the package as it was built: python3 packaging/make_wheel.py BUILD OUT VERSION
# BUILD/python/package/roofgs is the package. With it go the programs of BUILD/bin that it calls, the viewer's page in one file
# (roofgs/viewer.html), and libraries that not every Linux has, under names that hold their hash, found by $ORIGIN. The same inputs give the same bytes. SPDX-License-Identifier: Apache-2.0
import argparse
import csv
import hashlib
import io
import os
import re
import shutil
import stat
import subprocess
import tempfile
import zipfile
from base64 import urlsafe_b64encode
from pathlib import Path

from check_wheel import SYSTEM

PROGRAMS = ["rgs-audit", "rgs-convert", "rgs-prune"]
PLATFORM = "manylinux_2_36_x86_64"  # Debian 12's glibc; check_wheel.py holds the wheel to it
ROOT = Path(__file__).resolve().parent.parent


def run(*command):
    return subprocess.run([str(word) for word in command], check=True, capture_output=True, text=True).stdout


def needed(path):
    return re.findall(r"\(NEEDED\).*\[(.*)\]", run("readelf", "--wide", "--dynamic", path))


def bundle(files, folder):
    """Copies what `files` need, directly or not, into `folder`, and makes all of it be found there."""
    paths = {}
    for file in files:
        paths.update(re.findall(r"^\s*(\S+) => (/\S+)", run("ldd", file), re.MULTILINE))
    renamed = {}
    for name, path in sorted(paths.items()):
        if name not in SYSTEM:
            digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()[:8]
            renamed[name] = re.sub(r"\.so", f"-{digest}.so", name, count=1)
    folder.mkdir()
    for name, new in renamed.items():
        shutil.copyfile(paths[name], folder / new)
        (folder / new).chmod(0o755)
    for path in [*files, *folder.iterdir()]:
        inside = path.parent == folder
        # One change a call: patchelf 0.14 mixes up the strings of several.
        run("patchelf", "--force-rpath", "--set-rpath", "$ORIGIN" if inside else f"$ORIGIN/{os.path.relpath(folder, path.parent)}", path)
        for name in needed(path):
            if name in renamed:
                run("patchelf", "--replace-needed", name, renamed[name], path)
        if inside:
            run("patchelf", "--set-soname", path.name, path)
    return sorted(paths[name] for name in renamed)


def licences(libraries, folder):
    """The copyright files of the Debian packages that the libraries are from."""
    folder.mkdir(parents=True)
    shutil.copyfile(ROOT / "LICENSE", folder / "roofgs")
    patterns = [f"*/{Path(library).name}" for library in libraries]
    for package in sorted(set(re.findall(r"^([^:]+)(?::\w+)?: ", run("dpkg", "-S", *patterns), re.MULTILINE)) if patterns else []):
        shutil.copyfile(f"/usr/share/doc/{package}/copyright", folder / package)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("build", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("version")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        tree = Path(temporary)
        shutil.copytree(arguments.build / "python/package/roofgs", tree / "roofgs", ignore=shutil.ignore_patterns("__pycache__"))
        (extension,) = (tree / "roofgs").glob("_roofgs.cpython-*.so")
        python = "cp" + re.search(r"cpython-(\d+)-", extension.name)[1]
        (tree / "roofgs/bin").mkdir()
        for program in PROGRAMS:
            shutil.copy(arguments.build / "bin" / program, tree / "roofgs/bin")
        shutil.copyfile(ROOT / "web/viewer/dist-single/page.html", tree / "roofgs/viewer.html")
        files = [extension, *sorted((tree / "roofgs/bin").iterdir())]
        run("strip", "--strip-unneeded", *files)
        libraries = bundle(files, tree / "roofgs.libs")
        tag = f"{python}-{python}-{PLATFORM}"
        info = tree / f"roofgs-{arguments.version}.dist-info"
        licences(libraries, info / "licenses")
        (info / "WHEEL").write_text(f"Wheel-Version: 1.0\nGenerator: make_wheel.py\nRoot-Is-Purelib: false\nTag: {tag}\n")
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: roofgs\nVersion: {arguments.version}\n"
            "Summary: Compact files for 3D Gaussian splats, and a renderer of them\nLicense: Apache-2.0\n"
            f"Requires-Python: =={python[2]}.{python[3:]}.*\nRequires-Dist: numpy\nDescription-Content-Type: text/markdown\n\n"
            + (ROOT / "docs/user/PYTHON.md").read_text())
        (info / "top_level.txt").write_text("roofgs\n")
        files = sorted(path for path in tree.rglob("*") if path.is_file())
        rows = io.StringIO()
        writer = csv.writer(rows, lineterminator="\n")
        for path in files:
            data = path.read_bytes()
            writer.writerow([path.relative_to(tree), "sha256=" + urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode(),
                             len(data)])
        writer.writerow([(info / "RECORD").relative_to(tree), "", ""])
        (info / "RECORD").write_text(rows.getvalue())
        arguments.out.mkdir(parents=True, exist_ok=True)
        wheel = arguments.out / f"{info.name.removesuffix('.dist-info')}-{tag}.whl"
        with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in [*files, info / "RECORD"]:
                entry = zipfile.ZipInfo(str(path.relative_to(tree)))
                # Of regular files alone pip keeps the bits of programs.
                entry.external_attr = (stat.S_IFREG | (0o755 if ".so" in path.name or path.parent.name == "bin" else 0o644)) << 16
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, path.read_bytes())
        print(wheel)


if __name__ == "__main__":
    main()
