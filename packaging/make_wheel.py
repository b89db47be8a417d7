#!/usr/bin/python3
# make_wheel.py - the wheel that serves every Python: python3 packaging/make_wheel.py [--bundle] BUILD OUT VERSION [-DNAME=VALUE...]
# It is built in BUILD. With the package go the programs, as commands too, and, if it was built, the viewer's page. --bundle: also libraries
# that not every Linux has and those that module and programs share, under names that hold their hash, found by $ORIGIN; the tag then
# names the oldest glibc that has all symbols.
# The same inputs give the same bytes. build_wheel() and build_sdist() are what pip calls (PEP 517, pyproject.toml).
# SPDX-License-Identifier: Apache-2.0
import argparse
import csv
import gzip
import hashlib
import io
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from base64 import urlsafe_b64encode
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "packaging"))
from check_wheel import SYSTEM, oldest_glibc  # noqa: E402

PROGRAMS = ["rgs-audit", "rgs-convert", "rgs-diff", "rgs-info", "rgs-judge", "rgs-make-scene", "rgs-prune", "rgs-render", "rgs-view"]
# pip puts it on PATH. A program there would not find its libraries: the way from it to the package differs between installations.
COMMAND = """#!python
import os
import sys
from importlib.util import find_spec

package = find_spec("roofgs")
if package is None:
    sys.exit("{name}: Python does not find the package roofgs, whose programs this calls")
program = os.path.join(package.submodule_search_locations[0], "bin", "{name}")
os.execv(program, [program, *sys.argv[1:]])
"""
INFO = """Metadata-Version: 2.1
Name: roofgs
Version: {version}
Summary: Compact files for 3D Gaussian splats, and a renderer of them
License: Apache-2.0
Requires-Python: >=3.9
Requires-Dist: numpy>=1.22
Description-Content-Type: text/markdown

"""


def run(*command, **environment):
    return subprocess.run([str(word) for word in command], check=True, capture_output=True, text=True,
                          env={**os.environ, **environment}).stdout


def needed(path):
    return re.findall(r"\(NEEDED\).*\[(.*)\]", run("readelf", "--wide", "--dynamic", path))


def bundle(files, built, folder):
    """Copies what `files` need, directly or not, into `folder`, and makes all of it be found there. The paths of those that are not
    from the folder `built`."""
    paths = {}
    for file in files:
        paths.update(re.findall(r"^\s*(\S+) => (/\S+)", run("ldd", file, LD_LIBRARY_PATH=str(built)), re.MULTILINE))
    renamed = {}
    for name, path in sorted(paths.items()):
        if name not in SYSTEM:
            digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()[:8]
            renamed[name] = re.sub(r"\.so", f"-{digest}.so", name, count=1)
    folder.mkdir()
    own = {name for name in renamed if Path(paths[name]).is_relative_to(built)}
    for name, new in renamed.items():
        shutil.copyfile(paths[name], folder / new)
        (folder / new).chmod(0o755)
        if name in own:
            run("strip", "--strip-unneeded", folder / new)
    for path in [*files, *folder.iterdir()]:
        inside = path.parent == folder
        # One change a call: patchelf 0.14 mixes up the strings of several.
        run("patchelf", "--force-rpath", "--set-rpath", "$ORIGIN" if inside else f"$ORIGIN/{os.path.relpath(folder, path.parent)}", path)
        for name in needed(path):
            if name in renamed:
                run("patchelf", "--replace-needed", name, renamed[name], path)
        if inside:
            run("patchelf", "--set-soname", path.name, path)
    return sorted(paths[name] for name in renamed if name not in own)


def licences(libraries, folder):
    """The copyright files of the Debian packages that the libraries are from."""
    folder.mkdir(parents=True)
    shutil.copyfile(ROOT / "LICENSE", folder / "roofgs")
    patterns = [f"*-linux-gnu/{Path(library).name}" for library in libraries]  # not those for other processors
    for package in sorted(set(re.findall(r"^([^:]+)(?::\w+)?: ", run("dpkg", "-S", *patterns), re.MULTILINE)) if patterns else []):
        shutil.copyfile(f"/usr/share/doc/{package}/copyright", folder / package)


def build(folder, is_bundle, options):
    """Those of PROGRAMS that there are: rgs-view needs Boost."""
    shutil.rmtree(folder / "python/package", ignore_errors=True)  # files that the package no longer has
    subprocess.run(["cmake", "-S", ROOT, "-B", folder, "-DCMAKE_BUILD_TYPE=Release", "-DRGS_BUILD_PYTHON=ON",
                    "-DRGS_BUILD_SAMPLES=ON", "-DRGS_BUILD_TESTS=OFF",
                    *options, f"-DBUILD_SHARED_LIBS={'ON' if is_bundle else 'OFF'}"], check=True, stdout=sys.stderr)
    has_view = re.search(r"^RGS_ENABLE_VIEW:BOOL=(1|ON|TRUE)$", (folder / "CMakeCache.txt").read_text(), re.MULTILINE)
    programs = [name for name in PROGRAMS if has_view or name != "rgs-view"]
    subprocess.run(["cmake", "--build", folder, "--parallel", os.environ.get("RGS_JOBS", str(os.cpu_count())),
                    "--target", "rgs_python_package", *programs], check=True, stdout=sys.stderr)
    return programs


