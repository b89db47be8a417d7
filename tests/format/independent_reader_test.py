#!/usr/bin/python3
# independent_reader_test.py - the reader written from docs/format/FORMAT.md agrees with the library on every golden
# file.
# SPDX-License-Identifier: Apache-2.0
"""independent_reader_test.py RGS_DUMP_FILE GOLDEN_FOLDER

Valid files: every value bit for bit, but for what the library computes in binary32: normalised rotations within 2e-7,
log-scales and logits within 2 units in the last place of the larger magnitude and 1e-6. Files of reject/: both readers
refuse, with the code and offset of reject.txt.
"""
from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from skip import skip_without_tool

try:
    import numpy as np
    from numpy.typing import NDArray

    import rgs_reader
except ImportError as error:
    skip_without_tool(f"{error} (Debian: python3-numpy, python3-xxhash, python3-zstandard)")

SPLAT = {"mean": 3, "rotation": 4, "scale": 3, "opacity": 1, "sh": 48}
TRAINED = {"mean": 3, "log_scale": 3, "rotation": 4, "logit": 1, "sh": 48}


class Refused(Exception):
    """The library's error: name and offset."""


def dump(program: str, path: Path) -> dict[str, NDArray[Any]]:
    """The arrays that rgs_dump_file prints; raises Refused if it prints an error."""
    run = subprocess.run([program, path], capture_output=True, check=False)
    if run.stdout.startswith(b"error "):
        code, offset = run.stdout.split()[1:]
        raise Refused(code.decode(), int(offset))
    assert run.returncode == 0, f"{program} ended with {run.returncode}: {run.stderr.decode()}"
    arrays, data = {}, run.stdout
    while data:
        line, data = data.split(b"\n", 1)
        name, kind, *shape = line.decode().split()
        dtype, (rows, columns) = np.dtype("<" + kind), map(int, shape)
        size = rows * columns * dtype.itemsize
        arrays[name] = np.frombuffer(data[:size], dtype).reshape(rows, columns)
        data = data[size:]
    return arrays


def columns(rows: NDArray[np.float32], names: dict[str, int]) -> dict[str, NDArray[np.float32]]:
    return dict(zip(names, np.split(rows, np.cumsum(list(names.values()))[:-1], axis=1)))


def same_bits(name: str, library: NDArray[Any], reader: Any) -> None:
    ours = np.ascontiguousarray(np.asarray(reader, library.dtype)).reshape(library.shape)
    assert len(library) == len(reader), f"{name} has {len(library)} rows, not {len(reader)}"
    different = np.flatnonzero((library.view("u1") != ours.view("u1")).any(1))
    assert not different.size, f"{name} differs in row {different[0]}: {library[different[0]]}, {ours[different[0]]}"


def close(name: str, library: NDArray[np.float32], reader: NDArray[np.float32], tolerance: Any) -> None:
    ours = reader.reshape(library.shape).astype(np.float64)
    error = np.abs(library - ours) - tolerance
    assert not error.size or error.max() <= 0, f"{name} is off by {np.abs(library - ours).max()}"


