"""gsplat's rasterization(), forward only."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import operator
import reprlib
import sys
import threading
from typing import Any, Callable, Dict, Iterator, List, Literal, MutableMapping, Optional, Tuple, get_args

import numpy as np
from numpy.typing import NDArray

from . import cameras
from ._arrays import float_array, host_array, is_tensor
from ._camera import Camera, packed as packed_cameras
from ._errors import argument_error
from ._library import work
from ._render import Renderer
from ._scene import AntiAliasing, Scene

_SH0 = 0.28209479177387814  # Y of degree 0
RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
_NEWER = {"global_z_order": True}  # arguments of later gsplat versions with a default other than None or False
_OF_GAUSSIANS = ("batch_ids", "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities")
_local = threading.local()

Floats = NDArray[np.float32]


class Meta(MutableMapping[str, Any]):
    """gsplat's meta without its tiles. What it says of each Gaussian is computed when it is first asked for; until
    then it keeps the call's Gaussians."""

    def __init__(self, sizes: Dict[str, int], project: Callable[[], Dict[str, Any]]) -> None:
        self._values: Dict[str, Any] = {**dict.fromkeys(_OF_GAUSSIANS, ...), **sizes}
        self._project: Optional[Callable[[], Dict[str, Any]]] = project
        self._lock = threading.Lock()

    def __getitem__(self, key: str) -> Any:
        if key not in self._values:
            raise KeyError(f"{key!r}: RoofGS does not have gsplat's tiles and lists of them; meta holds {', '.join(self)} alone")
        with self._lock:
            if self._values[key] is ... and self._project is not None:
                found, self._project = self._project(), None
                self._values.update((name, found[name]) for name in _OF_GAUSSIANS if self._values.get(name) is ...)
        return self._values[key]

    def __setitem__(self, key: str, value: Any) -> None:
        self._values[key] = value

    def __delitem__(self, key: str) -> None:
        del self._values[key]

    def __contains__(self, key: object) -> bool:
        return key in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"Meta({', '.join(self)})"

    def __reduce__(self) -> Any:
        return dict, (self.copy(),)

    def copy(self) -> Dict[str, Any]:
        return dict(self)


