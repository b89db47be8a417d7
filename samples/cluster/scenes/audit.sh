#!/bin/sh
# audit.sh - rgs-audit, which finds its earlier results again: audit.sh KEPT REPORT JSON LOG ARGUMENTS...
# Snakemake removes outputs before a job. Links to them, KEPT.html and KEPT.json, stay, and where nothing but conditions has changed
# rgs-audit draws no picture again. A condition that fails (5) is a result, which the index shows and rule all reports.
# SPDX-License-Identifier: Apache-2.0
set -eu
kept=$1 report=$2 json=$3 log=$4
shift 4

# Not every file system has links.
link() { ln -f "$1" "$2" 2>/dev/null || cp -f "$1" "$2"; }

if [ -e "$kept.html" ] && [ -e "$kept.json" ]; then
  link "$kept.html" "$report"
  link "$kept.json" "$json"
fi
status=0
rgs-audit "$@" --report "$report" --json "$json" --overwrite >"$log" 2>&1 || status=$?
[ "$status" = 0 ] || [ "$status" = 5 ] || exit "$status"
touch "$report" "$json"  # newer than the asset, also if they are as before
mkdir -p "$(dirname "$kept")"
link "$report" "$kept.html"
link "$json" "$kept.json"
