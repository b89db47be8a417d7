#!/bin/sh
# test_web.sh - installs, builds and tests what is in web/: sh scripts/test_web.sh [NODE-TEST-ARGUMENTS...], for instance
# `sh scripts/test_web.sh --test-name-pattern=golden`.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
preset=web
. scripts/quiet.sh

quiet packages sh scripts/install-deps.sh web
quiet configure cmake --preset release
quiet programs cmake --build build/release --parallel "$jobs" --target rgs_dump_file rgs_dump_image_metrics rgs_first_view rgs_mutate_files rgs-convert rgs-judge rgs-make-scene rgs-render rgs-view
# Files that take several requests and many frames.
scene() (
  mkdir -p build/web/scenes && cd build/web/scenes || exit
  ../../release/bin/rgs-make-scene --overwrite --seed 1 --gaussians 60k --degree 3 --cameras cameras.json scene.ply &&
    ../../release/bin/rgs-convert --overwrite scene.ply packed.rgs &&
    ../../release/bin/rgs-convert --overwrite --profile archive:small scene.ply low.rgs &&
    ../../release/bin/rgs-convert --overwrite --profile direct scene.ply direct.rgs &&
    ../../release/bin/rgs-convert --overwrite --lod scene.ply levels.rgs &&
    ../../release/bin/rgs-make-scene --overwrite --seed 1 --gaussians 800k --degree 0 wide.ply &&
    ../../release/bin/rgs-convert --overwrite --lod wide.ply wide.rgs && rm wide.ply
)
{ [ -f build/web/scenes/wide.rgs ] && [ build/web/scenes/levels.rgs -nt build/release/bin/rgs-convert ]; } || quiet scenes scene
quiet page sh scripts/build_page.sh
. scripts/node.sh

# A trained scene, where RGS_DATA_DIR names the test data.
[ -z "${RGS_DATA_DIR:-}" ] || RGS_DATA_DIR=$(realpath "$RGS_DATA_DIR")
south=${RGS_DATA_DIR:-}/south/south.ply.zst
trained() {
  zstd -q -d -f "$south" -o build/web/south.ply && build/release/bin/rgs-convert --overwrite build/web/south.ply build/web/south.rgs &&
    build/release/bin/rgs-convert --overwrite --lod build/web/south.ply build/web/south-levels.rgs && rm build/web/south.ply
}
if [ -f "$south" ]; then
  export RGS_WEB_SOUTH="$PWD/build/web/south.rgs"
  [ build/web/south-levels.rgs -nt build/release/bin/rgs-convert ] || quiet trained trained
fi

export RGS_DUMP_FILE="$PWD/build/release/bin/rgs_dump_file" RGS_WEB_SCENES="$PWD/build/web/scenes" RGS_WEB_PROGRAMS="$PWD/build/release/bin"
report=build/web/test.tap
status=0
# One file at a time: browsers draw in software, on all cores.
(cd web && exec node --test --test-concurrency=1 --test-timeout=3600000 --test-reporter=tap "$@" */test/*.test.mjs) >"$report" 2>&1 </dev/null || status=$?
# In the words of ctest, which .ci/run counts.
awk '
  /^ *# Subtest: /  { next }
  /^ *ok [0-9]+ .*# SKIP/ { match($0, /# SKIP.*/); why = substr($0, RSTART + 7); sub(/ *# SKIP.*/, ""); sub(/^ *ok [0-9]+ - /, "");
                          printf "  %d - web: %s (Skipped)\nskipped: %s\n", ++n, $0, why }
  /^# pass [0-9]+/    { passed = $3 }
  /^# fail [0-9]+/    { failed = $3 }
  /^# cancelled [0-9]+/ { failed += $3 }
  /^# skipped [0-9]+/ { skipped = $3 }
  END { total = passed + failed + skipped
        printf "%d%% tests passed, %d tests failed out of %d\n", total ? 100 * (total - failed) / total : 0, failed, total }
' "$report" >build/web/summary.txt
[ "$status" = 0 ] || grep -vE '^ *(duration_ms|type|\.\.\.|---)' "$report" | tail -n "${RGS_TAIL:-120}"
cat build/web/summary.txt
exit "$status"
