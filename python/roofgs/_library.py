"""Calls the shared library, which is no extension module: one build serves every Python. Errors become exceptions here."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import atexit
import ctypes
import json
import os
from pathlib import Path as FilePath
from typing import Any, Callable, Dict, Optional

import numpy as np

from ._errors import argument_error, from_message, make
from ._paths import Path, encoded
from ._progress import Callback

# Calls release the GIL.
_library = ctypes.CDLL(str(FilePath(__file__).parent / "lib/libroofgs.so"))
_call, _free = _library.roofgs_call, _library.roofgs_free
_call.argtypes, _call.restype = (ctypes.c_char_p, ctypes.c_char_p), ctypes.c_char_p
_free.argtypes, _free.restype = (ctypes.c_void_p,), None

_has_threads = _lost_threads = False


class Handle:
    """Holds a value of the library once a call with `into` has put it there, and frees it with its last reference."""

    def __init__(self) -> None:
        self.slot = ctypes.c_void_p()

    # A forked process lost the threads that this may wait for: what they hold stays.
    def __del__(self, free: Callable[[ctypes.c_void_p], None] = _free) -> None:
        if not _lost_threads:
            free(self.slot)

    def close(self) -> None:
        """Ends the scene that it holds, though tracebacks may keep the handle itself."""
        if not _lost_threads:
            call("close", scene=self)


_left: Dict[Handle, Dict[str, Any]] = {}  # what Ctrl-C has ended before its work, and what that uses

def _plain(value: Any) -> Any:
    if isinstance(value, Handle):
        return ctypes.addressof(value.slot)
    if isinstance(value, np.ndarray):
        return value.__array_interface__["data"][0]
    if isinstance(value, bytes):
        return list(value)
    raise TypeError(f"{type(value).__name__} is no argument of the library")


_encode = json.JSONEncoder(default=_plain, allow_nan=False).encode


def _text(arguments: Dict[str, Any]) -> str:
    try:
        return _encode(arguments)
    except ValueError:
        for key, value in arguments.items():
            if isinstance(value, (float, tuple)) and not np.isfinite(value).all():
                raise argument_error(f"{key} is {value}") from None
        raise


def _value(reply: str, file: Optional[Path]) -> Any:
    answer = json.loads(reply)
    if "error" in answer:
        raise from_message(answer["error"], None if file is None else os.fsdecode(file))
    return answer["value"]


def call(name: str, *, file: Optional[Path] = None, **arguments: Any) -> Any:
    """Calls a function of python/src that needs no threads. `file` is what its errors name."""
    return _value(_call(name.encode(), _text(arguments).encode()), file)


def begin_work() -> None:
    """Call before starting or waiting for threads."""
    global _has_threads
    if _lost_threads:
        raise make("unavailable", "this process was forked after roofgs had started threads, which a fork loses: start workers by "
                   "'spawn' or 'forkserver', or load scenes in the workers alone")
    _has_threads = True


def work(name: str, *, file: Optional[Path] = None, **arguments: Any) -> Any:
    """call() for functions that start or wait for threads."""
    begin_work()
    return call(name, file=file, **arguments)


def run(name: str, *, file: Path, progress: Optional[Callback] = None, waits: bool = False, **arguments: Any) -> Any:
    """work() on a thread of its own, while this one reports progress and hears Ctrl-C, which cancels the work and raises at once, or
    if it `waits` when the work has ended."""
    begin_work()
    for left in list(_left):
        if call("wait", work=left, seconds=0):
            _left.pop(left, None)
    handle = Handle()
    call("make_work", into=handle)
    arguments.update(path=encoded(file), work=handle)
    text = _text(arguments)

    def report() -> None:
        if progress:
            for stage in call("report", work=handle):
                progress(*stage)

    try:
        call("start", work=handle, function=name, arguments=text)
        while not call("wait", work=handle, seconds=0.05):
            report()
    except BaseException:
        _left[handle] = arguments
        call("cancel", work=handle)
        while waits and not call("wait", work=handle, seconds=0.05):
            pass
        raise
    report()
    return _value(call("reply_of", work=handle), file)


# No thread outlives what it uses. Another Ctrl-C ends the wait and the process.
@atexit.register
def _wait_for_threads() -> None:
    for handle in list(_left):
        while not call("wait", work=handle, seconds=0.05):
            pass


def _after_fork() -> None:
    global _lost_threads
    _lost_threads = _has_threads
    _left.clear()


os.register_at_fork(after_in_child=_after_fork)
version: str = call("version")