def rasterization(means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, viewmats: Any, Ks: Any, width: int,
                  height: int, near_plane: float = 0.01, far_plane: float = 1e10, radius_clip: float = 0.0,
                  eps2d: float = 0.3, sh_degree: Optional[int] = None, packed: bool = True, tile_size: int = 16,
                  backgrounds: Any = None, render_mode: RenderMode = "RGB", sparse_grad: bool = False, absgrad: bool = False,
                  rasterize_mode: Literal["classic", "antialiased"] = "classic", channel_chunk: int = 32, distributed: bool = False,
                  camera_model: str = "pinhole", segmented: bool = False, covars: Any = None,
                  **others: Any) -> Tuple[Any, Any, Meta]:
    """Pictures of Gaussians, with the arguments, shapes and conventions of ``gsplat.rasterization``.

    A script for inference runs with ``from roofgs import rasterization``, or from ``roofgs.rendering`` as gsplat has it. Not
    differentiable: tensors that require gradients are rejected outside ``torch.no_grad()``. Torch tensors give torch tensors on their
    device, everything else NumPy arrays.

    Parameters
    ----------
    means : [..., N, 3]
    quats : [..., N, 4]
        w, x, y, z; normalised if they are not.
    scales : [..., N, 3]
        Standard deviations, not their logarithms.
    opacities : [..., N]
        0 to 1, not logits.
    colors : [..., (C,) N, D], or with `sh_degree` [..., (C,) N, K, 3]
        Colours or other features, any number of channels, either sign; or coefficients of spherical harmonics. A channel
        with negative values is exact to a millionth of its lowest value. For depth alone it may be None.
    viewmats : [..., C, 4, 4]
        World to camera, OpenCV axes.
    Ks : [..., C, 3, 3]
    eps2d : float
        px^2 added to projected covariances.
    sh_degree : int, optional
        Degree to use, 0 to 3; K is at least (sh_degree + 1)^2.
    backgrounds : [..., C, D], optional
    render_mode : "RGB", "D", "ED", "RGB+D" or "RGB+ED"
        D is the accumulated depth, the sum of weight times z; ED is D / alpha.
    rasterize_mode : "classic" or "antialiased"
    packed : bool
        How `meta` lists Gaussians.
    tile_size, channel_chunk, segmented
        Ignored: they say how gsplat computes.
    radius_clip, sparse_grad, absgrad, distributed, camera_model, covars, and gsplat's other arguments
        Only their defaults are accepted.

    Returns
    -------
    colors : [..., C, height, width, X]
        X is D, 1 or D + 1 channels, depth last. Depth has no background.
    alphas : [..., C, height, width, 1]
    meta : mapping
        "width", "height", "n_cameras", "n_batches"; and of each Gaussian and camera, computed on the CPU when first asked
        for, as gsplat has it from version 1.5 on: "means2d" [..., C, N, 2], centres in pixels, those of pixels at halves;
        "radii" int32 [..., C, N, 2], half the width and height of the box outside which its alpha is below 1/255, 0 if no
        pixel can have more; "depths" [..., C, N], z in the camera's axes; "conics" [..., C, N, 3], a, b, c of the inverse
        covariance a x^2 + 2 b x y + c y^2, 1/px^2, `eps2d` included; "opacities" [..., C, N], in mode "antialiased" as drawn.
        Where radii are 0, so are the others, except opacities. With `packed` these list, as [nnz, ...], only what has radii,
        and "batch_ids", "camera_ids", "gaussian_ids" [nnz] say of what; else these are None. KeyError for gsplat's
        tiles and lists of them.

    A Gaussian ends where its alpha falls below 1/255, alpha is at most 0.99, and a pixel stops at a transmittance of 1e-4.
    Pictures differ from those of a gsplat version with other thresholds.

    >>> colors, alphas, meta = rasterization(
    ...     means=np.array([[0.0, 0.0, 2.0]]), quats=np.array([[1.0, 0, 0, 0]]), scales=np.full((1, 3), 0.1),
    ...     opacities=np.array([0.5]), colors=np.array([[1.0, 0.0, 0.0]]), viewmats=np.eye(4)[None],
    ...     Ks=np.array([[[30.0, 0, 8], [0, 30, 6], [0, 0, 1]]]), width=16, height=12, render_mode="RGB+ED")
    >>> colors.shape, alphas.shape, meta["n_cameras"]
    ((1, 12, 16, 4), (1, 12, 16, 1), 1)
    """
    _refuse_absent(dict(radius_clip=(radius_clip, 0.0), sparse_grad=(sparse_grad, False), absgrad=(absgrad, False),
                        distributed=(distributed, False), camera_model=(camera_model, "pinhole"), covars=(covars, None),
                        **{name: (value, _NEWER.get(name)) for name, value in others.items()
                           if name in _NEWER or (value is not False and getattr(value, "name", "") != "GLOBAL")}))
    if render_mode not in get_args(RenderMode):
        raise argument_error(f"render_mode is one of {', '.join(get_args(RenderMode))}, not {render_mode!r}")
    if rasterize_mode not in ("classic", "antialiased"):
        raise argument_error(f"rasterize_mode is 'classic' or 'antialiased', not {rasterize_mode!r}")
    width, height, eps2d = operator.index(width), operator.index(height), float(eps2d)
    if sh_degree is not None:
        sh_degree = operator.index(sh_degree)
        if not 0 <= sh_degree <= 3:
            raise argument_error(f"sh_degree is 0 to 3, not {sh_degree}")
    tensor = means if is_tensor(means) else None
    if colors is None and "RGB" not in render_mode:
        colors, sh_degree = np.zeros((*np.shape(means)[:-1], 1), np.float32), None
    means, colors, viewmats = (host_array(value, name) for name, value in
                               dict(means=means, colors=colors, viewmats=viewmats).items())  # once, from whatever device
    device = None if tensor is None else tensor.device

    if means.ndim < 2:
        raise argument_error(f"means has the shape {list(means.shape)}, not [..., n, 3]")
    batch, n = means.shape[:-2], means.shape[-2]
    if viewmats.ndim < 3 or viewmats.shape[:-3] != batch:
        wanted = ", ".join([*map(str, batch), "C, 4, 4"])
        raise argument_error(f"viewmats has the shape {list(viewmats.shape)}, not [{wanted}]")
    views = cameras.from_matrices(viewmats, Ks, width, height)
    n_cameras, n_batches = viewmats.shape[-3], int(np.prod(batch, dtype=int))
    centres = _flat(means, "means", batch, (n, 3))
    rotations = _flat(quats, "quats", batch, (n, 4))
    deviations = _flat(scales, "scales", batch, (n, 3))
    weights = _flat(opacities, "opacities", batch, (n,))
    harmonics, lowest, n_channels = _harmonics(colors, batch, n_cameras, n, sh_degree)
    per_camera = lowest.shape[1] == n_cameras
    behind = np.zeros((n_batches, n_cameras, n_channels), np.float32)
    if backgrounds is not None and "RGB" in render_mode:
        behind = _flat(backgrounds, "backgrounds", batch, (n_cameras, n_channels))

    with_colour, depth_mode = "RGB" in render_mode, render_mode.rpartition("+")[2]
    n_out = (n_channels if with_colour else 0) + (depth_mode in ("D", "ED"))
    out = np.empty((n_batches, n_cameras, height, width, n_out), np.float32)
    alphas = np.empty((n_batches, n_cameras, height, width, 1), np.float32)
    seen: List[Scene] = []  # by batch; their colours do not matter
    for b in range(n_batches):
        for c in range(n_cameras):
            if c == 0 or per_camera:
                sets = [Scene._of_sh(centres[b], rotations[b], deviations[b], weights[b], sh,
                                     "mip" if rasterize_mode == "antialiased" else "classic", eps2d)
                        for sh in harmonics[b][c if per_camera else 0]]
            if c == 0:
                seen.append(sets[0])
            _render_one(sets if with_colour else sets[:1], views[b * n_cameras + c], behind[b, c], with_colour, depth_mode,
                        near_plane, far_plane, out[b, c], alphas[b, c])
            below = lowest[b, c if per_camera else 0]
            if with_colour and below.any():
                out[b, c, ..., :n_channels] += below * alphas[b, c]
    shape = (*batch, n_cameras, height, width)

    def project() -> Dict[str, Any]:
        found = _project(seen, views, n, near_plane, far_plane, packed)
        return {name: None if array is None
                else _like(device, array if packed else array.reshape(*batch, n_cameras, *array.shape[2:]))
                for name, array in found.items()}

    return (_like(device, out.reshape(*shape, n_out)), _like(device, alphas.reshape(*shape, 1)),
            Meta(dict(width=width, height=height, n_cameras=n_cameras, n_batches=n_batches), project))


