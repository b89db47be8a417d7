"""Scenes in memory, and streamed scenes."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64
import html
import json
import math
import operator
from typing import Any, Dict, List, Literal, Optional, Tuple, Union, get_args

import numpy as np
from numpy.typing import NDArray

from ._arrays import FloatArray, float_array, host_array, new_output
from ._camera import Camera, camera_count, packed, side
from ._draw import Drawer, make_options
from ._errors import Error, FormatError, argument_error, local_name
from ._library import Handle, call, run, work
from ._paths import Path, encoded, shown
from ._pictures import png
from ._progress import Progress, Reporting

Vector3 = Tuple[float, float, float]
AntiAliasing = Literal["classic", "mip"]
SpzAxes = Literal["ply", "opengl"]
Profile = Literal["packed", "direct", "archive", "archive:high", "archive:small", "archive:tiny"]
_DEGREES = {0: 0, 3: 1, 8: 2, 15: 3}
_LEGAL = {"scales": (0.0, math.inf), "opacities": (0.0, 1.0)}


class _Memory:
    """A scene's memory as a read-only array [shape], which keeps it alive."""

    def __init__(self, scene: Handle, address: int, shape: Tuple[int, ...]) -> None:
        self.scene = scene
        # Any address will do for an array without elements.
        self.__array_interface__ = {"data": (address or 64, True), "shape": shape, "typestr": np.dtype(np.float32).str, "version": 3}


