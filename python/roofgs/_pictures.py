"""Pictures as files, without another package."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from ._errors import argument_error


def png(image: "NDArray[np.uint8]") -> bytes:
    """A picture uint8 [height, width, 3] as the bytes of a PNG file.

    >>> (folder / "grey.png").write_bytes(png(np.full((48, 64, 3), 128, np.uint8))) > 60
    True
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise argument_error(f"a PNG is made of uint8 [height, width, 3], not of {image.dtype} {list(image.shape)}")
    height, width, _ = image.shape
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)  # before each row its filter: none
    rows[:, 1:] = image.reshape(height, 3 * width)

    def part(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (b"\x89PNG\r\n\x1a\n" + part(b"IHDR", header) + part(b"IDAT", zlib.compress(rows.tobytes()))
            + part(b"IEND", b""))
