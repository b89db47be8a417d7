#!/bin/sh
# fuzz.sh - builds the libFuzzer targets and runs each one: sh scripts/fuzz.sh SECONDS [NAME...]
# As many run at a time as there are processors (RGS_JOBS). Starts from tests/fuzz/corpus/NAME; what it finds grows in
# build/fuzz/corpus/NAME, crashes in build/fuzz/crashes.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
case ${1:-} in
  '' | *[!0-9]*)
    echo "usage: sh scripts/fuzz.sh SECONDS [NAME...]   (rgs_fuzz_NAME; all when none is named)" >&2
    exit 2
    ;;
esac
seconds=$1
shift
preset=fuzz
. scripts/quiet.sh

quiet packages sh scripts/install-deps.sh
quiet configure cmake --preset "$preset"
quiet build cmake --build "build/$preset" --parallel "$jobs" --target rgs_fuzzers

[ $# -gt 0 ] || set -- $(ls build/fuzz/bin | sed -n 's/^rgs_fuzz_//p')
if [ $# = 0 ]; then
  echo "fuzz: no rgs_fuzz_* target was built" >&2
  exit 1
fi
mkdir -p build/fuzz/crashes
printf '%s\n' "$@" | xargs -P "$jobs" -n 1 sh -c '
  log=$0/$2.log seconds=$1 name=$2
  grown=build/fuzz/corpus/$name
  mkdir -p "$grown"
  corpus=$grown
  seeds=$name
  [ "$name" = info ] && seeds=reader # the same files
  [ -d "tests/fuzz/corpus/$seeds" ] && corpus="$grown tests/fuzz/corpus/$seeds"
  verdict=ok
  # shellcheck disable=SC2086  # a list of folders
  "build/fuzz/bin/rgs_fuzz_$name" -max_total_time="$seconds" -timeout=10 -rss_limit_mb=2048 -print_final_stats=1 \
    -artifact_prefix="build/fuzz/crashes/$name-" $corpus >"$log" 2>&1 </dev/null || verdict=FAILED
  executions=$(sed -n "s/^stat::number_of_executed_units: *//p" "$log")
  echo "fuzz: $name: ${executions:-unknown} executions, $verdict"
  [ "$verdict" = ok ] || {
    tail -n 40 "$log" >&2
    exit 1
  }
' "$log_folder" "$seconds" || exit 1
