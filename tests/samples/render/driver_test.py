# driver_test.py - rgs-render reports the driver found and the one required: driver_test.py RGS_RENDER
# FAKE_DRIVER_FOLDER SCENE.rgs
# SPDX-License-Identifier: Apache-2.0
import os
import re
import subprocess
import sys
import tempfile

program, fake, scene = sys.argv[1:]


def render(backend, **environment):
    with tempfile.TemporaryDirectory() as folder:
        return subprocess.run([program, scene, "--backend", backend, "--size", "32x32", "--out", f"{folder}/p.png"], capture_output=True,
                              text=True, check=False, env={**os.environ, "LD_LIBRARY_PATH": fake, **environment})


def check(holds, what, result):
    if not holds:
        sys.exit(f"not so: {what}\n{result}")


# For any CUDA version built with: an ancient driver reveals the required one, then the version before that is tried.
version = 11080
for _ in range(2):
    old = render("cuda", RGS_FAKE_DRIVER=str(version))
    said = re.search(r"too old; install driver (525|580) or later, or use the CPU backend \(expected (\d+), found (\d+)\)", old.stderr)
    check(old.returncode == 2 and said and int(said[3]) == version // 1000 < int(said[2]), f"{version} is too old", old)
    version = 1000 * (int(said[2]) - 1) + 40
none = render("cuda", RGS_FAKE_DRIVER="0")
check(none.returncode == 2 and "no NVIDIA driver is found; install driver" in none.stderr, "no driver is no driver", none)
drawn = render("auto", RGS_FAKE_DRIVER="12040")
check(drawn.returncode == 0, "the CPU draws where it may", drawn)
