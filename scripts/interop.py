#!/usr/bin/python3
# interop.py - round trips both ways with PlayCanvas's splat-transform: python3 scripts/interop.py [--bin FOLDER] [PLY]
#
# Each tool must load what the other writes, with attributes equal within half a step of the format (to float rounding
# where both read the same file). Default scene: a generated one. The other tool runs through npx or as
# $RGS_SPLAT_TRANSFORM; without either the script does nothing. Tests of web/ run it with the version that they lock.
# SPDX-License-Identifier: Apache-2.0
import argparse
import json
import os
import shlex
import shutil
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

PEER = "@playcanvas/splat-transform@3.7.0"
failures = 0


def run(*command):
    result = subprocess.run([str(part) for part in command], stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if result.returncode != 0:
        sys.exit(f"interop: {' '.join(map(str, command))}\n{result.stdout}{result.stderr}")


def read_ply(path):
    """Attributes of a 3DGS PLY of floats: activated opacity, unit rotation, SH [n, coefficients, 3]."""
    data = Path(path).read_bytes()
    end = data.index(b"end_header\n") + 11
    lines = data[:end].decode().split("\n")
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    n = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    rows = np.frombuffer(data, "<f4", n * len(names), end).reshape(n, len(names)).astype(np.float64)
    column = {name: rows[:, i] for i, name in enumerate(names)}
    stack = lambda *names: np.stack([column[name] for name in names], 1)
    n_rest = sum(name.startswith("f_rest_") for name in names)
    rest = [column[f"f_rest_{i}"] for i in range(n_rest)]
    sh = np.concatenate([stack("f_dc_0", "f_dc_1", "f_dc_2")[:, None],
                         np.array(rest).reshape(3, n_rest // 3, n).transpose(2, 1, 0) if n_rest else
                         np.zeros((n, 0, 3))], 1)
    rotation = stack("rot_0", "rot_1", "rot_2", "rot_3")
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-column["opacity"]))
    return {"mean": stack("x", "y", "z"), "scale": stack("scale_0", "scale_1", "scale_2"), "opacity": opacity,
            "rotation": rotation / np.linalg.norm(rotation, axis=1, keepdims=True), "sh": sh}


def same_shape(a, b):
    """The quaternions of b nearest to those of a among those of the same ellipsoid: half turns about its axes, signs."""
    w, x, y, z = b.T
    turned = np.stack([b, np.stack([-x, w, z, -y], 1), np.stack([-y, -z, w, x], 1), np.stack([-z, y, -x, w], 1)])
    dot = (turned * a).sum(2)
    best = np.abs(dot).argmax(0)
    rows = np.arange(len(a))
    return turned[best, rows] * np.sign(dot[best, rows])[:, None]


def errors(a, b):
    """Largest differences by attribute; SH by degree."""
    out = {name: np.abs(a[name] - b[name]).max() for name in ("mean", "scale", "opacity")}
    out["rotation"] = np.abs(a["rotation"] - same_shape(a["rotation"], b["rotation"])).max()
    n = min(a["sh"].shape[1], b["sh"].shape[1])
    for degree in range(4):
        part = slice(degree * degree, (degree + 1) ** 2)
        if n >= (degree + 1) ** 2:
            out[f"sh{degree}"] = np.abs(a["sh"][:, part] - b["sh"][:, part]).max()
    return out


def check(what, a, b, bounds):
    """`bounds`: largest error by attribute."""
    global failures
    bad = [] if len(a["mean"]) == len(b["mean"]) else ["count"]
    found = errors(a, b) if not bad else {}
    bad += [f"{name} {found[name]:.3g} > {bounds[name]:.3g}" for name in found if not found[name] <= bounds[name]]
    failures += bool(bad)
    summary = ", ".join(f"{name} {value:.2g}" for name, value in found.items())
    print(f"{'FAILED' if bad else 'ok':6} {what}: {'; '.join(bad) if bad else summary}")


