"""samples/notebooks/look.ipynb runs from its first cell to its last. SPDX-License-Identifier: Apache-2.0"""
import shutil

import nbformat
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
