#!/usr/bin/python3
# measure_formats.py - size and rendered quality of scenes in each format that rgs-convert writes or reads.
# SPDX-License-Identifier: Apache-2.0
"""Converts a scene, and houses and a town that rgs-make-scene makes, to each format; rgs-audit compares their pictures with the PLY's
(CPU, the test views at half size). Writes the record that docs/records keeps and, with --svg, scripts/plot_formats.py's picture of it.

  measure_formats.py [SCENE.ply CAMERAS.json] --json RECORD.json [--svg PICTURE.svg] [--bin build/release/bin] [--work FOLDER]
                     [--peers]

--peers adds files of other programs: PlayCanvas's splat-transform (compressed.ply, spz; its sog takes hours without a GPU) and
GaussianSplats3D (ksplat, at most SH degree 2), by npm, and Qualcomm's L-GSC, by git and CMake. They are made in --work once. What the
record has of other formats and programs stays in it, with its date.
"""
import argparse
import datetime
import json
import pathlib
import platform
import subprocess
import sys

import plot_formats
from interop import version
from shrink_record import text

# name, options of rgs-make-scene
SCENES = [("houses", ["--gaussians", "150k"]), ("town", ["--town", "--gaussians", "300k"])]
STEPS = (("", 0.5), (":high", 1), ("", 1.5), (":small", 2.2), ("", 3.3), (":tiny", 5.25))
# format, name of the file, options
WRITTEN = [("rgs packed", "packed.rgs", []), ("rgs direct", "direct.rgs", ["--profile", "direct"])]
WRITTEN += [(f"rgs archive{preset}, step {step}", f"step{step}.rgs", ["--profile", "archive", "--archive-step", str(step)])
            for preset, step in STEPS]
WRITTEN += [("compressed.ply", "scene.compressed.ply", [])]
WRITTEN += [(f"spz {version}", f"scene{version}.spz", ["--spz-version", str(version)]) for version in (2, 3, 4)]
WRITTEN += [("splat", "scene.splat", []), ("ksplat, level 1", "scene.ksplat", []), ("sog", "scene.sog", [])]
TRANSFORM, SPLATS3D = "@playcanvas/splat-transform", "@mkkellogg/gaussian-splats-3d"
LGSC, LGSC_COMMIT = "https://github.com/qualcomm/lite-3Dgsplat-codec.git", "a78ee6e"
# format, writer, name of the file, command
PEERS = [(kind, f"splat-transform {version(TRANSFORM)}", f"peer.{kind}",
          ["npx", "--yes", f"{TRANSFORM}@{version(TRANSFORM)}", "-q", "-w", "-g", "cpu", "{input}", "{output}"])
         for kind in ("compressed.ply", "spz")]
PEERS += [(f"ksplat, level {level}", f"GaussianSplats3D {version(SPLATS3D)}", f"peer{level}.ksplat",
           ["node", "{work}/write_ksplat.mjs", "{input}", "{output}", str(level)]) for level in range(3)]
PEERS += [(f"L-GSC, level {level}", "L-GSC 1.0", f"peer{level}.lgsc",
           ["{work}/lgsc/build/source/lgsc-api-example1", "-c", "{output}.cfg"]) for level in range(3)]
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


def measure(name, ply, cameras, made_by, arguments, before):
    """The scene's part of the record; `before` is that of an earlier record, or {}."""
    work = arguments.work / name
    work.mkdir(exist_ok=True)
    camera = json.loads(cameras.read_text())[0]
    size = f"{camera['width'] // 2}x{camera['height'] // 2}"
    files = []  # format, writer, file, what to draw for it
    for kind, file, options in WRITTEN:
        run(arguments.bin / "rgs-convert", *options, "--quiet", "--overwrite", ply, work / file)
        files.append((kind, "rgs-convert", work / file, work / file))
    n = json.loads(run(arguments.bin / "rgs-info", "--json", work / "packed.rgs"))["header"]["n_gaussians"]
    if arguments.peers:
        files += write_as_peers(ply, work)
    report = work / "audit.json"
    run(arguments.bin / "rgs-audit", ply, files[0][3], *(f"--also={drawn}" for *_, drawn in files[1:]), "--cameras", cameras,
        "--split", "test", "--size", size, "--no-attribution", "--no-distances", "--quiet", "--overwrite", "--json", report)
    audit = json.loads(report.read_text())
    scores = [audit["rendered"], *audit["also"]]
    entries = [{"format": kind, "writer": writer, "bytes": file.stat().st_size,
                "bytes_per_gaussian": round(file.stat().st_size / n, 2), "psnr_db": round(score["psnr"], 2),
                "worst_psnr_db": round(score["worst_psnr"], 2), "ssim": round(score["ssim"], 5)}
               for (kind, writer, file, _), score in zip(files, scores, strict=True)]
    maker = lambda entry: (entry["format"], entry["writer"].split()[0])  # in whatever version
    found = {maker(entry) for entry in entries}
    entries += [{"date": before["date"], **entry} for entry in before.get("entries", []) if maker(entry) not in found]
    return {"scene": name, "made_by": made_by, "date": datetime.date.today().isoformat(),
            "commit": run("git", "rev-parse", "--short=8", "HEAD").strip(), "gaussians": n, "views": audit["rendered"]["n_views"],
            "size": size, "entries": entries}


