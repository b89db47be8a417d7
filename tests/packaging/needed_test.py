# needed_test.py - shared libraries link what they use and nothing else: needed_test.py FOLDER [--without-runtime]
# SPDX-License-Identifier: Apache-2.0
import re
import subprocess
import sys
from pathlib import Path

LANGUAGE = {"libstdc++.so.6", "libm.so.6", "libgcc_s.so.1", "libc.so.6", "ld-linux-x86-64.so.2"}
NEEDED = {
    "librgs_format.so": {"libhwy.so.1", "libxxhash.so.0", "libzstd.so.1"},
    "librgs_cameras.so": {"librgs_format.so"},
    "librgs_interchange.so": {"librgs_format.so", "libhwy.so.1", "libz.so.1", "libwebp.so.7", "libzip.so.4", "libzstd.so.1"},
    "librgs_runtime.so": {"librgs_format.so", "librgs_cameras.so", "libtbb.so.12", "libcurl.so.4", "libhwy.so.1"},
}

HEADER = (Path(__file__).resolve().parents[2] / "format/include/rgs/version.hpp").read_text()
VERSION = r"\.".join(re.search(rf"RGS_VERSION_{part} (\d+)", HEADER)[1] for part in ("MAJOR", "MINOR"))

folder = Path(sys.argv[1])
expected = {name: set(libraries) for name, libraries in NEEDED.items()}
if "--without-runtime" in sys.argv:
    del expected["librgs_runtime.so"]
found = {}
for library in sorted(folder.glob("lib*.so")):
    text = subprocess.run(["readelf", "-d", library], check=True, capture_output=True, text=True).stdout
    # Our own by their names without the version, which must be this tree's.
    text = re.sub(rf"(librgs_\w+\.so)\.{VERSION}(?=\])", r"\1", text)
    found[library.name] = set(re.findall(r"\(NEEDED\).*\[(.*)\]", text)) - LANGUAGE
if found != expected:
    sys.exit(f"libraries need {found}\nand should need {expected}")
