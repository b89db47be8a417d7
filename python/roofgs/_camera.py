"""The camera."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import operator
from typing import Any, Iterable, List, Optional, Sequence, Tuple

import numpy as np
from numpy.typing import NDArray

from ._errors import make
from ._library import call

_MOST_PIXELS = 65536  # of a side
MODELS = ("pinhole", "opencv", "opencv_fisheye", "equirectangular", "orthographic")  # as the library numbers them
_DISTORTIONS = 8


class Camera:
    """A camera, which never changes; roofgs.cameras says which frames it has.

    Parameters
    ----------
    width, height : int
        Pixels, 1 to 65536.
    fx, fy : float
        Focal lengths, pixels, per radian if equirectangular, per world unit if orthographic; fy is fx unless it is given.
    cx, cy : float
        Principal point, pixels from the left and upper edges; the middle unless it is given.
    world_to_camera : array [4, 4]
        Rigid motion to x right, y down, z forward. Without one the camera is in the world's origin.
    name : str
        Usually the photograph's file name.
    model : str
        "pinhole", "opencv", "opencv_fisheye", "equirectangular" or "orthographic".
    distortion : sequence of float
        Up to 8: k1 k2 p1 p2 k3 k4 k5 k6 of opencv, k1 k2 k3 k4 of opencv_fisheye; those left out are 0.
    """

    __slots__ = ("_name", "_numbers")
    _name: str
    _numbers: Tuple[float, ...]  # as the library takes them

    def __init__(self, width: int, height: int, fx: float, fy: Optional[float] = None, cx: Optional[float] = None,
                 cy: Optional[float] = None, world_to_camera: Any = None, name: str = "", model: str = "pinhole",
                 distortion: Sequence[float] = ()) -> None:
        matrix = np.eye(4) if world_to_camera is None else np.asarray(world_to_camera, dtype=np.float64)
        if matrix.shape != (4, 4):
            raise make("bad_camera", "world_to_camera is a matrix of 4 rows and 4 columns")
        if not isinstance(name, str):
            raise TypeError(f"a camera's name is a str, not {type(name).__name__}")
        if model not in MODELS:
            raise make("bad_camera", f"the camera model {model!r} is not one of {', '.join(MODELS)}")
        coefficients = [float(value) for value in distortion]
        if len(coefficients) > _DISTORTIONS:
            raise make("bad_camera", f"a distortion has at most {_DISTORTIONS} coefficients")
        coefficients += [0.0] * (_DISTORTIONS - len(coefficients))
        width, height = side(width), side(height)
        self._name = name
        self._numbers = (width, height, float(fx), float(fx if fy is None else fy), width / 2 if cx is None else float(cx),
                         height / 2 if cy is None else float(cy), *matrix.ravel().tolist(),
                         MODELS.index(model), *coefficients)
        call("check_cameras", file=name or None, **packed([self]))

    @classmethod
    def _of(cls, numbers: Sequence[float], name: str = "") -> "Camera":
        """From the library, which has checked it."""
        camera = cls.__new__(cls)
        camera._name, camera._numbers = name, tuple(numbers)
        return camera

    @property
    def name(self) -> str:
        """Usually the photograph's file name."""
        return self._name

    @property
    def width(self) -> int:
        """Pixels."""
        return int(self._numbers[0])

    @property
    def height(self) -> int:
        """Pixels."""
        return int(self._numbers[1])

    @property
    def fx(self) -> float:
        """Focal length, pixels."""
        return self._numbers[2]

    @property
    def fy(self) -> float:
        """Focal length, pixels."""
        return self._numbers[3]

    @property
    def cx(self) -> float:
        """Principal point, pixels from the left edge."""
        return self._numbers[4]

    @property
    def cy(self) -> float:
        """Principal point, pixels from the upper edge."""
        return self._numbers[5]

    @property
    def world_to_camera(self) -> "NDArray[np.float64]":
        """[4, 4], a copy."""
        return np.array(self._numbers[6:22]).reshape(4, 4)

    @property
    def model(self) -> str:
        """"pinhole", "opencv", "opencv_fisheye", "equirectangular" or "orthographic"."""
        return MODELS[int(self._numbers[22])]

    @property
    def distortion(self) -> Tuple[float, ...]:
        """8 coefficients, 0 where the model has none."""
        return tuple(self._numbers[23:])

    @property
    def centre(self) -> List[float]:
        """Position in the world."""
        view = self.world_to_camera
        centre: List[float] = (-view[:3, :3].T @ view[:3, 3]).tolist()
        return centre

    def axis(self, axis: int) -> List[float]:
        """World direction of its axis 0 (right), 1 (down) or 2 (forward), unit length."""
        if axis not in (0, 1, 2):
            raise make("bad_argument", "a camera's axes are 0, 1 and 2")
        return list(self._numbers[6 + 4 * axis:9 + 4 * axis])

    def resized(self, width: int, height: int) -> "Camera":
        """The same view in another size; keeps the horizontal field of view."""
        return Camera._of(call("resized", width=side(width), height=side(height), **packed([self])), self._name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Camera) and (self._name, self._numbers) == (other._name, other._numbers)

    def __hash__(self) -> int:
        return hash((self._name, self._numbers))

    def __repr__(self) -> str:
        x, y, z = self.centre
        return (f"<roofgs.Camera {self._name!r} {self.width}x{self.height} fx={self.fx:g} fy={self.fy:g} "
                f"at ({x:.4g}, {y:.4g}, {z:.4g})>")

    def __reduce__(self) -> "tuple[Any, ...]":
        return Camera, (*self._numbers[:6], self.world_to_camera, self._name, self.model, self.distortion)


def side(pixels: int) -> int:
    """A side of a picture."""
    number = operator.index(pixels)
    if not 1 <= number <= _MOST_PIXELS:
        raise make("bad_camera", f"the width or height of a picture is not 1 to {_MOST_PIXELS} pixels")
    return number


def camera_count(n: int, of: str) -> int:
    number = operator.index(n)
    if not 1 <= number < 1 << 31:
        raise make("bad_argument", f"{of} has 1 to {(1 << 31) - 1} cameras, not {number}")
    return number


def packed(cameras: Iterable[Camera]) -> "dict[str, Any]":
    """Cameras as arguments of the library."""
    cameras = list(cameras)
    if not all(isinstance(camera, Camera) for camera in cameras):
        raise TypeError("cameras are objects of roofgs.Camera")
    rows = np.array([camera._numbers for camera in cameras], dtype=np.float64)
    return dict(cameras=rows, n=len(rows))
