#!/usr/bin/python3
# npz_numpy_test.py - numpy reads what rgs-convert writes as .npz, and the reverse.
# SPDX-License-Identifier: Apache-2.0
"""npz_numpy_test.py RGS_CONVERT"""
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy

with tempfile.TemporaryDirectory() as folder:
    for k, saved in ((0, numpy.savez), (15, numpy.savez_compressed)):
        n = 50
        numbers = numpy.linspace(-0.9, 0.9, n * (14 + 3 * k), dtype="<f4")
        shapes = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4), "opacities": (n,), "sh0": (n, 1, 3), "shN": (n, k, 3)}
        scene, first = {}, 0
        for name, shape in shapes.items():
            scene[name] = numbers[first : first + numpy.prod(shape, dtype=int)].reshape(shape)
            first += scene[name].size
        one, two = Path(folder, f"one{k}.npz"), Path(folder, f"two{k}.npz")
        saved(one, **scene)
        subprocess.run([sys.argv[1], "--quiet", "--no-sync", "--keep-order", one, two], check=True)
        with numpy.load(two) as written:
            assert written.files == list(shapes), written.files
            for name, array in scene.items():
                assert written[name].dtype == numpy.float32 and written[name].shape == array.shape, name
                assert numpy.array_equal(written[name], array), name
