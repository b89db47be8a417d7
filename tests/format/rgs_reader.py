#!/usr/bin/python3
# rgs_reader.py - an independent reader of .rgs files, written from docs/format/FORMAT.md and docs/format/ARCHIVE.md alone; needs numpy,
# xxhash, zstandard.
# SPDX-License-Identifier: Apache-2.0
"""Reads an .rgs file, checks every rule of docs/format/FORMAT.md, and returns every value as a numpy array.

    scene = rgs_reader.read(open("scene.rgs", "rb").read())     # raises RgsError(code, offset, text)
    scene.means, scene.rotations, scene.scales, scene.opacities, scene.sh

The checks follow the order of the document's "Reading safely"; no count is used for an allocation before it is checked.
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
SH_BYTES = (4, 12, 28, 48)                                        # bytes per Gaussian, by degree
DEGREE = np.array([0] + [1] * 3 + [2] * 5 + [3] * 7)              # degree of SH coefficient k
KNOWN = ("DECL", "SHSC", "CHNK", "MEAN", "GEOM", "SHI8", "PERM", "PROV")
REQUIRED = KNOWN[:6]
ARCHIVED = ("MEAN", "GEOM", "SHI8")                               # sections that have codec 2, or 3, if any has
LEVELS = ("LODS", "PAGE")                                         # in a file with levels of detail
IN_PAGES = REQUIRED[1:]                                           # absent from such a file
ROOT = 2**32 - 1
CODED = ("SHSC", "CHNK", *ARCHIVED)
PROV_HEAD = struct.Struct("<QQII")
PROV_TEXT_MAX = 4096
CRS_TEXT_MAX = 2**14
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
    ("sort_metric", "u1"), ("depth_mapping", "u1"), ("depth_source", "u1"), ("order", "u1"), ("view_kind", "u1"),
    ("z_near", "<f4"), ("z_far", "<f4"), ("metres_per_unit", "<f4"), ("cutoff_sigma", "<f4"),
    ("alpha_threshold", "<f4"), ("alpha_max", "<f4"), ("low_pass_px2", "<f4"), ("transmittance_min", "<f4"),
    ("full_min", "<f4", 3), ("full_max", "<f4", 3), ("robust_min", "<f4", 3), ("robust_max", "<f4", 3),
    ("robust_fraction", "<f4"), ("n_source", "<u8"), ("n_dropped", "<u8"), ("n_repaired", "<u8"),
    ("n_scale_subnormal", "<u8"), ("n_scale_zero", "<u8"), ("n_opacity_zero", "<u8"), ("n_opacity_one", "<u8"),
    ("origin", "<f8", 3), ("view_position", "<f4", 3), ("view_pivot", "<f4", 3), ("view_up", "<f4", 3),
    ("view_width", "<f4"), ("reserved_tail", "u1", 40)])
ARCH_HEAD = [("mean_cells", "<u4"), ("mean_bits", "<u4"), ("n_classes", "<u4"), ("opacity_levels", "<u4"),
             ("n_distributions", "<u4")]
ARCH = {                                                          # by codec
    2: np.dtype([
        *ARCH_HEAD, ("reserved", "<u4"), ("centre", "<f8", 3), ("half_width", "<f8", 3), ("knobs", "<f4", 6),
        ("bound_mean", "<f4"), ("bound_opacity", "<f4"), ("reserved_tail", "u1", 24)]),
    3: np.dtype([
        *ARCH_HEAD, ("slope", "<u4"), ("centre", "<f8", 3), ("half_width", "<f8", 3), ("nearest", "<f8"), ("blur", "<i4"),
        ("coarse_step", "<u4"), ("fine_step", "<i4"), ("turn_step", "<i4"), ("mean_step", "<i4"), ("middle", "<i4"),
        ("step", "<f4"), ("bound_opacity", "<f4"), ("reserved_tail", "u1", 16)])}
ARCH_CLASS = {
    2: np.dtype([
        ("rotation_step", "<f4"), ("scale_step", "<u4"), ("scale_base", "<i4"), ("dc_step", "<u4"), ("sh_step", "<f4"),
        ("bound_rotation", "<f4"), ("bound_scale", "<f4"), ("bound_dc", "<f4"), ("bound_sh", "<f4")]),
    3: np.dtype([
        ("dc_step", "<u4"), ("sh_step", "<u4"), ("bound_mean", "<f4"), ("bound_covariance", "<f4"), ("bound_dc", "<f4"),
        ("bound_sh", "<f4")])}
LODS = np.dtype([
    ("n_pages", "<u4"), ("n_levels", "<u4"), ("page_chunks", "<u4"), ("reserved", "<u4"), ("n_stored", "<u8"),
    ("quality_db", "<f4"), ("reserved_tail", "u1", 36)])
PAGE = np.dtype([
    ("offset", "<u8"), ("xxh3", "<u8"), ("stored_bytes", "<u4"), ("n", "<u4"), ("parent", "<u4"), ("first_child", "<u4"),
    ("level", "u1"), ("n_children", "u1"), ("scale_exponent", "<i2"), ("error", "<f4"), ("min", "<f4", 3),
    ("max", "<f4", 3), ("corner", "<u4", 3), ("n_step_sets", "<u4"), ("core_min", "<f4", 3),
    ("core_max", "<f4", 3), ("n_origins", "<u2"), ("reserved", "u1", 6)])
ORIGIN = np.dtype([("first", "<u4"), ("offset", "<f4", 3)])
ENUMERATORS = {"colour_space": (0, 1, 2), "sh_basis": (1,), "kernel": (1,), "aa_mode": (0, 1, 2), "sort_metric": (1,),
               "depth_mapping": (1, 2), "depth_source": (1, 2, 3), "order": (1, 2)}
NOT_NEGATIVE = ("z_near", "z_far", "metres_per_unit", "cutoff_sigma", "alpha_threshold", "alpha_max", "low_pass_px2",
                "transmittance_min")
assert (HEADER.itemsize, ENTRY.itemsize, CHUNK.itemsize, DECL.itemsize) == (HEADER_BYTES, ENTRY_BYTES, 48, 256)
assert [ARCH[2].itemsize, ARCH[3].itemsize, ARCH_CLASS[2].itemsize, ARCH_CLASS[3].itemsize] == [128, 128, 36, 24]
assert (LODS.itemsize, PAGE.itemsize) == (64, 112)

Record = dict[str, Any]


class RgsError(ValueError):
    """A file that breaks a rule: name of the error, byte offset of what breaks it, and the rule in words."""

    def __init__(self, code: str, offset: int, text: str) -> None:
        super().__init__(f"{code} at byte {offset}: {text}")
        self.code, self.offset, self.text = code, offset, text


@dataclass
class Scene:
    """The contents of a file. N Gaussians, K = (sh_degree + 1)^2; values are float32 unless noted.

    For a file with levels of detail the arrays hold all pages in file order, and chunks count step sets within
    their page; only source_index refers to the leaves, which are the last Gaussians.
    """

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
    exponents: NDArray[np.int64]       # [N] scale_exponent of each Gaussian
    levels: Record | None = None       # LODS with its page records, if there are pages
    mean_rests: NDArray[np.float32] | None = None  # [N, 3] what FP32 rounds off the means, if there are pages

    def log_scales(self) -> NDArray[np.float32]:
        """[N, 3] as a 3DGS PLY stores them, at most 60."""
        exponent = -self.exponents[:, None]
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
    versions = {"ARCH": 2, "LODS": 4, "PAGE": 4, "CREF": 5}
    return KNOWN + tuple(kind for kind, minor in versions.items() if h["version_minor"] >= minor)


def codec_exists(h: Record, s: Record) -> bool:
    versions = {0: s["type"] in known(h), 1: h["version_minor"] >= 1 and s["type"] in (*CODED, "PAGE"),
                2: h["version_minor"] >= 2 and s["type"] in (*ARCHIVED, "PAGE"),
                3: h["version_minor"] >= 5 and s["type"] in (*ARCHIVED, "PAGE")}
    return versions.get(s["codec"], False)


def require_all(ok: NDArray[np.bool_], offset: int, row_bytes: int, column_bytes: int, text: str,
                code: str = "bad_value") -> None:
    """ok [n] or [n, k]: refuses the first False; its offset is offset + row * row_bytes + column * column_bytes."""
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
    # With levels of detail the end may be missing; read_table() knows whether there are any.
    least = table_end(h) + HASH_BYTES if h["version_minor"] >= 4 else h["file_bytes"]
    require(len(data) >= least, "truncated", len(data), "shorter than file_bytes says")
    require(len(data) <= h["file_bytes"], "trailing_bytes", h["file_bytes"], "longer than file_bytes says")
    return h


def read_table(data: memoryview, h: Record) -> list[Record]:
    """The section entries; checks their order and offsets, but not yet their sizes against the counts."""
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
        s["type"] = bytes(s["type"]).decode("latin-1")        # known types are ASCII, others are arbitrary
        if s["type"] in known(h):
            require(s["type"] not in seen, "duplicate_section", s["at"], s["type"] + " is there twice")
            require(codec_exists(h, s), "unsupported_codec", s["at"] + at["codec"], "codec 0, for some types 1, 2 or 3")
            require(s["codec"] or s["decoded_bytes"] == s["stored_bytes"], "size_mismatch",
                    s["at"] + at["decoded_bytes"], "codec 0 stores as many bytes as it decodes to")
        else:
            require(s["flags"] == 0, "unknown_required", s["at"], "an unknown section that must be understood")
        seen.add(s["type"])
    levels = [s for s in entries if s["type"] in LEVELS and s["type"] in known(h)]
    for kind in ("DECL", *LEVELS) if levels else REQUIRED:
        require(kind in seen, "missing_section", HEADER_BYTES, kind + " is required")
    before, needed = True, {"DECL", "LODS", "ARCH", "CREF"} & {*known(h)}
    for s in entries if levels else ():
        require(s["type"] not in IN_PAGES, "bad_section", s["at"], "a file with levels has its Gaussians in pages")
        require(before or s["type"] not in needed, "bad_section", s["at"], "it comes before PAGE")
        before &= s["type"] != "PAGE"
    require(levels or len(data) == h["file_bytes"], "truncated", len(data), "shorter than file_bytes says")
    archived = [s for s in entries if s["type"] in (*ARCHIVED, *LEVELS) and s["codec"] >= 2]
    for s in entries:
        if archived and s["type"] in ARCHIVED:
            require(s["codec"] == archived[0]["codec"], "unsupported_codec", s["at"] + at["codec"], "the same in all three")
        if not archived and s["type"] == "ARCH" and h["version_minor"] >= 2:
            raise RgsError("bad_section", s["at"], "ARCH is for codecs 2 and 3")
    require(not archived or "ARCH" in seen, "missing_section", HEADER_BYTES, "codecs 2 and 3 need ARCH")

    end = head + HASH_BYTES
    for s in entries:
        begin, where = s["offset"], s["at"] + at["offset"]
        require(begin % 256 == 0, "bad_section", where, "an offset is a multiple of 256")
        require(begin >= align256(end), "section_overlap", where, "it begins before the previous one has ended")
        require(begin <= align256(end), "section_gap", where, "it begins behind the next multiple of 256")
        require(begin <= h["file_bytes"] and s["stored_bytes"] <= h["file_bytes"] - begin, "bad_section",
                s["at"] + at["stored_bytes"], "the section leaves the file")
        nonzero = np.flatnonzero(np.frombuffer(data[end:begin], np.uint8))
        require(not nonzero.size, "section_gap", end + int(nonzero[:1].sum()), "bytes between sections are zero")
        end = begin + s["stored_bytes"]
    require(end == h["file_bytes"], "section_gap", end, "the last section ends the file")
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


    if "CREF" in sections:
        s = sections["CREF"]
        require(4 < s["decoded_bytes"] <= 4 + CRS_TEXT_MAX, "size_mismatch", s["at"] + ENTRY.fields["decoded_bytes"][1],
                "a text of 1 to 16,384 bytes")


def is_there(data: memoryview, s: Record) -> bool:
    return s["offset"] <= len(data) and s["stored_bytes"] <= len(data) - s["offset"]


def require_hash(data: memoryview, s: Record) -> None:
    stored = data[s["offset"]:s["offset"] + s["stored_bytes"]]
    require(xxhash.xxh3_64_intdigest(stored) == s["xxh3"], "checksum_mismatch", s["offset"], f"hash of {s['type']}")


def read_declarations(data: memoryview, h: Record, base: int) -> Record:
    """DECL without its statements about the payload, which check_declarations checks."""
    d = record(data, DECL, base)

    def rule(ok: Any, name: str, text: str) -> None:
        require(ok, "bad_value", base + DECL.fields[name][1], text)

    minor, has_view = h["version_minor"], d["view_kind"] != 0
    if minor < 5:
        require_reserved(data, base + 11, base + 12, "a reserved byte of DECL")
    rule(d["view_kind"] <= 2, "view_kind", "the first view is from outside or inside, or there is none")
    unused = 152 if minor < 3 else 216 if has_view else 176
    require_reserved(data, base + unused, base + 256, "reserved bytes of DECL")
    for name in ("view_position", "view_pivot"):
        for axis, value in enumerate(d[name]):
            require(abs(value) <= ORIGIN_MAX, "bad_value", base + DECL.fields[name][1] + 4 * axis, "within 10^12")
    if has_view:
        rule(d["view_position"] != d["view_pivot"], "view_position", "a first view looks at something")
        rule(abs(sum(x * x for x in d["view_up"]) - 1) <= 1e-3, "view_up", "a unit vector")
        rule(1 <= d["view_width"] <= 179, "view_width", "degrees")
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


def read_crs(data: memoryview, s: Record, scene_axes: list[int]) -> Record:
    base, size = s["offset"], s["stored_bytes"]
    require_hash(data, s)
    axes = list(data[base:base + 3])
    for axis, direction in enumerate(axes):
        require(direction <= 6, "bad_value", base + axis, "a direction is 0 to 6")
    spans = sorted((a + 1) // 2 for a in axes) == [1, 2, 3]
    require(spans or axes == [0, 0, 0], "bad_value", base, "directions that span space, or none declared")
    require_reserved(data, base + 3, base + 4, "a reserved byte of CREF")
    require(not spans or any(scene_axes), "bad_value", base, "no axes if the scene declares none")
    stored = bytes(data[base + 4:base + size])
    try:
        text, sound = stored.decode("utf-8"), len(stored)
    except UnicodeDecodeError as error:
        text, sound = stored[:error.start].decode("utf-8"), error.start
    control = next((i for i, c in enumerate(text) if ord(c) < 0x20 or 0x7F <= ord(c) < 0xA0), None)
    if control is not None:
        sound = len(text[:control].encode("utf-8"))
    require(sound == len(stored), "bad_value", base + 4 + sound, "UTF-8 without control characters")
    return {"text": text, "axes": axes}


def read_frame_table(data: memoryview, h: Record, s: Record, row_bytes: int) -> None:
    """Adds frame_rows and frames [(offset, stored_bytes, hash)] of a coded section to its entry."""
    base, end = s["offset"], s["offset"] + s["stored_bytes"]
    multiple = h["chunk_size"] if s["type"] in ("MEAN", "GEOM", "SHI8") else 1
    require(end - base >= 8, "size_mismatch", base, "a frame table has at least 8 bytes")
    rows, count = (int.from_bytes(data[base + k:base + k + 4], "little") for k in (0, 4))
    most = 2**15 if s["codec"] == 3 else 2**16
    require(1 <= rows <= most and rows % multiple == 0, "bad_value", base, "frame_rows: whole chunks, 1 to 2^16 or 2^15")
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


def read_arch(data: memoryview, h: Record, s: Record, codec: int) -> Record:
    """ARCH of a codec, with its classes (a list of records) and tables."""
    base, end = s["offset"], s["offset"] + s["stored_bytes"]
    head, one_class = ARCH[codec], ARCH_CLASS[codec]
    require(end - base >= head.itemsize, "size_mismatch", base, "ARCH has at least 128 bytes")
    require_hash(data, s)
    arch = record(data, head, base) | {"codec": codec}

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

    rules(head, arch, base, {
        "mean_cells": within(4, 20), "mean_bits": within(1, min(arch["mean_cells"] + 9, 28)), "n_classes": within(1, 32),
        "opacity_levels": within(1, 4096), "n_distributions": within(1, 255), "centre": within(-2.0**128, 2.0**128),
        "half_width": within(np.nextafter(0, 1), 2.0**128), "slope": within(0, 2**16),
        "nearest": within(2.0**-1000, 2.0**300), "blur": within(-2**22, 2**22), "coarse_step": within(1, 2**20),
        **{name: within(-2**24, 2**24) for name in ("fine_step", "turn_step", "mean_step", "middle")}})
    tables = base + head.itemsize + one_class.itemsize * arch["n_classes"]
    require(tables <= end, "size_mismatch", base, "ARCH ends inside its classes")
    arch["classes"] = []
    for at in range(base + head.itemsize, tables, one_class.itemsize):
        arch["classes"].append(record(data, one_class, at))
        rules(one_class, arch["classes"][-1], at, {
            "rotation_step": within(2.0**-20, 2), "scale_step": within(1, 2**22), "scale_base": within(-2**23, 2**23),
            "dc_step": within(1, 2**26), "sh_step": within(1, 2**15) if codec == 3 else within(2.0**-40, 2.0**40)})
    q = 3 * (h["sh_degree"] + 1) ** 2 - 3
    content = unzip(data[tables:end], tables, rgs_archive.tables_bytes(arch, q))
    try:
        arch["tables"] = rgs_archive.read_tables(content, arch, q)
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
    """Rows of MEAN, GEOM and SHI8 of codec 2 or 3. steps [n_chunks, 4, 3]"""
    n, size, rows_each, k = h["n_gaussians"], h["chunk_size"], sections["MEAN"]["frame_rows"], (h["sh_degree"] + 1) ** 2
    parts: dict[str, list[bytes]] = {kind: [] for kind in ARCHIVED}
    for f in range(len(sections["MEAN"]["frames"])):
        first = f * rows_each
        rows = min(rows_each, n - first)
        offset = 0

        def code(kind: str) -> bytes:
            nonlocal offset
            offset = sections[kind]["frames"][f][0]
            return bytes(frame_bytes(data, sections[kind]["frames"][f]))

        try:
            if arch["codec"] == 2:
                means = rgs_archive.decode_means(code("MEAN"), rows, arch)
                geometry, classes = rgs_archive.decode_geometry(code("GEOM"), rows, arch, h["scale_exponent"])
            else:
                stream, u = rgs_archive.open_points(code("MEAN"), rows, arch)
                stream.finish()
                stream = rgs_archive.Stream(code("GEOM"), arch["tables"])
                means, geometry, classes = rgs_archive.decode_shapes(stream, u, arch, h["scale_exponent"])
                stream.finish()
            stream = rgs_archive.Stream(code("SHI8"), arch["tables"])
            values = rgs_archive.sh_values(stream, arch, classes, 3 * k - 3)
            stream.finish()
        except rgs_archive.Damaged as error:
            raise RgsError("corrupt_data", offset, str(error)) from error
        each = steps[np.arange(first, first + rows) // size][:, DEGREE[:k]]
        for kind, part in zip(ARCHIVED, (means, geometry, rgs_archive.sh_codes(values, each, h["sh_bytes"]))):
            parts[kind].append(part)
    return {kind: b"".join(part) for kind, part in parts.items()}


# ---- levels of detail ------------------------------------------------------------------------------------------------

def align16(x: int) -> int:
    return (x + 15) // 16 * 16


def page_arrays(h: Record, p: Record) -> dict[str, tuple[int, int]]:
    """Offset and size of each array of a decoded page, and the end of all ("")."""
    n, at, arrays = p["n"], 0, {}
    for kind, size in (("CHNK", 48 * -(-n // h["chunk_size"])), ("SHSC", 48 * p["n_step_sets"]), ("MEAN", 12 * n),
                       ("GEOM", 16 * n), ("SHI8", h["sh_bytes"] * n)):
        arrays[kind] = (at, size)
        at = align16(at + size)
    return arrays | {"": (at, 0)}


def read_levels(data: memoryview, h: Record, sections: dict[str, Record], max_gaussians: int,
                max_expansion: int) -> Record:
    """LODS with its records as "pages"."""
    s, pages = sections["LODS"], sections["PAGE"]
    base, size = s["offset"], s["stored_bytes"]
    require(is_there(data, s), "truncated", len(data), "the file ends before its first page")
    require_hash(data, s)
    decoded = ENTRY.fields["decoded_bytes"][1]
    l = record(data, LODS, base) if size >= LODS.itemsize else {"n_pages": 0}
    require(size >= LODS.itemsize and size == LODS.itemsize + PAGE.itemsize * l["n_pages"], "size_mismatch",
            s["at"] + decoded, "64 bytes and 112 per page")

    def rule(ok: Any, name: str, text: str, code: str = "bad_value") -> None:
        require(ok, code, base + LODS.fields[name][1], text)

    for name in ("reserved", "reserved_tail"):
        begin = base + LODS.fields[name][1]
        require_reserved(data, begin, begin + LODS[name].itemsize, "reserved bytes of LODS")
    rule(1 <= l["n_pages"] < ROOT, "n_pages", "1 to 2^32 - 2 pages")
    rule(1 <= l["n_levels"] <= 64, "n_levels", "1 to 64 levels")
    rule(1 <= l["page_chunks"] <= 1024 and l["page_chunks"] * h["chunk_size"] <= 2**16, "page_chunks", "chunks a page")
    rule(l["n_stored"] <= max_gaussians, "n_stored", "more Gaussians than the caller allows", "limit_exceeded")
    rule(0 <= l["quality_db"] < np.inf, "quality_db", "finite, not negative")
    archive = pages["codec"] >= 2
    records = []
    for at in range(base + LODS.itemsize, base + size, PAGE.itemsize):
        p = record(data, PAGE, at) | {"at": at}
        require_reserved(data, at + 106, at + 112, "reserved bytes of a page's record")
        most_origins = 0 if archive or h["version_minor"] < 5 else p["n"]
        require(p["n_origins"] <= most_origins, "bad_value", at + 104, "origins of a page")
        chunks = -(-p["n"] // h["chunk_size"])
        most = min(l["page_chunks"] * h["chunk_size"], 2**15 if pages["codec"] == 3 else 2**16)
        for name, ok in (("n", p["n"] <= most),
                         ("n_step_sets", p["n_step_sets"] == chunks or p["n_step_sets"] == 1 and not archive),
                         ("scale_exponent", -110 <= p["scale_exponent"] <= 110 and (
                             p["level"] > 0 or p["scale_exponent"] == h["scale_exponent"]))):
            require(ok, "bad_value", at + PAGE.fields[name][1], name + " of a page")
        for axis, value in enumerate(p["corner"]):
            require(value < 2**28 if archive else value == 0, "bad_value", at + 64 + 4 * axis, "a page's corner")
        records.append(p)
    l["pages"] = records

    end, section_end = pages["offset"], pages["offset"] + pages["stored_bytes"]
    for p in records:
        start = end if pages["codec"] else align256(end)
        require(p["offset"] >= start, "section_overlap", p["at"], "a page begins before the previous one has ended")
        require(p["offset"] <= start, "section_gap", p["at"], "a page begins behind the end of the previous one")
        fits = p["stored_bytes"] <= section_end - p["offset"]
        if pages["codec"] == 0:
            fits &= p["stored_bytes"] == page_arrays(h, p)[""][0] + ORIGIN.itemsize * p["n_origins"]
        require(fits, "size_mismatch", p["at"] + PAGE.fields["stored_bytes"][1], "a page fits its section and its counts")
        end = p["offset"] + p["stored_bytes"]
    require(end == section_end, "size_mismatch", end, "the last page ends the section")
    check_tree(h, records)

    rule(l["n_stored"] == sum(p["n"] for p in records), "n_stored", "the Gaussians of all pages")
    rule(h["n_gaussians"] == sum(p["n"] for p in records if p["level"] == 0), "n_stored", "the leaves are the header's")
    rule(l["n_levels"] == records[0]["level"] + 1, "n_levels", "the root's level and one")
    if pages["codec"]:
        total = sum(page_arrays(h, p)[""][0] for p in records)
        require(pages["decoded_bytes"] == total, "size_mismatch", pages["at"] + decoded, "the sizes of decoded pages")
        require(total <= max_expansion * h["file_bytes"] + 2**20, "limit_exceeded", pages["at"] + decoded, "too much")
    return l


def within(inner: Record, its: str, outer: Record, others: str) -> bool:
    """Whether a box of one page, of fields ITSmin and ITSmax, lies inside one of another."""
    pairs = zip(inner[its + "min"] + outer[others + "max"], outer[others + "min"] + inner[its + "max"])
    return all(a >= b for a, b in pairs)


def check_tree(h: Record, pages: list[Record]) -> None:
    """Each page's own fields, then those against its parent."""
    for i, p in enumerate(pages):
        def rule(ok: Any, name: str, text: str) -> None:
            require(ok, "bad_value", p["at"] + PAGE.fields[name][1], text)

        leaf, last, above = p["level"] == 0, i == len(pages) - 1, pages[i - 1] if i else None
        rule(p["n"] > 0 and (not leaf or last or p["n"] % h["chunk_size"] == 0), "n", "leaves are whole chunks")
        rule(p["level"] < 64 and (above is None or above["level"] - p["level"] in (0, 1)), "level", "coarse to fine")
        rule((p["parent"] == ROOT) == (i == 0), "parent", "page 0 is the root, and it alone")
        rule(leaf or not last, "level", "the last page is a leaf")
        children = range(p["first_child"], p["first_child"] + p["n_children"])
        if leaf:
            rule(len(children) == 0 and p["first_child"] == 0, "first_child", "a leaf has no children")
        else:
            follows = above is None or above["level"] != p["level"] or children.start == (
                above["first_child"] + above["n_children"])
            rule(len(children) > 0 and i < children.start and children.stop <= len(pages) and follows, "first_child",
                 "children follow each other")
            rule(all(pages[c]["parent"] == i for c in children), "first_child", "children name their parent")
        for prefix in ("", "core_"):
            low, high = p[prefix + "min"], p[prefix + "max"]
            rule(np.isfinite(low + high).all() and all(a <= b for a, b in zip(low, high)), prefix + "min", "a box")
        rule(within(p, "core_", p, ""), "core_min", "inside the page's box")
        rule(0 <= p["error"] < np.inf and not np.signbit(p["error"]) and (not leaf or p["error"] == 0), "error",
             "finite, +0 in leaves")
        if i == 0:
            continue
        rule(p["parent"] < i, "parent", "a parent comes before its children")
        parent = pages[p["parent"]]
        inside = parent["first_child"] <= i < parent["first_child"] + parent["n_children"]
        rule(inside and parent["level"] == p["level"] + 1, "parent", "a child of its parent")
        rule(within(p, "", parent, ""), "min", "inside the parent's")
        rule(within(p, "core_", parent, "core_"), "core_min", "inside the parent's")
        rule(p["error"] < parent["error"], "error", "less than the parent's")


