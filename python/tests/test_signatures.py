"""What mypy --strict says of programs that call the module. SPDX-License-Identifier: Apache-2.0"""
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import roofgs

PROGRAM = """
import numpy as np
import roofgs

scene = roofgs.load("a.rgs")
renderer = roofgs.Renderer(device="cpu", pipeline="turbo")
camera = roofgs.cameras.default_view(scene)
renderer.render(scene, camera, dtype="uint8", depth=True).depth
renderer.render(scene, camera, dtype=np.uint8, anti_aliasing=scene.anti_aliasing).mean()
scene.save("b.rgs", profile="archive:small", lod="best")
x = scene.means
roofgs.convert("a.ply", "b.rgs", profile="archive:tiny", crop=(0, 0, 0, 1, 1, 1), max_count="200k", threads=2)
roofgs.prune("a.ply", "b.rgs", camera, keep=0.5, size=(64, 48), score="max")
roofgs.audit("a.ply", "b.rgs", cameras=[camera], size="64x48", also=["c.rgs"], no_render=True)
roofgs.rasterization(x, x, x, x, x, x, x, 8, 8, render_mode="RGB+ED", rasterize_mode="antialiased")
renderer.render(scene, camera, dtype="float16")  # wrong
renderer.render(scene, camera, anti_aliasing="x")  # wrong
scene.save("b.rgs", profile="x")  # wrong
scene.save("b.rgs", profil="packed")  # wrong
scene.save("b.rgs", lod="slow")  # wrong
scene.save("b.spz", spz_axes="x")  # wrong
roofgs.Renderer(device="gpu")  # wrong
roofgs.Renderer(pipeline="x")  # wrong
roofgs.load("a.spz", spz_axes="x")  # wrong
roofgs.convert("a.ply", "b.rgs", profil="packed")  # wrong
roofgs.convert("a.ply", "b.rgs", profile="x")  # wrong
roofgs.prune("a.ply", "b.rgs", camera, keeps=0.5)  # wrong
roofgs.audit("a.ply", "b.rgs", views="eight")  # wrong
roofgs.rasterization(x, x, x, x, x, x, x, 8, 8, render_mode="x")  # wrong
roofgs.rasterization(x, x, x, x, x, x, x, 8, 8, rasterize_mode="x")  # wrong
"""


def test_wrong_arguments_are_refused_and_others_are_not(tmp_path):
    pytest.importorskip("mypy", reason="mypy is not installed")
    (tmp_path / "program.py").write_text(PROGRAM)
    out = subprocess.run([sys.executable, "-m", "mypy", "--strict", "--cache-dir", tmp_path / "cache", "program.py"], cwd=tmp_path,
                         capture_output=True, text=True, env={**os.environ, "MYPYPATH": str(Path(roofgs.__file__).parents[1])})
    refused = {int(line) for line in re.findall(r"^program.py:(\d+): error:", out.stdout, re.MULTILINE)}
    assert refused == {i for i, line in enumerate(PROGRAM.splitlines(), 1) if line.endswith("# wrong")}, out.stdout + out.stderr