class Scene:
    """An immutable set of Gaussians.

    Made by :func:`load` or from arrays, which are copied: NumPy arrays, torch tensors, or anything else with DLPack, in host
    memory or on a GPU. Values are activated, as gsplat's ``rasterization()`` takes them.

    Parameters
    ----------
    means : array [n, 3]
        Centres relative to `origin`, world units.
    quats : array [n, 4]
        Rotations w, x, y, z; normalised if they are not. 0 is no rotation.
    scales : array [n, 3]
        Standard deviations along the local axes, world units, 0 and above.
    opacities : array [n]
        0 to 1.
    sh0 : array [n, 1, 3] or [n, 3]
        Coefficients of spherical harmonics of degree 0, in the basis of 3DGS: colour = 0.5 + 0.2820948 sh0.
    shN : array [n, 3 or 8 or 15, 3], optional
        Coefficients of degrees 1 to 1, 2 or 3.
    origin : three numbers
        The world point that means are relative to, for scenes so far away that float32 would round them.
    anti_aliasing : "classic" or "mip"
        How the scene was trained.
    low_pass : float, optional
        px^2 added to projected covariances in training; 0.3, or 0.1 with "mip".

    >>> scene = Scene(means=np.zeros((1, 3)), quats=[[1, 0, 0, 0]], scales=np.full((1, 3), 0.1), opacities=[0.5],
    ...               sh0=np.ones((1, 3)))
    >>> scene
    <roofgs.Scene 1 Gaussian, SH degree 0>
    >>> scene.scales
    array([[0.1, 0.1, 0.1]], dtype=float32)
    """

    _native: Handle
    _facts: Dict[str, Any]
    _path: Optional[bytes]

    def __init__(self, means: Any, quats: Any, scales: Any, opacities: Any, sh0: Any, shN: Any = None, *,
                 origin: Any = (0.0, 0.0, 0.0), anti_aliasing: AntiAliasing = "classic",
                 low_pass: Optional[float] = None) -> None:
        if anti_aliasing not in ("classic", "mip"):
            raise argument_error(f"anti_aliasing is 'classic' or 'mip', not {anti_aliasing!r}")
        centres = float_array(means, "means", (None, 3))
        n = centres.shape[0]
        first = host_array(sh0, "sh0")
        first = float_array(first.reshape(n, 1, 3) if first.shape == (n, 3) else first, "sh0", (n, 1, 3))
        coefficients, degree = first, 0
        if shN is not None:
            others = float_array(shN, "shN", (n, None, 3))
            if others.shape[1] not in _DEGREES:
                raise argument_error(f"shN has {others.shape[1]} coefficients; 0, 3, 8 or 15 make a degree")
            degree = _DEGREES[others.shape[1]]
            coefficients = np.concatenate([first, others], axis=1)
        x, y, z = (float(value) for value in origin)
        self._take_arrays(centres, float_array(quats, "quats", (n, 4)), float_array(scales, "scales", (n, 3)),
                          float_array(opacities, "opacities", (n,)), coefficients, degree, (x, y, z), anti_aliasing, low_pass)

    def _take_arrays(self, means: FloatArray, quats: FloatArray, scales: FloatArray, opacities: FloatArray, sh: FloatArray,
                     degree: int, origin: Vector3, anti_aliasing: str, low_pass: Optional[float]) -> None:
        try:
            self._native = Handle()
            work("scene_of_arrays", into=self._native, means=means, quats=quats, scales=scales, opacities=opacities, sh=sh,
                 n=len(means), sh_degree=degree, origin=origin, anti_aliasing=anti_aliasing,
                 low_pass=None if low_pass is None else float(low_pass))
        except FormatError as error:  # the library names only the Gaussian
            damage = _damage(means=means, quats=quats, scales=scales, opacities=opacities, sh0=sh[:, :1], shN=sh[:, 1:])
            raise damage or error from None
        self._facts, self._path = {**call("facts", scene=self._native), "format": None}, None

    @classmethod
    def _of_file(cls, path: bytes, native: Handle, facts: Dict[str, Any]) -> "Scene":
        scene = cls.__new__(cls)
        scene._native, scene._facts, scene._path = native, facts, path
        return scene

    def __copy__(self) -> "Scene":
        return self

    def __deepcopy__(self, memo: Dict[int, Any]) -> "Scene":
        return self

    def __reduce__(self) -> Any:
        raise TypeError("a roofgs.Scene cannot be pickled: pass its path and load it in the other process")

    @classmethod
    def _of_sh(cls, means: FloatArray, quats: FloatArray, scales: FloatArray, opacities: FloatArray, sh: FloatArray,
               anti_aliasing: str, low_pass: float) -> "Scene":
        """From arrays of float_array(), all coefficients in one."""
        scene = cls.__new__(cls)
        scene._take_arrays(means, quats, scales, opacities, np.ascontiguousarray(sh), _DEGREES[sh.shape[1] - 1], (0.0, 0.0, 0.0),
                           anti_aliasing, low_pass)
        return scene

    def _orbit(self, n: int, width: int, height: int, horizontal_fov: Optional[float]) -> List[Camera]:
        return _orbit(self._native, self._path, self._facts["up"], n, width, height, horizontal_fov)

    # ---- attributes

    def __len__(self) -> int:
        n: int = self._facts["n"]
        return n

    def _array(self, name: str, row: Tuple[int, ...]) -> FloatArray:
        return np.asarray(_Memory(self._native, work("arrays", scene=self._native, file=self._path)[name], (len(self), *row)))

    @property
    def means(self) -> FloatArray:
        """[n, 3] centres relative to :attr:`origin`, world units.

        This and the other arrays are read-only views that keep the scene's memory alive. The first access makes all of
        them: 236 bytes a Gaussian at SH degree 3.
        """
        return self._array("means", (3,))

    @property
    def quats(self) -> FloatArray:
        """[n, 4] unit quaternions w, x, y, z, as precise as the file stores them (FP16)."""
        return self._array("quats", (4,))

    @property
    def scales(self) -> FloatArray:
        """[n, 3] standard deviations along the local axes, world units."""
        return self._array("scales", (3,))

    @property
    def opacities(self) -> FloatArray:
        """[n] 0 to 1."""
        return self._array("opacities", ())

    @property
    def sh(self) -> FloatArray:
        """[n, (degree + 1)^2, 3] coefficients of spherical harmonics, red, green, blue."""
        return self._array("sh", ((self.sh_degree + 1) ** 2, 3))

    @property
    def sh0(self) -> FloatArray:
        """[n, 1, 3] coefficients of degree 0."""
        return self.sh[:, :1]

    @property
    def shN(self) -> FloatArray:
        """[n, (degree + 1)^2 - 1, 3] coefficients of the other degrees."""
        return self.sh[:, 1:]

    @property
    def sh_degree(self) -> int:
        """0 to 3."""
        sh_degree: int = self._facts["sh_degree"]
        return sh_degree

    @property
    def origin(self) -> "NDArray[np.float64]":
        """[3] the world point that means are relative to."""
        return np.array(self._facts["origin"], dtype=np.float64)

    @property
    def crs(self) -> str:
        """The coordinate reference system of origin + mean, such as ``EPSG:4978`` or WKT; empty if none is stated."""
        crs: str = self._facts["crs"]
        return crs

    @property
    def anti_aliasing(self) -> AntiAliasing:
        """"classic" or "mip": what the scene declares."""
        anti_aliasing: AntiAliasing = self._facts["anti_aliasing"]
        return anti_aliasing

    @property
    def low_pass(self) -> float:
        """px^2 added to projected covariances: as the scene declares, else 0.3, or 0.1 with "mip"."""
        low_pass: float = self._facts["low_pass"]
        return low_pass

    @property
    def bounds(self) -> Tuple[Vector3, Vector3]:
        """Two corners of the world box where Gaussians are dense and opaque. Reads the scene."""
        return _bounds(self._native, self._path)

    @property
    def up(self) -> Vector3:
        """Up in the world: what the file states, else -y."""
        return _vector(self._facts["up"])

    @property
    def levels(self) -> int:
        """Number of levels of detail in the file; 0 without."""
        levels: int = self._facts["levels"]
        return levels

    @property
    def format(self) -> Optional[str]:
        """Format of its file: "rgs", "ply", "spz", ...; None if it was made from arrays."""
        format: Optional[str] = self._facts["format"]
        return format

    @property
    def path(self) -> Optional[str]:
        """Its path, or its address without user, password and query."""
        return None if self._path is None else shown(self._path)

    # ---- saving

    def save(self, path: Path, *, profile: Profile = "packed", lod: Union[bool, Literal["fast", "best"]] = False, overwrite: bool = False,
             sync: bool = True, strict: bool = False, spz_axes: SpzAxes = "ply", progress: Progress = None) -> int:
        """Writes a file, whole or not at all, and returns its bytes. The ending names the format, one of those
        that ``rgs-convert --formats`` calls written.

        Parameters
        ----------
        profile : "packed", "direct", "archive:high", "archive:small" or "archive:tiny"
            For .rgs: the small form, the form that a GPU reads as it lies on disk, or lossy within stated bounds.
        lod : bool, "fast" or "best"
            For .rgs: with levels of detail.
        overwrite : bool
            Replace an existing file, the scene's own too; otherwise :class:`OutputExistsError`.
        sync : bool
            Wait until it is on the disk.
        strict : bool
            Refuse values that the format cannot hold, instead of clamping them.
        spz_axes : "ply" or "opengl"
            For .spz, which does not state them: right, down, forward, or right, up, backward.
        progress : True or a function
            A bar, or ``function(stage, done, total, unit)``.

        >>> scene = load(examples / "scene.rgs")
        >>> scene.save(folder / "scene.spz") < scene.save(folder / "scene.ply")
        True
        """
        if profile not in get_args(Profile):
            raise argument_error(f"profile is one of {', '.join(get_args(Profile))}, not {profile!r}")
        if lod not in (False, True, "fast", "best"):
            raise argument_error(f"lod is True, False, 'fast' or 'best', not {lod!r}")
        quality = lod if isinstance(lod, str) else "fast" if lod else ""
        with Reporting(progress) as callback:
            size: int = run("save", file=local_name(path), progress=callback, waits=True, scene=self._native, profile=profile,
                            lod=quality, overwrite=bool(overwrite), sync=bool(sync), strict=bool(strict),
                            spz_axes=_spz_axes(spz_axes))
            return size

    # ---- shown

    def _described(self) -> str:
        facts = f"{len(self):,} Gaussian{'' if len(self) == 1 else 's'}, SH degree {self.sh_degree}"
        if self.levels:
            facts += f", {self.levels} levels of detail"
        return f"{facts}, from {self.path!r}" if self.path else facts

    def __repr__(self) -> str:
        return f"<roofgs.Scene {self._described()}>"

    def _repr_html_(self) -> str:
        return _html(self, self._described())


