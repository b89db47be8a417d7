#!/usr/bin/python3
# rgs_archive.py - frames of codec 2 to rows, for rgs_reader.py; written from docs/format/ARCHIVE.md alone; needs numpy.
# SPDX-License-Identifier: Apache-2.0
"""Draco's kd-tree in a few lines, the entropy coder, and the way from codes to rows of MEAN, GEOM and SHI8.

Readable, not fast: some thousand Gaussians per second. Any defect of a frame raises Damaged, a ValueError.
"""
from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

TOKENS, SLOTS = 76, 4096
SIZES = (3, 7, 12, 22, 37, 60, 98)
EXP2 = (0.001893754059, 0.008949590422, 0.05586033708, 0.2401418182, 0.6931544897, 0.9999998984)


class Damaged(ValueError):
    """A frame that cannot be decoded."""


def need(ok: Any, text: str) -> None:
    if not ok:
        raise Damaged(text)


@dataclass
class Tables:
    """The frame of tables in ARCH; Q coefficients above degree 0, X contexts, T distributions."""

    dc_centre: NDArray[np.float32]       # [3]
    sh_centre: NDArray[np.float32]       # [Q]
    dc_matrix: NDArray[np.int64]         # [3, 3]
    dc_weights: NDArray[np.int64]        # [3, 2]
    sh_matrix: NDArray[np.int64]         # [Q, Q]
    map: NDArray[np.uint8]               # [X]
    frequencies: NDArray[np.int64]       # [T, 76]


def n_contexts(classes: int, q: int) -> int:
    return 1 + classes * (1 + 1 + 12 + 8 + 128 + 256 + 24 + 8 * q)


def tables_bytes(classes: int, q: int, distributions: int) -> int:
    return 12 + 4 * q + 18 + 12 + 2 * q * q + n_contexts(classes, q) + 2 * TOKENS * distributions


def read_tables(content: bytes, classes: int, q: int, distributions: int) -> Tables:
    """`content` has tables_bytes()."""
    parts, at = [], 0
    for dtype, *shape in (("<f4", 3), ("<f4", q), ("<i2", 3, 3), ("<i2", 3, 2), ("<i2", q, q),
                          ("u1", n_contexts(classes, q)), ("<u2", distributions, TOKENS)):
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        parts.append(np.frombuffer(content[at:at + size], dtype).reshape(shape))
        at += size
    t = Tables(*(part.astype(np.int64) if part.dtype.kind == "i" or part.dtype == np.uint16 else part for part in parts))
    for values in (t.dc_centre, t.sh_centre):
        need((np.abs(values) <= 2.0**40).all(), "centres: finite, magnitudes up to 2^40")
    need((t.map < distributions).all(), "a context's distribution")
    need((t.frequencies.sum(1) == SLOTS).all(), "frequencies of a distribution")
    return t


# ---- Draco ----------------------------------------------------------------------------------------------------------

DRACO_HEAD = b"DRACO\x02\x03\x00\x01\x00\x00"
DRACO_ATTRIBUTE = bytes.fromhex("01 01 00 06 03 00 00 06")


