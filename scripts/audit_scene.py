#!/usr/bin/env python3
# audit_scene.py - converts a scene, audits it against its cameras and photographs, and prints the README's tables.
# SPDX-License-Identifier: Apache-2.0
"""Takes a folder with one scene, SCENE.ply or SCENE.ply.zst, cameras.json and, if there are any, photos/.

  audit_scene.py DATA/south                          # temporary files
  audit_scene.py DATA/south --out build/south        # keeps assets, reports and JSON
"""
import argparse
import datetime
import json
import pathlib
import subprocess
import sys
import tempfile

CONVERSIONS = {"default": [], "one step set for the file": ["--file-scales"]}


def unpacked(folder: pathlib.Path, out: pathlib.Path) -> pathlib.Path:
    plain, packed = sorted(folder.glob("*.ply")), sorted(folder.glob("*.ply.zst"))
    if plain:
        return plain[0]
    if not packed:
        sys.exit(f"{folder}: no .ply and no .ply.zst file")
    scene = out / packed[0].name.removesuffix(".zst")
    if not scene.exists():
        subprocess.run(["zstd", "-q", "-d", packed[0], "-o", scene], check=True)
    return scene


def processor() -> str:
    for line in pathlib.Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return "unknown processor"


def decibels(value: float | None, digits: int = 1) -> str:
    return "identical" if value is None else f"{value:.{digits}f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--bin", type=pathlib.Path, default=pathlib.Path("build/release/bin"))
    parser.add_argument("--out", type=pathlib.Path, help="folder for what is made")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rgs-audit-") as temporary:
        out = options.out or pathlib.Path(temporary)
        out.mkdir(parents=True, exist_ok=True)
        scene = unpacked(options.folder, out)
        photos = options.folder / "photos"
        results = {}
        for name, arguments in CONVERSIONS.items():
            stem = out / f"{scene.stem}-{name.replace(' ', '-')}"
            asset, result = f"{stem}.rgs", f"{stem}.json"
            subprocess.run([options.bin / "rgs-convert", "--quiet", "--overwrite", *arguments, scene, asset], check=True)
            subprocess.run([options.bin / "rgs-audit", "--quiet", "--overwrite", scene, asset, "--cameras",
                            options.folder / "cameras.json", *(["--photos", photos] if photos.is_dir() else []),
                            "--json", result, "--report", f"{stem}.html"], check=True)
            results[name] = json.loads(pathlib.Path(result).read_text(encoding="utf-8"))

    first = next(iter(results.values()))
    if any(j["rendered"]["n_rated"] == 0 for j in results.values()):
        sys.exit(f"{options.folder}: no camera shows the scene")
    views = first["rendered"]["views"]
    print(f"{scene.name}: {first['source']['gaussians']:,} Gaussians, SH degree {first['source']['sh_degree']}, {len(views)} "
          f"views of {views[0]['width']}x{views[0]['height']}; {first['tool']}, {datetime.date.today()}, "
          f"{first['rendered']['backend']}, {processor()}\n")
    with_photos = first["rendered"]["photos"] is not None
    print("| conversion | size | bytes a Gaussian | smaller | PSNR, dB | worst view | SSIM | largest, 1/255 |"
          + (" lost against photographs, dB |" if with_photos else "") + " with the fast renderer's arithmetic, dB |")
    print("|---" * (9 + with_photos) + "|")
    for name, j in results.items():
        r, size = j["rendered"], j["size"]
        together = next(row for row in r["attribution"] if row["key"] == "together")
        cells = [name, f"{size['asset_bytes'] / 1e6:.1f} MB", f"{size['bytes_per_gaussian']:.2f}", f"{size['ratio']:.2f}x",
                 decibels(r["psnr"]), decibels(r["worst_psnr"]), f"{r['ssim']:.6f}", f"{255 * r['largest']:.1f}"]
        if with_photos:
            cells.append(f"{r['photos']['loss']:.4f} (of {r['photos']['source_psnr']:.2f})")
        lost = f", {together['loss']:.4f} lost" if with_photos else ""
        cells.append(f"{decibels(together['psnr'])}{lost}")
        print("| " + " | ".join(cells) + " |")
    print("\n| step alone | PSNR, dB | share of the squared error |" + (" lost against photographs, dB |" if with_photos else ""))
    print("|---" * (3 + with_photos) + "|")
    for row in first["rendered"]["attribution"]:
        lost = f" {row['loss']:.4f} |" if with_photos else ""
        print(f"| {row['key']} | {decibels(row['psnr'])} | {100 * row['share']:.1f} % |{lost}")


if __name__ == "__main__":
    main()
