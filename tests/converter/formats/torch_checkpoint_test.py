#!/usr/bin/python3
# torch_checkpoint_test.py - rgs-convert reads the tensors of a checkpoint, and nothing but tensors.
# SPDX-License-Identifier: Apache-2.0
"""torch_checkpoint_test.py RGS_CONVERT [FOLDER]

Writes what torch.save() writes without PyTorch: Python's own pickler, classes of the same names, and a file for each storage.
FOLDER gets the checkpoints too.
"""
import collections
import io
import os
import pickle
import subprocess
import sys
import tempfile
import types
import zipfile
from pathlib import Path

import numpy

torch = types.ModuleType("torch")
torch._utils = types.ModuleType("torch._utils")
sys.modules.update({"torch": torch, "torch._utils": torch._utils})
TYPES = {"FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8"}
for storage in TYPES:
    setattr(torch, storage, type(storage, (), {"__module__": "torch"}))


def _rebuild_tensor_v2():
    pass


def _rebuild_parameter():
    pass


for function in (_rebuild_tensor_v2, _rebuild_parameter):
    function.__module__ = "torch._utils"
    setattr(torch._utils, function.__name__, function)


class Tensor:
    """A view of `storage`, a flat array; sizes and strides in numbers."""

    def __init__(self, storage, offset, sizes, strides):
        self.storage, self.view = storage, (offset, sizes, strides)

    def __reduce_ex__(self, protocol):
        return _rebuild_tensor_v2, (self.storage, *self.view, False, collections.OrderedDict())


class Parameter:
    def __init__(self, tensor):
        self.tensor = tensor

    def __reduce_ex__(self, protocol):
        return _rebuild_parameter, (self.tensor, True, collections.OrderedDict())


def save(path, data, name="archive"):
    numbers = []

    class Pickler(pickle.Pickler):
        def persistent_id(self, value):
            if not isinstance(value, numpy.ndarray):
                return None
            kind = next(kind for kind, dtype in TYPES.items() if value.dtype == dtype)
            numbers.append(value)
            return "storage", getattr(torch, kind), str(len(numbers) - 1), "cuda:0", value.size

    text = io.BytesIO()
    Pickler(text, 2).dump(data)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}/data.pkl", text.getvalue())
        archive.writestr(f"{name}/byteorder", "little")
        for i, storage in enumerate(numbers):
            archive.writestr(f"{name}/data/{i}", storage.tobytes())
        archive.writestr(f"{name}/version", "3\n")


def tensor(array):
    return Tensor(array.ravel(), 0, array.shape, tuple(s // array.itemsize for s in array.strides))


def scene(n, k, dtype):
    shapes = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4), "opacities": (n,), "sh0": (n, 1, 3), "shN": (n, k, 3)}
    numbers = numpy.linspace(-0.9, 0.9, n * 59).astype(dtype)
    return {name: numbers[i : i + numpy.prod(shape, dtype=int)].reshape(shape) for i, (name, shape) in enumerate(shapes.items())}


with tempfile.TemporaryDirectory() as folder:
    folder = Path(sys.argv[2] if len(sys.argv) > 2 else folder)

    def convert(name):
        return subprocess.run([sys.argv[1], "--quiet", "--no-sync", "--overwrite", folder / name, folder / "out.npz"],
                              capture_output=True, text=True)

    def check(name, arrays):
        run = convert(name)
        assert run.returncode == 0, run.stderr
        with numpy.load(folder / "out.npz") as out:
            for parameter, array in arrays.items():
                assert numpy.array_equal(out[parameter], array.astype("<f4")), (name, parameter)
        os.remove(folder / "out.npz")

    # As gsplat's trainer: the state_dict of a ParameterDict has metadata; a further tensor of another type beside it.
    arrays = scene(4, 3, "<f4")
    state = collections.OrderedDict((name, tensor(array)) for name, array in arrays.items())
    state._metadata = collections.OrderedDict({"": {"version": 1}})
    count = Tensor(numpy.arange(3, dtype="<i8"), 0, (3,), (1,))
    save(folder / "gsplat.pt", {"step": 29999, "splats": state, "big": 1 << 40, "rate": 1e-3, "seen": [count, None, -1, 300]})
    check("gsplat.pt", arrays)

    # Parameters at the top, views of one storage with strides, no higher harmonics.
    arrays = scene(4, 0, "<f2")
    shared = numpy.arange(64, dtype="<f2")
    arrays["means"] = shared[5 : 5 + 4 * 7].reshape(4, 7)[:, :3]
    state = {name: Parameter(tensor(array)) for name, array in arrays.items() if name != "shN"}
    state["means"] = Parameter(Tensor(shared, 5, (4, 3), (7, 1)))
    save(folder / "views.pt", state, "views")
    check("views.pt", {name: array for name, array in arrays.items() if name != "shN"})

    # Nothing is executed: a pickle that would call a function of Python is refused, at its byte.
    class Harm:
        def __reduce__(self):
            return os.system, (f"touch {folder}/harmed",)

    save(folder / "harm.pt", {"splats": Harm()})
    run = convert("harm.pt")
    assert run.returncode == 4 and "more than tensors" in run.stderr and "byte 18" in run.stderr, run.stderr
    assert not (folder / "harmed").exists()

    for sizes, strides, offset in (((4, 3), (3, 1), 1), ((5, 3), (3, 1), 0), ((4, 3), (3, 2), 0), ((4, 3), (1 << 60, 1), 0),
                                   ((4, 3), (-3, 1), 0), ((4, 3), (3,), 0), ((1 << 50, 3), (0, 1), 0), ((4, 3), (3, 1), -1)):
        state = {name: tensor(array) for name, array in scene(4, 0, "<f4").items()}
        state["means"] = Tensor(numpy.zeros(12, "<f4"), offset, sizes, strides)
        save(folder / "wrong.pt", state)
        run = convert("wrong.pt")
        assert run.returncode == 4, (sizes, strides, offset, run.stderr)
