#!/bin/sh
# test.sh - installs, configures, builds and runs every test: sh scripts/test.sh [PRESET]
# PRESET (or RGS_PRESET) is release by default; dev runs under AddressSanitizer and UBSan, tsan under ThreadSanitizer.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
preset=${1:-${RGS_PRESET:-release}}
. scripts/quiet.sh

quiet packages sh scripts/install-deps.sh
quiet configure cmake --preset "$preset"
quiet build cmake --build "build/$preset" --parallel "$jobs"
# The sanitizer's memory map needs the classic address layout; Linux 6 randomises more bits than gcc 12's expects.
test_command="ctest --preset $preset --parallel $jobs"
[ "$preset" = tsan ] && test_command="setarch $(uname -m) --addr-no-randomize $test_command"
# shellcheck disable=SC2086  # a list of words
quiet test $test_command
grep -E '^[0-9]+% tests passed' "$log_folder/test.log"
