"""Modules import each other in one direction. SPDX-License-Identifier: Apache-2.0"""
import ast
import graphlib
from pathlib import Path

import roofgs


def test_modules_import_in_one_direction():
    imported = {}
    for path in Path(roofgs.__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text())
        inner = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level > 0]
        assert all(node in tree.body for node in inner), f"{path.name} imports within a function or a condition"
        imported[path.stem] = {name for node in inner for name in
                               ([node.module] if node.module else [alias.name for alias in node.names])}
    assert imported["cameras"]
    graphlib.TopologicalSorter(imported).prepare()  # raises CycleError
