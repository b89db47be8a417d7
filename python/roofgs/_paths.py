"""File names as the library takes them."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from typing import Union

Path = Union[str, bytes, "os.PathLike[str]", "os.PathLike[bytes]"]


def encoded(path: Path) -> bytes:
    """The bytes of a path or address; ValueError if it contains a zero byte."""
    name = os.fsencode(path)
    if b"\0" in name:
        raise ValueError("embedded null byte")
    return name


def is_address(name: Union[str, bytes]) -> bool:
    return os.fsdecode(name).lower().startswith(("http://", "https://"))


def shown(name: Union[str, bytes]) -> str:
    """A path, or an address without user, password, query and fragment."""
    text = os.fsdecode(name)
    if not is_address(text):
        return text
    scheme, _, rest = text.partition("://")
    rest = rest.partition("?")[0].partition("#")[0]
    host, slash, path = rest.partition("/")
    return f"{scheme}://{host.rpartition('@')[2]}{slash}{path}"