def bounds(mean, scale, opacity, rotation, *sh):
    names = ["mean", "scale", "opacity", "rotation"] + [f"sh{degree}" for degree in range(4)]
    return dict(zip(names, (mean, scale, opacity, rotation, *sh, *[sh[-1]] * 3)))


# Two readers of the same file differ by float rounding, and in what logit they give to opacity 0 and 1. Codes of .splat
# rotations are (code - 128) / 128 in its first viewer and 2 code / 255 - 1 in the other tool.
def same(scene, rotation=1e-5):
    return bounds(1e-6 * max(1, np.abs(scene["mean"]).max()), 2e-5, 0.5 / 255, rotation, 2e-5)


def log_step(mean):
    """Half a step of 16 bits in sign(x) ln(1 + |x|), whose slope is 1 / (1 + |x|)."""
    width = np.ptp(np.sign(mean) * np.log1p(np.abs(mean)), 0).max()
    return 0.52 * width / 65535 * (1 + np.abs(mean).max())


def own_steps(scene):
    """Half a step of each format (a whole one where the other tool rounds down; 0.62 of SPZ's SH, see spz.cpp)."""
    width = np.ptp(scene["mean"], 0).max()
    eight_bits = 0.51 / 255
    spz = bounds(0.51 / 4096, 0.51 / 16, eight_bits, 3e-3, eight_bits / 0.15, 5 / 128, 10 / 128)
    float32 = bounds(1e-5, 1e-5, 1e-6, 1e-5, 1e-6)
    return {"ply": float32, "spz": spz, "splat": bounds(1e-6, 1e-5, eight_bits, 2 / 128, eight_bits / 0.282),
            # Chunks are smaller than the scene; how much, the file says. Here the scene bounds them.
            "compressed.ply": bounds(0.51 * width / 1023, 0.51 * 20 / 1023, eight_bits, 3e-3, 0.03, 0.51 / 32),
            "glb": bounds(1e-5, 1e-5, 1e-6, 1e-5, 1e-6),
            # Codebooks and the palette have no steps; both tools' readers must agree.
            "sog": bounds(log_step(scene["mean"]), np.inf, eight_bits, 3 * 0.51 * 2 ** 0.5 / 255, np.inf)}


def clamp_to_spz(scene):
    out = dict(scene)
    out["scale"] = np.clip(scene["scale"], -10, 255 / 16 - 10)
    out["sh"] = np.clip(scene["sh"], -1, 127 / 128)
    out["sh"][:, 0] = np.clip(scene["sh"][:, 0], -0.5 / 0.15, 0.5 / 0.15)
    return out


def clamp_colours(scene):
    out = dict(scene)
    out["sh"] = scene["sh"][:, :1].clip(-0.5 / 0.28209479, 0.5 / 0.28209479)
    return out


