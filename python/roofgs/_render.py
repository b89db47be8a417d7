"""Pictures of scenes."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
import operator
import os
from typing import Any, Dict, Iterable, List, Literal, NamedTuple, Optional, Sequence, Tuple, Type, Union, get_args, overload

import numpy as np
from numpy.typing import NDArray

from ._arrays import Output, device_output, float_array, host_output, new_output
from ._camera import Camera, packed
from ._device_array import DeviceArray
from ._draw import Drawer, make_options
from ._errors import argument_error
from ._library import Handle
from ._scene import AntiAliasing, Scene, StreamedScene, _count_or_none

Cameras = Union[Camera, Iterable[Camera]]
AnyScene = Union[Scene, StreamedScene]
Colour = Union[Sequence[float], "NDArray[Any]"]
Device = Literal["auto", "cpu", "cuda"]
Pipeline = Literal["automatic", "baseline", "paper", "turbo"]
ImageType = Union[None, Literal["float32", "uint8"], Type[np.float32], Type[np.uint8], "np.dtype[Any]"]

_BLACK = (0.0, 0.0, 0.0)


class Frame(NamedTuple):
    """The result of :meth:`Renderer.render` with alpha or depth."""

    image: Any  #: [height, width, 3] colour over the background, float32 or uint8
    alpha: Any  #: [height, width] 1 - transmittance; None unless requested
    depth: Any  #: [height, width] expected depth (docs/format/RENDERING.md), world units; 0 where the picture is empty


class Renderer:
    """Renders pictures on the CPU or on an NVIDIA GPU. It reuses its memory; threads that share one take turns.

    Parameters
    ----------
    device : "auto", "cpu" or "cuda"
        "auto" is the GPU if there is one.
    pipeline : "automatic", "baseline", "paper" or "turbo"
        The method; docs/format/RENDERING.md. "automatic" is the image's definition on the CPU and turbo on a GPU.
    threads : int
        CPU threads; 0 is all. Pictures do not depend on it.
    devices : sequence of int
        GPUs, by CUDA's numbers: each holds the scene and draws a part of one call's pictures. Empty: CUDA's current one. Several
        draw into NumPy arrays alone.

    >>> import roofgs
    >>> scene = roofgs.load(examples / "scene.rgs")
    >>> renderer = Renderer(device="cpu")
    >>> camera = roofgs.cameras.default_view(scene, width=64, height=48)
    >>> image = renderer.render(scene, camera)
    >>> image.shape, image.dtype
    ((48, 64, 3), dtype('float32'))
    >>> frame = renderer.render(scene, camera, dtype="uint8", depth=True)
    >>> frame.image.dtype, frame.depth.shape, frame.alpha is None
    (dtype('uint8'), (48, 64), True)
    """

    def __init__(self, device: Device = "auto", pipeline: Pipeline = "automatic", *, threads: int = 0,
                 devices: Sequence[int] = ()) -> None:
        if device not in get_args(Device):
            raise argument_error(f"device is one of {', '.join(get_args(Device))}, not {device!r}")
        if pipeline not in get_args(Pipeline):
            raise argument_error(f"pipeline is one of {', '.join(get_args(Pipeline))}, not {pipeline!r}")
        if not 0 <= threads <= 1024:
            raise argument_error(f"threads is 0 to 1024, not {threads}")
        devices = [operator.index(number) for number in devices]
        if not all(0 <= number < 2**31 for number in devices):
            raise argument_error(f"devices are numbers of GPUs, from 0 on, not {devices}")
        self._drawer = Drawer(device, operator.index(threads), devices)
        self._pipeline = pipeline
        self._options: Dict[Tuple[Any, ...], Handle] = {}

    @property
    def device(self) -> str:
        """"cpu" or "cuda"."""
        return self._drawer.device

    @property
    def name(self) -> str:
        """The device: "cpu AVX2", "cuda NVIDIA H100 80GB HBM3"."""
        return self._drawer.name

    @property
    def pipeline(self) -> Pipeline:
        """The pipeline it was made with."""
        return self._pipeline

    @property
    def stats(self) -> List[Dict[str, float]]:
        """The cost of each picture of the last call: ``total_ms``, ``visible``, ``instances``, ..."""
        return self._drawer.stats()

    def __reduce__(self) -> Any:
        raise TypeError("a roofgs.Renderer cannot be copied or pickled: make another")

    def __repr__(self) -> str:
        return f"<roofgs.Renderer {self.name}, pipeline {self._pipeline}>"

    @overload
    def render(self, scene: AnyScene, camera: Cameras, *, out: None = ..., dtype: ImageType = ...,
               alpha: Literal[False] = ..., depth: Literal[False] = ..., on_device: Literal[False] = ...,
               background: Colour = ..., near_plane: Optional[float] = ...,
               far_plane: Optional[float] = ..., sh_degree: int = ..., low_pass: Optional[float] = ...,
               anti_aliasing: Optional[AntiAliasing] = ..., detail: Optional[float] = ...,
               max_gaussians: Optional[int] = ...) -> "NDArray[Any]": ...

    @overload
    def render(self, scene: AnyScene, camera: Cameras, *, out: Any = ..., dtype: ImageType = ...,
               alpha: Literal[True], depth: bool = ..., on_device: bool = ...,
               background: Colour = ..., near_plane: Optional[float] = ...,
               far_plane: Optional[float] = ..., sh_degree: int = ..., low_pass: Optional[float] = ...,
               anti_aliasing: Optional[AntiAliasing] = ..., detail: Optional[float] = ...,
               max_gaussians: Optional[int] = ...) -> Frame: ...

    @overload
    def render(self, scene: AnyScene, camera: Cameras, *, out: Any = ..., dtype: ImageType = ...,
               alpha: bool = ..., depth: Literal[True], on_device: bool = ...,
               background: Colour = ..., near_plane: Optional[float] = ...,
               far_plane: Optional[float] = ..., sh_degree: int = ..., low_pass: Optional[float] = ...,
               anti_aliasing: Optional[AntiAliasing] = ..., detail: Optional[float] = ...,
               max_gaussians: Optional[int] = ...) -> Frame: ...

    @overload
    def render(self, scene: AnyScene, camera: Cameras, *, out: Any = ..., dtype: ImageType = ...,
               alpha: Literal[False] = ..., depth: Literal[False] = ..., on_device: bool = ...,
               background: Colour = ..., near_plane: Optional[float] = ...,
               far_plane: Optional[float] = ..., sh_degree: int = ..., low_pass: Optional[float] = ...,
               anti_aliasing: Optional[AntiAliasing] = ..., detail: Optional[float] = ...,
               max_gaussians: Optional[int] = ...) -> Any: ...

    def render(self, scene: AnyScene, camera: Cameras, *, out: Any = None, dtype: ImageType = None, alpha: bool = False,
               depth: bool = False, on_device: bool = False, background: Colour = _BLACK,
               near_plane: Optional[float] = None, far_plane: Optional[float] = None, sh_degree: int = 3,
               low_pass: Optional[float] = None, anti_aliasing: Optional[AntiAliasing] = None,
               detail: Optional[float] = None, max_gaussians: Optional[int] = None) -> Any:
        """Draws a picture, or one for each of several cameras of one picture size.

        Parameters
        ----------
        camera : Camera or several
            Several cameras add a leading axis to all results.
        out : array, or Frame or tuple of arrays
            Filled instead of new arrays: C-contiguous, float32, the image also uint8; with `alpha` or `depth` a tuple
            (image, alpha, depth). NumPy arrays and CPU tensors; on "cuda" also GPU tensors and other arrays with
            ``__cuda_array_interface__``, all of them or none.
        dtype : "float32" or "uint8"
            Type of the image; by default that of `out`, else float32. 8-bit codes are round(255 clamp(v, 0, 1)).
        alpha, depth : bool
            Return these, too, in a :class:`Frame`.
        on_device : bool
            On "cuda": return arrays in GPU memory, :class:`DeviceArray`, for ``torch.from_dlpack()``.
        background : three numbers
            The colour behind everything.
        near_plane, far_plane : float, optional
            Gaussians with a centre nearer than this (0.2) or farther (no limit) are not drawn. World units.
        sh_degree : int
            Higher degrees are ignored.
        low_pass, anti_aliasing : optional
            As the scene declares; px^2, "classic" or "mip".
        detail : float, optional
            For scenes with levels of detail: the largest projected error of drawn pages, in pixels [1]; 0 draws all
            Gaussians.
        max_gaussians : int, optional
            For scenes with levels of detail: the finest detail, from `detail` on, is taken that draws no more Gaussians in
            all directions; the coarsest page is always drawn. ``stats`` has it as ``detail_px``.

        Outputs in GPU memory are written after the work queued on torch's current stream (or the stream that the array names),
        and are complete on return. The GIL is released. Ctrl-C takes effect between two pictures of a call, on "cuda" between 64.
        On "cuda" one call for several small pictures is faster than several calls.
        """
        _check_scene(scene)
        single = isinstance(camera, Camera)
        if isinstance(camera, (str, bytes, os.PathLike)):
            raise TypeError("camera is a roofgs.Camera or several of them; roofgs.cameras.load() reads files")
        cameras: List[Camera] = [camera] if isinstance(camera, Camera) else list(camera)
        rows = packed(cameras)["cameras"]
        if cameras and (rows[:, :2] != rows[0, :2]).any():
            raise argument_error("the cameras of one call must have pictures of one size: use Camera.resized()")
        given, stream = _given(out, alpha or depth, on_device)
        size = (cameras[0].height, cameras[0].width) if cameras else (0, 0)
        shape = size if single else (len(cameras), *size)
        options = self._options_of(background, near_plane, far_plane, sh_degree, low_pass, anti_aliasing, detail,
                                   max_gaussians)
        kind = _image_type(dtype, given[0])
        wanted = (((*shape, 3), kind), (shape, "float32") if alpha else None, (shape, "float32") if depth else None)
        for output, facts in zip(given, wanted):
            if output is not None and facts is not None:
                _check_output(output, *facts)
        if stream is not None and isinstance(scene, StreamedScene):
            raise argument_error("streamed scenes are drawn into host memory")
        image, alphas, depths = (None if facts is None else output or self._new_output(facts, stream is not None)
                                 for output, facts in zip(given, wanted))
        assert image is not None
        _refuse_overlap([each for each in (image, alphas, depths) if each is not None])
        self._drawer.draw(scene._native, scene._path, rows, (image, alphas, depths), options, isinstance(scene, StreamedScene), stream)
        if not alpha and not depth:
            return image.array
        return Frame(*(None if output is None else output.array for output in (image, alphas, depths)))

    def refine(self, scene: StreamedScene, camera: Camera, seconds: float = 60.0, *,
               detail: Optional[float] = None, max_gaussians: Optional[int] = None) -> bool:
        """Waits until every page that this view of a streamed scene wants is resident. :meth:`render` then draws the picture of
        the whole file. False: time ran out, or the budget has no room for the rest. Ctrl-C ends it."""
        _check_scene(scene)
        options = self._options_of(_BLACK, None, None, 3, None, None, detail, max_gaussians)
        if not seconds >= 0:
            raise argument_error("seconds to wait are 0 or more")
        return self._drawer.refine(scene._native, scene._path, camera, float(seconds), options)

    def prepare(self, scene: Scene) -> None:
        """Uploads a scene now; otherwise the first picture does."""
        _check_scene(scene)
        self._drawer.prepare(scene._native, scene._path)

    def _new_output(self, facts: Tuple[Tuple[int, ...], str], on_device: bool) -> Output:
        if not on_device:
            return new_output(*facts)
        array = DeviceArray(self._drawer.handle, *facts)
        return Output(array, array.__cuda_array_interface__["data"][0], *facts, True, False)

    def _options_of(self, background: Colour, near_plane: Optional[float],
                    far_plane: Optional[float], sh_degree: int, low_pass: Optional[float],
                    anti_aliasing: Optional[AntiAliasing], detail: Optional[float],
                    max_gaussians: Optional[int]) -> Handle:
        red, green, blue = _BLACK if background is _BLACK else float_array(background, "background", (3,)).tolist()
        sh_degree = operator.index(sh_degree)  # 3.0 == 3 would be accepted
        max_gaussians = _count_or_none(max_gaussians, "max_gaussians")
        key = (red, green, blue, near_plane, far_plane, sh_degree, low_pass, anti_aliasing, detail, max_gaussians)
        known = self._options.get(key)
        if known is not None:
            return known
        if anti_aliasing not in (None, "classic", "mip"):
            raise argument_error(f"anti_aliasing is 'classic' or 'mip', not {anti_aliasing!r}")
        if not 0 <= sh_degree <= 3:
            raise argument_error(f"sh_degree is 0 to 3, not {sh_degree}")
        options = make_options((red, green, blue), near_plane, None if far_plane == math.inf else far_plane, sh_degree, low_pass,
                               anti_aliasing, detail, max_gaussians, self._pipeline)
        if len(self._options) > 64:  # a caller may change the background every time
            self._options.clear()
        self._options[key] = options
        return options


def _check_scene(scene: Any) -> None:
    if not isinstance(scene, (Scene, StreamedScene)):
        raise TypeError(f"scene is a roofgs.Scene or StreamedScene, not {type(scene).__name__}; roofgs.load() reads files")


def _given(out: Any, several: bool, on_device: bool) -> Tuple[Tuple[Optional[Output], ...], Optional[int]]:
    """Image, alpha and depth to fill, or None; for GPU memory also the stream to wait for."""
    given: Tuple[Any, ...] = (None, None, None)
    if out is not None and not several:
        given = (out.image if isinstance(out, Frame) else out, None, None)
    elif out is not None:
        if not isinstance(out, tuple) or len(out) != 3:
            raise argument_error("with alpha or depth, out is a tuple (image, alpha, depth)")
        given = out
    names = ("out[0]", "out[1]", "out[2]") if several else ("out", "", "")
    found = [None if each is None or isinstance(each, np.ndarray) else device_output(each, name)
             for each, name in zip(given, names)]
    if not on_device and not any(found):
        return tuple(None if each is None else host_output(each, name) for each, name in zip(given, names)), None
    if any(each is not None and place is None for each, place in zip(given, found)):
        raise argument_error("outputs are on the GPU or in host memory, all of them")
    return (tuple(None if place is None else place[0] for place in found),
            next((place[1] for place in found if place is not None), 0))


def _image_type(dtype: ImageType, image: Optional[Output]) -> str:
    if dtype is None:
        return "uint8" if image is not None and image.dtype == "uint8" else "float32"
    kind = np.dtype(dtype)
    if kind not in (np.dtype(np.float32), np.dtype(np.uint8)):
        raise argument_error(f"pictures are float32 or uint8, not {kind}")
    return str(kind)


def _check_output(output: Output, shape: Tuple[int, ...], dtype: str) -> None:
    if output.dtype != dtype:
        raise argument_error("an output has the wrong data type: float32; images may be uint8")
    if output.shape != shape:
        raise argument_error("an output has the wrong shape: [height, width, 3] for colour and [height, width] for alpha and depth, with "
                             "the number of cameras before that for a list of cameras")
    if not output.contiguous:
        raise argument_error("an output must be C-contiguous")
    if output.readonly:
        raise argument_error("an output is read-only")


def _refuse_overlap(outputs: Sequence[Output]) -> None:
    spans = sorted((each.address, each.address + math.prod(each.shape) * np.dtype(each.dtype).itemsize) for each in outputs)
    if any(end > start for (_, end), (start, _) in zip(spans, spans[1:])):
        raise argument_error("two outputs share memory")
