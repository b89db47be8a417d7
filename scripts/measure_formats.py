#!/usr/bin/python3
# measure_formats.py - size and rendered quality of a scene in each format that rgs-convert writes or reads.
# SPDX-License-Identifier: Apache-2.0
"""Converts a PLY to each format, renders the test views of all at half size with rgs-render (FP32 pictures), and prints
bytes per Gaussian and PSNR against the PLY's pictures as a table; --json writes the record that docs/records keeps.

  measure_formats.py scene.ply cameras.json [--bin build/release/bin] [--work FOLDER] [--json OUT] [--peers] [NAME=FILE...]

--peers adds files of other programs: PlayCanvas's splat-transform (compressed.ply, spz, sog) and
GaussianSplats3D (ksplat, at most SH degree 2), fetched by npm into --work. Their files are made once: clustering for SOG takes
hours without a GPU. NAME=FILE adds further files. scripts/plot_formats.py draws the record.
"""
import argparse
import datetime
import json
import pathlib
import platform
import struct
import subprocess
import sys
import zlib

import numpy as np

from shrink_record import text

# format, name of the file, options
WRITTEN = [("rgs packed", "packed.rgs", []), ("rgs direct", "direct.rgs", ["--profile", "direct"]),
           ("rgs archive:high", "high.rgs", ["--profile", "archive:high"]),
           ("rgs archive:small", "small.rgs", ["--profile", "archive:small"]),
           ("rgs archive:tiny", "tiny.rgs", ["--profile", "archive:tiny"]),
           ("compressed.ply", "scene.compressed.ply", []), ("spz", "scene.spz", ["--spz-version", "4"]), ("splat", "scene.splat", []),
           ("glb", "scene.glb", [])]
TRANSFORM, SPLATS3D = "@playcanvas/splat-transform@3.7.0", "@mkkellogg/gaussian-splats-3d@0.4.7"
# format, writer, name of the file, command
PEERS = [(kind, "splat-transform 3.7.0", f"peer.{kind}",
          ["npx", "--yes", TRANSFORM, "-q", "-w", "-g", "cpu", "{input}", "{output}"])
         for kind in ("compressed.ply", "spz", "sog")]
PEERS += [(f"ksplat, level {level}", "GaussianSplats3D 0.4.7", f"peer{level}.ksplat",
           ["node", "{work}/write_ksplat.mjs", "{input}", "{output}", str(level)]) for level in range(3)]
WRITE_KSPLAT = """import fs from 'node:fs';
globalThis.window = globalThis;
globalThis.self = globalThis;
const { PlyParser, SplatBufferGenerator } = await import('@mkkellogg/gaussian-splats-3d');
const [input, output, level] = process.argv.slice(2);
const file = fs.readFileSync(input);
const splats = PlyParser.parseToUncompressedSplatArray(file.buffer.slice(file.byteOffset, file.byteOffset + file.length), 2);
const generator = SplatBufferGenerator.getStandardGenerator(0, Number(level), 0);
fs.writeFileSync(output, new Uint8Array(generator.generateFromUncompressedSplatArray(splats).bufferData));
"""


