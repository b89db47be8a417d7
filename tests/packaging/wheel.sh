#!/bin/sh
# wheel.sh - in a bare root with Python, pip and NumPy, without a network: a wheel installs, renders a file and brings every program:
# wheel.sh WHEEL
# SPDX-License-Identifier: Apache-2.0
set -eux
cd /tmp
if command -v c++; then exit 1; fi
began=$(date +%s)
python3 -m pip install --no-index --break-system-packages "$1"
python3 - <<'END'
import roofgs

scene = roofgs.load("/project/tests/golden/packed_degree3.rgs")
camera = roofgs.cameras.default_view(scene, width=160, height=120)
image = roofgs.Renderer().render(scene, camera)
assert image.shape == (120, 160, 3) and image.max() > 0.05, image.max()
# Arrays hold the scene with every version of NumPy.
assert scene.means.strides == (12, 4) and len(set(scene.means[:, 0])) > 100, scene.means.strides
assert abs(1 - (scene.quats ** 2).sum(axis=1)).max() < 0.01 and camera.world_to_camera.shape == (4, 4)
scene.save("copy.rgs")
assert len(roofgs.load("copy.rgs")) == len(scene)
roofgs.convert("/project/tests/golden/packed_degree3.rgs", "copy.ply")  # by the programs in the wheel
assert roofgs.audit("copy.ply", "copy.rgs", report="audit.html", fail_below={"psnr": 40}).holds
assert len(roofgs.load("copy.ply")) == len(scene)
page = roofgs.view(scene).page
assert 'id="rgs-file-0"' in page and "<!-- rgs-view:insert -->" not in page
try:
    roofgs.Renderer(device="cuda")
except roofgs.UnavailableError as error:
    print(error)
else:
    raise AssertionError("there is a GPU in a bare root")
END
echo "from nothing to the first picture: $(($(date +%s) - began)) s"
mkdir used
(cd used && PATH=/usr/local/bin:$PATH && sh /project/tests/packaging/every_program.sh \
  "$(python3 -c 'import roofgs; print(roofgs.__path__[0])')/share/roofgs/viewer")
python3 -m pip uninstall -y --break-system-packages roofgs
if python3 -c 'import roofgs'; then exit 1; fi
if ls /usr/local/bin/rgs-*; then exit 1; fi