class StreamPool:
    """A memory budget shared by streamed scenes: the largest error in pixels gets room first, whichever scene shows it.

    Parameters
    ----------
    host_memory : int
        Bytes of host memory for all of its scenes.
    device_memory : int
        Bytes of GPU memory for all of its scenes: half for pages, one allocation while there are scenes, half for the
        workspace of frames; what does not fit is drawn coarser. Then only "cuda" draws them, and they share SH degree,
        chunk size and page size. 0: pages are in host memory, and only "cpu" draws them.

    >>> pool = StreamPool(host_memory=1 << 28)
    >>> with StreamedScene(examples / "levels.rgs", pool=pool) as one, StreamedScene(examples / "levels.rgs", pool=pool):
    ...     one.pool is pool, 0 < pool.host_bytes <= pool.host_memory
    (True, True)
    """

    def __init__(self, *, host_memory: int = 2 << 30, device_memory: int = 0) -> None:
        self._host_memory, self._device_memory = _count(host_memory, "host_memory"), _count(device_memory, "device_memory")
        self._native = Handle()
        work("make_pool", into=self._native, host_memory=self._host_memory, device_memory=self._device_memory)

    @property
    def host_memory(self) -> int:
        """The budget, bytes."""
        return self._host_memory

    @property
    def device_memory(self) -> int:
        """The budget on the GPU, bytes."""
        return self._device_memory

    @property
    def host_bytes(self) -> int:
        """Held now."""
        return self._bytes("host")

    @property
    def device_bytes(self) -> int:
        """Held now on the GPU, the workspace included."""
        return self._bytes("device")

    def _bytes(self, where: str) -> int:
        n: int = work("pool_bytes", pool=self._native)[where]
        return n

    def __repr__(self) -> str:
        device = f", device_memory={self.device_memory}" if self.device_memory else ""
        return f"roofgs.StreamPool(host_memory={self.host_memory}{device})"


