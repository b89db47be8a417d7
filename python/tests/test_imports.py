"""Modules import each other in one direction. SPDX-License-Identifier: Apache-2.0"""
import ast
import ctypes
import graphlib
from pathlib import Path

import roofgs
from roofgs import _device_array


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


def test_functions_of_python_keep_the_types_that_others_gave_them():
    assert _device_array._new_capsule is not ctypes.pythonapi.PyCapsule_New