def _render_one(sets: List[Scene], view: Camera, behind: Floats, with_colour: bool, depth_mode: str, near_plane: float,
                far_plane: float, out: Floats, alpha: Floats) -> None:
    """One camera: three channels at a time, then depth."""
    renderer = _renderer()
    wants_depth = depth_mode in ("D", "ED")
    for i, scene in enumerate(sets):
        under = behind[3 * i:3 * i + 3] if with_colour else behind[:0]
        background = tuple(float(value) for value in np.pad(under, (0, 3 - len(under))))
        frame = renderer.render(scene, view, alpha=True, depth=wants_depth and i == 0,
                                background=(background[0], background[1], background[2]), near_plane=near_plane,
                                far_plane=far_plane)
        if with_colour:
            channels = slice(3 * i, min(3 * i + 3, len(behind)))
            out[..., channels] = frame.image[..., :channels.stop - channels.start]
        if i == 0:
            assert frame.alpha is not None
            alpha[..., 0] = frame.alpha
            if frame.depth is not None:
                out[..., -1] = frame.depth if depth_mode == "ED" else frame.depth * frame.alpha


def _project(scenes: List[Scene], views: List[Camera], n: int, near_plane: float, far_plane: float,
             packed: bool) -> "Dict[str, Optional[NDArray[Any]]]":
    """_OF_GAUSSIANS, [batch, camera, n, ...] or packed."""
    n_cameras = len(views) // len(scenes) if scenes else 0
    shape = (len(scenes), n_cameras, n)
    found: "Dict[str, NDArray[Any]]" = dict(
        radii=np.zeros((*shape, 2), np.int32), means2d=np.zeros((*shape, 2), np.float32), depths=np.zeros(shape, np.float32),
        conics=np.zeros((*shape, 3), np.float32), opacities=np.zeros(shape, np.float32))
    for i, view in enumerate(views):
        b, c = divmod(i, n_cameras)
        work("project", scene=scenes[b]._native, near_plane=float(near_plane),
             far_plane=0.0 if far_plane == np.inf else float(far_plane), **packed_cameras([view]),
             **{name: array[b, c] for name, array in found.items()})
    if not packed:
        return {**dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids")), **found}
    has_radii = found["radii"][..., 0] > 0
    ids = dict(zip(("batch_ids", "camera_ids", "gaussian_ids"), np.nonzero(has_radii)))
    return {**ids, **{name: array[has_radii] for name, array in found.items()}}


def _renderer() -> Renderer:
    """One for each thread; the next call reuses its memory."""
    if not hasattr(_local, "renderer"):
        _local.renderer = Renderer()
    renderer: Renderer = _local.renderer
    return renderer


def _refuse_absent(arguments: Dict[str, Tuple[Any, Any]]) -> None:
    for name, (value, usual) in arguments.items():
        if value is usual or (usual is not None and value == usual):
            continue
        why = "not differentiable" if name in ("sparse_grad", "absgrad") else "RoofGS does not have it"
        raise NotImplementedError(f"{name}={reprlib.repr(value)}: {why}; leave it at {usual!r}, or call gsplat")


def _flat(value: Any, name: str, batch: Tuple[int, ...], own: Tuple[int, ...]) -> Floats:
    """[..., own] as [n_batches, own]."""
    return float_array(value, name, (*batch, *own)).reshape(int(np.prod(batch, dtype=int)), *own)  # reshape(-1) fails on empty arrays


def _harmonics(colors: "NDArray[Any]", batch: Tuple[int, ...], n_cameras: int, n: int,
               sh_degree: Optional[int]) -> Tuple[List[List[List[Floats]]], Floats, int]:
    """Coefficients [N, K, 3] by batch, camera (one for all unless they differ) and three channels; what was added to them,
    because the renderer clamps at 0, [batch, camera, channel]; and the number of channels."""
    shape = colors.shape
    own = 2 if sh_degree is None else 3
    per_camera = len(shape) == len(batch) + own + 1
    wanted: Tuple[Optional[int], ...] = (*batch, *((n_cameras,) if per_camera else ()), n)
    values = float_array(colors, "colors", (*wanted, None) if sh_degree is None else (*wanted, None, 3))
    if not np.isfinite(values).all():
        raise argument_error("colors holds NaN or an infinity")
    values = values.reshape(int(np.prod(batch, dtype=int)), n_cameras if per_camera else 1, *shape[len(shape) - own:])
    if sh_degree is not None:
        n_used = (sh_degree + 1) ** 2
        if values.shape[-2] < n_used:
            raise argument_error(f"colors has {values.shape[-2]} coefficients; sh_degree={sh_degree} takes {n_used}")
        return ([[[each[:, :n_used]] for each in of_batch] for of_batch in values],
                np.zeros((*values.shape[:2], 3), np.float32), 3)
    n_channels = values.shape[-1]
    lowest = values.min(axis=2, initial=0)
    padding = [(0, 0)] * (values.ndim - 1) + [(0, -n_channels % 3 if n_channels else 3)]
    with np.errstate(over="ignore"):
        sh = (np.pad(values - lowest[:, :, None], padding) - np.float32(0.5)) / np.float32(_SH0)
    too_wide = np.flatnonzero(~np.isfinite(sh).all(axis=tuple(range(sh.ndim - 1))))
    if len(too_wide):
        raise argument_error(f"colors has values too large or too far apart in channel {too_wide[0]}: their coefficients of "
                             "spherical harmonics are beyond float32")
    return ([[[each[:, None, first:first + 3] for first in range(0, each.shape[-1], 3)] for each in of_batch]
             for of_batch in sh], lowest, n_channels)


def _like(device: Any, array: Floats) -> Any:
    """A torch tensor on the device, or the array itself."""
    if device is None:
        return array
    torch: Any = sys.modules["torch"]  # torch is loaded: a tensor exists
    return torch.from_numpy(array).to(device)