class StreamedScene:
    """A file with levels of detail, drawn while it is read: the coarsest page is always resident, others as cameras want
    them, within a budget.

    Parameters
    ----------
    path : path or address
        An .rgs with levels (``lod=True``).
    host_memory, device_memory : int
        Budget of its own :class:`StreamPool` [2 GiB and 0].
    pool : StreamPool
        A pool shared with other scenes, instead.
    prefetch : bool
        Also request what a moving camera is about to see.
    open_seconds : float
        The most that opening an address may take, until its coarsest page has come.

    Use it in a ``with`` statement, or call :meth:`close`: it has threads. Frames show resident pages and wait for nothing;
    :meth:`Renderer.refine` waits.

    >>> with StreamedScene(examples / "levels.rgs") as scene:
    ...     camera = roofgs.cameras.default_view(scene, width=64, height=48)
    ...     renderer = roofgs.Renderer(device="cpu")
    ...     whole = renderer.refine(scene, camera, seconds=60)
    ...     image = renderer.render(scene, camera)
    >>> whole, image.shape
    (True, (48, 64, 3))
    """

    def __init__(self, path: Path, *, host_memory: Optional[int] = None, device_memory: Optional[int] = None,
                 pool: Optional[StreamPool] = None, prefetch: bool = True, max_expansion: Optional[int] = None,
                 open_seconds: float = 60.0) -> None:
        budget = {name: value for name, value in (("host_memory", host_memory), ("device_memory", device_memory))
                  if value is not None}
        if pool is not None and budget:
            raise argument_error(f"{' and '.join(budget)} are those of the pool that is given")
        self._pool = StreamPool(**budget) if pool is None else pool
        self._path = encoded(path)
        self._handle: Optional[Handle] = Handle()
        run("open_stream", file=self._path, into=self._handle, pool=self._pool._native, prefetch=bool(prefetch),
            max_expansion=_count_or_none(max_expansion, "max_expansion"), open_seconds=float(open_seconds))
        self._all_facts: Dict[str, Any] = call("facts", scene=self._handle)

    @property
    def _native(self) -> Handle:
        if self._handle is None:
            raise argument_error("the scene is closed", self.path)
        return self._handle

    @property
    def _facts(self) -> Dict[str, Any]:
        return self._all_facts if self._native else {}

    def _orbit(self, n: int, width: int, height: int, horizontal_fov: Optional[float]) -> List[Camera]:
        return _orbit(self._native, self._path, self._facts["up"], n, width, height, horizontal_fov)

    def __len__(self) -> int:
        n: int = self._facts["n"]
        return n

    @property
    def sh_degree(self) -> int:
        """0 to 3."""
        sh_degree: int = self._facts["sh_degree"]
        return sh_degree

    @property
    def origin(self) -> "NDArray[np.float64]":
        """[3] the world point that means are relative to."""
        return np.array(self._facts["origin"], dtype=np.float64)

    @property
    def bounds(self) -> Tuple[Vector3, Vector3]:
        """As `Scene.bounds`, from the table of pages: nearly the same."""
        return _bounds(self._native, self._path)

    @property
    def up(self) -> Vector3:
        """Up in the world."""
        return _vector(self._facts["up"])

    @property
    def path(self) -> str:
        """Its path, or its address without user, password and query."""
        return shown(self._path)

    @property
    def pool(self) -> StreamPool:
        """The pool that it takes memory from."""
        return self._pool

    @property
    def stats(self) -> Dict[str, float]:
        """Counts since it was opened: ``pages_resident``, ``pages_missing`` (wanted by the last view), ``bytes_read``, ``bytes_decoded``, ``bytes_uploaded``, ``bytes_evicted``, ``detail_reached_px``."""
        stats: Dict[str, float] = work("stream_stats", scene=self._native, file=self._path)
        return stats

    def check(self) -> None:
        """Raises the file's error, if there is one. Resident pages are drawn all the same."""
        work("check_stream", scene=self._native, file=self._path)

    def close(self) -> None:
        """Ends its threads. Any later use of the scene is an error."""
        handle, self._handle = self._handle, None
        if handle:
            handle.close()

    @property
    def closed(self) -> bool:
        """Whether :meth:`close` has been called."""
        return self._handle is None

    def __enter__(self) -> "StreamedScene":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        if self.closed:
            return f"<roofgs.StreamedScene of {self.path!r}, closed>"
        return f"<roofgs.StreamedScene {len(self):,} Gaussians, SH degree {self.sh_degree}, from {self.path!r}>"

    def _repr_html_(self) -> str:
        return html.escape(repr(self)) if self.closed else _html(self, repr(self)[1:-1])