def compare(scene: rgs_reader.Scene, library: dict[str, NDArray[Any]]) -> None:
    h, d, p = scene.header, scene.declarations, scene.provenance
    n, k = len(scene.means), (h["sh_degree"] + 1) ** 2
    same_bits("header", library["header"], [[h[name] for name in (
        "version_major", "version_minor", "file_bytes", "n_gaussians", "n_scale_sets", "chunk_size", "sh_degree",
        "scale_exponent")]])
    entry = ("flags", "codec", "offset", "stored_bytes", "decoded_bytes", "xxh3")
    types = [int.from_bytes(s["type"].encode("ascii"), "little") for s in scene.sections]
    same_bits("sections", library["sections"], np.array(
        [[kind, *(s[name] for name in entry)] for kind, s in zip(types, scene.sections)], np.uint64))
    same_bits("enumerators", library["enumerators"], [d["axes"] + [d[name] for name in rgs_reader.ENUMERATORS]])
    same_bits("constants", library["constants"], [[d[name] for name in (*rgs_reader.NOT_NEGATIVE, "robust_fraction")]])
    same_bits("boxes", library["boxes"], [d["full_min"] + d["full_max"], d["robust_min"] + d["robust_max"]])
    same_bits("counts", library["counts"], np.array([[d[name] for name in (
        "n_source", "n_dropped", "n_repaired", "n_scale_subnormal", "n_scale_zero", "n_opacity_zero",
        "n_opacity_one")]], np.uint64))
    same_bits("origin", library["origin"], [d["origin"]])
    assert (d["view_kind"] != 0) == ("first_view" in library), "first view"
    if d["view_kind"] != 0:
        view = [d["view_kind"], *d["view_position"], *d["view_pivot"], *d["view_up"], d["view_width"]]
        same_bits("first_view", library["first_view"], np.array([view], np.float32))
    assert ("crs" in d) == ("crs" in library), "CRS"
    if "crs" in d:
        assert library["crs"].tobytes().decode("utf-8") == d["crs"]["text"], "text of the CRS"
        same_bits("crs_axes", library["crs_axes"], [d["crs"]["axes"]])
    assert (p is None) == ("source" not in library), "provenance"
    if p:
        same_bits("source", library["source"], np.array([[p["source_bytes"], p["source_xxh3"]]], np.uint64))
        for name in ("source_name", "tool"):
            assert library[name].tobytes().decode("utf-8", "replace") == p[name], name

    sh = np.zeros((n, 16, 3), np.float32)
    sh[:, :k] = scene.sh
    activated, trained = columns(library["activated"], SPLAT), columns(library["trained"], TRAINED)
    for name, values in {"mean": scene.means, "scale": scene.scales, "opacity": scene.opacities, "sh": sh}.items():
        same_bits(name, activated[name], values)
    close("rotation", activated["rotation"], scene.rotations, 2e-7)
    for name, values in {"mean": scene.means, "rotation": scene.rotations_stored, "sh": sh}.items():
        same_bits("trained " + name, trained[name], values)
    rests = np.zeros((n, 3), np.float32) if scene.mean_rests is None else scene.mean_rests
    same_bits("mean_rest", library["mean_rest"], rests)
    for name, values in {"log_scale": scene.log_scales(), "logit": scene.opacity_logits()}.items():
        close(name, trained[name], values, 2 * np.spacing(np.abs(trained[name])) + 1e-6)

    c = scene.chunks
    same_bits("chunk_floats", library["chunk_floats"],
              np.hstack([c["min"], c["max"], c["radius"][:, None], c["max_opacity"][:, None]]))
    same_bits("chunk_integers", library["chunk_integers"], np.stack([c["scale_set"], c["count"]], 1))
    same_bits("steps", library["steps"], scene.sh_steps)
    index = np.arange(h["n_gaussians"]) if scene.source_index is None else scene.source_index
    same_bits("source_index", library["source_index"], index)
    assert (scene.levels is None) == ("pages" not in library), "levels"
    if scene.levels:
        integers = ("offset", "xxh3", "stored_bytes", "n", "parent", "first_child", "level", "n_children", "n_step_sets")
        pages = [[*(p[name] for name in integers), p["scale_exponent"] % 2**64, *p["corner"]]
                 for p in scene.levels["pages"]]
        same_bits("pages", library["pages"], np.array(pages, np.uint64))
        n_origins = [[p["n_origins"]] for p in scene.levels["pages"]]
        same_bits("n_origins", library["n_origins"], np.array(n_origins, np.uint64))
        same_bits("page_floats", library["page_floats"],
                  [[p["error"], *p["min"], *p["max"], *p["core_min"], *p["core_max"]] for p in scene.levels["pages"]])
        same_bits("quality", library["quality"], [[scene.levels["quality_db"]]])


