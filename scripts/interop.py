#!/usr/bin/python3
# interop.py - a scene through other programs, both ways and in every format that they have: python3 scripts/interop.py [--bin FOLDER] [PLY]
#
# A peer must read what is written here, and it what a peer writes, in the frame that INTERCHANGE.md names and with values equal within
# half a step of the format (to float rounding where both read the same file). Default scene: a generated one, a house that no turn or
# mirror image looks like. splat-transform runs through npx or as $RGS_SPLAT_TRANSFORM; without either the script does nothing. The
# others run where `npm ci` has installed web/. All have the versions that web/package-lock.json locks. Tests of web/ run it.
# SPDX-License-Identifier: Apache-2.0
import argparse
import itertools
import json
import os
import re
import shlex
import shutil
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
LOCK = json.loads((ROOT / "web/package-lock.json").read_text())["packages"]
failures = 0


def version(package):
    return LOCK[f"node_modules/{package}"]["version"]


TRANSFORM = "@playcanvas/splat-transform"
PACKAGES = {"splat-transform": TRANSFORM, "@adobe/spz": "@adobe/spz", "@spz-loader/core": "@spz-loader/core", "Spark": "@sparkjsdev/spark",
            "GaussianSplats3D": "@mkkellogg/gaussian-splats-3d", "PlayCanvas engine": "playcanvas"}
# Files that are written here, in the order of the scene but for those of REORDERED: name and options.
FORMATS = {"ply": ("ours.ply", []), "compressed.ply": ("ours.compressed.ply", []), "splat": ("ours.splat", []),
           "spz 2": ("ours2.spz", ["--spz-version", 2]), "spz 3": ("ours3.spz", ["--spz-version", 3]),
           "spz 4": ("ours4.spz", ["--spz-version", 4]), "ksplat": ("ours.ksplat", []), "sog": ("ours.sog", []),
           "lod-meta.json": ("ours/lod-meta.json", [])}
REORDERED = {"ksplat", "lod-meta.json"}
# What a peer reads, and of SPZ what it refuses.
READERS = {"splat-transform": "ply, compressed.ply, splat, spz 2, spz 3, spz 4, ksplat, sog, lod-meta.json",
           "@adobe/spz": "spz 2, spz 3, spz 4", "@spz-loader/core": "spz 2, spz 3, not spz 4",
           "Spark": "ply, compressed.ply, splat, spz 2, spz 3, not spz 4, ksplat, sog",
           "GaussianSplats3D": "ply, compressed.ply, splat, spz 2, not spz 3, not spz 4, ksplat",
           "PlayCanvas engine": "ply, compressed.ply, not spz 2, not spz 3, spz 4"}
# peer, format, file, options (splat-transform) or option (peers.mjs)
WRITERS = [("splat-transform", "ply", "t.ply", []), ("splat-transform", "compressed.ply", "t.compressed.ply", []),
           ("splat-transform", "spz 3", "t3.spz", ["--spz-version", "3"]), ("splat-transform", "spz 4", "t4.spz", []),
           ("splat-transform", "sog", "t.sog", ["-i", "2"]), ("splat-transform", "sog", "t/meta.json", ["-i", "2"]),
           ("splat-transform", "lod-meta.json", "t/lod-meta.json", ["-i", "2"]), ("splat-transform", "glb", "t.glb", []),
           *[("@adobe/spz", f"spz {v}", f"adobe{v}.spz", v) for v in (2, 3, 4)], ("Spark", "spz 2", "spark.spz", None),
           *[("GaussianSplats3D", "ksplat", f"theirs{level}.ksplat", level) for level in range(3)]]


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


def differences(a, b):
    """By attribute, of every value; SH by degree."""
    out = {name: np.abs(a[name] - b[name]).reshape(len(a["mean"]), -1) for name in ("mean", "scale", "opacity")}
    out["rotation"] = np.abs(a["rotation"] - same_shape(a["rotation"], b["rotation"]))
    n = min(a["sh"].shape[1], b["sh"].shape[1])
    for degree in range(4):
        if n >= (degree + 1) ** 2:
            part = slice(degree * degree, (degree + 1) ** 2)
            out[f"sh{degree}"] = np.abs(a["sh"][:, part] - b["sh"][:, part]).reshape(len(a["mean"]), -1)
    return out


