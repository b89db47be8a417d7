"""samples/notebooks/look.ipynb runs from its first cell to its last. SPDX-License-Identifier: Apache-2.0"""
import base64
import html
import json
import re
import shutil

import nbformat
import pytest
from conftest import ROOT
from nbclient import NotebookClient

import roofgs


def test_the_notebook_runs(examples, tmp_path):
    for name in ("scene.ply", "cameras.json"):
        shutil.copy(examples / name, tmp_path)
    book = nbformat.read(ROOT / "samples" / "notebooks" / "look.ipynb", as_version=4)
    nbformat.validate(book)
    assert not any(cell.get("outputs") for cell in book.cells)  # none is committed
    NotebookClient(book, timeout=None, startup_timeout=1_000_000, kernel_name="python3",
                   resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    kinds = [kind for output in outputs for kind in output.get("data", {})]
    assert kinds.count("image/png") == 3 and kinds.count("text/html") == 2
    assert any("Gaussians" in output.get("text", "") for output in outputs)
    assert roofgs.load(tmp_path / "scene.rgs").levels > 1 and (tmp_path / "audit.html").exists()


@pytest.mark.parametrize("load", [roofgs.load, roofgs.StreamedScene], ids=["memory", "stream"])
def test_the_viewers_page_holds_the_scene(load, examples, tmp_path, monkeypatch):
    (tmp_path / "page.html").write_bytes("<p title='\u2190'>\r\n<!-- rgs-view:insert --></p>".encode())
    monkeypatch.setattr("roofgs._view._PAGE", tmp_path / "page.html")
    scene = load(examples / "levels.rgs")
    shown = roofgs.view(scene, height=300)
    assert shown.page.startswith("<p title='\u2190'>\r\n<script ") and "rgs-view:insert" not in shown.page
    facts = json.loads(re.search(r'id="rgs-view">(.*?)</script>', shown.page)[1])
    data = base64.b64decode(re.search(r'id="rgs-file-0">(.*?)</script>', shown.page)[1])
    assert facts["scenes"] == [{"name": "scene.rgs", "url": "#rgs-file-0", "bytes": len(data)}]
    (tmp_path / "again.rgs").write_bytes(data)
    assert len(roofgs.load(tmp_path / "again.rgs")) == len(scene)
    frame = shown._repr_html_()
    assert html.unescape(frame.partition('srcdoc="')[2].partition('"')[0]) == shown.page and 'height="300"' in frame


def test_without_the_page_a_view_is_unavailable(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("roofgs._view._PAGE", tmp_path / "page.html")
    with pytest.raises(roofgs.UnavailableError, match="build_page.sh"):
        roofgs.view(scene)
