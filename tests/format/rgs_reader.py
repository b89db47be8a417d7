#!/usr/bin/python3
# rgs_reader.py - an independent reader of .rgs files, written from docs/FORMAT.md and docs/ARCHIVE.md alone; needs numpy,
# xxhash, zstandard.
# SPDX-License-Identifier: Apache-2.0
"""Reads an .rgs file, checks every rule of docs/FORMAT.md, and gives every value as a numpy array.

    scene = rgs_reader.read(open("scene.rgs", "rb").read())     # raises RgsError(code, offset, text)
    scene.means, scene.rotations, scene.scales, scene.opacities, scene.sh

The checks stand in the order of the document's "Reading safely"; nothing is allocated from a count before it is proven.
"""
from __future__ import annotations

import argparse
import json
import mmap
import struct
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import xxhash
import zstandard
from numpy.typing import NDArray

import rgs_archive

MAGIC = bytes.fromhex("89 52 47 53 0D 0A 1A 0A")
HEADER_BYTES, ENTRY_BYTES, HASH_BYTES = 128, 64, 8
SH_BYTES = (4, 12, 28, 48)                                        # bytes a Gaussian, by degree
DEGREE = np.array([0] + [1] * 3 + [2] * 5 + [3] * 7)              # degree of SH coefficient k
KNOWN = ("DECL", "SHSC", "CHNK", "MEAN", "GEOM", "SHI8", "PERM", "PROV")
REQUIRED = KNOWN[:6]
ARCHIVED = ("MEAN", "GEOM", "SHI8")                               # what has codec 2 if anything has
CODED = ("SHSC", "CHNK", *ARCHIVED)
PROV_HEAD = struct.Struct("<QQII")
PROV_TEXT_MAX = 4096
ORIGIN_MAX = 1e12

HEADER = np.dtype([
    ("magic", "S8"), ("version_major", "<u2"), ("version_minor", "<u2"), ("flags", "<u4"), ("file_bytes", "<u8"),
    ("n_gaussians", "<u8"), ("n_chunks", "<u8"), ("n_scale_sets", "<u8"), ("chunk_size", "<u4"), ("n_sections", "<u4"),
    ("sh_degree", "u1"), ("sh_bytes", "u1"), ("scale_exponent", "<i2"), ("reserved", "u1", 68)])
ENTRY = np.dtype([
    ("type", "u1", 4), ("flags", "<u4"), ("codec", "<u4"), ("reserved", "<u4"), ("offset", "<u8"),
    ("stored_bytes", "<u8"), ("decoded_bytes", "<u8"), ("xxh3", "<u8"), ("reserved_tail", "u1", 16)])
CHUNK = np.dtype([
    ("min", "<f4", 3), ("radius", "<f4"), ("max", "<f4", 3), ("max_opacity", "<f4"), ("scale_set", "<u8"),
    ("count", "<u4"), ("reserved", "<u4")])
DECL = np.dtype([
    ("axes", "u1", 3), ("colour_space", "u1"), ("sh_basis", "u1"), ("kernel", "u1"), ("aa_mode", "u1"),
    ("sort_metric", "u1"), ("depth_mapping", "u1"), ("depth_source", "u1"), ("order", "u1"), ("reserved", "u1"),
    ("z_near", "<f4"), ("z_far", "<f4"), ("metres_per_unit", "<f4"), ("cutoff_sigma", "<f4"),
    ("alpha_threshold", "<f4"), ("alpha_max", "<f4"), ("low_pass_px2", "<f4"), ("transmittance_min", "<f4"),
    ("full_min", "<f4", 3), ("full_max", "<f4", 3), ("robust_min", "<f4", 3), ("robust_max", "<f4", 3),
    ("robust_fraction", "<f4"), ("n_source", "<u8"), ("n_dropped", "<u8"), ("n_repaired", "<u8"),
    ("n_scale_subnormal", "<u8"), ("n_scale_zero", "<u8"), ("n_opacity_zero", "<u8"), ("n_opacity_one", "<u8"),
    ("origin", "<f8", 3), ("reserved_tail", "u1", 80)])
ARCH = np.dtype([
    ("mean_cells", "<u4"), ("mean_bits", "<u4"), ("n_classes", "<u4"), ("opacity_levels", "<u4"),
    ("n_distributions", "<u4"), ("reserved", "<u4"), ("centre", "<f8", 3), ("half_width", "<f8", 3),
    ("knobs", "<f4", 6), ("bound_mean", "<f4"), ("bound_opacity", "<f4"), ("reserved_tail", "u1", 24)])
ARCH_CLASS = np.dtype([
    ("rotation_step", "<f4"), ("scale_step", "<u4"), ("scale_base", "<i4"), ("dc_step", "<u4"), ("sh_step", "<f4"),
    ("bound_rotation", "<f4"), ("bound_scale", "<f4"), ("bound_dc", "<f4"), ("bound_sh", "<f4")])
ENUMERATORS = {"colour_space": (0, 1, 2), "sh_basis": (1,), "kernel": (1,), "aa_mode": (0, 1, 2), "sort_metric": (1,),
               "depth_mapping": (1, 2), "depth_source": (1, 2, 3), "order": (1, 2)}
