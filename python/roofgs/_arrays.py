"""Converts anything with DLPack, __array__ or a buffer, torch tensors on a GPU included, to NumPy arrays."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
import sys
from typing import Any, Dict, NamedTuple, Optional, Sequence, Tuple

import numpy as np
from numpy.typing import NDArray

from ._errors import argument_error

FloatArray = NDArray[np.float32]
_DLPACK_CPU, _DLPACK_CUDA_HOST = 1, 3
_OUTPUTS = {"<f4": "float32", "|u1": "uint8"}  # str() of a dtype takes longer than the rest of host_output()


def is_tensor(value: Any) -> bool:
    """Whether `value` is a torch.Tensor, without importing torch."""
    return type(value).__module__.partition(".")[0] == "torch" and hasattr(value, "detach")


def _refuse_gradient(tensor: Any, name: str) -> None:
    torch: Any = sys.modules.get("torch")
    if tensor.requires_grad and (torch is None or torch.is_grad_enabled()):  # not under torch.no_grad(), where none is asked for
        raise NotImplementedError(
            f"{name} requires a gradient, but RoofGS renders forward only: pass {name}.detach(), or train with gsplat")


def _is_bfloat16(tensor: Any) -> bool:
    """Whether a tensor is bfloat16, which NumPy does not have."""
    return str(getattr(tensor, "dtype", "")) == "torch.bfloat16"


def host_array(value: Any, name: str) -> "NDArray[Any]":
    """`value` as an array in host memory; no copy if it is there already."""
    if isinstance(value, np.ndarray):
        return value
    if is_tensor(value):
        _refuse_gradient(value, name)
        tensor = value.detach().cpu()
        if _is_bfloat16(tensor):
            tensor = tensor.float()
        array: NDArray[Any] = tensor.numpy()
        return array
    if hasattr(value, "__dlpack_device__"):
        kind = int(value.__dlpack_device__()[0])
        if kind in (_DLPACK_CPU, _DLPACK_CUDA_HOST):
            return np.from_dlpack(value)
        if not hasattr(value, "get"):  # CuPy's way to the host
            raise argument_error(f"{name} is on a device that cannot be read from here: pass it in host memory")
        return np.asarray(value.get())
    return np.asarray(value)


def float_array(value: Any, name: str, shape: Sequence[Optional[int]]) -> FloatArray:
    """`value` as C-contiguous float32 in native byte order, of this shape; None is any length."""
    array = host_array(value, name)
    if array.dtype.kind not in "fiu":
        raise argument_error(f"{name} holds {array.dtype}, not numbers")
    if array.ndim != len(shape) or any(want is not None and want != have for want, have in zip(shape, array.shape)):
        wanted = ", ".join("n" if length is None else str(length) for length in shape)
        raise argument_error(f"{name} has the shape {list(array.shape)}, not [{wanted}]")
    with np.errstate(over="ignore"):  # beyond float32 values become infinite and are rejected
        return np.ascontiguousarray(array, dtype=np.float32)


class Output(NamedTuple):
    """An array to fill."""

    array: Any
    address: int
    shape: Tuple[int, ...]
    dtype: str
    contiguous: bool
    readonly: bool


def new_output(shape: Tuple[int, ...], dtype: str) -> Output:
    """A new array in host memory."""
    return host_output(np.empty(shape, dtype), "")


def host_output(value: Any, name: str) -> Output:
    """An array or CPU tensor to fill."""
    array = value
    if is_tensor(value) and value.device.type == "cpu":
        _refuse_gradient(value, name)
        if _is_bfloat16(value):
            raise argument_error(f"{name} holds {value.dtype}; outputs are float32; images may be uint8")
        array = value.detach().numpy()
    if not isinstance(array, np.ndarray):
        raise argument_error(f"{name} is not a NumPy array, a torch tensor or an array on a GPU")
    facts = array.__array_interface__
    kind = _OUTPUTS.get(facts["typestr"], "?")
    return Output(value, facts["data"][0], array.shape, kind, array.flags.c_contiguous, not array.flags.writeable)


def device_output(value: Any, name: str) -> "Optional[Tuple[Output, int]]":
    """A torch tensor or other ``__cuda_array_interface__`` in GPU memory, with the stream on which it is ready; else None."""
    if is_tensor(value):
        if value.device.type != "cuda":
            return None
        _refuse_gradient(value, name)
        torch: Any = sys.modules["torch"]
        stream = int(torch.cuda.current_stream(value.device).cuda_stream)
        kind = str(value.dtype).rpartition(".")[2]
        return Output(value, value.data_ptr(), tuple(value.shape), kind, value.is_contiguous(), False), stream
    facts: Optional[Dict[str, Any]] = getattr(value, "__cuda_array_interface__", None)
    if facts is None:
        return None
    kind = _OUTPUTS.get(facts["typestr"], "?")
    shape, strides, (address, readonly) = tuple(facts["shape"]), facts.get("strides"), facts["data"]
    size = 4 if kind == "float32" else 1
    tight = [size * math.prod(shape[i + 1:]) for i in range(len(shape))]
    return Output(value, address or 0, shape, kind, strides is None or list(strides) == tight, readonly), facts.get("stream") or 0
