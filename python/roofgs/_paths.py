"""Names of files as the library takes them."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from typing import Union

Path = Union[str, bytes, "os.PathLike[str]", "os.PathLike[bytes]"]


def encoded(path: Path) -> bytes:
    """The bytes of a path or address; ValueError for one with a zero byte, at which the system would end it."""
    name = os.fsencode(path)
    if b"\0" in name:
        raise ValueError("embedded null byte")
    return name


def shown(name: bytes) -> str:
    return os.fsdecode(name)
