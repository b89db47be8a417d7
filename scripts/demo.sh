#!/bin/sh
# demo.sh - installs what is needed, builds, and takes a synthetic scene through the programs into build/demo.
# RGS_DEMO_GAUSSIANS sets the scene's size.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
preset=release
. scripts/quiet.sh

quiet packages sh scripts/install-deps.sh
quiet configure cmake --preset "$preset"
quiet build cmake --build "build/$preset" --parallel "$jobs" \
  --target rgs-make-scene rgs-convert rgs-info rgs-audit rgs-render rgs-view
quiet page sh scripts/build_page.sh

bin=build/$preset/bin
out=build/demo
preset=demo
log_folder=$out/logs
mkdir -p "$log_folder"
quiet make-scene "$bin/rgs-make-scene" --overwrite --seed 1 --gaussians "${RGS_DEMO_GAUSSIANS:-200000}" --degree 3 \
  --cameras "$out/cameras.json" "$out/scene.ply"
# The sky is 300 m away, and too few Gaussians for the range that --cameras finds.
quiet convert "$bin/rgs-convert" --overwrite --cameras "$out/cameras.json" --far 400 "$out/scene.ply" "$out/scene.rgs"
quiet info "$bin/rgs-info" --verify "$out/scene.rgs"
quiet render "$bin/rgs-render" --overwrite --cameras "$out/cameras.json" --view 0 --size 960x540 \
  --out "$out/picture.png" "$out/scene.rgs"
quiet audit "$bin/rgs-audit" --overwrite --cameras "$out/cameras.json" --size 960x540 --report "$out/audit.html" \
  "$out/scene.ply" "$out/scene.rgs"
quiet look "$bin/rgs-view" --overwrite --cameras "$out/cameras.json" --export "$out/look.html" "$out/scene.rgs"
cat "$log_folder/info.log"
ls -l "$out/scene.ply" "$out/scene.rgs" "$out/picture.png" "$out/look.html" | awk '{ print $NF ": " $5 " bytes" }'
tail -n 2 "$log_folder/audit.log" # the verdict, and where the report is
cat <<END

Open $out/look.html and $out/audit.html in a browser. Then try:
  $bin/rgs-view $out/scene.rgs --cameras $out/cameras.json
  $bin/rgs-view $out/scene.ply $out/scene.rgs --cameras $out/cameras.json
  $bin/rgs-convert --overwrite --profile archive:high $out/scene.ply $out/small.rgs
  $bin/rgs-convert --help
END