def _spz_axes(name: str) -> str:
    if name not in ("ply", "opengl"):
        raise argument_error(f"spz_axes is 'ply' or 'opengl', not {name!r}")
    return name


def load(path: Path, *, level_of_detail: Optional[int] = None, max_count: Optional[int] = None,
         max_expansion: Optional[int] = None, spz_axes: SpzAxes = "ply", progress: Progress = None) -> Scene:
    """Reads a scene of any format that ``rgs-convert --formats`` lists. The content decides.

    Parameters
    ----------
    path : path or address
        An address (http, https) is read whole; :class:`StreamedScene` reads what is seen.
    level_of_detail : int, optional
        For files with levels: only this level; 0 is the finest.
    max_count : int, optional
        For files with levels: the finest cut of at most so many Gaussians.
    max_expansion : int, optional
        Limit of the decompressed size, as a multiple of the file's [1032].
    spz_axes : "ply" or "opengl"
        Axes of an SPZ that declares none: right, down, forward, or right, up, backward.
    progress : True or a function
        A bar, or ``function(stage, done, total, unit)``; for addresses alone.

    >>> scene = load(examples / "scene.rgs")
    >>> scene.means.shape, scene.shN.shape, scene.means.flags.writeable
    ((2000, 3), (2000, 15, 3), False)
    """
    with Reporting(progress) as callback:
        name, native = encoded(path), Handle()
        return Scene._of_file(name, native, run("load", file=name, into=native, progress=callback, spz_axes=_spz_axes(spz_axes),
                                                level_of_detail=_count_or_none(level_of_detail, "level_of_detail"),
                                                max_count=_count_or_none(max_count, "max_count"),
                                                max_expansion=_count_or_none(max_expansion, "max_expansion")))