NOT_NEGATIVE = ("z_near", "z_far", "metres_per_unit", "cutoff_sigma", "alpha_threshold", "alpha_max", "low_pass_px2",
                "transmittance_min")
assert (HEADER.itemsize, ENTRY.itemsize, CHUNK.itemsize, DECL.itemsize) == (HEADER_BYTES, ENTRY_BYTES, 48, 256)
assert (ARCH.itemsize, ARCH_CLASS.itemsize) == (128, 36)

Record = dict[str, Any]


class RgsError(ValueError):
    """A file that breaks a rule: name of the error, byte offset of what breaks it, and the rule in words."""

    def __init__(self, code: str, offset: int, text: str) -> None:
        super().__init__(f"{code} at byte {offset}: {text}")
        self.code, self.offset, self.text = code, offset, text


@dataclass
class Scene:
    """Everything a file says. N Gaussians, K = (sh_degree + 1)^2; values are float32 unless noted."""

    header: Record
    sections: list[Record]             # type (str), flags, codec, offset, stored_bytes, decoded_bytes, xxh3
    declarations: Record
    provenance: Record | None          # source_bytes, source_xxh3, source_name, tool; the texts are untrusted
    means: NDArray[np.float32]         # [N, 3] relative to the declared origin, world units
    rotations_stored: NDArray[np.float32]   # [N, 4] w, x, y, z as in the file
    rotations: NDArray[np.float32]     # [N, 4] of unit norm
    scales_stored: NDArray[np.float16]      # [N, 3] standard deviation times 2^scale_exponent
    scales: NDArray[np.float32]        # [N, 3] standard deviation, world units
    opacities: NDArray[np.float32]     # [N] 0 to 1
    sh_steps: NDArray[np.float32]      # [n_scale_sets, 4, 3] degree, channel
    sh_codes: NDArray[np.int8]         # [N, K, 3]
    sh: NDArray[np.float32]            # [N, K, 3] coefficient, channel
    chunks: NDArray[np.void]           # [n_chunks] of CHUNK
    source_index: NDArray[np.uint64] | None  # [N] position in the source file

    def log_scales(self) -> NDArray[np.float32]:
        """[N, 3] as a 3DGS PLY stores them, at most 60."""
        exponent = -self.header["scale_exponent"]
        stored = np.where(self.scales_stored == 0, 2.0**-26, self.scales_stored.astype(np.float64))
        return np.log(np.ldexp(stored, exponent)).clip(None, 60).astype(np.float32)

    def opacity_logits(self) -> NDArray[np.float32]:
        """[N] as a 3DGS PLY stores them."""
        o = self.opacities.astype(np.float64)
        with np.errstate(divide="ignore"):
            logit = np.log(o / (1 - o))
        return np.select([o == 0, o == 1], [-18.0, 9.0107908], logit).astype(np.float32)


def align256(x: int) -> int:
    return (x + 255) // 256 * 256


def require(ok: Any, code: str, offset: int, text: str) -> None:
    if not ok:
        raise RgsError(code, offset, text)


def known(h: Record) -> tuple[str, ...]:
    return KNOWN + (("ARCH",) if h["version_minor"] >= 2 else ())


def codec_exists(h: Record, s: Record) -> bool:
    versions = {0: s["type"] in known(h), 1: h["version_minor"] >= 1 and s["type"] in CODED,
                2: h["version_minor"] >= 2 and s["type"] in ARCHIVED}
    return versions.get(s["codec"], False)


def require_all(ok: NDArray[np.bool_], offset: int, row_bytes: int, column_bytes: int, text: str,
                code: str = "bad_value") -> None:
    """ok [n] or [n, k]: refuses the first False, whose place is offset + row * row_bytes + column * column_bytes."""
    if not ok.all():
        row, column = divmod(int(np.argmin(ok)), ok[0].size)
        raise RgsError(code, offset + row * row_bytes + column * column_bytes, text)


def require_reserved(data: memoryview, begin: int, end: int, text: str) -> None:
    require(not any(data[begin:end]), "reserved_bits", begin, text)


def record(data: memoryview, dtype: np.dtype[np.void], offset: int) -> Record:
    row = np.frombuffer(data[offset:offset + dtype.itemsize], dtype)[0]
    return {name: row[name].tolist() for name in dtype.names}


def table_end(h: Record) -> int:
    return HEADER_BYTES + ENTRY_BYTES * h["n_sections"]


