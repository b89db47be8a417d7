#!/bin/sh
# every_program.sh - in a bare root: each program on PATH does its work, in the current folder: sh every_program.sh PAGE
# PAGE is the folder of the page that rgs-view serves. SPDX-License-Identifier: Apache-2.0
set -eux
rgs-make-scene --gaussians 2k --cameras cameras.json scene.ply
rgs-convert scene.ply scene.rgs
rgs-info --verify scene.rgs
rgs-render scene.rgs --cameras cameras.json --view 0 --size 320x180 --out picture.png
test "$(head -c 4 picture.png | tail -c 3)" = PNG
rgs-render scene.rgs --cameras cameras.json --size 160x90 --format jpg --out pictures
if rgs-render scene.rgs --out picture.exr 2>refused.txt; then exit 1; fi
grep roofgs-pictures refused.txt
rgs-audit scene.ply scene.rgs --cameras cameras.json --size 160x90 --fail-below psnr=40 --report audit.html
rgs-prune scene.ply small.rgs --cameras cameras.json --size 160x90 --keep 50%
rgs-diff scene.rgs scene.rgs
rgs-judge scene.rgs --cameras cameras.json --against pictures --size 160x90
rgs-view scene.rgs --cameras cameras.json --export look.html
test -f "$1/index.html"
rgs-info --verify "$1/sample.rgs"
