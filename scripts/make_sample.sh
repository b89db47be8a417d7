#!/bin/sh
# make_sample.sh - writes the scene that the viewer's page offers where it has nothing to show:
#   sh scripts/make_sample.sh PROGRAMS FILE
# PROGRAMS is the folder of rgs-make-scene and rgs-convert, FILE is sample.rgs beside the page.
# SPDX-License-Identifier: Apache-2.0
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# The file states the name of its source.
"$1/rgs-make-scene" --quiet --gaussians 200k --degree 2 "$folder/sample.ply"
"$1/rgs-convert" --quiet --overwrite --profile archive:small "$folder/sample.ply" "$2"