def info(path: Path, *, verify: bool = False, statistics: Optional[bool] = None,
         max_expansion: Optional[int] = None) -> Dict[str, Any]:
    """The contents and declarations of an .rgs file: the object of ``rgs-info --json`` (docs/user/INFO_JSON.md). `verify` checks
    every checksum and value and raises what is wrong.

    statistics : bool, optional
        Read all values for ranges and histograms; the default for files up to 1 GB.

    >>> info(examples / "scene.rgs")["header"]["n_gaussians"]
    2000
    """
    values: Dict[str, Any] = json.loads(run("info", file=local_name(path), verify=bool(verify),
                                            statistics=None if statistics is None else bool(statistics),
                                            max_expansion=_count_or_none(max_expansion, "max_expansion")))
    return values


def _damage(**arrays: FloatArray) -> Optional[Error]:
    """Names the first invalid value."""
    for name, array in arrays.items():
        low, high = _LEGAL.get(name, (-math.inf, math.inf))
        bad = np.argwhere(~(np.isfinite(array) & (array >= low) & (array <= high)))
        if len(bad):
            place, hint = tuple(int(i) for i in bad[0]), ""
            if math.isfinite(array[place]):
                hint = {"opacities": "; of logits take 1 / (1 + exp(-x))", "scales": "; of logarithms take exp(x)"}[name]
            allowed = {"scales": "0 and above", "opacities": "0 to 1"}.get(name, "finite")
            return argument_error(f"{name}{list(place)} is {float(array[place])!r}, not {allowed}{hint}")
    return None


def _count(value: int, name: str) -> int:
    number = operator.index(value)
    if not 0 <= number < 1 << (32 if name == "level_of_detail" else 64):
        raise argument_error(f"{name} is {number}, which is no count")
    return number


def _count_or_none(value: Optional[int], name: str) -> Optional[int]:
    return None if value is None else _count(value, name)


def _html(scene: Union[Scene, StreamedScene], facts: str) -> str:
    picture = ""
    if len(scene):
        on_device = isinstance(scene, StreamedScene) and scene.pool.device_memory > 0
        image = new_output((270, 480, 3), "uint8")
        view = packed(scene._orbit(1, 480, 270, None))["cameras"]
        Drawer("cuda" if on_device else "cpu").draw(scene._native, scene._path, view, (image, None, None), make_options(), True)
        picture = f'<img alt="" width="480" height="270" src="data:image/png;base64,{base64.b64encode(png(image.array)).decode()}">'
    return f"<figure>{picture}<figcaption>{html.escape(facts)}</figcaption></figure>"


def _vector(values: List[float]) -> Vector3:
    x, y, z = values
    return x, y, z


def _bounds(scene: Handle, path: Optional[bytes]) -> Tuple[Vector3, Vector3]:
    low, high = work("bounds", scene=scene, file=path)
    return _vector(low), _vector(high)


def _orbit(scene: Handle, path: Optional[bytes], up: List[float], n: int, width: int, height: int,
           horizontal_fov: Optional[float]) -> List[Camera]:
    return list(map(Camera._of, work("orbit", scene=scene, file=path, up=up, n=camera_count(n, "an orbit"), width=side(width),
                                     height=side(height), horizontal_fov=horizontal_fov)))