def robust_box(means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The box of the middle 99 percent on each axis, from a histogram over the upper 16 bits of ordered floats."""
    box = np.empty((2, 3), np.uint32)
    bits = (means + np.float32(0)).view(np.uint32)      # -0 + 0 is +0
    ordered = np.where(bits >> 31, ~bits, bits ^ 0x80000000)
    for axis in range(3):
        counts = np.bincount(ordered[:, axis] >> 16, minlength=65536)
        tail = len(means) // 200
        box[0, axis] = np.argmax(np.cumsum(counts) > tail) << 16
        box[1, axis] = (65535 - np.argmax(np.cumsum(counts[::-1]) > tail)) << 16 | 0xFFFF
    low, high = np.where(box >> 31, box ^ 0x80000000, ~box).astype(np.uint32).view(np.float32)
    return np.maximum(low, means.min(0)), np.minimum(high, means.max(0))


def check_robust(scene: rgs_reader.Scene) -> None:
    """Golden files follow the writers' rules for the robust box."""
    if scene.header["n_gaussians"] == 0:
        return
    d, means = scene.declarations, scene.means[-scene.header["n_gaussians"]:]
    low, high = robust_box(means)
    assert (np.float32(d["robust_min"]) == low).all() and (np.float32(d["robust_max"]) == high).all(), "robust box"
    inside = ((means >= low) & (means <= high)).mean(0).astype(np.float32)
    assert (inside >= d["robust_fraction"]).all(), "robust fraction"


def check_order(scene: rgs_reader.Scene) -> None:
    """Golden files follow the writers' rules for order: keys ascend, and source positions of equal keys do too."""
    n, d = scene.header["n_gaussians"], scene.declarations
    if n == 0 or scene.source_index is None:
        return
    key = np.zeros(n, np.uint64)
    if d["order"] == 2:
        low, high = np.array(d["robust_min"]), np.array(d["robust_max"])
        flat = high == low
        t = (scene.means[-n:] - (low + high) / 2) * np.where(flat, 1, 2 / np.where(flat, 1, high - low))
        s = np.where(np.abs(t) <= 1, np.abs(t) / 2, 1 - 1 / (2 * np.maximum(np.abs(t), 1)))
        cell = np.minimum(2.0**21 * (0.5 + np.sign(t) * s / 2), 2**21 - 1).astype(np.uint64)
        for bit in range(21):
            for axis in range(3):
                key |= (cell[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    index = scene.source_index
    ascends = (key[1:] > key[:-1]) | ((key[1:] == key[:-1]) & (index[1:] > index[:-1]))
    assert ascends.all(), f"Gaussian {np.argmin(ascends) + 1} is out of order"


def check_refused(program: str, path: Path, code: str, offset: int) -> None:
    try:
        rgs_reader.read_file(str(path))
        raise AssertionError("the independent reader accepts it")
    except rgs_reader.RgsError as error:
        assert (error.code, error.offset) == (code, offset), f"{error}; it should be {code} at {offset}"
    try:
        dump(program, path)
        raise AssertionError("the library accepts it")
    except Refused as error:
        assert error.args == (code, offset), f"the library says {error.args}; it should be {code} at {offset}"


def main(program: str, folder: Path) -> int:
    accepted, rejected = sorted(folder.glob("*.rgs")), sorted((folder / "reject").glob("*.rgs"))
    lines = (folder / "reject/reject.txt").read_text().splitlines()
    listed = [line.split() for line in lines if line and not line.startswith("#")]
    expected = {name: (code, int(offset)) for name, code, offset, *_ in listed}
    odd = expected.keys() ^ {path.name for path in rejected}
    failures = [f"{name}: only one of reject/ and reject.txt has it" for name in sorted(odd)]
    for path in accepted + rejected:
        try:
            if path in accepted:
                scene = rgs_reader.read_file(str(path))
                compare(scene, dump(program, path))
                if not any(s["codec"] >= 2 for s in scene.sections):  # their frames have an order of their own
                    check_order(scene)
                check_robust(scene)
            elif path.name in expected:
                check_refused(program, path, *expected[path.name])
        except (AssertionError, rgs_reader.RgsError, Refused) as error:
            failures.append(f"{path.name}: {error}")
    print(*failures, f"{len(accepted)} files read, {len(rejected)} refused, {len(failures)} failures", sep="\n")
    return 1 if failures or not accepted or not rejected else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2])))
