#!/usr/bin/python3
# rgs_archive.py - frames of codecs 2 and 3 to rows, for rgs_reader.py; written from docs/format/ARCHIVE.md alone; needs numpy.
# SPDX-License-Identifier: Apache-2.0
"""The entropy coder, the way from codes to rows of MEAN, GEOM and SHI8, and for codec 2 Draco's kd-tree in a few lines.

Readable, not fast: some thousand Gaussians per second. Any defect of a frame raises Damaged, a ValueError.
"""
from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

TOKENS, SLOTS = 76, 4096
MEAN_CONTEXTS, GEOM_CONTEXTS = 28, 1 + 16 + 256 + 4096 + 96 + 96  # of codec 3, those of MEAN first
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
    dc_weights: NDArray[np.int64]        # [3, 2], in codec 3 [0]
    sh_unit: NDArray[np.float32]         # [1], in codec 2 [0], as is the next
    smoothing: NDArray[np.int64]         # [2, 2] of DC and of the others: recent, kept
    sh_matrix: NDArray[np.int64]         # [Q, Q]
    opacity: NDArray[np.float16]         # [L + 1], in codec 2 [0]
    map: NDArray[np.uint8]               # [X]
    frequencies: NDArray[np.int64]       # [T, 76]


def sh_contexts(classes: int, q: int) -> int:
    """The last of all contexts."""
    return 24 * classes + 8 * q * classes


def tables_layout(arch: dict[str, Any], q: int) -> list[tuple[np.dtype[Any], tuple[int, ...]]]:
    codec_3, classes = arch["codec"] == 3, arch["n_classes"]
    contexts = MEAN_CONTEXTS + GEOM_CONTEXTS if codec_3 else 1 + classes * (1 + 1 + 12 + 8 + 128 + 256)
    return [(np.dtype(dtype), shape) for dtype, *shape in (
        ("<f4", 3), ("<f4", q), ("<i2", 3, 3), ("<i2", 0 if codec_3 else 3, 2), ("<f4", int(codec_3)),
        ("u1", 2 * codec_3, 2), ("<i2", q, q), ("<f2", arch["opacity_levels"] + 1 if codec_3 else 0),
        ("u1", contexts + sh_contexts(classes, q)), ("<u2", arch["n_distributions"], TOKENS))]


def tables_bytes(arch: dict[str, Any], q: int) -> int:
    return sum(dtype.itemsize * int(np.prod(shape)) for dtype, shape in tables_layout(arch, q))


def read_tables(content: bytes, arch: dict[str, Any], q: int) -> Tables:
    """`content` has tables_bytes()."""
    parts, at = [], 0
    for dtype, shape in tables_layout(arch, q):
        size = int(np.prod(shape)) * dtype.itemsize
        parts.append(np.frombuffer(content[at:at + size], dtype).reshape(shape))
        at += size
    t = Tables(*(part.astype(np.int64) if part.dtype.kind == "i" or part.dtype == np.uint16 else part for part in parts))
    for values in (t.dc_centre, t.sh_centre):
        need((np.abs(values) <= 2.0**40).all(), "centres: finite, magnitudes up to 2^40")
    need(((t.sh_unit >= 2.0**-60) & (t.sh_unit <= 2.0**40)).all(), "the unit of SH: 2^-60 to 2^40")
    need((t.smoothing.sum(1, dtype=np.int64) < 256).all(), "recent and kept: together below 2^8")
    need(((t.opacity > 0) & (t.opacity <= 1)).all(), "an opacity: above 0, at most 1")
    need((t.map < arch["n_distributions"]).all(), "a context's distribution")
    need((t.frequencies.sum(1) == SLOTS).all(), "frequencies of a distribution")
    return t


# ---- streams --------------------------------------------------------------------------------------------------------