def decode_page(data: memoryview, h: Record, p: Record, codec: int, arch: Record | None) -> dict[str, bytes]:
    """The arrays of a page; CHNK only if it is stored. MEAN in binary64, relative to the file's origin."""
    code = frame_bytes(data, (p["offset"], p["stored_bytes"], p["xxh3"]))
    n_bytes = ORIGIN.itemsize * p["n_origins"]
    require(n_bytes <= len(code), "corrupt_data", p["offset"], "a page ends inside its origins")
    origins = np.frombuffer(code[:n_bytes], ORIGIN)
    first = origins["first"].astype(np.int64)
    ok = np.isfinite(origins["offset"]).all(1) & (first < p["n"]) & (np.diff(first, prepend=-1) > 0)
    ok[:1] &= first[:1] == 0
    require_all(ok, p["offset"], ORIGIN.itemsize, 0, "finite origins, of rows in order", "corrupt_data")
    arrays = decode_arrays(code[n_bytes:], h, p, codec, arch)
    means = np.frombuffer(arrays["MEAN"], "<f4").reshape(-1, 3).astype(np.float64)
    if len(origins):
        means += np.repeat(origins["offset"].astype(np.float64), np.diff(first, append=p["n"]), 0)
    return arrays | {"MEAN": means.tobytes()}