def run(*command):
    result = subprocess.run([str(part) for part in command], stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if result.returncode != 0:
        sys.exit(f"measure_formats: {' '.join(map(str, command))}\n{result.stdout}{result.stderr}")
    return result.stdout


def read_exr(path):
    """[height, width, channels] of an OpenEXR scanline file of 32-bit floats with ZIP compression."""
    data = path.read_bytes()
    at, attributes = 8, {}
    while data[at] != 0:
        name, kind = (part.decode() for part in data[at:].split(b"\0", 2)[:2])
        at += len(name) + len(kind) + 2
        size = struct.unpack_from("<i", data, at)[0]
        attributes[name] = data[at + 4:at + 4 + size]
        at += 4 + size
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    channels = attributes["channels"].count(b"\x02\0\0\0")  # each entry says once that it is a float
    if attributes["compression"] != b"\x03":
        sys.exit(f"measure_formats: {path} is not compressed by ZIP")
    picture = np.empty((height, channels, width), np.float32)
    for offset in struct.unpack_from(f"<{(height + 15) // 16}Q", data, at + 1):
        y, size = struct.unpack_from("<2i", data, offset)
        lines = min(16, bottom + 1 - y)
        raw_bytes = lines * channels * width * 4
        block = np.frombuffer(data, np.uint8, size, offset + 8)
        if size < raw_bytes:  # differences of bytes, the even ones before the odd ones
            codes = np.frombuffer(zlib.decompress(block.tobytes()), np.uint8).astype(np.int64)
            codes[1:] -= 128
            block = (np.cumsum(codes) & 255).astype(np.uint8)
            halves = block[:(raw_bytes + 1) // 2], block[(raw_bytes + 1) // 2:]
            block = np.stack(halves, 1).reshape(-1)
        picture[y - top:y - top + lines] = np.frombuffer(block.tobytes(), "<f4").reshape(lines, channels, width)
    return picture.transpose(0, 2, 1)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ply", type=pathlib.Path)
    parser.add_argument("cameras", type=pathlib.Path)
    parser.add_argument("others", nargs="*", metavar="NAME=FILE")
    parser.add_argument("--bin", type=pathlib.Path, default=pathlib.Path("build/release/bin"))
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("build/formats"))
    parser.add_argument("--json", type=pathlib.Path)
    parser.add_argument("--peers", action="store_true")
    arguments = parser.parse_intermixed_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    cameras = [camera for camera in json.loads(arguments.cameras.read_text()) if camera.get("split", "test") == "test"]
    size = f"{cameras[0]['width'] // 2}x{cameras[0]['height'] // 2}"

    def render(scene, name):
        folder = arguments.work / f"{name.replace(' ', '_')}_views"
        run(arguments.bin / "rgs-render", scene, "--cameras", arguments.cameras, "--split", "test", "--size", size,
            "--format", "exr", "--out", f"{folder}/", "--overwrite", "--quiet")
        return [read_exr(path).astype(np.float64) for path in sorted(folder.glob("*.exr"))]

    reference = render(arguments.ply, "ply")
    n = None
    files = [("ply", "", arguments.ply)]
    for kind, name, options in WRITTEN:
        path = arguments.work / name
        summary = json.loads(run(arguments.bin / "rgs-convert", *options, "--json", "--quiet", "--overwrite",
                                 arguments.ply, path))
        n = summary["source"]["gaussians"]
        files.append((kind, "rgs-convert", path))
    if arguments.peers:
        files += write_as_peers(arguments.ply, arguments.work)
    files += [(name, "", pathlib.Path(path)) for name, path in (other.split("=", 1) for other in arguments.others)]
    entries = []
    for kind, writer, path in files:
        entry = {"format": kind, "writer": writer, "bytes": path.stat().st_size,
                 "bytes_per_gaussian": round(path.stat().st_size / n, 2), "psnr_db": None, "worst_psnr_db": None}
        if kind != "ply":
            pictures = render(path, path.name)
            psnr = [-10 * np.log10(max(np.mean((a - b) ** 2), 1e-20)) for a, b in zip(reference, pictures, strict=True)]
            entry |= {"psnr_db": round(float(np.mean(psnr)), 2), "worst_psnr_db": round(float(min(psnr)), 2)}
        entries.append(entry)
    record = {"schema": "rgs-formats/2", "date": datetime.date.today().isoformat(), "renderer": "CPU, FP32",
              "device": cpu_name(), "scene": arguments.ply.name, "gaussians": n, "views": len(reference), "size": size,
              "psnr": "mean and least over views, float pictures, against the PLY", "entries": entries}
    print("| file | written by | bytes per Gaussian | PSNR | worst view |\n|---|---|---|---|---|")
    for entry in entries:
        psnr, worst = ("-" if value is None else f"{value:.1f} dB" for value in (entry["psnr_db"], entry["worst_psnr_db"]))
        print(f"| {entry['format']} | {entry['writer']} | {entry['bytes_per_gaussian']:.1f} | {psnr} | {worst} |")
    if arguments.json:
        arguments.json.write_text(text(record) + "\n")


def write_as_peers(ply, work):
    """[format, writer, path] of the files of other programs."""
    work = work.resolve()
    (work / "write_ksplat.mjs").write_text(WRITE_KSPLAT)
    files = []
    for kind, writer, name, command in PEERS:
        path = work / name
        if not path.exists():
            if command[0] == "node" and not (work / "node_modules").exists():
                run("npm", "install", "--silent", "--prefix", work, SPLATS3D)
            run(*(word.format(input=ply.resolve(), output=path, work=work) for word in command))
        files.append((kind, writer, path))
    return files


def cpu_name():
    for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()


main()