def read_header(data: memoryview, max_file_bytes: int, max_gaussians: int) -> Record:
    for i, (found, expected) in enumerate(zip(data, MAGIC)):
        require(found == expected, "bad_magic", i, "not an .rgs file")
    require(len(data) >= HEADER_BYTES, "truncated", len(data), "the file ends inside the header")
    h = record(data, HEADER, 0)

    def rule(ok: bool, name: str, text: str, code: str = "bad_header") -> None:
        require(ok, code, HEADER.fields[name][1], text)

    rule(h["version_major"] == 1, "version_major", "only version 1 is known", "unsupported_version")
    require_reserved(data, 12, 16, "header flags are reserved")
    require_reserved(data, 60, HEADER_BYTES, "header bytes 60 to 127 are reserved")
    n, size = h["n_gaussians"], h["chunk_size"]
    rule(32 <= size <= 2**16 and size % 32 == 0, "chunk_size", "a multiple of 32, 32 to 2^16")
    rule(h["n_chunks"] == -(-n // size), "n_chunks", "ceil(n_gaussians / chunk_size)")
    rule(min(1, n) <= h["n_scale_sets"] <= h["n_chunks"], "n_scale_sets", "1 to n_chunks, 0 without Gaussians")
    rule(1 <= h["n_sections"] <= 1024, "n_sections", "1 to 1024 sections")
    rule(table_end(h) + HASH_BYTES <= h["file_bytes"], "n_sections", "the section table leaves the file")
    rule(h["sh_degree"] <= 3, "sh_degree", "SH degree 0 to 3")
    rule(h["sh_bytes"] == SH_BYTES[h["sh_degree"]], "sh_bytes", "4, 12, 28, 48 for degree 0, 1, 2, 3")
    rule(-110 <= h["scale_exponent"] <= 110, "scale_exponent", "-110 to 110")
    rule(h["file_bytes"] <= max_file_bytes, "file_bytes", "larger than the caller allows", "limit_exceeded")
    rule(n <= max_gaussians, "n_gaussians", "more Gaussians than the caller allows", "limit_exceeded")
    require(len(data) >= h["file_bytes"], "truncated", len(data), "shorter than file_bytes says")
    require(len(data) <= h["file_bytes"], "trailing_bytes", h["file_bytes"], "longer than file_bytes says")
    return h


def read_table(data: memoryview, h: Record) -> list[Record]:
    """The section entries; their order and place are checked, not yet that their sizes follow from the counts."""
    head = table_end(h)
    stored = int.from_bytes(data[head:head + HASH_BYTES], "little")
    require(xxhash.xxh3_64_intdigest(data[:head]) == stored, "checksum_mismatch", head, "hash of header and table")
    at = {name: ENTRY.fields[name][1] for name in ENTRY.names}
    entries = [record(data, ENTRY, p) | {"at": p} for p in range(HEADER_BYTES, head, ENTRY_BYTES)]
    for s in entries:
        require(s["flags"] < 2, "reserved_bits", s["at"] + at["flags"], "bits 1 to 31 of the flags are reserved")
        for name in ("reserved", "reserved_tail"):
            begin = s["at"] + at[name]
            require_reserved(data, begin, begin + ENTRY[name].itemsize, "reserved bytes of an entry")

    seen: set[str] = set()
    for s in entries:
        s["type"] = bytes(s["type"]).decode("latin-1")        # known types are ASCII, others may be anything
        if s["type"] in known(h):
            require(s["type"] not in seen, "duplicate_section", s["at"], s["type"] + " is there twice")
            require(codec_exists(h, s), "unsupported_codec", s["at"] + at["codec"], "codec 0, for some types 1 or 2")
            require(s["codec"] or s["decoded_bytes"] == s["stored_bytes"], "size_mismatch",
                    s["at"] + at["decoded_bytes"], "codec 0 stores as many bytes as it decodes to")
        else:
            require(s["flags"] == 0, "unknown_required", s["at"], "an unknown section that must be understood")
        seen.add(s["type"])
    for kind in REQUIRED:
        require(kind in seen, "missing_section", HEADER_BYTES, kind + " is required")
    archived = [s for s in entries if s["type"] in ARCHIVED and s["codec"] == 2]
    for s in entries:
        if archived and s["type"] in ARCHIVED:
            require(s["codec"] == 2, "unsupported_codec", s["at"] + at["codec"], "codec 2 in all three or in none")
        if not archived and s["type"] == "ARCH" and h["version_minor"] >= 2:
            raise RgsError("bad_section", s["at"], "ARCH is for codec 2")
    require(not archived or "ARCH" in seen, "missing_section", HEADER_BYTES, "codec 2 needs ARCH")

    end = head + HASH_BYTES
    for s in entries:
        begin, where = s["offset"], s["at"] + at["offset"]
        require(begin % 256 == 0, "bad_section", where, "an offset is a multiple of 256")
        require(begin >= align256(end), "section_overlap", where, "it begins before the previous one has ended")
        require(begin <= align256(end), "section_gap", where, "it begins behind the next multiple of 256")
        require(begin <= len(data) and s["stored_bytes"] <= len(data) - begin, "bad_section",
                s["at"] + at["stored_bytes"], "the section leaves the file")
        nonzero = np.flatnonzero(np.frombuffer(data[end:begin], np.uint8))
        require(not nonzero.size, "section_gap", end + int(nonzero[:1].sum()), "bytes between sections are zero")
        end = begin + s["stored_bytes"]
    require(end == len(data), "section_gap", end, "the last section ends the file")
    return entries


def require_sizes(h: Record, sections: dict[str, Record], n_source: int | None = None) -> None:
    """n_source is None while DECL is not read; it decides about PERM."""
    n = h["n_gaussians"]
    sizes = {"DECL": DECL.itemsize, "SHSC": 48 * h["n_scale_sets"], "CHNK": 48 * h["n_chunks"], "MEAN": 12 * n,
             "GEOM": 16 * n, "SHI8": h["sh_bytes"] * n}
    if n_source is not None:
        sizes["PERM"] = (4 if n_source < 2**32 else 8) * n
    for s in filter(lambda s: s["type"] in sizes, sections.values()):
        require(s["decoded_bytes"] == sizes[s["type"]], "size_mismatch", s["at"] + ENTRY.fields["decoded_bytes"][1],
                f"{s['type']} contradicts the counts of the header")


def require_hash(data: memoryview, s: Record) -> None:
    stored = data[s["offset"]:s["offset"] + s["stored_bytes"]]
    require(xxhash.xxh3_64_intdigest(stored) == s["xxh3"], "checksum_mismatch", s["offset"], f"hash of {s['type']}")


def read_declarations(data: memoryview, h: Record, base: int) -> Record:
    """DECL without its statements about the payload, which check_declarations proves."""
    d = record(data, DECL, base)

    def rule(ok: Any, name: str, text: str) -> None:
        require(ok, "bad_value", base + DECL.fields[name][1], text)

    require_reserved(data, base + 11, base + 12, "a reserved byte of DECL")
    require_reserved(data, base + (176 if h["version_minor"] >= 3 else 152), base + 256, "reserved bytes of DECL")
    for axis, value in enumerate(d["origin"]):
        require(abs(value) <= ORIGIN_MAX, "bad_value", base + 152 + 8 * axis, "an origin within 10^12")
    for axis, direction in enumerate(d["axes"]):
        require(direction <= 6, "bad_value", base + axis, "a direction is 0 to 6")
    spans = sorted((a + 1) // 2 for a in d["axes"]) == [1, 2, 3]
    rule(spans or d["axes"] == [0, 0, 0], "axes", "directions that span space, or none declared")
    for name, allowed in ENUMERATORS.items():
        rule(d[name] in allowed, name, f"{name} is one of {allowed}")
    for name in NOT_NEGATIVE:
        rule(0 <= d[name] < np.inf, name, f"{name} is finite and not negative")
    rule(0 < d["z_near"] < d["z_far"], "z_near", "0 < z_near < z_far")
    for low, high in (("full_min", "full_max"), ("robust_min", "robust_max")):
        rule(np.isfinite(d[low] + d[high]).all(), low, "boxes are finite")
        rule(all(a <= b for a, b in zip(d[low], d[high])), low, "min <= max")
        rule(h["n_gaussians"] > 0 or not any(d[low] + d[high]), low, "boxes are zero without Gaussians")
    outside = any(r < f for r, f in zip(d["robust_min"] + d["full_max"], d["full_min"] + d["robust_max"]))
    rule(not outside, "robust_min", "the robust box lies inside the full one")
    rule(0 <= d["robust_fraction"] <= 1, "robust_fraction", "a share")
    rule(d["n_source"] - d["n_dropped"] == h["n_gaussians"], "n_source", "n_gaussians = n_source - n_dropped")
    return d


def read_provenance(data: memoryview, s: Record) -> Record:
    base, size = s["offset"], s["stored_bytes"]
    require(size >= PROV_HEAD.size, "size_mismatch", base, "PROV has at least 24 bytes")
    require_hash(data, s)
    source_bytes, source_xxh3, a, b = PROV_HEAD.unpack(data[base:base + PROV_HEAD.size])
    require(a <= PROV_TEXT_MAX, "limit_exceeded", base + 16, "a name of at most 4096 bytes")
    require(b <= PROV_TEXT_MAX, "limit_exceeded", base + 20, "a tool of at most 4096 bytes")
    require(size == PROV_HEAD.size + a + b, "size_mismatch", base, "PROV ends behind its texts")
    name, tool = (bytes(data[p:q]) for p, q in ((base + 24, base + 24 + a), (base + 24 + a, base + size)))
    return {"source_bytes": source_bytes, "source_xxh3": source_xxh3,
            "source_name": name.decode("utf-8", "replace"), "tool": tool.decode("utf-8", "replace")}


def read_frame_table(data: memoryview, h: Record, s: Record, row_bytes: int) -> None:
    """Adds frame_rows and frames [(offset, stored_bytes, hash)] of a coded section to its entry."""
    base, end = s["offset"], s["offset"] + s["stored_bytes"]
    multiple = h["chunk_size"] if s["type"] in ("MEAN", "GEOM", "SHI8") else 1
    require(end - base >= 8, "size_mismatch", base, "a frame table has at least 8 bytes")
    rows, count = (int.from_bytes(data[base + k:base + k + 4], "little") for k in (0, 4))
    require(1 <= rows <= 2**16 and rows % multiple == 0, "bad_value", base, "frame_rows: whole chunks, 1 to 2^16")
    require(count == -(-(s["decoded_bytes"] // row_bytes) // rows), "bad_value", base + 4, "ceil(rows / frame_rows)")
    table = base + 8 + 16 * count
    require(end - base >= 16 + 16 * count, "size_mismatch", base, "the frame table leaves the section")
    s["frame_rows"], s["frames"], at = rows, [], table + 8
    for entry in range(base + 8, table, 16):
        hash_, stored, reserved = struct.unpack("<QII", data[entry:entry + 16])
        require(reserved == 0, "reserved_bits", entry + 12, "a reserved field of a frame")
        require(stored <= end - at, "size_mismatch", entry + 8, "a frame leaves the section")
        s["frames"].append((at, stored, hash_))
        at += stored
    require(xxhash.xxh3_64_intdigest(data[base:table]) == int.from_bytes(data[table:table + 8], "little"),
            "checksum_mismatch", table, "hash of a frame table")
    require(at == end, "size_mismatch", at, "the last frame ends the section")


def read_arch(data: memoryview, h: Record, s: Record) -> Record:
    """ARCH with its classes (a list of records) and tables."""
    base, end = s["offset"], s["offset"] + s["stored_bytes"]
    require(end - base >= ARCH.itemsize, "size_mismatch", base, "ARCH has at least 128 bytes")
    require_hash(data, s)
    arch = record(data, ARCH, base)

    def rules(dtype: np.dtype[np.void], row: Record, at: int, legal: dict[str, Any]) -> None:
        for name in dtype.names:
            values, field = np.atleast_1d(row[name]), at + dtype.fields[name][1]
            item_bytes = dtype[name].base.itemsize
            if name.startswith("reserved"):
                require_reserved(data, field, field + dtype[name].itemsize, "reserved bytes of ARCH")
            else:
                require_all(legal.get(name, positive_or_0)(values), field, item_bytes, 0, name)

    def positive_or_0(x: NDArray[Any]) -> Any:
        return (x >= 0) & np.isfinite(x)

    def within(low: float, high: float) -> Any:
        return lambda x: (x >= low) & (x <= high)

    rules(ARCH, arch, base, {
        "mean_cells": within(4, 20), "mean_bits": within(1, min(arch["mean_cells"] + 9, 28)), "n_classes": within(1, 32),
        "opacity_levels": within(1, 4096), "n_distributions": within(1, 255), "centre": within(-2.0**128, 2.0**128),
        "half_width": within(np.nextafter(0, 1), 2.0**128)})
    tables = base + ARCH.itemsize + ARCH_CLASS.itemsize * arch["n_classes"]
    require(tables <= end, "size_mismatch", base, "ARCH ends inside its classes")
    arch["classes"] = []
    for at in range(base + ARCH.itemsize, tables, ARCH_CLASS.itemsize):
        arch["classes"].append(record(data, ARCH_CLASS, at))
        rules(ARCH_CLASS, arch["classes"][-1], at, {
            "rotation_step": within(2.0**-20, 2), "scale_step": within(1, 2**22), "scale_base": within(-2**23, 2**23),
            "dc_step": within(1, 2**26), "sh_step": within(2.0**-40, 2.0**40)})
    shape = arch["n_classes"], 3 * (h["sh_degree"] + 1) ** 2 - 3, arch["n_distributions"]
    content = unzip(data[tables:end], tables, rgs_archive.tables_bytes(*shape))
    try:
        arch["tables"] = rgs_archive.read_tables(content, *shape)
    except rgs_archive.Damaged as error:
        raise RgsError("bad_value", tables, str(error)) from error
    return arch


def frame_bytes(data: memoryview, frame: tuple[int, int, int]) -> memoryview:
    offset, stored, hash_ = frame
    code = data[offset:offset + stored]
    require(xxhash.xxh3_64_intdigest(code) == hash_, "checksum_mismatch", offset, "hash of a frame")
    return code


def inflate(data: memoryview, frame: tuple[int, int, int], size: int) -> NDArray[np.uint8]:
    return np.frombuffer(unzip(frame_bytes(data, frame), frame[0], size), np.uint8)


def unzip(code: memoryview, offset: int, size: int) -> bytes:
    require(bytes(code[:4]) == b"\x28\xB5\x2F\xFD", "corrupt_data", offset, "a Zstandard frame")
    stream = zstandard.ZstdDecompressor().decompressobj()
    try:
        content = stream.decompress(code)
    except zstandard.ZstdError:
        content = b""
    require(stream.eof and not stream.unused_data and len(content) == size, "corrupt_data", offset,
            "one Zstandard frame of the right size")
    return content


def unfold(z: NDArray[Any]) -> NDArray[Any]:
    return z >> 1 ^ (0 - (z & 1)).astype(z.dtype)


def decode_words(content: NDArray[np.uint8], rows: int) -> bytes:
    planes = content.reshape(-1, 4, rows).astype(np.uint32)
    z = planes[:, 0] | planes[:, 1] << 8 | planes[:, 2] << 16 | planes[:, 3] << 24
    key = np.cumsum(unfold(z), axis=1, dtype=np.uint32)
    return np.where(key >> 31, key & 0x7FFFFFFF, ~key).T.astype("<u4").tobytes()


def decode_geometry(content: NDArray[np.uint8], rows: int) -> bytes:
    columns = np.ascontiguousarray(content.reshape(16, rows).T).view("<u2")
    x, y, z = columns[:, 1:4].view("<f2").astype(np.float32).T
    with np.errstate(invalid="ignore", over="ignore"):
        s = np.float32(1) - ((x * x + y * y) + z * z)
        root = np.sqrt(np.where(s > 0, s, np.float32(0)))
    columns[:, 0] = root.astype(np.float16).view(np.uint16) + unfold(columns[:, 0])
    return columns.tobytes()


def decode_sh(content: NDArray[np.uint8], rows: int, h: Record, steps: NDArray[np.float32]) -> bytes:
    """steps [chunks of the frame, 4, 3]"""
    c = 3 * (h["sh_degree"] + 1) ** 2
    n_weights = c * (c - 1) // 2
    weights = content[:n_weights + c].view(np.int8).astype(np.int32) * 256
    residual = content[n_weights + c:].reshape(c, rows)
    largest = steps.max(axis=(0, 2), keepdims=True)
    share = np.divide(steps, largest, out=np.zeros_like(steps), where=largest > 0)
    q = np.rint(np.float32(256) * share).astype(np.int32)
    r = np.where(q < 3, 0, 65536 // np.maximum(q, 1))
    lane_rows = rows // 64
    out = np.zeros((rows, h["sh_bytes"]), np.int8)
    e = np.zeros((c, 64), np.int16)

    def product(a: NDArray[np.int16], b: int) -> NDArray[np.int32]:
        return a.astype(np.int32) * b >> 16

    for first in range(0, rows, 64):
        p = np.arange(first, min(first + 64, rows))
        row = p % 64 * lane_rows + p // 64 if first < 64 * lane_rows else p
        lanes, chunk = len(p), row // h["chunk_size"]
        v = np.zeros((c, lanes), np.int16)
        for i in range(c):
            k, channel = i // 3, (1, 0, 2)[i % 3]
            w = weights[i * (i - 1) // 2:i * (i + 1) // 2]
            base = np.full(lanes, i // 2, np.int32)
            for j in range(i):
                base += product(v[j], w[j])
            base = base.astype(np.int16)
            half = (base + 2 * product(e[i, :lanes], weights[n_weights + i])).astype(np.int16)
            guess = (half.astype(np.int32) * r[chunk, DEGREE[k], channel] + 2**14 >> 15).astype(np.int16)
            code = (residual[i, p] + guess.clip(-127, 127)).astype(np.int8)
            out[row, 3 * k + channel] = code
            v[i] = code.astype(np.int32) * q[chunk, DEGREE[k], channel]
            e[i, :lanes] = (v[i] >> 1) - base.astype(np.int32)
    return out.tobytes()


def decode_section(data: memoryview, h: Record, s: Record, steps: NDArray[np.float32] | None = None) -> bytes:
    """The bytes that codec 0 would have stored; SHI8 needs steps [n_chunks, 4, 3]."""
    if s["codec"] == 0:
        return data[s["offset"]:s["offset"] + s["stored_bytes"]]
    row_bytes = {"MEAN": 12, "GEOM": 16, "SHI8": h["sh_bytes"]}.get(s["type"], 48)
    total, parts = s["decoded_bytes"] // row_bytes, []
    for f, frame in enumerate(s["frames"]):
        first = f * s["frame_rows"]
        rows = min(s["frame_rows"], total - first)
        if s["type"] == "SHI8":
            c = 3 * (h["sh_degree"] + 1) ** 2
            chunks = steps[first // h["chunk_size"]:-(-(first + rows) // h["chunk_size"])]
            parts.append(decode_sh(inflate(data, frame, c * (c + 1) // 2 + c * rows), rows, h, chunks))
        else:
            content = inflate(data, frame, row_bytes * rows)
            parts.append((decode_geometry if s["type"] == "GEOM" else decode_words)(content, rows))
    return b"".join(parts)


def decode_archive(data: memoryview, h: Record, sections: dict[str, Record], arch: Record,
                   steps: NDArray[np.float32]) -> dict[str, bytes]:
    """Rows of MEAN, GEOM and SHI8 of codec 2. steps [n_chunks, 4, 3]"""
    n, size, rows_each = h["n_gaussians"], h["chunk_size"], sections["MEAN"]["frame_rows"]
    parts: dict[str, list[bytes]] = {kind: [] for kind in ARCHIVED}
    for f in range(len(sections["MEAN"]["frames"])):
        first = f * rows_each
        rows = min(rows_each, n - first)
        offset = 0
        try:
            for kind in ARCHIVED:
                frame = sections[kind]["frames"][f]
                offset, code = frame[0], bytes(frame_bytes(data, frame))
                if kind == "MEAN":
                    part = rgs_archive.decode_means(code, rows, arch)
                elif kind == "GEOM":
                    part, classes = rgs_archive.decode_geometry(code, rows, arch, h["scale_exponent"])
                else:
                    each = steps[np.arange(first, first + rows) // size][:, DEGREE[:(h["sh_degree"] + 1) ** 2]]
                    part = rgs_archive.decode_sh(code, rows, arch, classes, each, h["sh_bytes"])
                parts[kind].append(part)
        except rgs_archive.Damaged as error:
            raise RgsError("corrupt_data", offset, str(error)) from error
    return {kind: b"".join(part) for kind, part in parts.items()}


def check_declarations(d: Record, base: int, means: NDArray[np.float32], scales: NDArray[np.float16],
                       opacities: NDArray[np.float32]) -> None:
    def rule(ok: Any, name: str, text: str) -> None:
        require(ok, "bad_value", base + DECL.fields[name][1], text)

    counts = {"n_scale_subnormal": (scales > 0) & (scales < 2.0**-14), "n_scale_zero": scales == 0,
              "n_opacity_zero": opacities == 0, "n_opacity_one": opacities == 1}
    for name, which in counts.items():
        rule(d[name] == np.count_nonzero(which), name, f"{name} counts the stored values")
    if not len(means):
        return
    for name, box in (("full_min", means.min(0)), ("full_max", means.max(0))):
        rule((np.float32(d[name]) == box).all(), name, f"{name} is that of the means")


def read(data: bytes | mmap.mmap | memoryview, max_file_bytes: int = 2**40, max_gaussians: int = 2**33,
         max_expansion: int = 1032) -> Scene:
    """Parses and checks a whole file; raises RgsError on the first broken rule."""
    data = memoryview(data)
    h = read_header(data, max_file_bytes, max_gaussians)
    entries = read_table(data, h)
    sections = {s["type"]: s for s in entries if s["type"] in known(h)}
    base = {kind: s["offset"] for kind, s in sections.items()}
    require_sizes(h, sections)
    require_hash(data, sections["DECL"])
    d = read_declarations(data, h, base["DECL"])
    require_sizes(h, sections, d["n_source"])
    provenance = read_provenance(data, sections["PROV"]) if "PROV" in sections else None

    row_bytes = {"MEAN": 12, "GEOM": 16, "SHI8": h["sh_bytes"], "CHNK": 48, "SHSC": 48}
    coded = [s for s in entries if s["type"] in CODED and s["codec"] != 0]
    budget = max_expansion * len(data) + 2**20
    for s in coded:
        read_frame_table(data, h, s, row_bytes[s["type"]])
        budget -= s["decoded_bytes"]
        require(budget >= 0, "limit_exceeded", s["at"] + ENTRY.fields["decoded_bytes"][1], "too much for so small a file")
    archived = [s for s in coded if s["codec"] == 2]
    for s in (sections[kind] for kind in ARCHIVED if archived):
        require(s["frame_rows"] == sections["MEAN"]["frame_rows"], "bad_value", s["offset"], "the same rows in each frame")
    arch = read_arch(data, h, sections["ARCH"]) if archived else None

    def array(kind: str, dtype: Any, *shape: int, **more: Any) -> NDArray[Any]:
        return np.frombuffer(decode_section(data, h, sections[kind], **more), dtype).reshape(shape)

    n, k = h["n_gaussians"], (h["sh_degree"] + 1) ** 2
    early = {kind: array(kind, "u1", -1) for kind in ("CHNK", "SHSC") if sections[kind]["codec"] == 1}
    for s in entries:
        require_hash(data, s)
    tables = {kind: early[kind] if kind in early else array(kind, "u1", -1) for kind in ("CHNK", "SHSC")}
    steps = tables["SHSC"].view("<f4").reshape(h["n_scale_sets"], 4, 3)
    chunks = tables["CHNK"].view(CHUNK)

    step_ok = (steps.view("<u4") == 0) | ((steps >= 2.0**-107) & (steps <= 2.0**93) & (steps.view("<u4") % 128 == 0))
    step_ok[:, h["sh_degree"] + 1:] &= steps[:, h["sh_degree"] + 1:] == 0
    require_all(step_ok.ravel(), base["SHSC"], 4, 0, "a step is +0, or 2^-107 to 2^93 in 17 bits, up to degree D")

    sets = np.minimum(chunks["scale_set"], max(h["n_scale_sets"], 1) - 1)      # legal or not is checked below
    if arch:
        decoded = decode_archive(data, h, sections, arch, steps[sets])
        means, geom, rows = (np.frombuffer(decoded[kind], dtype).reshape(n, -1) for kind, dtype in
                             (("MEAN", "<f4"), ("GEOM", "<f2"), ("SHI8", "i1")))
    else:
        means = array("MEAN", "<f4", n, 3)
        geom = array("GEOM", "<f2", n, 8)
        rows = array("SHI8", "i1", n, h["sh_bytes"], **({"steps": steps[sets]} if sections["SHI8"]["codec"] else {}))

    require_all(np.isfinite(means), base["MEAN"], 12, 4, "means are finite")

    wide = geom.astype(np.float64)                # squares and sums of f16 are exact in binary64
    sign_clear = ~np.signbit(geom)
    norm2 = (wide[:, :4] ** 2).sum(1)
    require_all(np.abs(norm2 - 1) <= 2.0**-8, base["GEOM"], 16, 0, "the squared norm of a rotation is within 2^-8 of 1")
    require_all(sign_clear[:, 0], base["GEOM"], 16, 0, "the sign bit of w is clear")
    require_all(np.isfinite(geom[:, 4:7]) & sign_clear[:, 4:7], base["GEOM"] + 8, 16, 2, "a scale: finite, sign clear")
    require_all((geom[:, 7] <= 1) & sign_clear[:, 7], base["GEOM"] + 14, 16, 0, "opacity 0 to 1, sign clear")
    opacities = geom[:, 7].astype(np.float32)
    exact_scales = np.ldexp(wide[:, 4:7], -h["scale_exponent"])

    first = np.arange(h["n_chunks"]) * h["chunk_size"]
    count = np.minimum(n - first, h["chunk_size"])

    def chunk_rule(ok: NDArray[np.bool_], name: str, text: str, code: str = "bad_value") -> None:
        require_all(ok, base["CHNK"] + CHUNK.fields[name][1], CHUNK.itemsize, 0, text, code)

    chunk_rule(chunks["reserved"] == 0, "reserved", "reserved field of a chunk", "reserved_bits")
    chunk_rule(chunks["count"] == count, "count", "chunk_size Gaussians, in the last chunk the rest")
    chunk_rule(chunks["scale_set"] < h["n_scale_sets"], "scale_set", "a row of SHSC")
    if n:
        low, high = np.minimum.reduceat(means, first), np.maximum.reduceat(means, first)
        chunk_rule(((chunks["min"] == low) & (chunks["max"] == high)).all(1), "min", "the box of the chunk's means")
        largest = np.maximum.reduceat(exact_scales.max(1), first)
        chunk_rule(chunks["radius"] == 3 * largest, "radius", "three times the largest scale")
        chunk_rule(chunks["max_opacity"] == np.maximum.reduceat(opacities, first), "max_opacity", "largest opacity")

    step = steps[np.repeat(chunks["scale_set"], count)][:, DEGREE[:k]]          # [N, K, 3]
    codes = rows[:, :3 * k].reshape(n, k, 3)
    require_all(rows[:, :3 * k] != -128, base["SHI8"], h["sh_bytes"], 1, "code -128 is not used")
    step_or_zero = ((codes == 0) | (step != 0)).reshape(n, 3 * k)
    require_all(step_or_zero, base["SHI8"], h["sh_bytes"], 1, "a code whose step is 0 is 0")
    require_all(rows[:, 3 * k:] == 0, base["SHI8"] + 3 * k, h["sh_bytes"], 1, "padding of a row", "reserved_bits")

    source_index = None
    if "PERM" in sections:
        item_bytes = 4 if d["n_source"] < 2**32 else 8
        source_index = array("PERM", f"<u{item_bytes}", n).astype(np.uint64)
        require_all(source_index < d["n_source"], base["PERM"], item_bytes, 0, "a position below n_source")
        require(np.unique(source_index).size == n, "bad_value", base["PERM"], "positions are all different")
    check_declarations(d, base["DECL"], means, geom[:, 4:7], opacities)

    return Scene(header=h, sections=entries, declarations=d, provenance=provenance, means=means,
                 rotations_stored=geom[:, :4].astype(np.float32),
                 rotations=(wide[:, :4] / np.sqrt(norm2)[:, None]).astype(np.float32), scales_stored=geom[:, 4:7],
                 scales=exact_scales.astype(np.float32), opacities=opacities, sh_steps=steps, sh_codes=codes,
                 sh=step * codes.astype(np.float32), chunks=chunks, source_index=source_index)


def read_file(path: str) -> Scene:
    with open(path, "rb") as file:
        return read(file.read())


def main() -> int:
    parser = argparse.ArgumentParser(description="Check an .rgs file against docs/FORMAT.md and print or dump it.")
    parser.add_argument("file")
    parser.add_argument("--dump", metavar="OUT.npz", help="write all arrays")
    parser.add_argument("--json", action="store_true", help="print header, section table, declarations, provenance")
    options = parser.parse_args()
    try:
        scene = read_file(options.file)
        if options.dump:
            arrays = {name: value for name, value in vars(scene).items() if isinstance(value, np.ndarray)}
            np.savez(options.dump, **arrays, log_scales=scene.log_scales(), opacity_logits=scene.opacity_logits())
    except RgsError as error:
        print(f"{options.file}: {error}", file=sys.stderr)
        return 4
    except OSError as error:
        print(f"{options.file}: {error.strerror}", file=sys.stderr)
        return 3
    if options.json:
        heads = {name: getattr(scene, name) for name in ("header", "sections", "declarations", "provenance")}
        print(json.dumps(heads, indent=2, default=lambda value: value.decode("latin-1")))
    else:
        h = scene.header
        print(f"{options.file}: version {h['version_major']}.{h['version_minor']}, {h['n_gaussians']} Gaussians, "
              f"SH degree {h['sh_degree']}, {h['n_chunks']} chunks; every rule holds")
    return 0


if __name__ == "__main__":
    sys.exit(main())
