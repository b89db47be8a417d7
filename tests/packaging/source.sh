#!/bin/sh
# source.sh - pip installs this checkout without a network, and the module renders; the source distribution holds the same files.
# SPDX-License-Identifier: Apache-2.0
set -eux
cd "$(dirname "$0")/../.."
rm -rf build/source
mkdir -p build/source
python=/usr/bin/python3
PYTHONPATH=packaging $python -c 'import make_wheel; make_wheel.build_sdist("build/source")'
tar -tzf build/source/roofgs-*.tar.gz | sed 's|^[^/]*/||' | grep -vx PKG-INFO | sort >build/source/files
git ls-files | sort | diff - build/source/files
CMAKE_ARGS="-G Ninja -DRGS_ENABLE_CUDA=OFF" $python -m pip install --no-index --no-deps --target build/source/site .
PYTHONPATH=build/source/site build/source/site/bin/rgs-info tests/golden/packed_degree3.rgs
PYTHONPATH=build/source/site $python - <<'END'
import roofgs

scene = roofgs.load("tests/golden/packed_degree3.rgs")
assert roofgs.Renderer(device="cpu").render(scene, roofgs.cameras.default_view(scene, width=64, height=48)).max() > 0.05
roofgs.convert("tests/golden/packed_degree3.rgs", "build/source/copy.ply")
END
