"""Pictures of scenes."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import operator
import os
from typing import Any, Dict, Iterable, List, Literal, NamedTuple, Optional, Sequence, Tuple, Union, overload

import numpy as np
from numpy.typing import NDArray

from . import _roofgs
from ._arrays import DeviceOutput, device_output, float_array, output_array
from ._errors import argument_error
from ._roofgs import Camera
from ._scene import Scene, StreamedScene, _count_or_none

Cameras = Union[Camera, Iterable[Camera]]
AnyScene = Union[Scene, StreamedScene]
Colour = Union[Sequence[float], "NDArray[Any]"]
_DEVICES = ("auto", "cpu", "cuda")
_PIPELINES = ("automatic", "baseline", "paper", "turbo")


class Frame(NamedTuple):
    """The result of :meth:`Renderer.render` with alpha or depth."""

    image: Any  #: [height, width, 3] colour over the background, float32 or uint8
    alpha: Any  #: [height, width] 1 - transmittance; None unless requested
    depth: Any  #: [height, width] expected z in the camera's axes, world units; 0 where the picture is empty


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

    def __init__(self, device: str = "auto", pipeline: str = "automatic", *, threads: int = 0) -> None:
        if device not in _DEVICES:
            raise argument_error(f"device is one of {', '.join(_DEVICES)}, not {device!r}")
        if pipeline not in _PIPELINES:
            raise argument_error(f"pipeline is one of {', '.join(_PIPELINES)}, not {pipeline!r}")
        if not 0 <= threads <= 1024:
            raise argument_error(f"threads is 0 to 1024, not {threads}")
        self._native = _roofgs.Renderer(device, threads)
        self._pipeline = pipeline
        self._options: Dict[Tuple[Any, ...], _roofgs.RenderOptions] = {}

    @property
    def device(self) -> str:
        """"cpu" or "cuda"."""
        return self._native.device

    @property
    def name(self) -> str:
        """The device: "cpu AVX2", "cuda NVIDIA H100 80GB HBM3"."""
        return self._native.name

    @property
    def pipeline(self) -> str:
        """The pipeline it was made with."""
        return self._pipeline

    @property
    def stats(self) -> List[Dict[str, float]]:
        """The cost of each picture of the last call: ``total_ms``, ``visible``, ``instances``, ..."""
        return self._native.stats()

    def __reduce__(self) -> Any:
        raise TypeError("a roofgs.Renderer cannot be copied or pickled: make another")

    def __repr__(self) -> str:
        return f"<roofgs.Renderer {self.name}, pipeline {self._pipeline}>"

    @overload
    def render(self, scene: AnyScene, camera: Cameras, *, out: None = ..., dtype: Any = ...,
               alpha: Literal[False] = ..., depth: Literal[False] = ..., on_device: Literal[False] = ...,
               background: Colour = ..., near_plane: Optional[float] = ...,
               far_plane: Optional[float] = ..., sh_degree: int = ..., low_pass: Optional[float] = ...,
               anti_aliasing: Optional[str] = ..., detail: Optional[float] = ...,
               max_gaussians: Optional[int] = ...) -> "NDArray[Any]": ...

    @overload
    def render(self, scene: AnyScene, camera: Cameras, *, out: Any = ..., dtype: Any = ...,
               alpha: Literal[True], depth: bool = ..., on_device: bool = ...,
               background: Colour = ..., near_plane: Optional[float] = ...,
               far_plane: Optional[float] = ..., sh_degree: int = ..., low_pass: Optional[float] = ...,
               anti_aliasing: Optional[str] = ..., detail: Optional[float] = ...,
               max_gaussians: Optional[int] = ...) -> Frame: ...

    @overload
    def render(self, scene: AnyScene, camera: Cameras, *, out: Any = ..., dtype: Any = ...,
               alpha: bool = ..., depth: Literal[True], on_device: bool = ...,
               background: Colour = ..., near_plane: Optional[float] = ...,
               far_plane: Optional[float] = ..., sh_degree: int = ..., low_pass: Optional[float] = ...,
               anti_aliasing: Optional[str] = ..., detail: Optional[float] = ...,
               max_gaussians: Optional[int] = ...) -> Frame: ...

    @overload
    def render(self, scene: AnyScene, camera: Cameras, *, out: Any = ..., dtype: Any = ...,
               alpha: Literal[False] = ..., depth: Literal[False] = ..., on_device: bool = ...,
               background: Colour = ..., near_plane: Optional[float] = ...,
               far_plane: Optional[float] = ..., sh_degree: int = ..., low_pass: Optional[float] = ...,
               anti_aliasing: Optional[str] = ..., detail: Optional[float] = ...,
               max_gaussians: Optional[int] = ...) -> Any: ...

    def render(self, scene: AnyScene, camera: Cameras, *, out: Any = None, dtype: Any = None, alpha: bool = False,
               depth: bool = False, on_device: bool = False, background: Colour = (0.0, 0.0, 0.0),
               near_plane: Optional[float] = None, far_plane: Optional[float] = None, sh_degree: int = 3,
               low_pass: Optional[float] = None, anti_aliasing: Optional[str] = None,
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
        given, outputs, stream = _outputs(out, alpha or depth, on_device)
        eight_bit = _is_eight_bit(dtype, outputs[0])
        options = self._options_of(background, near_plane, far_plane, sh_degree, low_pass, anti_aliasing, detail,
                                   max_gaussians)
        made: Tuple[Any, Any, Any]
        if stream is None:
            made = self._native.render(scene._native, cameras, not single, *outputs, eight_bit, alpha, depth, options)
        else:
            if isinstance(scene, StreamedScene):
                raise argument_error("streamed scenes are drawn into host memory")
            made = self._native.render_on_device(scene._native, cameras, not single, *outputs, eight_bit, alpha, depth, stream,
                                                 options)
        # Return the caller's own tensor, not an array of its memory.
        image, alphas, depths = (new if new is None or old is None else old for new, old in zip(made, given))
        return Frame(image, alphas, depths) if alpha or depth else image

    def refine(self, scene: StreamedScene, camera: Camera, seconds: float = 60.0, *,
               detail: Optional[float] = None, max_gaussians: Optional[int] = None) -> bool:
        """Waits until every page that this view of a streamed scene wants is resident. :meth:`render` then draws the picture of
        the whole file. False: time ran out, or the budget has no room for the rest. Ctrl-C ends it."""
        _check_scene(scene)
        options = self._options_of((0.0, 0.0, 0.0), None, None, 3, None, None, detail, max_gaussians)
        return self._native.refine(scene._native, camera, float(seconds), options)

    def prepare(self, scene: Scene) -> None:
        """Uploads a scene now; otherwise the first picture does."""
        _check_scene(scene)
        self._native.prepare(scene._native)

    def _options_of(self, background: Colour, near_plane: Optional[float],
                    far_plane: Optional[float], sh_degree: int, low_pass: Optional[float],
                    anti_aliasing: Optional[str], detail: Optional[float],
                    max_gaussians: Optional[int]) -> _roofgs.RenderOptions:
        red, green, blue = float_array(background, "background", (3,)).tolist()
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
        options = _roofgs.RenderOptions((red, green, blue), near_plane,
                                        0.0 if far_plane is None else float(far_plane), sh_degree, low_pass,
                                        anti_aliasing, detail, max_gaussians, self._pipeline)
        if len(self._options) > 64:  # a caller may change the background every time
            self._options.clear()
        self._options[key] = options
        return options


def _check_scene(scene: Any) -> None:
    if not isinstance(scene, (Scene, StreamedScene)):
        raise TypeError(f"scene is a roofgs.Scene or StreamedScene, not {type(scene).__name__}; roofgs.load() reads files")


def _outputs(out: Any, several: bool, on_device: bool) -> Tuple[Tuple[Any, ...], Tuple[Any, Any, Any], Optional[int]]:
    """Image, alpha and depth to fill (or None), as the caller and as the extension module hold them; for GPU memory also
    the stream to wait for."""
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
        image, alpha, depth = (None if each is None else output_array(each, name) for each, name in zip(given, names))
        return given, (image, alpha, depth), None
    if any(each is not None and place is None for each, place in zip(given, found)):
        raise argument_error("outputs are on the GPU or in host memory, all of them")
    first, second, third = (None if place is None else place[0] for place in found)
    return given, (first, second, third), next((place[1] for place in found if place is not None), 0)


def _is_eight_bit(dtype: Any, image: Any) -> bool:
    if dtype is None:
        if isinstance(image, DeviceOutput):
            return image.format == "B"
        return image is not None and image.dtype == np.uint8
    kind = np.dtype(dtype)
    if kind not in (np.dtype(np.float32), np.dtype(np.uint8)):
        raise argument_error(f"pictures are float32 or uint8, not {kind}")
    return kind == np.dtype(np.uint8)
