"""Each snippet of docs/user/PYTHON.md, in its order; calls as gsplat's documentation makes them, with another import alone.
SPDX-License-Identifier: Apache-2.0"""
import re
import shutil

import numpy as np
import pytest
from conftest import ROOT

import roofgs

PAGE = ROOT / "docs" / "user" / "PYTHON.md"


def test_snippets_run(examples, tmp_path, monkeypatch):
    for name in ("scene.ply", "scene.rgs", "cameras.json"):
        shutil.copy(examples / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text()
    snippets = re.findall(r"```python\n(.*?)```", text, re.S)
    assert len(snippets) > 4 and "roofgs" in snippets[0]
    names = {}
    for i, snippet in enumerate(snippets):
        exec(compile(snippet, f"{PAGE.name}, snippet {i}", "exec"), names)
    assert names["image"].shape == (240, 320, 3) and names["images"].shape == (12, 240, 320, 3)
    assert names["whole"].shape == names["first"].shape and np.isfinite(names["frame"].depth).all()
    assert len(roofgs.load("kept.rgs")) == len(roofgs.load("levels.rgs")) < len(names["scene"])


# The calls of forward rasterization in gsplat 1.6: docstring, docs/batch.md, docs/source/migration, examples. Those that train, or
# need 2DGS, fisheye, lidar or distorted cameras, have no counterpart here.
CALLS = {
    "positions": """
from gsplat import rasterization

colors, alphas, meta = rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height)
names = set(meta.keys())
visible = len(meta["gaussian_ids"])
""",
    "names": """
from gsplat import rasterization

colors, alphas, meta = rasterization(means=means, quats=quats, scales=scales, opacities=opacities, colors=colors,
                                     viewmats=viewmats, Ks=Ks, width=width, height=height, packed=False)
means2d, radii = meta["means2d"][0], meta["radii"]
visible = int((radii > 0).all(-1).sum())
""",
    "harmonics": """
from gsplat.rendering import rasterization

colors, alphas, meta = rasterization(means=means, quats=quats, scales=scales, opacities=opacities, colors=sh, sh_degree=2,
                                     viewmats=viewmats, Ks=Ks, width=width, height=height, near_plane=0.01, far_plane=100.0,
                                     radius_clip=0.0, eps2d=0.3, rasterize_mode="antialiased", camera_model="pinhole")
""",
    "depth": """
from gsplat.rendering import rasterization

given = dict(means=means, quats=quats, scales=scales, opacities=opacities, viewmats=viewmats, Ks=Ks, width=width, height=height)
expected, _, _ = rasterization(**given, colors=None, render_mode="ED")
accumulated, alphas, _ = rasterization(**given, colors=colors, render_mode="D")
both, _, _ = rasterization(**given, colors=colors, render_mode="RGB+ED")
""",
    "viewer": """
from gsplat.rendering import rasterization

both, alphas, info = rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, render_mode="RGB+D",
                                   packed=False, distributed=False)
depths = both[..., 3:4] / both[..., 3:4].max()
""",
    "trainer": """
from gsplat.rendering import rasterization

colors, alphas, info = rasterization(
    means=means, quats=quats, scales=scales, opacities=opacities, colors=sh, viewmats=viewmats, Ks=Ks, width=width,
    height=height, packed=True, absgrad=False, sparse_grad=False, rasterize_mode="classic", distributed=False,
    camera_model="pinhole", with_ut=False, with_eval3d=False, radial_coeffs=None, tangential_coeffs=None,
    thin_prism_coeffs=None, ftheta_coeffs=None, sh_degree=1, backgrounds=backgrounds, tile_size=None)
""",
    "batch": """
from gsplat import rasterization

renders, alphas, meta = rasterization(*(stack([each, each]) for each in (means, quats, scales, opacities, colors)),
                                      stack([viewmats, viewmats]), stack([Ks, Ks]), width, height)
""",
}


@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize("call", CALLS)
def test_calls_of_gsplat(call, library):
    array = np.asarray
    if library == "torch":
        torch = pytest.importorskip("torch", reason="torch is not installed")
        array = torch.from_numpy
    r = np.random.default_rng(3)
    given = dict(means=r.normal(size=(100, 3)), quats=r.normal(size=(100, 4)), scales=0.1 * r.uniform(size=(100, 3)),
                 opacities=r.uniform(size=100), colors=r.uniform(size=(100, 3)), sh=r.normal(size=(100, 9, 3)),
                 viewmats=np.stack([np.eye(4)] * 2), Ks=np.array([[[30.0, 0, 15], [0, 30, 10], [0, 0, 1]]] * 2),
                 backgrounds=r.uniform(size=(2, 3)))
    given["viewmats"][:, 2, 3] = 3, 5
    names = {name: array(each.astype(np.float32)) for name, each in given.items()}
    names.update(width=30, height=20, stack=np.stack if library == "numpy" else torch.stack)
    exec(compile(CALLS[call].replace("from gsplat", "from roofgs"), call, "exec"), names)
    found = {name: np.asarray(names[name]) for name in ("colors", "alphas", "expected", "accumulated", "both", "depths", "renders",
                                                        "means2d", "radii") if name in names}
    colors = found.get("renders", found.get("both", found["colors"]))
    batch = (2,) if call == "batch" else ()
    assert found["alphas"].shape == (*batch, 2, 20, 30, 1) and 0.2 < found["alphas"].max() <= 1
    assert colors.shape == (*batch, 2, 20, 30, 4 if "both" in found else 3) and colors[..., :3].std() > 0.01
    if call in ("positions", "names"):
        assert 50 < names["visible"] <= 200
    if call == "positions":
        assert names["names"] > {"camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities", "width", "height"}
    if call == "names":
        assert found["means2d"].shape == (100, 2) and found["radii"].shape == (2, 100, 2)
    if call == "depth":
        np.testing.assert_allclose(found["expected"] * found["alphas"], found["accumulated"], rtol=1e-5)
        np.testing.assert_array_equal(found["both"][..., 3:], found["expected"])
    if call == "viewer":
        assert found["depths"].max() == 1
    if call == "batch":
        np.testing.assert_array_equal(found["renders"][0], found["renders"][1])