def write_as_peers(ply, work):
    """[format, writer, path, what to draw for it] of the files of other programs."""
    work, tools = work.resolve(), work.resolve().parent
    (tools / "write_ksplat.mjs").write_text(WRITE_KSPLAT)
    files = []
    for kind, writer, name, command in PEERS:
        path = drawn = work / name
        settings = [""]
        if writer.startswith("L-GSC"):
            drawn = path.with_suffix(".lgsc.ply")  # its program reads a file of settings, once to encode and once to decode
            if not (tools / "lgsc").exists():
                run("git", "clone", "--quiet", LGSC, tools / "lgsc")
                run("git", "-C", tools / "lgsc", "checkout", "--quiet", LGSC_COMMIT)
                run("cmake", "-S", tools / "lgsc", "-B", tools / "lgsc/build", "-DCMAKE_BUILD_TYPE=Release")
                run("cmake", "--build", tools / "lgsc/build")
            settings = [f"mode=0\nuncompressedDataPath={ply.resolve()}\ncompressedStreamPath={path}\ncompLevel={kind[-1]}\n",
                        f"mode=1\nreconstructedDataPath={drawn}\ncompressedStreamPath={path}\noutputBinaryPly=1\n"]
        if not drawn.exists():
            if command[0] == "node" and not (tools / "node_modules/@mkkellogg").exists():
                run("npm", "install", "--silent", "--prefix", tools, f"{SPLATS3D}@{version(SPLATS3D)}")
            for words in settings:
                if words:
                    pathlib.Path(f"{path}.cfg").write_text(words)
                run(*(word.format(input=ply.resolve(), output=path, work=tools) for word in command))
        files.append((kind, writer, path, drawn))
    return files


def cpu_name():
    for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ply", type=pathlib.Path, nargs="?")
    parser.add_argument("cameras", type=pathlib.Path, nargs="?")
    parser.add_argument("--bin", type=pathlib.Path, default=pathlib.Path("build/release/bin"))
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("build/formats"))
    parser.add_argument("--json", type=pathlib.Path, required=True)
    parser.add_argument("--svg", type=pathlib.Path)
    parser.add_argument("--peers", action="store_true")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    before = json.loads(arguments.json.read_text())["scenes"] if arguments.json.exists() else []
    scenes = [(arguments.ply.stem, arguments.ply, arguments.cameras, None)] if arguments.cameras else []
    for name, options in SCENES:
        ply, cameras = arguments.work / f"{name}.ply", arguments.work / f"{name}.json"
        run(arguments.bin / "rgs-make-scene", *options, "--cameras", cameras, "--quiet", "--overwrite", ply)
        scenes.append((name, ply, cameras, " ".join(["rgs-make-scene", *options, "--cameras", cameras.name, ply.name])))
    measured = [measure(*scene, arguments, next((old for old in before if old["scene"] == scene[0]), {})) for scene in scenes]
    kept = [old for old in before if old["scene"] not in [scene[0] for scene in scenes]]
    record = {"schema": "rgs-formats/3", "renderer": "CPU, FP32", "device": cpu_name(),
              "quality": "rgs-audit's PSNR (mean, least) and mean SSIM of views against the PLY", "scenes": kept + measured}
    arguments.json.write_text(text(record) + "\n")
    if arguments.svg:
        arguments.svg.write_text(plot_formats.svg(record))
    print(plot_formats.table(record), end="")


if __name__ == "__main__":
    main()
