# set_version.py - the version in every file that states it: python3 scripts/set_version.py [VERSION]
# Without VERSION it prints the version, or exits with 4 and names the files that state another. With it, all of them state VERSION,
# and what CHANGELOG.md lists under "Unreleased" becomes VERSION's. Its date is SOURCE_DATE_EPOCH, or the last commit's.
# format/include/rgs/version.hpp is where CMake, the wheel and Conan read it.
# SPDX-License-Identifier: Apache-2.0
import datetime
import os
import re
import subprocess
import sys
from email.utils import format_datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HEADER = ROOT / "format/include/rgs/version.hpp"
CHANGELOG = ROOT / "CHANGELOG.md"
DEBIAN = ROOT / "packaging/debian/changelog"
PARTS = ("MAJOR", "MINOR", "PATCH")
# Each states the version, or MAJOR.MINOR, as the pattern's second group.
OWN = r'((?:"name": "@?roofgs\S*",\s+|"@roofgs/[a-z]+": )(?:"version": )?")([0-9.]+)(?=")'
PLACES = {
    "packaging/vcpkg/roofgs/vcpkg.json": OWN,
    "web/*/package.json": OWN,
    "web/package-lock.json": OWN,
    "samples/*/CMakeLists.txt": r"(find_package\(rgs )([0-9.]+)",
}


def places():
    return [(path, pattern) for glob, pattern in PLACES.items() for path in sorted(ROOT.glob(glob))
            if re.search(pattern, path.read_text())]


def stated():
    return ".".join(re.search(rf"RGS_VERSION_{part} (\d+)", HEADER.read_text())[1] for part in PARTS)


def wrong():
    """The files that state another version than the header."""
    version = stated()
    minor = version.rpartition(".")[0]
    found = [str(path.relative_to(ROOT)) for path, pattern in places()
             if not {match[2] for match in re.finditer(pattern, path.read_text())} <= {version, minor}]
    if not DEBIAN.read_text().startswith(f"roofgs ({version}-"):
        found.append(str(DEBIAN.relative_to(ROOT)))
    return found


def date():
    epoch = os.environ.get("SOURCE_DATE_EPOCH") or subprocess.run(
        ["git", "-C", ROOT, "log", "-1", "--format=%ct"], check=True, capture_output=True, text=True).stdout
    return datetime.datetime.fromtimestamp(int(epoch), datetime.timezone.utc)


def set_version(version):
    changes = CHANGELOG.read_text()
    if not re.search(r"^## Unreleased\n+[^#\n]", changes, re.MULTILINE):
        print('set_version.py: CHANGELOG.md lists nothing under "## Unreleased": write there what is new', file=sys.stderr)
        return 2
    if re.search(rf"^## {re.escape(version)}(?!\S)", changes, re.MULTILINE):
        print(f"set_version.py: CHANGELOG.md has a part of {version} already", file=sys.stderr)
        return 2
    heading = f"## Unreleased\n\n## {version} ({date():%Y-%m-%d})\n"
    CHANGELOG.write_text(changes.replace("## Unreleased\n", heading, 1))
    for part, number in zip(PARTS, version.split(".")):
        HEADER.write_text(re.sub(rf"(RGS_VERSION_{part}) \d+", rf"\1 {number}", HEADER.read_text()))
    for path, pattern in places():
        path.write_text(re.sub(
            pattern, lambda m: m[1] + (version if m[2].count(".") == 2 else version.rpartition(".")[0]), path.read_text()))
    debian = DEBIAN.read_text()
    if not debian.startswith(f"roofgs ({version}-"):
        maintainer = re.search(r"^ -- (.*?)  ", debian, re.MULTILINE)[1]
        DEBIAN.write_text(f"roofgs ({version}-1) unstable; urgency=medium\n\n  * Version {version}: CHANGELOG.md.\n\n"
                          f" -- {maintainer}  {format_datetime(date())}\n\n{debian}")
    return 0


def main():
    if len(sys.argv) > 1:
        return set_version(sys.argv[1])
    if files := wrong():
        print(f"set_version.py: the version is {stated()}, but not in {', '.join(files)}", file=sys.stderr)
        return 4
    print(stated())
    return 0


if __name__ == "__main__":
    sys.exit(main())