class Bytes:
    """A cursor with a check for the end."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, size: int) -> bytes:
        need(size <= len(self.data) - self.at, "a frame of means ends early")
        self.at += size
        return self.data[self.at - size:self.at]

    def varint(self) -> int:
        value = 0
        for shift in range(0, 35, 7):
            byte = self.take(1)[0]
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise Damaged("a number of variable length")


class AsymmetricBits:
    """Bits of one probability, coded by a binary range asymmetric numeral system and read from the end."""

    def __init__(self, source: Bytes) -> None:
        self.zero = source.take(1)[0]
        self.data = source.take(source.varint())
        need(self.data, "bits without a state")
        size = (self.data[-1] >> 6) + 1
        need(size <= 3 and size <= len(self.data), "the state of a bit coder")
        self.left = len(self.data) - size
        tail = int.from_bytes(self.data[self.left:], "little")
        self.state = (tail & (1 << 8 * size - 2) - 1) + 4096
        need(self.state < 4096 * 256, "the state of a bit coder")

    def bit(self) -> int:
        if self.state < 4096 and self.left > 0:
            self.left -= 1
            self.state = self.state * 256 + self.data[self.left]
        one = 256 - self.zero & 255
        quotient, slot = divmod(self.state, 256)
        if slot < one:
            self.state = quotient * one + slot
            return 1
        self.state -= quotient * one + one
        return 0


class PlainBits:
    """Bits in 32-bit words, from the highest on."""

    def __init__(self, source: Bytes) -> None:
        size = int.from_bytes(source.take(4), "little")
        need(size % 4 == 0 and size > 0, "words of bits")
        words = np.frombuffer(source.take(size), "<u4")
        self.value, self.left = int.from_bytes(words.astype(">u4").tobytes(), "big"), 8 * size

    def bits(self, count: int) -> int:
        need(count <= self.left, "bits end early")
        self.left -= count
        return self.value >> self.left & (1 << count) - 1


def decode_points(frame: bytes, rows: int, mean_bits: int) -> NDArray[np.int64]:
    """[rows, 3] coordinates, in Draco's order."""
    head = DRACO_HEAD + struct.pack("<I", rows) + DRACO_ATTRIBUTE
    source = Bytes(frame)
    need(source.take(len(head)) == head, "the head of a Draco stream")
    bit_length, count = struct.unpack("<2I", source.take(8))
    need(bit_length <= mean_bits and count == rows, "coordinates of too many bits, or another number of rows")
    numbers = [AsymmetricBits(source) for _ in range(33)]
    remaining, axes, halves = PlainBits(source), PlainBits(source), PlainBits(source)
    need(source.at == len(source.data), "bytes behind a Draco stream")

    points: list[tuple[int, ...]] = []
    stack = [(rows, (0, 0, 0), (0, 0, 0))]          # points of a cell, its lowest corner, how often each axis was halved
    while stack:
        count, corner, levels = stack.pop()
        axis = axes.bits(4) if count >= 64 else levels.index(min(levels))
        need(axis < 3, "an axis")
        if levels[axis] == bit_length:
            points += [corner] * count
            continue
        if count <= 2:
            for _ in range(count):
                point = list(corner)
                for a in (axis, (axis + 1) % 3, (axis + 2) % 3):
                    point[a] |= remaining.bits(bit_length - levels[a])
                points.append(tuple(point))
            continue
        less = 0
        for digit in range(count.bit_length() - 1):
            less = less << 1 | numbers[digit].bit()
        need(less <= count // 2, "more points than there are")
        low, high = count // 2 - less, count - (count // 2 - less)
        if low != high and not halves.bits(1):
            low, high = high, low
        deeper = tuple(level + (a == axis) for a, level in enumerate(levels))
        upper = tuple(x + ((a == axis) << bit_length - 1 - levels[axis]) for a, x in enumerate(corner))
        stack += [half for half in ((low, corner, deeper), (high, upper, deeper)) if half[0]]
    return np.array(points, np.int64).reshape(rows, 3)


def decode_means(frame: bytes, rows: int, arch: dict[str, Any], corner: tuple[int, ...] = (0, 0, 0)) -> bytes:
    m, bits = arch["mean_cells"], arch["mean_bits"]
    u = decode_points(frame, rows, bits) + np.array(corner, np.int64)
    need((u < 1 << bits).all(), "a coordinate beyond the grid")
    q = u - (1 << bits - 1)
    n = np.where(q >= 0, q, -1 - q)
    k, rest = np.divmod(n, 1 << m)
    cell = (rest + 0.5) / 2.0**m
    t = np.where(k == 0, cell, np.ldexp(1 + cell, np.maximum(k, 1) - 1))
    offset = np.array(arch["half_width"]) * np.where(q >= 0, t, -t)
    largest = np.finfo(np.float32).max
    mean = (np.array(arch["centre"]) + offset).clip(-float(largest), float(largest)).astype(np.float32)
    return (mean + np.float32(0)).astype("<f4").tobytes()     # -0 + 0 is +0


# ---- streams --------------------------------------------------------------------------------------------------------

class Stream:
    """Planes of a frame of GEOM or SHI8."""

    def __init__(self, frame: bytes, tables: Tables) -> None:
        need(len(frame) >= 32 and len(frame) % 2 == 0, "a stream: eight states, then words")
        self.states = list(struct.unpack("<8I", frame[:32]))
        self.words = np.frombuffer(frame[32:], "<u2").tolist()
        self.at = 0
        self.map = tables.map.tolist()
        self.frequency = tables.frequencies.tolist()
        self.before = (np.cumsum(tables.frequencies, 1) - tables.frequencies).tolist()
        self.token_of = [np.repeat(np.arange(TOKENS), row).tolist() for row in tables.frequencies]

    def refill(self, x: int) -> int:
        if x >= 1 << 16:
            return x
        need(self.at < len(self.words), "a stream ends early")
        self.at += 1
        return x << 16 | self.words[self.at - 1]

    def number(self, row: int, context: int) -> int:
        d, x = self.map[context], self.states[row % 8]
        quotient, slot = divmod(x, SLOTS)
        z = self.token_of[d][slot]
        x = self.refill(self.frequency[d][z] * quotient + slot - self.before[d][z])
        if z >= 32:
            r = (z - 32) // 4 + 3
            z, x = ((4 + z % 4) << r) + x % (1 << r), self.refill(x >> r)
        self.states[row % 8] = x
        return z

    def signed(self, row: int, context: int) -> int:
        z = self.number(row, context)
        return z // 2 if z % 2 == 0 else -(z + 1) // 2

    def finish(self) -> None:
        need(self.at == len(self.words) and all(x == 1 << 16 for x in self.states), "the end of a stream")


def bucket(n: int) -> int:
    return min(max(n // 4 + 8, 0), 15)


def decode_geometry(frame: bytes, rows: int, arch: dict[str, Any], exponent: int) -> tuple[bytes, list[int]]:
    """Rows of GEOM, and the class of each."""
    stream, count, levels = Stream(frame, arch["tables"]), arch["n_classes"], arch["opacity_levels"]
    classes: list[int] = []
    for i in range(rows):
        classes.append(stream.number(i, classes[-1] if i else 0))
        need(classes[-1] < count, "a class")
    base = count
    opacity = [stream.number(i, base + c) for i, c in enumerate(classes)]
    need(max(opacity) <= levels, "an opacity")
    base += count
    largest = [stream.number(i, base) for i in range(rows)]
    need(max(largest) < 4, "the largest component")
    base += 1
    rotation = [[stream.signed(i, base + (j * count + c) * 4 + largest[i]) for i, c in enumerate(classes)]
                for j in range(3)]
    base += 12 * count
    seen = [8 * c + 8 * o // (levels + 1) for c, o in zip(classes, opacity)]
    scale = [[stream.signed(i, base + seen[i]) for i in range(rows)]]
    base += 8 * count
    scale.append([stream.signed(i, base + seen[i] * 16 + bucket(scale[0][i])) for i in range(rows)])
    base += 128 * count
    scale.append([stream.signed(i, base + (16 * c + bucket(scale[0][i])) * 16 + bucket(scale[1][i]))
                  for i, c in enumerate(classes)])
    stream.finish()

    of = {name: np.array([c[name] for c in arch["classes"]])[classes] for name in
          ("rotation_step", "scale_step", "scale_base")}
    r = np.array(rotation, np.float64) * of["rotation_step"]
    squared = (r[0] * r[0] + r[1] * r[1]) + r[2] * r[2]
    w = np.sqrt(np.where(squared < 1, 1 - squared, 0))
    unit = np.stack([w, *r]) / np.sqrt(squared + w * w)
    out = np.empty((rows, 8), np.float16)
    for i, b in enumerate(largest):
        order = [1, 2, 3]
        order.insert(b, 0)
        q = unit[order, i]
        out[i, :4] = (-q if q[0] < 0 else q).astype(np.float32)
    out[:, 0] = np.abs(out[:, 0])

    e = (of["scale_base"] + np.array(scale) * of["scale_step"]).clip(-2**23, 2**23)
    y, p = e % 65536 / 65536, np.zeros(e.shape)
    for factor in EXP2:
        p = p * y + factor
    with np.errstate(over="ignore", under="ignore"):
        stored = np.ldexp(p.astype(np.float32), (e // 65536 + exponent).astype(np.int32)).astype(np.float16)
        out[:, 4:7] = np.minimum(stored, np.float16(65504)).T
    o = np.array(opacity, np.float32)
    out[:, 7] = np.where(o == 0, np.float32(0.25), o) / np.float32(levels)
    return out.astype("<f2").tobytes(), classes


def decode_sh(frame: bytes, rows: int, arch: dict[str, Any], classes: list[int],
              steps: NDArray[np.float32], row_bytes: int) -> bytes:
    """`steps` [rows, K, 3], of each row's chunk."""
    return sh_codes(sh_values(frame, rows, arch, classes, 3 * (steps.shape[1] - 1)), steps, row_bytes)


def step_for(largest: float) -> np.float32:
    """The step of a page's chunk for values of at most this magnitude."""
    largest = np.float32(largest)
    if not largest >= np.float32(127 * 2.0**-107):
        return np.float32(0)
    bits = (int((largest / np.float32(127)).view(np.uint32)) + 127) // 128 * 128
    if np.uint32(bits).view(np.float32) * np.float32(127) < largest:
        bits += 128
    return np.uint32(bits).view(np.float32)


def sh_values(frame: bytes, rows: int, arch: dict[str, Any], classes: list[int], q: int) -> NDArray[np.float32]:
    """[rows, 3 + q] before they become codes."""
    tables, count = arch["tables"], arch["n_classes"]
    stream = Stream(frame, tables)
    context = n_contexts(count, q) - 8 * q * count - 24 * count
    codes = np.zeros((3 + q, rows), np.int64)
    h = [0] * rows
    for plane in range(3 + q):
        if plane == 3:
            context, h = context + 24 * count, [0] * rows
        j = plane if plane < 3 else plane - 3
        for i, c in enumerate(classes):
            size = sum(limit <= h[i] for limit in SIZES)
            code = stream.signed(i, context + (j * count + c) * 8 + size)
            h[i] = (13 * h[i] + 128 * min(abs(code), 255)) // 16
            codes[plane, i] = code
    stream.finish()

    of = {name: np.array([c[name] for c in arch["classes"]])[classes] for name in ("dc_step", "sh_step")}
    value = np.empty((rows, 3 + q), np.float32)
    before = [(0, 0)] * 3
    for i in range(rows):
        step = int(of["dc_step"][i])
        v = []
        for m in range(3):
            near, far = tables.dc_weights[m].tolist()
            guess = (near * before[m][0] + far * before[m][1]) // 256
            v.append(min(max((int(codes[m, i]) + (2 * guess + step) // (2 * step)) * step, -2**30), 2**30))
            before[m] = v[m], before[m][0]
        value[i, :3] = tables.dc_matrix @ np.array(v) * 2.0**-30 + tables.dc_centre.astype(np.float64)
    sums = (tables.sh_matrix @ codes[3:]).astype(np.uint32).view(np.int32).astype(np.float32).T
    factor = of["sh_step"].astype(np.float32) * np.float32(2.0**-14)
    value[:, 3:] = sums * factor[:, None] + tables.sh_centre
    return value


def sh_codes(value: NDArray[np.float32], steps: NDArray[np.float32], row_bytes: int) -> bytes:
    """Rows of SHI8; `steps` [rows, K, 3]"""
    rows, width = value.shape
    flat = steps.reshape(rows, width)
    with np.errstate(over="ignore"):
        ratio = np.divide(value, flat, out=np.zeros_like(value), where=flat != 0)
    out = np.zeros((rows, row_bytes), np.int8)
    out[:, :width] = np.rint(ratio.clip(-127, 127))
    return out.tobytes()