def write_ksplat(path, scene, level, degree):
    """GaussianSplats3D's format, for which the other tool has a reader only: one section, buckets of 256 in order."""
    n, width, code_range, bucket = len(scene["mean"]), 5.0, 32767, 256
    header, section = bytearray(4096), bytearray(1024)
    struct.pack_into("<BBxxIIIIH", header, 0, 0, 1, 1, 1, n, n, level)
    struct.pack_into("<ff", header, 36, -1.5, 1.5)
    starts = np.arange(0, n, bucket)
    lengths = np.minimum(bucket, n - starts)
    full = int((lengths == bucket).sum())
    struct.pack_into("<II", section, 0, n, n)
    data = b""
    centres = scene["mean"][starts]
    scale = np.exp(np.maximum(scene["scale"], -16))  # what FP16 would flush to 0 has no logarithm to compare
    if level > 0:
        struct.pack_into("<IIfHxxI", section, 8, bucket, len(starts), width, 12, code_range)
        struct.pack_into("<II", section, 32, full, len(starts) - full)
        data += lengths[full:].astype("<u4").tobytes() + centres.astype("<f4").tobytes()
    struct.pack_into("<H", section, 40, degree)
    number = "<f4" if level == 0 else "<f2"
    raw = lambda values, kind: np.ascontiguousarray(values.astype(kind)).view(np.uint8).reshape(n, -1)
    if level == 0:
        mean = raw(scene["mean"], "<f4")
    else:
        offset = (scene["mean"] - centres[np.arange(n) // bucket]) * (2 * code_range / width)
        mean = raw(np.clip(np.round(offset) + code_range, 0, 65535), "<u2")
    byte = lambda values: np.clip(np.round(values * 255), 0, 255).astype(np.uint8)
    columns = [mean, raw(scale, number), raw(scene["rotation"], number),
               byte(0.5 + 0.28209479 * scene["sh"][:, 0]), byte(scene["opacity"][:, None])]
    for d in range(1, degree + 1):
        part = scene["sh"][:, d * d:(d + 1) ** 2].transpose(0, 2, 1).reshape(n, -1)
        columns.append(byte((part + 1.5) / 3) if level == 2 else raw(part, number))
    Path(path).write_bytes(bytes(header) + bytes(section) + data + np.concatenate(columns, 1).tobytes())


def write_lcc(folder, scene):
    """XGRIDS' format, for which the other tool has a reader only: two cells of two levels each; returns the finest, in order."""
    n = len(scene["mean"]) // 4
    scale = np.exp(scene["scale"])
    low, high = scale.min(0), scale.max(0)
    sh_low, sh_high = scene["sh"][:, 1:].min((0, 1)) - 0.1, scene["sh"][:, 1:].max((0, 1)) + 0.2
    code = lambda values, least, most, codes: np.round((values - least) / (most - least) * codes).clip(0, codes).astype(np.uint64)
    q = scene["rotation"][:, [1, 2, 3, 0]]
    largest = np.abs(q).argmax(1)
    q = q * np.sign(q[np.arange(len(q)), largest])[:, None]
    rest = np.stack([np.delete(row, i) for row, i in zip(q, largest)])
    rotation = (code(rest, -0.5 ** 0.5, 0.5 ** 0.5, 1023) << np.array([0, 10, 20], np.uint64)).sum(1) | largest.astype(np.uint64) << 30
    raw = lambda values, kind: np.ascontiguousarray(values.astype(kind)).view(np.uint8).reshape(len(values), -1)
    byte = lambda values: code(values, 0, 1, 255)
    data = np.concatenate([raw(scene["mean"], "<f4"), raw(byte(0.5 + 0.28209479 * scene["sh"][:, 0]), "u1"),
                           raw(byte(scene["opacity"][:, None]), "u1"), raw(code(scale, low, high, 65535), "<u2"),
                           raw(rotation[:, None], "<u4"), np.zeros((len(q), 6), np.uint8)], 1)
    sh = code(scene["sh"][:, 1:], sh_low, sh_high, np.array([2047, 1023, 2047]))
    sh = raw((sh << np.array([0, 11, 21], np.uint64)).sum(2), "<u4")
    cells = [(0, n), (n, 2 * n + 1)], [(3 * n, 4 * n), (2 * n + 1, 3 * n)]  # ranges of the two levels
    index = b"".join(struct.pack("<hh", -3, i) + b"".join(struct.pack("<IQI", b - a, 32 * a, 32 * (b - a)) for a, b in cell)
                     for i, cell in enumerate(cells))
    attributes = [{"name": name, "min": list(a), "max": list(b)} for name, a, b in (("scale", low, high), ("shcoef", sh_low, sh_high))]
    (folder / "scene.lcc").write_text(json.dumps({
        "version": "5.0", "totalLevel": 2, "cellLengthX": 30, "cellLengthY": 30, "encoding": "COMPRESS", "fileType": "Quality",
        "splats": [sum(b - a for a, b in level) for level in zip(*cells)], "attributes": attributes}))
    (folder / "index.bin").write_bytes(index)
    (folder / "data.bin").write_bytes(data.tobytes())
    (folder / "shcoef.bin").write_bytes(np.pad(sh, ((0, 0), (0, 4))).tobytes())


def shaped(scene):
    """The scene, its covariances as scales: readers may turn a Gaussian's own axes along."""
    w, x, y, z = scene["rotation"].T
    turn = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
                     2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1).reshape(-1, 3, 3)
    axes = turn * np.exp(scene["scale"] - scene["scale"].max(1, keepdims=True))[:, None]
    return scene | {"scale": (axes @ axes.transpose(0, 2, 1)).reshape(-1, 9), "rotation": np.tile([1.0, 0, 0, 0], (len(w), 1))}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--bin", default="build/release/bin", help="folder with rgs-convert")
    parser.add_argument("ply", nargs="?", help="a 3DGS PLY of degree 3 without damaged Gaussians")
    arguments = parser.parse_args()
    command = os.environ.get("RGS_SPLAT_TRANSFORM")
    if command is None and shutil.which("npx") is None:
        print("interop: skipped, there is neither npx nor RGS_SPLAT_TRANSFORM")
        return
    peer = shlex.split(command) if command else ["npx", "--yes", PEER]
    bin = Path(arguments.bin)

    with tempfile.TemporaryDirectory(prefix="rgs-interop-") as folder:
        path = lambda name: Path(folder) / name
        theirs = lambda *words: run(*peer, "-q", "-w", "-g", "cpu", *words)
        ours = lambda *words: run(bin / "rgs-convert", "--quiet", "--no-sync", "--overwrite", *words)
        scene_path = arguments.ply
        if scene_path is None:
            scene_path = path("scene.ply")
            run(bin / "rgs-make-scene", "--seed", 1, "--gaussians", "3000", "--degree", 3, scene_path)
        scene = read_ply(scene_path)
        steps = own_steps(scene)
        clamped = {"spz": clamp_to_spz(scene), "splat": clamp_colours(scene)}

        def load(tool, source, name):
            tool(source, path(name))
            return read_ply(path(name))

        print(f"{len(scene['mean'])} Gaussians; largest differences")
        for kind, version in (("ply", None), ("compressed.ply", None), ("spz", 2), ("spz", 3), ("spz", 4), ("splat", None),
                              ("sog", None)):
            file = path(f"ours.{kind}")
            ours(*(["--spz-version", version] if version else []), "--keep-order", scene_path, file)
            there = load(theirs, file, "there.ply")
            name = f"{kind} {version}" if version else kind
            bound = steps[kind] | ({"rotation": 0.06} if version == 2 else {})  # three bytes, see spz_test.cpp
            check(f"{name}: written here, read there, against the scene", there, clamped.get(kind, scene), bound)
            # Of SPZ 2 the other tool computes a w near 0 from the others in single precision.
            check(f"{name}: written here, read there and here", there, load(ours, file, "here.ply"),
                  same(scene, 1 / 128 if kind == "splat" else 5e-4 if version == 2 else 1e-5))
        for degree in range(3):
            flat = scene | {"sh": scene["sh"][:, :(degree + 1) ** 2]}
            ours("--keep-order", "--sh-degree", degree, scene_path, path("flat.ply"))
            for kind, bound, cut in (("compressed.ply", steps["compressed.ply"], flat), ("spz", steps["spz"], clamp_to_spz(flat)),
                                     ("sog", steps["sog"], flat)):
                ours("--keep-order", path("flat.ply"), path(f"flat.{kind}"))
                check(f"{kind} of degree {degree}: written here, read there, against the scene",
                      load(theirs, path(f"flat.{kind}"), "there.ply"), cut, bound)
                theirs(path("flat.ply"), path(f"flat.{kind}"))
                check(f"{kind} of degree {degree}: written there, read here and there",
                      load(ours, path(f"flat.{kind}"), "here.ply"), load(theirs, path(f"flat.{kind}"), "there.ply"),
                      same(scene))
        ours("--keep-order", scene_path, path("ours.glb"))
        check("glb: written and read here", load(ours, path("ours.glb"), "here.ply"), scene, steps["glb"])

        for kind, name, options in (("ply", "t.ply", []), ("compressed.ply", "t.compressed.ply", []),
                                    ("spz", "t3.spz", ["--spz-version", "3"]), ("spz", "t4.spz", []),
                                    ("sog", "t.sog", ["-i", "2"]), ("sog", "meta.json", ["-i", "2"]), ("glb", "t.glb", [])):
            file = path(name)
            theirs(*options, scene_path, file)
            here = load(ours, file, "here.ply")
            if kind in ("ply", "spz", "glb"):  # the others are reordered
                check(f"{name}: written there, read here, against the scene", here, clamped.get(kind, scene),
                      steps[kind])
            if kind != "glb":  # which the other tool does not read
                check(f"{name}: written there, read here and there", here, load(theirs, file, "there.ply"), same(scene))

        for level in range(3):
            for degree in (0, 2):
                file = path("scene.ksplat")
                write_ksplat(file, scene, level, degree)
                read = [load(ours, file, "here.ply"), load(theirs, file, "there.ply")]
                check(f"ksplat of level {level}, degree {degree}: read here and there", *read, same(scene))

        ours(scene_path, path("ours.ksplat"))
        check("ksplat: written here, read there and here", load(theirs, path("ours.ksplat"), "there.ply"),
              load(ours, path("ours.ksplat"), "here.ply"), same(scene))

        write_lcc(Path(folder), scene)
        chunks = [f"data/3dgs/{i}" for i in range(3)]
        path("data/3dgs").mkdir(parents=True)
        for kind in ("sog", "spz"):
            for i, chunk in enumerate(chunks):
                theirs(*(["-i", "2"] if kind == "sog" else []), scene_path, "-t", f"{i},{-2 * i},{3 * i}", path(f"{chunk}.{kind}"))
            nodes = [{"data": {"3dgs": {"name": i}}} for i in (2, 1)]
            path(f"{kind}.lcc2").write_text(json.dumps({
                "totalSplats": 1, "lodSplats": [1, 1], "totalLevels": 2, "splatType": f".{kind}",
                "root": {"splatFiles": [f"{chunk}.{kind}" for chunk in chunks],
                         "child": [{"data": {"3dgs": {"name": 0}}, "child": nodes}]}}))
        for name in ("scene.lcc", "sog.lcc2", "spz.lcc2"):
            theirs("-L", "0", path(name), path("there.ply"))
            check(f"{name}: read here and there", shaped(load(ours, path(name), "here.ply")), shaped(read_ply(path("there.ply"))),
                  same(scene))

        # The other tool moves scenes in axes of its own, which are half a turn about z away from the file's.
        moves = [("-t", "1,-2,3", "--translate=-1,2,3"), ("-s", "2.5", "--scale=2.5"),
                 ("-r", "30,0,0", "--rotate=-30,0,0"), ("-r", "0,50,0", "--rotate=0,-50,0"),
                 ("-r", "0,0,-70", "--rotate=0,0,-70"), ("-r", "10,20,30", "--rotate=-10,-20,30")]
        for flag, value, option in moves:
            theirs(scene_path, flag, value, path("there.ply"))
            ours(option, scene_path, path("here.ply"))
            check(f"moved by {flag} {value}", read_ply(path("here.ply")), read_ply(path("there.ply")),
                  bounds(2e-4, 2e-5, 1e-6, 2e-5, 2e-5))
    if failures:
        sys.exit(f"interop: {failures} comparisons failed")
    print("interop: ok")


main()
