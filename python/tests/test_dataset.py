"""samples/python/rendered_views.py: with torch, and where there is none with the little of it that counts.
SPDX-License-Identifier: Apache-2.0"""
import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

import roofgs

SAMPLE = ROOT / "samples" / "python" / "rendered_views.py"

# A fresh process, as a program that trains is: it makes the data set, forks workers and asks them for views.
FORKING = """
import importlib.util, multiprocessing, sys, types
torch = types.ModuleType("torch"); data = types.ModuleType("torch.utils.data")
class Tensor:
    def __init__(self, array): self.array = array
    def permute(self, *axes): return Tensor(self.array.transpose(axes))
torch.from_numpy = Tensor; data.Dataset = object; data.DataLoader = None
sys.modules.update({"torch": torch, "torch.utils": types.ModuleType("torch.utils"), "torch.utils.data": data})
import roofgs
spec = importlib.util.spec_from_file_location("rendered_views", sys.argv[1])
sample = importlib.util.module_from_spec(spec); sys.modules["rendered_views"] = sample; spec.loader.exec_module(sample)
cameras = [camera.resized(32, 24) for camera in roofgs.cameras.load(sys.argv[3])]
views = sample.RenderedViews(sys.argv[2], cameras)

def mean(i):
    image, index = views[i]
    assert index == i and image.array.shape == (3, 24, 32)
    return float(image.array.mean())

context = multiprocessing.get_context("fork")
with context.Pool(2) as pool:
    print(pool.map(mean, range(len(views))))
"""


def test_forked_workers_open_the_scene_themselves(examples):
    out = subprocess.run([sys.executable, "-c", FORKING, SAMPLE, examples / "scene.rgs", examples / "cameras.json"],
                         capture_output=True, text=True, env=os.environ)
    assert out.returncode == 0, out.stderr
    renderer, scene = roofgs.Renderer(device="cpu"), roofgs.load(examples / "scene.rgs")
    views = [view.resized(32, 24) for view in roofgs.cameras.load(examples / "cameras.json")]
    np.testing.assert_allclose(eval(out.stdout), [renderer.render(scene, view).mean() for view in views], rtol=1e-5)


@pytest.mark.parametrize("workers", [0, 2])
def test_with_torch(workers, examples):
    pytest.importorskip("torch", reason="torch is not installed")
    out = subprocess.run([sys.executable, SAMPLE, examples / "scene.rgs", examples / "cameras.json", str(workers)],
                         capture_output=True, text=True, check=True, env=os.environ)
    assert out.stdout.count("(4, 3, 240, 320)") == 2
