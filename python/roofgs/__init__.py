"""RoofGS: compact files for 3D Gaussian splats, and a renderer for them.

>>> import roofgs
>>> scene = roofgs.load(examples / "scene.rgs")
>>> camera = roofgs.cameras.default_view(scene, width=64, height=48)
>>> roofgs.Renderer(device="cpu").render(scene, camera).shape
(48, 64, 3)

Start with docs/user/PYTHON.md; the docstrings are the manual.
"""
# SPDX-License-Identifier: Apache-2.0
from . import cameras
from ._camera import Camera
from ._errors import (ArgumentError, DeviceError, Error, FormatError, IncompleteError, InputOutputError, InternalError,
                      MissingFileError, OutOfMemoryError, OutputExistsError, QualityError, UnavailableError)
from ._device_array import DeviceArray
from ._library import version as __version__
from ._pictures import png
from ._programs import Audit, audit, convert, prune
from ._rasterization import rasterization
from ._render import Frame, Renderer
from ._scene import Scene, StreamedScene, StreamPool, info, load
from ._view import View, view

__all__ = [
    "ArgumentError", "Audit", "Camera", "DeviceArray", "DeviceError", "Error", "FormatError", "Frame", "IncompleteError",
    "InputOutputError", "InternalError", "MissingFileError", "OutOfMemoryError", "OutputExistsError", "QualityError",
    "Renderer", "Scene", "StreamPool", "StreamedScene", "UnavailableError", "View", "audit", "cameras", "convert", "info", "load", "png",
    "prune", "rasterization", "view", "__version__",
]