class Stream:
    """Planes of a frame, of one number for each row or cell of a list."""

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

    def plane(self, contexts: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.array([self.number(i, c) for i, c in enumerate(contexts.tolist())], np.int64)

    def signed(self, contexts: NDArray[np.int64]) -> NDArray[np.int64]:
        z = self.plane(contexts)
        return np.where(z % 2 == 0, z // 2, -(z + 1) // 2)

    def bits(self, widths: NDArray[np.int64]) -> NDArray[np.int64]:
        numbers = []
        for i, w in enumerate(widths.tolist()):
            x = self.states[i % 8]
            numbers.append(x % (1 << w))
            self.states[i % 8] = self.refill(x >> w)
        return np.array(numbers, np.int64)

    def finish(self) -> None:
        need(self.at == len(self.words) and all(x == 1 << 16 for x in self.states), "the end of a stream")


# ---- formulas -------------------------------------------------------------------------------------------------------

def log(x: NDArray[np.float64]) -> NDArray[np.int64]:
    """Octaves."""
    return (x.view(np.int64) >> 36) - 1023 * 65536


def mantissa(e: NDArray[np.int64]) -> NDArray[np.float32]:
    """exp(e) is this times 2^(e div 65536)."""
    y, p = e % 65536 / 65536, np.zeros(e.shape)
    for factor in EXP2:
        p = p * y + factor
    return p.astype(np.float32)


def exp(e: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.ldexp(mantissa(e).astype(np.float64), e // 65536)


def step_index(e: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    return ((e + 16384) // 32768).clip(-24, most)


def step(j: NDArray[np.int64]) -> NDArray[np.int64]:
    h, w = np.where(j % 2 == 0, 65536, 92682), j // 2
    return h << w.clip(0, None) >> (-w).clip(0, None)


def sum_of_squares(x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
    return x * x + y * y + z * z


def quaternion(r: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[4, rows] from [3, rows], the component left out first; and its length."""
    squared = sum_of_squares(*r)
    w = np.sqrt(np.where(squared < 1, 1 - squared, 0))
    return np.stack([w, *r]), np.sqrt(squared + w * w)


def place(u: NDArray[np.int64], f: Any, arch: dict[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """t(f) and g of coordinates."""
    m, q = arch["mean_cells"], u - (1 << arch["mean_bits"] - 1)
    g, rest = np.divmod(np.where(q >= 0, q, -1 - q), 1 << m)
    cell = (rest + f) / 2.0**m
    t = np.where(g == 0, cell, np.ldexp(1 + cell, g.clip(1, None) - 1))
    return np.where(q >= 0, t, -t), g


def mean_rows(t: NDArray[np.float64], arch: dict[str, Any]) -> bytes:
    """t [rows, 3]"""
    largest = float(np.finfo(np.float32).max)
    mean = (np.array(arch["centre"]) + np.array(arch["half_width"]) * t).clip(-largest, largest).astype(np.float32)
    return (mean + np.float32(0)).astype("<f4").tobytes()     # -0 + 0 is +0


# ---- MEAN and GEOM --------------------------------------------------------------------------------------------------

def open_points(frame: bytes, rows: int, arch: dict[str, Any],
                corner: tuple[int, ...] = (0, 0, 0)) -> tuple[Stream, NDArray[np.int64]]:
    """The stream of a frame of MEAN or of a page, behind its coordinates; and these, [rows, 3]."""
    need(len(frame) >= 4, "a frame begins with four bytes")
    bits = list(frame[:3])
    need(max(bits) <= arch["mean_bits"], "coordinates of too many bits")
    need(frame[3] == 0, "the byte behind the bits is 0")
    stream = Stream(frame[4:], arch["tables"])
    u = np.zeros((rows, 3), np.int64)
    left = np.zeros((rows, 3), np.int64)             # bits of each row's coordinates that are not known yet
    points, first, lowest = np.array([rows]), np.array([0]), np.zeros((1, 3), np.int64)      # the list of cells
    axes_left = np.array(bits)
    for bit, k in ((bit, k) for bit in reversed(range(max(bits))) for k in range(3) if bits[k] > bit):
        single = points == 1
        u[first[single]], left[first[single]] = lowest[single], axes_left
        points, first, lowest = points[~single], first[~single], lowest[~single]
        bit_length = np.frexp(points)[1]
        low = points // 2 + stream.signed(np.where(points < 16, points, 11 + bit_length))
        need(((low >= 0) & (low <= points)).all(), "a half has more points than its cell")
        upper = lowest + (np.arange(3) == k) * (1 << bit)
        points, first, lowest = (np.stack(halves, 1).reshape(-1, *halves[0].shape[1:]) for halves in (
            (low, points - low), (first, first + low), (lowest, upper)))
        points, first, lowest = points[points > 0], first[points > 0], lowest[points > 0]
        axes_left[k] = bit
    for n, row, at in zip(points, first, lowest):
        u[row:row + n] = at
    for k in range(3):
        while True:
            width = left[:, k].clip(None, 12)
            left[:, k] -= width
            u[:, k] += stream.bits(width) << left[:, k]
            if not left[:, k].any():
                break
    u += np.array(corner, np.int64)
    need((u < 1 << arch["mean_bits"]).all(), "a coordinate beyond the grid")
    return stream, u


def decode_shapes(stream: Stream, u: NDArray[np.int64], arch: dict[str, Any], exponent: int,
                  level: int = 0) -> tuple[bytes, bytes, NDArray[np.int64]]:
    """Rows of MEAN and GEOM, and the class of each; within, arrays are [3, rows] of the three axes."""
    levels, half_width = arch["opacity_levels"], np.array(arch["half_width"])[:, None]
    context, each = MEAN_CONTEXTS, np.arange(3)
    o = stream.plane(np.full(len(u), context))
    need((o <= levels).all(), "an opacity")
    opacity = arch["tables"].opacity[o]
    near, coarse = 16 * o // (levels + 1), []
    context += 1
    for size in (16, 256, 4096):
        coarse.append(stream.signed(context + near))
        near = 16 * near + coarse[-1].clip(0, 15)
        context += size

    b = arch["blur"] + 65536 * level
    wide = b + np.array(coarse) * arch["coarse_step"]

    def importance(h: NDArray[np.int64]) -> NDArray[np.int64]:
        """Above the middle."""
        w = 2 * log(opacity.astype(np.float64)) + h.sum(0) - h.min(0) - 163840 * level
        return w - arch["middle"]

    def finer(h: NDArray[np.int64]) -> NDArray[np.int64]:
        return arch["slope"] * importance(h) // 2**17

    fine = step_index(arch["fine_step"] - finer(wide.clip(-2**23, 2**23)), 7)
    e = np.stack([stream.signed(context + 32 * k + 24 + fine) for k in each])
    context += 96
    h = (wide + e * step(fine)).clip(-2**23, 2**23)
    f, count = finer(h), arch["n_classes"]
    classes = ((importance(h) + 32768) // 65536 + count // 2).clip(0, count - 1)
    d = exp(np.array([2 * b]))
    variance = np.maximum(exp(2 * h) - d, d / 64)

    i, j = (each + 1) % 3, (each + 2) % 3
    apart = variance[i] - variance[j]
    shows = log(apart * apart) - log(variance[i] + d) - log(variance[j] + d)
    turn = step_index(arch["turn_step"] - f - shows // 2, 2)
    v = np.stack([stream.signed(context + 32 * k + 24 + turn[k]) for k in each])
    of_length, length = quaternion(v * (step(turn) * 2.0**-16))
    unit = of_length * (1 / length)

    t, g = place(u.T, 0.5, arch)
    distance = np.maximum(arch["nearest"], sum_of_squares(*(half_width * t)))
    w, x, y, z = unit
    matrix = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                       [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                       [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
    p = [matrix[:, k] * matrix[:, k] * (1 / (variance[k] + d)) for k in each]
    cell = log(half_width) + 65536 * ((g - 1).clip(0, None) - arch["mean_cells"])
    mean_step = arch["mean_step"] - f + log(distance) // 2 - log(p[0] + p[1] + p[2]) // 2
    n = ((cell - mean_step + 32768) // 65536).clip(0, 12)
    part = np.stack([stream.bits(n[k]) for k in each])
    means = mean_rows(place(u.T, (part + 0.5) * 2.0**-n, arch)[0].T, arch)

    out = np.empty((len(u), 8), np.float16)
    with np.errstate(over="ignore", under="ignore"):
        out[:, :4] = unit.T.astype(np.float32)
        scale = np.sqrt(variance * distance) * 2.0**exponent
        out[:, 4:7] = np.minimum(scale.T.astype(np.float32).astype(np.float16), 65504)
    out[:, 7] = opacity
    return means, out.astype("<f2").tobytes(), classes


# ---- SHI8 -----------------------------------------------------------------------------------------------------------

def step_for(largest: float) -> np.float32:
    """The step of a page's chunk for values of at most this magnitude."""
    largest = np.float32(largest)
    if not largest >= np.float32(127 * 2.0**-107):
        return np.float32(0)
    bits = (int((largest / np.float32(127)).view(np.uint32)) + 127) // 128 * 128
    if np.uint32(bits).view(np.float32) * np.float32(127) < largest:
        bits += 128
    return np.uint32(bits).view(np.float32)


def sh_values(stream: Stream, arch: dict[str, Any], classes: NDArray[np.int64], q: int) -> NDArray[np.float32]:
    """[rows, 3 + q] before they become codes."""
    tables, count, rows = arch["tables"], arch["n_classes"], len(classes)
    context = len(tables.map) - sh_contexts(count, q)
    codes, h = np.zeros((3 + q, rows), np.int64), np.zeros(rows, np.int64)
    for plane in range(3 + q):
        h *= plane != 3
        size = np.searchsorted(SIZES, h, side="right")
        codes[plane] = stream.signed(context + (plane * count + classes) * 8 + size)
        h = (13 * h + 128 * np.abs(codes[plane]).clip(None, 255)) // 16

    of = {name: np.array([c[name] for c in arch["classes"]])[classes] for name in ("dc_step", "sh_step")}
    if arch["codec"] == 3:
        dc = smooth(codes[:3], of["dc_step"], tables.smoothing[0], -2**30, 2**30)
        others = smooth(codes[3:], of["sh_step"], tables.smoothing[1], -2**15, 2**15 - 1)
        unit = np.repeat(tables.sh_unit, rows)
    else:
        dc, others, unit = predict_dc(codes[:3], of["dc_step"], tables.dc_weights), codes[3:], of["sh_step"]
    value = np.empty((rows, 3 + q), np.float32)
    value[:, :3] = (tables.dc_matrix @ dc).T * 2.0**-30 + tables.dc_centre.astype(np.float64)
    sums = (tables.sh_matrix @ others).astype(np.uint32).view(np.int32).astype(np.float32).T
    factor = unit.astype(np.float32) * np.float32(2.0**-14)
    value[:, 3:] = sums * factor[:, None] + tables.sh_centre
    return value


def smooth(codes: NDArray[np.int64], steps: NDArray[np.int64], smoothing: NDArray[np.int64], low: int,
           high: int) -> NDArray[np.int64]:
    """Values [planes, rows] of codes in codec 3."""
    recent, kept = smoothing.astype(np.int64)
    values, state = np.empty_like(codes), np.zeros(len(codes), np.int64)
    for i, step in enumerate(steps):
        values[:, i] = (codes[:, i] * int(step) + (state + 128) // 256).clip(low, high)
        state = recent * values[:, i] + kept * state // 256
    return values


def predict_dc(codes: NDArray[np.int64], steps: NDArray[np.int64], weights: NDArray[np.int64]) -> NDArray[np.int64]:
    """Values [3, rows] of codes in codec 2."""
    values = np.empty_like(codes)
    before, before_that = np.zeros((2, 3), np.int64)
    for i, step in enumerate(steps.tolist()):
        guess = (weights[:, 0] * before + weights[:, 1] * before_that) // 256
        values[:, i] = ((codes[:, i] + (2 * guess + step) // (2 * step)) * step).clip(-2**30, 2**30)
        before, before_that = values[:, i], before
    return values


def sh_codes(value: NDArray[np.float32], steps: NDArray[np.float32], row_bytes: int) -> bytes:
    """Rows of SHI8; `steps` [rows, K, 3]"""
    rows, width = value.shape
    flat = steps.reshape(rows, width)
    with np.errstate(over="ignore"):
        ratio = np.divide(value, flat, out=np.zeros_like(value), where=flat != 0)
    out = np.zeros((rows, row_bytes), np.int8)
    out[:, :width] = np.rint(ratio.clip(-127, 127))
    return out.tobytes()


# ---- codec 2: Draco --------------------------------------------------------------------------------------------------

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
    u = decode_points(frame, rows, arch["mean_bits"]) + np.array(corner, np.int64)
    need((u < 1 << arch["mean_bits"]).all(), "a coordinate beyond the grid")
    return mean_rows(place(u, 0.5, arch)[0], arch)


def decode_geometry(frame: bytes, rows: int, arch: dict[str, Any], exponent: int) -> tuple[bytes, NDArray[np.int64]]:
    """Rows of GEOM, and the class of each."""
    stream, count, levels = Stream(frame, arch["tables"]), arch["n_classes"], arch["opacity_levels"]
    before, numbers = 0, []
    for i in range(rows):
        before = stream.number(i, before)
        need(before < count, "a class")
        numbers.append(before)
    c, context = np.array(numbers), count
    o = stream.plane(context + c)
    need((o <= levels).all(), "an opacity")
    context += count
    largest = stream.plane(np.full(rows, context))
    need((largest < 4).all(), "the largest component")
    context += 1
    rotation = [stream.signed(context + (j * count + c) * 4 + largest) for j in range(3)]
    context += 12 * count
    seen = 8 * c + 8 * o // (levels + 1)
    scale = [stream.signed(context + seen)]
    context += 8 * count
    bucket = (scale[0] // 4 + 8).clip(0, 15)
    scale.append(stream.signed(context + seen * 16 + bucket))
    context += 128 * count
    scale.append(stream.signed(context + (16 * c + bucket) * 16 + (scale[1] // 4 + 8).clip(0, 15)))
    stream.finish()

    of = {name: np.array([row[name] for row in arch["classes"]])[c] for name in
          ("rotation_step", "scale_step", "scale_base")}
    of_length, length = quaternion(np.array(rotation, np.float64) * of["rotation_step"])
    unit = of_length / length
    out = np.empty((rows, 8), np.float16)
    for i, b in enumerate(largest):
        order = [1, 2, 3]
        order.insert(b, 0)
        q = unit[order, i]
        out[i, :4] = (-q if q[0] < 0 else q).astype(np.float32)
    out[:, 0] = np.abs(out[:, 0])

    e = (of["scale_base"] + np.array(scale) * of["scale_step"]).clip(-2**23, 2**23)
    with np.errstate(over="ignore", under="ignore"):
        stored = np.ldexp(mantissa(e), (e // 65536 + exponent).astype(np.int32)).astype(np.float16)
        out[:, 4:7] = np.minimum(stored, np.float16(65504)).T
    out[:, 7] = np.where(o == 0, 0.25, o).astype(np.float32) / np.float32(levels)
    return out.astype("<f2").tobytes(), c