def metadata(version):
    return INFO.format(version=version) + (ROOT / "docs/user/PYTHON.md").read_text()


def pack(built, programs, out, version, is_bundle):
    """The wheel's path."""
    with tempfile.TemporaryDirectory() as temporary:
        tree = Path(temporary)
        shutil.copytree(built / "python/package/roofgs", tree / "roofgs", ignore=shutil.ignore_patterns("__pycache__"))
        (tree / "roofgs/bin").mkdir()
        commands = tree / f"roofgs-{version}.data/scripts"
        commands.mkdir(parents=True)
        for name in programs:
            shutil.copy(built / "bin" / name, tree / "roofgs/bin")
            (commands / name).write_text(COMMAND.format(name=name))
        page = tree / "roofgs/share/roofgs/viewer"  # where rgs-view looks
        if (ROOT / "web/viewer/dist-single/page.html").exists():
            shutil.copytree(ROOT / "web/viewer/dist", page)
            shutil.copyfile(ROOT / "web/viewer/dist-single/page.html", page / "single.html")
            run("sh", ROOT / "scripts/make_sample.sh", built / "bin", page / "sample.rgs")
        files = [tree / "roofgs/lib/libroofgs.so", *sorted((tree / "roofgs/bin").iterdir())]
        info = tree / f"roofgs-{version}.dist-info"
        run("strip", "--strip-unneeded", *files)
        licences(bundle(files, (built / "lib").resolve(), tree / "roofgs.libs") if is_bundle else [], info / "licenses")
        platform = "linux_" + os.uname().machine
        if is_bundle:
            glibc = oldest_glibc(path for path in tree.rglob("*") if path.is_file() and path.read_bytes()[:4] == b"\x7fELF")
            platform = "many" + platform.replace("_", f"_{glibc[0]}_{glibc[1]}_", 1)
        tag = f"py3-none-{platform}"
        (info / "WHEEL").write_text(f"Wheel-Version: 1.0\nGenerator: make_wheel.py\nRoot-Is-Purelib: false\nTag: {tag}\n")
        (info / "METADATA").write_text(metadata(version))
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
        out.mkdir(parents=True, exist_ok=True)
        wheel = out / f"roofgs-{version}-{tag}.whl"
        with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in [*files, info / "RECORD"]:
                entry = zipfile.ZipInfo(str(path.relative_to(tree)))
                # Of regular files alone pip keeps the bits of programs.
                is_program = ".so" in path.name or path.parent.name in ("bin", "scripts")
                entry.external_attr = (stat.S_IFREG | (0o755 if is_program else 0o644)) << 16
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, path.read_bytes())
        return wheel


def source_version():
    header = (ROOT / "format/include/rgs/version.hpp").read_text()
    return ".".join(re.search(rf"RGS_VERSION_{part} (\d+)", header)[1] for part in ("MAJOR", "MINOR", "PATCH"))


# CMAKE_ARGS holds options for CMake.
def build_wheel(wheel_directory, config_settings=None, metadata_directory=None):
    folder = ROOT / "build/pip"
    programs = build(folder, False, shlex.split(os.environ.get("CMAKE_ARGS", "")))
    return pack(folder, programs, Path(wheel_directory), source_version(), False).name


def build_sdist(sdist_directory, config_settings=None):
    name = f"roofgs-{source_version()}"
    epoch = int(os.environ.get("SOURCE_DATE_EPOCH", 0)) or None

    def same_everywhere(entry):
        entry.uid, entry.gid, entry.uname, entry.gname, entry.mtime = 0, 0, "", "", epoch or entry.mtime
        entry.mode = 0o755 if entry.mode & 0o100 else 0o644
        return entry

    with gzip.GzipFile(Path(sdist_directory) / f"{name}.tar.gz", "wb", mtime=epoch) as zipped, \
            tarfile.open(fileobj=zipped, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for file in run("git", "-C", ROOT, "ls-files", "-z").split("\0")[:-1]:
            archive.add(ROOT / file, f"{name}/{file}", filter=same_everywhere)
        data = metadata(source_version()).encode()
        entry = same_everywhere(tarfile.TarInfo(f"{name}/PKG-INFO"))
        entry.size = len(data)
        archive.addfile(entry, io.BytesIO(data))
    return f"{name}.tar.gz"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--bundle", action="store_true")
    parser.add_argument("build", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("version", nargs="?", default=source_version())
    arguments, options = parser.parse_known_args()
    programs = build(arguments.build, arguments.bundle, options)
    print(pack(arguments.build, programs, arguments.out, arguments.version, arguments.bundle))


if __name__ == "__main__":
    main()
