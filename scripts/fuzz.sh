#!/bin/sh
# fuzz.sh - builds the libFuzzer targets and runs each one: sh scripts/fuzz.sh RUNS [NAME...]
# RUNS inputs of each target, the same ones for the same code; or, as 600s, all that ten minutes allow, from a
# corpus that grows in build/fuzz/corpus/NAME. Both start from tests/fuzz/corpus/NAME. Crashes land in build/fuzz/crashes.
# As many targets run at a time as there are processors (RGS_JOBS).
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
case ${1:-} in
  *[!0-9s]* | *s?* | s | '')
    echo "usage: sh scripts/fuzz.sh RUNS|SECONDSs [NAME...]   (rgs_fuzz_NAME; all when none is named)" >&2
    exit 2
    ;;
esac
limit=$1
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
  log=$0/$2.log limit=$1 name=$2 verdict=ok
  seeds=tests/fuzz/corpus/$name
  [ "$name" = info ] && seeds="tests/fuzz/corpus/reader tests/fuzz/corpus/levels"
  [ -d "${seeds%% *}" ] || seeds=
  case $limit in
    *s) grown=build/fuzz/corpus/$name options="-max_total_time=${limit%s} -timeout=10" ;;
    *)
      grown=build/fuzz/runs/$name options="-seed=1 -use_cmp=0 -timeout=0 -runs=$limit"
      rm -rf "$grown"
      ;;
  esac
  mkdir -p "$grown"
  # Comparisons and some loops depend on addresses: the same ones in each run, where the container allows it.
  fixed="setarch -R"
  $fixed true 2>"$log" || fixed=
  # shellcheck disable=SC2086  # lists of options and folders
  $fixed "build/fuzz/bin/rgs_fuzz_$name" $options -rss_limit_mb=0 -malloc_limit_mb=2048 -print_final_stats=1 \
    -artifact_prefix="build/fuzz/crashes/$name-" "$grown" $seeds >"$log" 2>&1 </dev/null || verdict=FAILED
  executions=$(sed -n "s/^stat::number_of_executed_units: *//p" "$log")
  echo "fuzz: $name: ${executions:-unknown} executions, $verdict"
  [ "$verdict" = ok ] || {
    tail -n 40 "$log" >&2
    exit 1
  }
' "$log_folder" "$limit" || exit 1
