"""Cameras from files, by hand, around a scene or along a path.

A camera's axes are OpenCV's and COLMAP's: x right, y down, z forward. ``world_to_camera`` maps world points to
camera axes; gsplat calls it a view matrix. Pixel (i, j) covers [i, i + 1) x [j, j + 1), so that
``cx = width / 2`` is the middle of the picture. docs/user/CAMERAS.md has the files.
"""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from typing import Any, Iterable, List, Optional, Sequence, Tuple, Union

import numpy as np

from ._arrays import host_array
from ._camera import Camera, camera_count, packed, side
from ._errors import argument_error, local_name, make
from ._library import call
from ._paths import Path
from ._scene import Scene, StreamedScene

__all__ = ["Camera", "CameraList", "default_view", "from_matrices", "load", "look_at", "orbit", "path", "save"]

Vector = Sequence[float]
WORLD_UP = (0.0, -1.0, 0.0)


class CameraList(List[Camera]):
    """The cameras of a file, in its order. A slice is a plain list without parts.

    Attributes
    ----------
    source : str
        ``"list"``, ``"training"`` (cameras.json of 3DGS), ``"transforms"`` (NeRF) or ``"colmap"``.
    split_declared : bool
        Whether the file marks any camera as a test camera; the others are then for training. If not, every eighth by name is a
        test camera.
    train, test : list of Camera
        The two parts.
    """

    def __init__(self, cameras: Iterable[Camera], is_test: Sequence[bool], source: str, split_declared: bool) -> None:
        super().__init__(cameras)
        self.source = source
        self.split_declared = split_declared
        self.train = [camera for camera, test in zip(self, is_test) if not test]
        self.test = [camera for camera, test in zip(self, is_test) if test]

    def named(self, name: str) -> Camera:
        """The camera with this name, else KeyError."""
        for camera in self:
            if camera.name == name:
                return camera
        raise KeyError(name)


def load(path: Path) -> CameraList:
    """Reads a JSON camera file or a folder with a COLMAP model.

    >>> views = load(examples / "cameras.json")
    >>> len(views), views[0].width, views[0].height
    (8, 320, 240)
    """
    file = call("read_cameras", file=path, path=local_name(path))
    cameras = map(Camera._of, file["cameras"], file["names"])
    return CameraList(cameras, file["is_test"], file["source"], file["split_declared"])


def save(path: Path, cameras: Union[Camera, Iterable[Camera]], *, overwrite: bool = False) -> None:
    """Writes cameras as the JSON list of docs/user/CAMERAS.md, whole or not at all; a :class:`CameraList` keeps its declared
    split. An existing file is kept unless `overwrite`.

    >>> save(folder / "two.json", orbit(roofgs.load(examples / "scene.rgs"), 2))
    >>> len(load(folder / "two.json"))
    2
    """
    if isinstance(cameras, Camera):
        cameras = [cameras]
    parts = {}  # by identity: equal cameras may belong to different parts
    if isinstance(cameras, CameraList) and cameras.split_declared:
        parts = {id(camera): split for split in ("train", "test") for camera in getattr(cameras, split)}
    rows = [{"name": camera.name, "width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
             "cx": camera.cx, "cy": camera.cy, "world_to_camera": camera.world_to_camera.tolist(),
             **({"model": camera.model, "distortion": camera.distortion} if camera.model != "pinhole" else {}),
             **({"split": parts[id(camera)]} if id(camera) in parts else {})} for camera in cameras]
    name = local_name(path)
    call("write_cameras", file=name, path=b"./-" if name == b"-" else name, json=json.dumps(rows, indent=1), overwrite=bool(overwrite))


def look_at(eye: Vector, target: Vector, *, up: Vector = WORLD_UP, width: int = 1280, height: int = 720,
            horizontal_fov: float = 60.0) -> Camera:
    """A camera at `eye` that looks at `target`. Field of view in degrees.

    >>> camera = look_at((0, 0, -2), (0, 0, 0), width=64, height=48)
    >>> (camera.world_to_camera @ [0, 0, 0, 1])[:3]
    array([0., 0., 2.])
    """
    return Camera._of(call("look_at", eye=_vector(eye), target=_vector(target), up=_vector(up), width=side(width), height=side(height),
                           horizontal_fov=_field_of_view(horizontal_fov)))


def orbit(scene: Union[Scene, StreamedScene], n: int, *, width: int = 1280, height: int = 720,
          horizontal_fov: Optional[float] = None) -> List[Camera]:
    """`n` cameras around what the first view looks at; of a room, turning where it stands. The first is
    :func:`default_view`."""
    return scene._orbit(n, width, height, None if horizontal_fov is None else _field_of_view(horizontal_fov))


def default_view(scene: Union[Scene, StreamedScene], *, width: int = 1280, height: int = 720,
                 horizontal_fov: Optional[float] = None) -> Camera:
    """The view from which the scene is seen first: the one that its .rgs states, else the best by quick pictures. As wide
    as that, 60 degrees as a rule, unless `horizontal_fov` is given."""
    return orbit(scene, 1, width=width, height=height, horizontal_fov=horizontal_fov)[0]


def path(keys: Iterable[Camera], n: int) -> List[Camera]:
    """`n` cameras along a smooth path through `keys`, first and last included."""
    keys = list(keys)
    if not keys:
        raise argument_error("a path has at least one key")
    return list(map(Camera._of, call("interpolated_path", n_frames=camera_count(n, "a path"), **packed(keys))))


def from_matrices(viewmats: Any, Ks: Any, width: int, height: int) -> List[Camera]:
    """Cameras from matrices in gsplat's conventions.

    Parameters
    ----------
    viewmats : array [..., 4, 4]
        World to camera, OpenCV axes.
    Ks : array [..., 3, 3]
        Intrinsics in pixels: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
    """
    views = np.asarray(host_array(viewmats, "viewmats"), dtype=np.float64)
    intrinsics = np.asarray(host_array(Ks, "Ks"), dtype=np.float64)
    if views.shape[-2:] != (4, 4) or intrinsics.shape != views.shape[:-2] + (3, 3):
        raise argument_error(f"viewmats and Ks are [..., 4, 4] and [..., 3, 3], not {list(views.shape)} and "
                             f"{list(intrinsics.shape)}")
    cameras = []
    for view, k in zip(views.reshape(-1, 4, 4), intrinsics.reshape(-1, 3, 3)):
        if k[0, 1] != 0 or k[1, 0] != 0 or not np.array_equal(k[2], (0.0, 0.0, 1.0)):
            raise argument_error("Ks must have no skew and a last row of 0 0 1")
        cameras.append(Camera(width, height, float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]), view))
    return cameras


def _field_of_view(degrees: float) -> float:
    if not 0 < degrees < 180:
        raise make("bad_camera", "a horizontal field of view is between 0 and 180 degrees")
    return float(degrees)


def _vector(values: Vector) -> Tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
