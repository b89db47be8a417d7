"""The library's renderer."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
import time
from typing import Dict, List, Optional, Sequence, Tuple

import numpy as np
from numpy.typing import NDArray

from ._arrays import Output
from ._camera import Camera, packed
from ._library import Handle, begin_work, call, work

Outputs = Tuple[Output, Optional[Output], Optional[Output]]


def make_options(background: Tuple[float, float, float] = (0.0, 0.0, 0.0), near_plane: Optional[float] = None,
                 far_plane: Optional[float] = None, sh_degree: int = 3, low_pass: Optional[float] = None,
                 anti_aliasing: Optional[str] = None, detail: Optional[float] = None, max_gaussians: Optional[int] = None,
                 pipeline: str = "automatic") -> Handle:
    near_plane, far_plane, low_pass, detail = (
        None if value is None else float(value) for value in (near_plane, far_plane, low_pass, detail))
    options = Handle()
    call("make_options", into=options, background=background, near_plane=near_plane, far_plane=far_plane, sh_degree=sh_degree,
         low_pass=low_pass, anti_aliasing=anti_aliasing, detail=detail, max_gaussians=max_gaussians, pipeline=pipeline)
    return options


class Drawer:
    """A renderer of the library; threads take turns."""

    def __init__(self, device: str, threads: int = 0, devices: Sequence[int] = ()) -> None:
        self.handle = Handle()
        made = work("make_renderer", into=self.handle, device=device, threads=threads, devices=list(devices))
        self.device, self.name = str(made["device"]), str(made["name"])
        self._part = 64 * max(1, len(devices)) if self.device == "cuda" else 1
        self._turn = threading.Lock()

    def draw(self, scene: Handle, file: Optional[bytes], cameras: "NDArray[np.float64]", outputs: Outputs, options: Handle,
             one_by_one: bool, stream: Optional[int] = None) -> None:
        """Fills `outputs` with what packed `cameras` see; in GPU memory if there is a `stream`. Ctrl-C is heard between parts."""
        image, alpha, depth = (0 if output is None else output.address for output in outputs)
        rgb, codes = (image, 0) if outputs[0].dtype == "float32" else (0, image)
        part = 1 if one_by_one else self._part
        begin_work()
        with self._turn:
            for first in range(0, len(cameras) or 1, part):
                some = cameras[first:first + part]
                call("render", file=file, renderer=self.handle, scene=scene, options=options, cameras=some, n=len(some), first=first,
                     rgb=rgb, codes=codes, alpha=alpha, depth=depth, on_device=stream is not None, stream=stream or 0)

    def refine(self, scene: Handle, file: Optional[bytes], camera: Camera, seconds: float, options: Handle) -> bool:
        end, refined = time.monotonic() + seconds, None
        begin_work()
        while refined is None:
            left = max(0.0, end - time.monotonic())
            with self._turn:
                refined = call("refine", file=file, renderer=self.handle, scene=scene, options=options, seconds=min(left, 0.1),
                               last=left <= 0.1, **packed([camera]))
        return bool(refined)

    def prepare(self, scene: Handle, file: Optional[bytes]) -> None:
        begin_work()
        with self._turn:
            call("prepare", file=file, renderer=self.handle, scene=scene)

    def stats(self) -> List[Dict[str, float]]:
        begin_work()  # another thread may have had its turn at the fork
        with self._turn:
            stats: List[Dict[str, float]] = call("frame_stats", renderer=self.handle)
        return stats