def nearest(a, b):
    """For each row of a that of b."""
    parts = np.array_split(a, max(1, len(a) // 64))
    return np.concatenate([((part[:, None] - b) ** 2).sum(2).argmin(1) for part in parts])


def frame_of(found, wanted):
    """The axes of `found` in those of `wanted`, told by where a few Gaussians lie: "x y z" if they are the same."""
    few = wanted["mean"][:: max(1, len(wanted["mean"]) // 50)]
    turns = [(order, signs) for order in itertools.permutations(range(3)) for signs in itertools.product((1, -1), repeat=3)]
    miss = [np.abs(found["mean"][nearest(turned := few[:, order] * signs, found["mean"])] - turned).sum() for order, signs in turns]
    order, signs = turns[int(np.argmin(miss))]
    return " ".join(("-" if sign < 0 else "") + "xyz"[axis] for axis, sign in zip(order, signs))


def check(what, found, wanted, slack, steps=None, ordered=True):
    """`slack`, `steps`: by attribute, largest difference beside half a step, and step (numbers, or of every value)."""
    global failures
    steps = dict.fromkeys(slack, 0) | (steps or {})
    bad = [] if len(found["mean"]) == len(wanted["mean"]) else ["count"]
    frame, kept, summary = "x y z", "kept", []
    if not bad:
        apart = np.abs(found["mean"] - wanted["mean"])
        if not (apart <= slack["mean"] + 1.1 * steps["mean"]).all():
            frame = frame_of(found, wanted)
            key = lambda cloud: np.concatenate([cloud["mean"], cloud["scale"], cloud["opacity"][:, None], cloud["sh"][:, 0]], 1)
            kept, order = "changed", nearest(key(wanted), key(found))
            found = {name: values[order] for name, values in found.items()}
            steps = {name: step[order] if np.ndim(step) else step for name, step in steps.items()}
            bad += ["order"] if ordered else []
            bad += ["some are missing"] if len(set(order)) < len(order) else []
        bad += [f"frame {frame}"] if frame != "x y z" else []
    if not bad:
        for name, apart in differences(found, wanted).items():
            # Of the smallest three of a quaternion the fourth takes all errors; SPZ's SH: spz.cpp.
            half = {"rotation": 12 if "spz 2" in what else 2.2}.get(name, 0.63 if name > "sh0" and "spz" in what else 0.51)
            step = np.broadcast_to(steps[name], apart.shape)
            if np.isinf(slack[name]) or np.isinf(step).any():
                continue
            size = (apart[step > 0] / step[step > 0]).max() if (step > 0).any() else apart.max()
            summary.append(f"{name} {size:.2g}" + (" steps" if (step > 0).any() else ""))
            if not (apart <= half * step * (2 if "rounded down" in what else 1) + slack[name]).all():
                bad.append(summary[-1])
    failures += bool(bad)
    print(f"{'FAILED' if bad else 'ok':6} {what}: " + ("; ".join(bad) or f"frame and count kept, order {kept}; {', '.join(summary)}"))


def by_name(mean, scale, opacity, rotation, *sh):
    names = ["mean", "scale", "opacity", "rotation"] + [f"sh{degree}" for degree in range(4)]
    return dict(zip(names, (mean, scale, opacity, rotation, *sh, *[sh[-1]] * 3)))


# Two readers of the same file differ by float rounding, and in what logit they give to opacity 0 and 1. Codes of .splat
# rotations are (code - 128) / 128 in its first viewer and 2 code / 255 - 1 in the other tool. Of SPZ 2 w near 0 is computed from the others.
def rounding(scene, kind=""):
    return by_name(1e-6 * max(1, np.abs(scene["mean"]).max()), 2e-5, 2e-4, {"splat": 1 / 128, "spz 2": 5e-4}.get(kind, 1e-5), 2e-5)


def steps_of(kind, path, cloud):
    """Of a file, and of what was read of it. Codebooks and the palette of SOG have none."""
    width, eight_bits = np.ptp(np.sign(cloud["mean"]) * np.log1p(np.abs(cloud["mean"])), 0), 1 / 255
    three = 2 ** 0.5 / 1023
    if kind.startswith("spz"):
        return by_name(1 / 4096, 1 / 16, eight_bits, 2 / 255 if kind == "spz 2" else three, eight_bits / 0.15, 1 / 16, 1 / 8)
    if kind == "splat":
        return by_name(0, 0, eight_bits, 1 / 128, eight_bits / 0.282, 0)
    if kind == "ksplat":  # level 2 has SH of 8 bits
        half = 2 ** -11
        return by_name(5 / 65534, 16 * half, eight_bits, half, eight_bits / 0.282, 2 * half if path.read_bytes()[20] < 2 else eight_bits * 3)
    if kind == "compressed.ply":
        data = path.read_bytes()
        header = data[:data.index(b"end_header\n") + 11]
        n = int(header.split(b"element chunk ")[1].split()[0])
        bounds = np.frombuffer(data, "<f4", 18 * n, len(header)).reshape(n, 6, 3).astype(np.float64)
        low, high = bounds[:, ::2], bounds[:, 1::2]
        by_chunk = (high - low) / np.array([[2047, 1023, 2047], [2047, 1023, 2047], [255, 255, 255]])
        mean, scale, colour = np.repeat(by_chunk, 256, 0)[:len(cloud["mean"])].transpose(1, 0, 2)
        return by_name(mean, scale, eight_bits, three, colour / 0.282, 1 / 32)
    if kind in ("sog", "lod-meta.json"):
        return by_name(width / 65535 * (1 + np.abs(cloud["mean"])), np.inf, eight_bits, 2 ** 0.5 / 255, np.inf)
    return by_name(0, 0, 0, 0, 0)


def as_held(kind, scene):
    """Without what the format, or the peer, cannot hold."""
    out = dict(scene)
    if kind in ("splat", "ksplat", "GaussianSplats3D"):
        out["sh"] = scene["sh"][:, :1 if kind == "splat" else 9].copy()
        out["sh"][:, 0] = out["sh"][:, 0].clip(-0.5 / 0.28209479, 0.5 / 0.28209479)
    if kind.startswith("spz"):
        out["scale"] = np.clip(scene["scale"], -10, 255 / 16 - 10)
        out["sh"] = np.clip(scene["sh"], -1, 127 / 128)
        out["sh"][:, 0] = np.clip(scene["sh"][:, 0], -0.5 / 0.15, 0.5 / 0.15)
    if kind == "Spark":  # a colour's three harmonics have 8 bits of the power of 2 below the largest, and what is above is cut off
        largest = 2 ** np.floor(np.log2(np.maximum(np.abs(scene["sh"]).max(2, keepdims=True), 2.0 ** -15)))
        out["sh"] = np.concatenate([scene["sh"][:, :1], np.clip(scene["sh"], -largest, largest)[:, 1:]], 1)
    return out


# What a peer rounds by itself: Spark to FP16 and to axis and angle, which it computes as if quaternions had length 1. GaussianSplats3D
# rounds colours and opacities of floats down to 8 bits. The engine leaves the rotations of SPZ to its shader.
def rounding_of(peer, kind):
    codes = 5e-3 if kind == "compressed.ply" else 0  # of harmonics, 127 or 127.5 for 0
    if peer == "Spark":
        return by_name(1e-4, 4e-3, 3e-4, 0.12 if kind == "splat" else 0.01, 2e-3, 5e-3)
    if peer == "GaussianSplats3D":
        return by_name(0, 0, 1 / 255, 0, 1 / 255 / 0.282, codes)
    return by_name(0, 0, 0, np.inf if (peer, kind) == ("PlayCanvas engine", "spz 4") else 0, 0, codes if peer == "PlayCanvas engine" else 0)


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
    peer = shlex.split(command) if command else ["npx", "--yes", f"{TRANSFORM}@{version(TRANSFORM)}"]
    bin = Path(arguments.bin)
    for name, package in PACKAGES.items():
        named = set(re.findall(rf"{name}\s(\d+\.\d+\.\d+)", (ROOT / "docs/user/INTERCHANGE.md").read_text()))
        if not named <= {version(package)}:
            sys.exit(f"interop: docs/user/INTERCHANGE.md speaks of {name} {', '.join(named)}, web/package-lock.json has {version(package)}")
    others = (ROOT / "web/node_modules/@sparkjsdev").exists()
    if not others:
        print("interop: only splat-transform, the others are not installed: npm ci in web")

    with tempfile.TemporaryDirectory(prefix="rgs-interop-") as folder:
        path = lambda name: Path(folder) / name
        theirs = lambda *words: run(*peer, "-q", "-w", "-g", "cpu", *words)
        ours = lambda *words: run(bin / "rgs-convert", "--quiet", "--no-sync", "--overwrite", *words)
        scene_path = arguments.ply
        if scene_path is None:
            scene_path = path("scene.ply")
            run(bin / "rgs-make-scene", "--seed", 1, "--gaussians", "3000", "--degree", 3, scene_path)
        scene = read_ply(scene_path)

        def load(tool, source, name):
            tool(source, path(name))
            return read_ply(path(name))

        def by_others(jobs):
            """Errors, or None, of jobs [peer, "read" or "write" or "validate", from, to, option] of web/viewer/test/peers.mjs."""
            words = [dict(zip(("peer", "does", "from", "to"), map(str, job))) | {"option": job[4]} for job in jobs]
            path("jobs.json").write_text(json.dumps(words))
            command = ["node", ROOT / "web/viewer/test/peers.mjs", path("jobs.json")]
            return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])

        print(f"{len(scene['mean'])} Gaussians; largest differences")
        (path("ours")).mkdir()
        (path("t")).mkdir()
        ours("--lod", scene_path, path("levels.rgs"))
        ours("--keep-order", scene_path, path("ours.glb"))
        check("glb: written and read here", load(ours, path("ours.glb"), "here.ply"), scene, by_name(1e-5, 1e-5, 1e-6, 1e-5, 1e-6))
        here = {}
        for kind, (name, options) in FORMATS.items():
            ours(*options, *([path("levels.rgs")] if kind == "lod-meta.json" else ["--keep-order", scene_path]), path(name))
            here[kind] = load(ours, path(name), "here.ply")
        reads = [(reader, kind.removeprefix("not "), kind.startswith("not ")) for reader, kinds in READERS.items() for kind in kinds.split(", ")
                 if others or reader == "splat-transform"]
        jobs = [(reader, "read", path(FORMATS[kind][0]), path(f"read{i}.ply"), None) for i, (reader, kind, _) in enumerate(reads)]
        jobs += [(writer, "write", path("ours4.spz") if writer == "@adobe/spz" else scene_path, path(name), option)
                 for writer, kind, name, option in WRITERS if others]
        jobs.append(("gltf-validator", "validate", path("ours.glb"), "", None))
        their_jobs = [job for job in jobs if job[0] != "splat-transform"] if others else []
        errors = dict(zip([job[1:4] for job in their_jobs], by_others(their_jobs) if others else []))
        for (reader, kind, refused), job in zip(reads, jobs):
            what = f"{reader} {version(PACKAGES[reader])} reads {kind}"
            if reader == "splat-transform":
                theirs(*(["-L", "0"] if kind == "lod-meta.json" else []), job[2], job[3])
            elif refused != (errors[job[1:4]] is not None):
                sys.exit(f"interop: {what}: {errors[job[1:4]] or 'INTERCHANGE.md says that it does not'}")
            if refused:
                print(f"ok     {what}: refused")
                continue
            there, theirs_too = read_ply(job[3]), (reader, kind) == ("GaussianSplats3D", "splat")
            slack = {name: value + rounding_of(reader, kind)[name] for name, value in rounding(scene, kind).items()}
            check(f"{what} as it is read here", there, as_held(reader, here[kind]), slack, None, not theirs_too)
            if reader == "Spark":  # what it cuts off depends on what was rounded
                slack |= dict.fromkeys(("sh1", "sh2", "sh3"), np.inf)
            check(f"{what} as the scene", there, as_held(reader, as_held(kind, scene)), slack,
                  steps_of(kind, path(FORMATS[kind][0]), there), kind not in REORDERED and not theirs_too)
        for writer, kind, name, option in WRITERS:
            if writer == "splat-transform":
                theirs(*option, scene_path, path(name))
            elif not others:
                continue
            elif error := next(error for key, error in errors.items() if key[2] == path(name)):
                sys.exit(f"interop: {writer} does not write {name}: {error}")
            cloud = load(ours, path(name), "here.ply")
            what = f"{writer} {version(PACKAGES[writer])} writes {kind}"
            slack = {name: value + rounding_of(writer, kind)[name] for name, value in rounding(scene, kind).items()}
            down = ", rounded down," if writer == "splat-transform" and kind in ("sog", "lod-meta.json") else ""
            check(f"{what}{down} as the scene", cloud, as_held(kind, scene), slack, steps_of(kind, path(name), cloud),
                  kind in ("ply", "glb") or kind.startswith("spz"))
            if writer == "splat-transform" and kind != "glb":  # which it does not read
                theirs(*(["-L", "0"] if kind == "lod-meta.json" else []), path(name), path("there.ply"))
                check(f"{what} as it reads it", cloud, read_ply(path("there.ply")), rounding(scene, kind))
        if others:
            if error := errors["validate", path("ours.glb"), ""]:
                sys.exit(f"interop: gltf-validator: {error}")
            print("ok     gltf-validator knows all of the .glb but the names of the extension's attributes")

        for degree in range(3):
            flat = scene | {"sh": scene["sh"][:, :(degree + 1) ** 2]}
            ours("--keep-order", "--sh-degree", degree, scene_path, path("flat.ply"))
            for kind in ("compressed.ply", "spz", "sog"):
                file = path(f"flat.{kind}")
                ours("--keep-order", path("flat.ply"), file)
                there = load(theirs, file, "there.ply")
                check(f"{kind} of degree {degree}: written here, read there, against the scene", there, as_held(kind, flat), rounding(scene),
                      steps_of(kind, file, there))
                theirs(path("flat.ply"), file)
                check(f"{kind} of degree {degree}: written there, read here and there", load(ours, file, "here.ply"),
                      load(theirs, file, "there.ply"), rounding(scene))

        for level in range(3):
            for degree in (0, 2):
                file = path("scene.ksplat")
                write_ksplat(file, scene, level, degree)
                read = [load(ours, file, "here.ply"), load(theirs, file, "there.ply")]
                check(f"ksplat of level {level}, degree {degree}: read here and there", *read, rounding(scene))

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
                  rounding(scene))

        # The other tool moves scenes in axes of its own, which are half a turn about z away from the file's.
        moves = [("-t", "1,-2,3", "--translate=-1,2,3"), ("-s", "2.5", "--scale=2.5"),
                 ("-r", "30,0,0", "--rotate=-30,0,0"), ("-r", "0,50,0", "--rotate=0,-50,0"),
                 ("-r", "0,0,-70", "--rotate=0,0,-70"), ("-r", "10,20,30", "--rotate=-10,-20,30")]
        for flag, value, option in moves:
            theirs(scene_path, flag, value, path("there.ply"))
            ours(option, scene_path, path("here.ply"))
            check(f"moved by {flag} {value}", read_ply(path("here.ply")), read_ply(path("there.ply")),
                  by_name(2e-4, 2e-5, 1e-6, 2e-5, 2e-5))
    if failures:
        sys.exit(f"interop: {failures} comparisons failed")
    print("interop: ok")


if __name__ == "__main__":
    main()