def decode_arrays(code: memoryview, h: Record, p: Record, codec: int, arch: Record | None) -> dict[str, bytes]:
    n, sets, size = p["n"], p["n_step_sets"], h["chunk_size"]
    if codec == 0:
        return {kind: bytes(code[at:at + length]) for kind, (at, length) in page_arrays(h, p).items() if kind}
    if codec == 1:
        c = 3 * (h["sh_degree"] + 1) ** 2
        sizes = (48 * sets, 12 * n, 16 * n, c * (c + 1) // 2 + c * n)
        content = np.frombuffer(unzip(code, p["offset"], sum(sizes)), np.uint8)
        parts = np.split(content, np.cumsum(sizes)[:-1])
        steps = decode_words(parts[0], sets)
        by_chunk = check_steps(h, steps, p["offset"], 0)[np.zeros(-(-n // size), int) if sets == 1 else slice(None)]
        return {"SHSC": steps, "MEAN": decode_words(parts[1], n), "GEOM": decode_geometry(parts[2], n),
                "SHI8": decode_sh(parts[3], n, h, by_chunk)}
    k = (h["sh_degree"] + 1) ** 2
    try:
        if codec == 2:
            rgs_archive.need(len(code) >= 8, "a page begins with two sizes")
            m, g = struct.unpack("<II", code[:8])
            rgs_archive.need(m + g <= len(code) - 8, "a page ends inside its streams")
            means = rgs_archive.decode_means(bytes(code[8:8 + m]), n, arch, p["corner"])
            geometry, classes = rgs_archive.decode_geometry(bytes(code[8 + m:8 + m + g]), n, arch, p["scale_exponent"])
            stream = rgs_archive.Stream(bytes(code[8 + m + g:]), arch["tables"])
        else:
            stream, u = rgs_archive.open_points(bytes(code), n, arch, p["corner"])
            means, geometry, classes = rgs_archive.decode_shapes(stream, u, arch, p["scale_exponent"], p["level"])
        values = rgs_archive.sh_values(stream, arch, classes, 3 * k - 3)
        stream.finish()
    except rgs_archive.Damaged as error:
        raise RgsError("corrupt_data", p["offset"], str(error)) from error
    steps = np.zeros((sets, 4, 3), np.float32)
    by_value = np.abs(values).reshape(n, k, 3)
    for chunk in range(sets):
        for degree in range(h["sh_degree"] + 1):
            for channel in range(3):
                rows = by_value[chunk * size:(chunk + 1) * size, DEGREE[:k] == degree, channel]
                steps[chunk, degree, channel] = rgs_archive.step_for(rows.max())
    codes = rgs_archive.sh_codes(values, steps[np.arange(n) // size][:, DEGREE[:k]], h["sh_bytes"])
    return {"SHSC": steps.tobytes(), "MEAN": means, "GEOM": geometry, "SHI8": codes}


def check_steps(h: Record, steps: bytes, offset: int, each: int) -> NDArray[np.float32]:
    """[sets, 4, 3]; `each`: bytes a step in the file, 0 where it is coded."""
    array = np.frombuffer(steps, "<f4").reshape(-1, 4, 3)
    ok = (array.view("<u4") == 0) | ((array >= 2.0**-107) & (array <= 2.0**93) & (array.view("<u4") % 128 == 0))
    ok[:, h["sh_degree"] + 1:] &= array.view("<u4")[:, h["sh_degree"] + 1:] == 0
    require_all(ok.ravel(), offset, each, 0, "a step is +0, or 2^-107 to 2^93 in 17 bits, up to degree D")
    return array


def implied_chunks(h: Record, p: Record, means: NDArray[np.float32], geom: NDArray[np.float16]) -> NDArray[np.void]:
    first = np.arange(0, p["n"], h["chunk_size"])
    chunks = np.zeros(len(first), CHUNK)
    chunks["min"] = np.minimum.reduceat(means, first) + np.float32(0)
    chunks["max"] = np.maximum.reduceat(means, first) + np.float32(0)
    largest = np.maximum.reduceat(geom[:, 4:7].max(1).astype(np.float64), first)
    chunks["radius"] = 3 * np.ldexp(largest, -p["scale_exponent"])
    chunks["max_opacity"] = np.maximum.reduceat(geom[:, 7].astype(np.float32), first)
    chunks["scale_set"] = np.arange(len(first)) if p["n_step_sets"] > 1 else 0
    chunks["count"] = np.minimum(p["n"] - first, h["chunk_size"])
    return chunks


@dataclass
class PageRows:
    """A page's arrays, every value checked."""

    means: NDArray[np.float32]
    rests: NDArray[np.float32]         # what FP32 rounds off the means
    geom: NDArray[np.float16]
    codes: NDArray[np.int8]            # [n, K, 3]
    steps: NDArray[np.float32]         # [n_step_sets, 4, 3]
    step: NDArray[np.float32]          # [n, K, 3]
    chunks: NDArray[np.void]


def read_page(data: memoryview, h: Record, p: Record, codec: int, arch: Record | None) -> PageRows:
    decoded, n, k = decode_page(data, h, p, codec, arch), p["n"], (h["sh_degree"] + 1) ** 2
    begin = p["offset"] + ORIGIN.itemsize * p["n_origins"] if codec == 0 else p["offset"]
    base = {kind: begin + (at if codec == 0 else 0) for kind, (at, _) in page_arrays(h, p).items()}

    def rule(ok: NDArray[np.bool_], kind: str, row: int, column: int, text: str, byte: int = 0,
             code: str = "bad_value") -> None:
        each = (row, column) if codec == 0 else (0, 0)
        require_all(ok, base[kind] + (byte if codec == 0 else 0), *each, text, code)

    exact = np.frombuffer(decoded["MEAN"], "<f8").reshape(n, 3)
    means = exact.astype(np.float32)
    rests = (exact - means).astype(np.float32)
    geom = np.frombuffer(decoded["GEOM"], "<f2").reshape(n, 8)
    rows = np.frombuffer(decoded["SHI8"], "i1").reshape(n, h["sh_bytes"])
    if codec == 0:
        stored = np.frombuffer(decoded["CHNK"], CHUNK)
        rule(stored["reserved"] == 0, "CHNK", 48, 0, "reserved field of a chunk", 44, "reserved_bits")
        sets = np.arange(len(stored)) if p["n_step_sets"] > 1 else np.zeros(len(stored), int)
        count = np.minimum(n - np.arange(len(stored)) * h["chunk_size"], h["chunk_size"])
        rule(stored["count"] == count, "CHNK", 48, 0, "whole chunks", 40)
        rule(stored["scale_set"] == sets, "CHNK", 48, 0, "the steps of a chunk's place in the page", 32)
    steps = check_steps(h, decoded["SHSC"], base["SHSC"], 4 if codec == 0 else 0)
    rule(np.isfinite(means), "MEAN", 12, 4, "means are finite")
    wide, clear = geom.astype(np.float64), ~np.signbit(geom)
    norm2 = (wide[:, :4] ** 2).sum(1)
    rule(np.abs(norm2 - 1) <= 2.0**-8, "GEOM", 16, 0, "the squared norm of a rotation is within 2^-8 of 1")
    rule(clear[:, 0], "GEOM", 16, 0, "the sign bit of w is clear")
    rule(np.isfinite(geom[:, 4:7]) & clear[:, 4:7], "GEOM", 16, 2, "a scale: finite, sign clear", 8)
    rule((geom[:, 7] <= 1) & clear[:, 7], "GEOM", 16, 0, "opacity 0 to 1, sign clear", 14)
    chunk = np.arange(n) // h["chunk_size"] if p["n_step_sets"] > 1 else np.zeros(n, int)
    step, codes = steps[chunk][:, DEGREE[:k]], rows[:, :3 * k].reshape(n, k, 3)
    rule(rows[:, :3 * k] != -128, "SHI8", h["sh_bytes"], 1, "code -128 is not used")
    rule(((codes == 0) | (step != 0)).reshape(n, 3 * k), "SHI8", h["sh_bytes"], 1, "a code whose step is 0 is 0")
    rule(rows[:, 3 * k:] == 0, "SHI8", h["sh_bytes"], 1, "padding of a row", 3 * k, "reserved_bits")
    chunks = implied_chunks(h, p, means, geom)
    if codec == 0:
        for name, byte in (("min", 0), ("max", 0), ("radius", 12), ("max_opacity", 28)):
            same = (stored[name] == chunks[name]).reshape(len(chunks), -1).all(1)
            rule(same, "CHNK", 48, 0, name + " is that of the chunk's rows", byte)

    w, x, y, z = (wide[:, :4] / np.sqrt(norm2)[:, None]).T
    rotation = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                         [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                         [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
    scales = np.ldexp(wide[:, 4:7], -p["scale_exponent"])
    reach = 3 * np.sqrt(((rotation * scales.T) ** 2).sum(1)).T * (1 - 2.0**-10)
    inside = (means - reach >= np.array(p["min"])) & (means + reach <= np.array(p["max"]))
    rule(inside, "MEAN", 12, 4, "the page's box holds its Gaussians")
    return PageRows(means, rests, geom, codes, steps, step, chunks)


def read_with_levels(data: memoryview, h: Record, entries: list[Record], max_gaussians: int, max_expansion: int) -> Scene:
    """read() for a file with levels of detail."""
    sections = {s["type"]: s for s in entries if s["type"] in known(h)}
    require_sizes(h, {kind: s for kind, s in sections.items() if kind in ("DECL", "CREF")})
    require(is_there(data, sections["DECL"]), "truncated", len(data), "the file ends before its first page")
    require_hash(data, sections["DECL"])
    d = read_declarations(data, h, sections["DECL"]["offset"])
    require_sizes(h, {kind: s for kind, s in sections.items() if kind == "PERM"}, d["n_source"])
    has_provenance = "PROV" in sections and is_there(data, sections["PROV"])
    provenance = read_provenance(data, sections["PROV"]) if has_provenance else None
    if "CREF" in sections:
        require(is_there(data, sections["CREF"]), "truncated", len(data), "the file ends before its first page")
        d["crs"] = read_crs(data, sections["CREF"], d["axes"])
    arch = None
    if "ARCH" in sections:
        require(is_there(data, sections["ARCH"]), "truncated", len(data), "the file ends before its first page")
        arch = read_arch(data, h, sections["ARCH"], sections["PAGE"]["codec"])
    levels = read_levels(data, h, sections, max_gaussians, max_expansion)
    for s in entries:
        if s["type"] != "PAGE" and is_there(data, s):
            require_hash(data, s)
    codec, end, present = sections["PAGE"]["codec"], sections["PAGE"]["offset"], []
    for p in levels["pages"]:
        if p["offset"] + p["stored_bytes"] > len(data):
            break
        nonzero = np.flatnonzero(np.frombuffer(data[end:p["offset"]], np.uint8))
        require(not nonzero.size, "section_gap", end + int(nonzero[:1].sum()), "bytes between pages are zero")
        end = p["offset"] + p["stored_bytes"]
        present.append(p)
    pages = [read_page(data, h, p, codec, arch) for p in present]
    require(len(data) == h["file_bytes"], "pages_missing", len(data), "the end of the file is missing")

    means, rests, geom, codes, steps, step = (np.concatenate([getattr(p, name) for p in pages]) for name in
                                              ("means", "rests", "geom", "codes", "steps", "step"))
    exponents = np.repeat([p["scale_exponent"] for p in present], [p["n"] for p in present])
    wide = geom.astype(np.float64)
    norm2 = (wide[:, :4] ** 2).sum(1)
    opacities, n = geom[:, 7].astype(np.float32), h["n_gaussians"]
    check_declarations(d, sections["DECL"]["offset"], means[-n:], geom[-n:, 4:7], opacities[-n:])
    source_index = None
    if "PERM" in sections:
        item_bytes, base = 4 if d["n_source"] < 2**32 else 8, sections["PERM"]["offset"]
        source_index = np.frombuffer(data[base:base + item_bytes * n], f"<u{item_bytes}").astype(np.uint64)
        require_all(source_index < d["n_source"], base, item_bytes, 0, "a position below n_source")
        require(np.unique(source_index).size == n, "bad_value", base, "positions are all different")
    return Scene(header=h, sections=entries, declarations=d, provenance=provenance, means=means,
                 rotations_stored=geom[:, :4].astype(np.float32),
                 rotations=(wide[:, :4] / np.sqrt(norm2)[:, None]).astype(np.float32), scales_stored=geom[:, 4:7],
                 scales=np.ldexp(wide[:, 4:7], -exponents[:, None]).astype(np.float32), opacities=opacities, sh_steps=steps,
                 sh_codes=codes, sh=step * codes.astype(np.float32), chunks=np.concatenate([p.chunks for p in pages]),
                 source_index=source_index, exponents=exponents, levels=levels, mean_rests=rests)


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
    if any(s["type"] == "LODS" and s["type"] in known(h) for s in entries):
        return read_with_levels(data, h, entries, max_gaussians, max_expansion)
    sections = {s["type"]: s for s in entries if s["type"] in known(h)}
    base = {kind: s["offset"] for kind, s in sections.items()}
    require_sizes(h, sections)
    require_hash(data, sections["DECL"])
    d = read_declarations(data, h, base["DECL"])
    require_sizes(h, sections, d["n_source"])
    provenance = read_provenance(data, sections["PROV"]) if "PROV" in sections else None
    if "CREF" in sections:
        d["crs"] = read_crs(data, sections["CREF"], d["axes"])

    row_bytes = {"MEAN": 12, "GEOM": 16, "SHI8": h["sh_bytes"], "CHNK": 48, "SHSC": 48}
    coded = [s for s in entries if s["type"] in CODED and s["codec"] != 0]
    budget = max_expansion * len(data) + 2**20
    for s in coded:
        read_frame_table(data, h, s, row_bytes[s["type"]])
        budget -= s["decoded_bytes"]
        require(budget >= 0, "limit_exceeded", s["at"] + ENTRY.fields["decoded_bytes"][1], "too much for so small a file")
    archived = [s for s in coded if s["codec"] >= 2]
    for s in (sections[kind] for kind in ARCHIVED if archived):
        require(s["frame_rows"] == sections["MEAN"]["frame_rows"], "bad_value", s["offset"], "the same rows in each frame")
    arch = read_arch(data, h, sections["ARCH"], archived[0]["codec"]) if archived else None

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

    sets = np.minimum(chunks["scale_set"], max(h["n_scale_sets"], 1) - 1)      # validity is checked below
    if arch:
        decoded = decode_archive(data, h, sections, arch, steps[sets])
        means, geom, rows = (np.frombuffer(decoded[kind], dtype).reshape(n, columns) for kind, dtype, columns in
                             (("MEAN", "<f4", 3), ("GEOM", "<f2", 8), ("SHI8", "i1", h["sh_bytes"])))
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
                 sh=step * codes.astype(np.float32), chunks=chunks, source_index=source_index,
                 exponents=np.full(n, h["scale_exponent"]))


def read_file(path: str) -> Scene:
    with open(path, "rb") as file:
        return read(file.read())


def main() -> int:
    parser = argparse.ArgumentParser(description="Check an .rgs file against docs/format/FORMAT.md and print or dump it.")
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
