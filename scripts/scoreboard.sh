#!/bin/sh
# scoreboard.sh - draws scenes by web clients and writes how far they are from the image's definition, and why, to
# docs/records/scoreboard.json and scoreboard.html: sh scripts/scoreboard.sh [DATA]. DATA, or RGS_DATA_DIR, is a folder with
# south/south.ply.zst and south/cameras.json, which are drawn too.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
preset=scoreboard
. scripts/quiet.sh

data=${1:-${RGS_DATA_DIR:-}}
[ -z "$data" ] || data=$(realpath "$data")
quiet packages sh scripts/install-deps.sh web
quiet configure cmake --preset release
quiet programs cmake --build build/release --parallel "$jobs" --target rgs-convert rgs-judge rgs-make-scene
quiet page sh scripts/build_page.sh
. scripts/node.sh

export RGS_WEB_PROGRAMS="$PWD/build/release/bin"
node web/clients/scoreboard.mjs ${data:+--data "$data"}
python3 scripts/shrink_record.py docs/records/scoreboard.json
