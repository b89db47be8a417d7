"""Pictures in a GPU's memory."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import ctypes
import math
from typing import Any, Dict, Optional, Tuple

from ._library import Handle, call, work

_BYTES = {"float32": 4, "uint8": 1}
_CUDA = 2  # DLPack's number of it
_new_capsule = ctypes.pythonapi["PyCapsule_New"]  # whose types are its own: as an attribute others would share them
_new_capsule.argtypes, _new_capsule.restype = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p), ctypes.py_object
_CAPSULE_NAME = ctypes.c_char_p(b"dltensor")  # a capsule keeps the address


class DeviceArray:
    """Pictures in a GPU's memory, for whoever takes arrays by DLPack (torch.from_dlpack(), cupy.from_dlpack()) or by
    __cuda_array_interface__. They are complete. The memory lives as long as this or any array that was made of it.
    """

    def __init__(self, renderer: Handle, shape: Tuple[int, ...], dtype: str) -> None:
        self._shape, self._dtype = shape, dtype
        self._block = Handle()
        made = work("allocate", into=self._block, renderer=renderer, bytes=self.nbytes)
        self._address, self._device = int(made["address"]), int(made["device"])

    @property
    def shape(self) -> Tuple[int, ...]:
        """[height, width, 3] or [height, width], after an axis for several cameras."""
        return self._shape

    @property
    def dtype(self) -> str:
        """"float32" or "uint8"."""
        return self._dtype

    @property
    def nbytes(self) -> int:
        """Bytes."""
        return math.prod(self._shape) * _BYTES[self._dtype]

    @property
    def __cuda_array_interface__(self) -> Dict[str, Any]:
        return {"shape": self._shape, "typestr": {"float32": "<f4", "uint8": "|u1"}[self._dtype], "data": (self._address, False),
                "version": 3, "strides": None, "stream": None}

    def __dlpack_device__(self) -> Tuple[int, int]:
        return _CUDA, self._device

    def __dlpack__(self, *, stream: Any = None, max_version: Any = None, dl_device: Optional[Tuple[int, int]] = None,
                   copy: Optional[bool] = None) -> Any:
        # The work is complete: any stream may read it at once.
        if dl_device not in (None, self.__dlpack_device__()):
            raise BufferError("the array is not copied to another device")
        if copy:
            raise BufferError("the array is not copied")
        tensor, release = call("dlpack", block=self._block, shape=self._shape, dtype=self._dtype)
        return _new_capsule(tensor, _CAPSULE_NAME, release)

    def __repr__(self) -> str:
        return f"<roofgs.DeviceArray {self._dtype} {self._shape} on cuda:{self._device}>"
