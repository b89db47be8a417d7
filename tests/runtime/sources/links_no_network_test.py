# links_no_network_test.py - programs that read no URLs do not link libcurl, which would add 20 ms to every start.
# SPDX-License-Identifier: Apache-2.0
import re
import shutil
import subprocess
import sys

from skip import skip_without_tool

if not shutil.which("readelf"):
    skip_without_tool("readelf is not installed")
for program in sys.argv[1:]:
    text = subprocess.run(["readelf", "-d", program], check=True, capture_output=True, text=True).stdout
    needed = re.findall(r"\(NEEDED\).*\[(.*)\]", text)
    if not needed:
        sys.exit(f"{program} needs no library at all, or readelf prints another format")
    if any("curl" in library for library in needed):
        sys.exit(f"{program} needs {needed}")
