#!/bin/sh
# bench_synthetic.sh - measures the GPU renderer on generated scenes of several sizes, a JSON file each:
#   sh scripts/bench_synthetic.sh BIN OUT        BIN: folder of the programs, build/cuda/bin or that of a bundle
# Environment: RGS_GAUSSIANS "100k 1M 5M 20M", RGS_SIZES 1280x720,1920x1080,3840x2160,7680x4320, RGS_FRAMES 10 a camera,
# RGS_SECONDS 330 for all: what is left by then is named and skipped. OUT needs 6.5 GB for 20 M.
# Then: scripts/bench_tables.py --scaling OUT/synthetic_*.json
# SPDX-License-Identifier: Apache-2.0
set -eu
if [ $# -ne 2 ]; then
  sed -n '2,6s/^# //p' "$0" >&2
  exit 2
fi
bin=$1 out=$2
sizes=${RGS_SIZES:-1280x720,1920x1080,3840x2160,7680x4320}
frames=${RGS_FRAMES:-10}
end=$(($(date +%s) + ${RGS_SECONDS:-330}))
mkdir -p "$out"
trap 'rm -f "$out/scene.ply" "$out/scene.rgs"' EXIT

left() { echo $((end - $(date +%s))); }
# timed COMMAND...: within the time left; timeout's status when that is over
timed() {
  [ "$(left)" -gt 0 ] || return 124
  timeout "$(left)" "$@"
}
# bench SIZES JSON
bench() {
  timed "$bin/rgs-bench" "$out/scene.rgs" --cameras "$out/cameras.json" --size "$1" --mode baseline,paper,turbo \
    --frames "$frames" --json "$2" --overwrite
}

failed=0
for gaussians in ${RGS_GAUSSIANS:-100k 1M 5M 20M}; do
  json=$out/synthetic_$gaussians.json
  echo "$gaussians Gaussians, $(left) s left"
  status=0
  timed "$bin/rgs-make-scene" --gaussians "$gaussians" --degree 3 --cameras "$out/cameras.json" --no-sync --overwrite \
    --quiet "$out/scene.ply" &&
    timed "$bin/rgs-convert" --quiet --overwrite --no-sync --profile direct --cameras "$out/cameras.json" \
      "$out/scene.ply" "$out/scene.rgs" || status=$?
  rm -f "$out/scene.ply"
  if [ "$status" -eq 0 ]; then
    bench "$sizes" "$json" || status=$?
    # The largest image may need more (tile, Gaussian) pairs or memory than the device has: measure the others.
    if [ "$status" -ne 0 ] && [ "$status" -ne 124 ] && [ "$sizes" != "${sizes%,*}" ]; then
      echo "skipped: $gaussians at ${sizes##*,}"
      status=0
      bench "${sizes%,*}" "$json" || status=$?
    fi
  fi
  if [ "$status" -eq 124 ]; then
    echo "skipped: $gaussians, out of time"
    failed=1
  elif [ "$status" -ne 0 ]; then
    echo "skipped: $gaussians, exit code $status"
    failed=1
  fi
done
exit "$failed"
