#!/bin/sh
# test.sh - installs, configures, builds and runs every test: sh scripts/test.sh [PRESET [CTEST-ARGUMENTS...]]
# PRESET (or RGS_PRESET) is release by default; dev runs under AddressSanitizer and UBSan, tsan under ThreadSanitizer.
# RGS_TARGETS names the targets to build, all by default: CTEST-ARGUMENTS should then choose their tests.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
preset=${1:-${RGS_PRESET:-release}}
[ $# = 0 ] || shift
[ $# != 0 ] || set -- -LE '^growth$' # under valgrind: sh scripts/test.sh release -L growth
. scripts/quiet.sh

quiet packages sh scripts/install-deps.sh test
quiet configure cmake --preset "$preset"
# shellcheck disable=SC2086  # a list of targets
quiet build cmake --build "build/$preset" --parallel "$jobs" ${RGS_TARGETS:+--target $RGS_TARGETS}
# One more than processors: many tests wait for disks and programs.
set -- ctest --preset "$preset" --parallel "$((jobs + 1))" "$@"
# ThreadSanitizer of gcc 12 and clang 14 needs fewer random address bits than Linux 6 uses.
[ "$preset" != tsan ] || set -- setarch "$(uname -m)" --addr-no-randomize "$@"
# What the first failed tests said and the counts, also where the end of the log holds neither.
counts='^[0-9]+% tests passed'
failures() {
  awk '/^ *[0-9]+\/[0-9]+ Test +#/ || /^ +Start +[0-9]+: / || /^[0-9]+% tests passed/ {
         left = /\*\*\*/ && !/\*\*\*Skipped/ && failed++ < 4 ? 30 : 0
       }
       left-- > 0' "$log_folder/test.log"
  tail -n "${RGS_TAIL:-60}" "$log_folder/test.log" | grep -qE "$counts" || grep -E "$counts" "$log_folder/test.log" || :
}
trap failures EXIT
rm -f "$log_folder/test.log"
quiet test "$@"
trap - EXIT
grep -E "$counts" "$log_folder/test.log" || echo "$preset: no test matches"
# Which tests were skipped (.ci/run counts these lines), and why.
if grep -E '^\s*[0-9]+ - .* \(Skipped\)$' "$log_folder/test.log"; then
  grep -a '^skipped: ' "build/$preset/Testing/Temporary/LastTest.log" | sort | uniq -c
fi
