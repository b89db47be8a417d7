"""Each snippet of docs/user/PYTHON.md, in its order. SPDX-License-Identifier: Apache-2.0"""
import re
import shutil

import numpy as np
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
