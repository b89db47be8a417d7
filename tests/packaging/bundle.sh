#!/bin/sh
# bundle.sh - in a bare root: the bundle's programs run from wherever the archive is unpacked. SPDX-License-Identifier: Apache-2.0
set -eux
mkdir /opt/moved
tar -C /opt/moved -xf /project/build/packaging/roofgs.tar.gz
cd /tmp
bin=/opt/moved/roofgs/bin
# Only libc comes from the system, also for indirect dependencies.
for program in "$bin"/*; do
  if ldd "$program" | grep '=>' | grep -v '=> /opt/moved/' | grep -vE '^\s*(libc|libm|libdl|librt|libpthread|libresolv|libmvec|libanl|libnsl|libutil)\.so'; then
    exit 1
  fi
done
"$bin/rgs-make-scene" --gaussians 2k --cameras cameras.json scene.ply
"$bin/rgs-convert" scene.ply scene.rgs
"$bin/rgs-info" --verify scene.rgs
"$bin/rgs-render" scene.rgs --cameras cameras.json --view 0 --size 320x180 --out picture.png
test "$(head -c 4 picture.png | tail -c 3)" = PNG
"$bin/rgs-render" scene.rgs --cameras cameras.json --size 160x90 --format jpg --out pictures
if "$bin/rgs-render" scene.rgs --out picture.exr 2>refused.txt; then exit 1; fi
grep roofgs-pictures refused.txt
"$bin/rgs-audit" scene.ply scene.rgs --cameras cameras.json --size 160x90 --fail-below psnr=40 --report audit.html
"$bin/rgs-prune" scene.ply small.rgs --cameras cameras.json --size 160x90 --keep 50%
"$bin/rgs-diff" scene.rgs scene.rgs
"$bin/rgs-judge" scene.rgs --cameras cameras.json --against pictures --size 160x90
"$bin/rgs-view" scene.rgs --cameras cameras.json --export look.html
test -f "$bin/../share/roofgs/viewer/index.html"
"$bin/rgs-info" --verify "$bin/../share/roofgs/viewer/sample.rgs"
