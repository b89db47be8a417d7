#!/usr/bin/python3
# round_trips.py - what a scene has lost when it comes back from each format: python3 scripts/round_trips.py [--bin FOLDER] [--work FOLDER]
#
# Prints the table that docs/records/FORMATS.md keeps. A house of rgs-make-scene goes to each format and back to a PLY; the same house
# with levels, an origin, a coordinate reference system and anti-aliasing goes there and back to an .rgs.
# SPDX-License-Identifier: Apache-2.0
import argparse
import datetime
import json
from pathlib import Path

import numpy as np

from interop import differences, nearest, read_ply, shaped
from measure_formats import WRITTEN, cpu_name, run

FORMATS = [("ply", "scene.back.ply", []), *((kind, f"scene.{kind}", []) for kind in ("glb", "spz.glb", "usda", "usdz", "npz", "rad")),
           *((kind, name, options) for kind, name, options in WRITTEN if "step" not in kind),
           *((f"rgs archive{preset}", f"archive{preset[1:]}.rgs", ["--profile", f"archive{preset}"]) for preset in (":high", ":small", ":tiny")),
           ("tileset.json", "tiles/tileset.json", []), ("lod-meta.json", "streamed/lod-meta.json", [])]
DECLARED = ["--crs", "EPSG:4978", "--translate", "4000000,500000,4700000", "--aa", "mip", "--low-pass", "0.2"]


def number(value):
    return "0" if value == 0 else f"{value:.1g}" if value < 1e-3 else f"{value:.2g}"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--bin", type=Path, default=Path("build/release/bin"))
    parser.add_argument("--work", type=Path, default=Path("build/round-trips"))
    arguments = parser.parse_args()
    work = arguments.work
    work.mkdir(parents=True, exist_ok=True)
    make = ["--gaussians", "20k", "--cameras", work / "cameras.json", work / "scene.ply"]
    run(arguments.bin / "rgs-make-scene", "--quiet", "--overwrite", *make)
    convert = lambda *words: run(arguments.bin / "rgs-convert", "--quiet", "--overwrite", *words)
    info = lambda path: json.loads(run(arguments.bin / "rgs-info", "--json", path))
    convert(*DECLARED, "--keep-order", work / "scene.ply", work / "declared.ply")
    for name in ("scene", "declared"):
        convert("--lod", work / f"{name}.ply", work / f"{name}.levels.rgs")
    scene = read_ply(work / "scene.ply")
    rows, backs = [], []
    for kind, name, options in FORMATS:
        streamed, is_rgs, path = kind == "lod-meta.json", kind.startswith("rgs"), work / name
        back = work / f"{name.replace('/', '.')}.ply"
        there = {}
        for words in [], [] if streamed else ["--keep-permutation" if is_rgs else "--keep-order"]:
            convert(*options, *words, work / ("scene.levels.rgs" if streamed else "scene.ply"), path)
            convert("--keep-order", path, back)
            there[len(words)] = read_ply(back)
        in_order = [n for n, cloud in sorted(there.items()) if np.median(np.abs(cloud["mean"] - scene["mean"])) < 0.5]
        order = {0: "kept", 1: "an option"}[in_order[0]] if in_order else "lost"
        there = there[1 if is_rgs else 0]  # Gaussians of an .rgs are the same
        if order != "kept" and not is_rgs:
            key = lambda cloud: np.concatenate([cloud["mean"], cloud["scale"], cloud["opacity"][:, None], cloud["sh"][:, 0]], 1)
            taken = nearest(key(scene), key(there))
            there = {name: values[taken] for name, values in there.items()}
            convert(*options, work / ("scene.levels.rgs" if streamed else "scene.ply"), path)
            convert("--keep-order", path, back)
        backs.append(back)
        # What a file states.
        file = work / "declared.rgs"
        source = work / ("declared.levels.rgs" if streamed else "declared.ply")
        written = json.loads(convert("--json", *(["--lod"] if is_rgs else []), *options, source, file if is_rgs else path))
        if not is_rgs:
            convert("--allow-rounding", path, file)
        stated = info(file)
        lost = [] if stated["header"]["sh_degree"] == 3 else [f"SH above degree {stated['header']['sh_degree']}"]
        lost += [] if "levels" in stated else ["levels"]
        lost += ["origin"] if written["position_rounding"] > 1e-3 else []
        lost += [] if stated["declarations"].get("crs") else ["CRS"]
        lost += [] if stated["declarations"]["aa_mode"] == "mip_splatting" else ["anti-aliasing"]
        lost += [] if stated["declarations"].get("low_pass_px2") == 0.2 else ["low-pass"]
        apart = differences(scene, there) | {"shape": np.abs(shaped(scene)["scale"] - shaped(there)["scale"])}
        if "archive" in kind:  # which may name axes otherwise
            apart["scale"] = np.abs(np.sort(scene["scale"], 1) - np.sort(there["scale"], 1))
            del apart["rotation"]
        rest = [apart[f"sh{degree}"] for degree in (1, 2, 3) if f"sh{degree}" in apart]
        if rest:
            apart["rest"] = np.concatenate(rest, 1)
        columns = [apart.get(name) for name in ("mean", "scale", "rotation", "shape", "opacity", "sh0", "rest")]
        rows.append([kind, ", ".join(lost), order, *("" if c is None else f"{number(c.mean())}, {number(c.max())}" for c in columns)])
    report = work / "audit.json"
    run(arguments.bin / "rgs-audit", work / "scene.ply", backs[0], *(f"--also={back}" for back in backs[1:]), "--cameras", work / "cameras.json",
        "--size", "640x360", "--no-attribution", "--no-distances", "--quiet", "--overwrite", "--json", report)
    audit = json.loads(report.read_text())
    for row, score in zip(rows, [audit["rendered"], *audit["also"]], strict=True):
        row.append("same" if score["psnr"] is None else f"{score['psnr']:.1f}, {score['worst_psnr']:.1f}")
    print(f"{datetime.date.today().isoformat()}, {run('git', 'rev-parse', '--short=8', 'HEAD').strip()}, {cpu_name()}: `rgs-make-scene "
          f"{' '.join(map(str, make[:2]))}`, {audit['rendered']['n_views']} views at 640x360\n")
    print("| format | lost | order | mean | log-scale | rotation | shape | opacity | SH 0 | SH 1 to 3 | dB, worst |\n" + "|---" * 11 + "|")
    print("\n".join("| " + " | ".join(row) + " |" for row in rows))


if __name__ == "__main__":
    main()
