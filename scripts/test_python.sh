#!/bin/sh
# test_python.sh - installs what the Python module needs, builds it and runs its tests: sh scripts/test_python.sh [CTEST-ARGUMENTS...]
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
preset=python
. scripts/quiet.sh

quiet packages sh scripts/install-deps.sh python
quiet configure cmake --preset python
quiet build cmake --build build/python --parallel "$jobs"
quiet test ctest --preset python --parallel "$jobs" "$@"
grep -E '^[0-9]+% tests passed' "$log_folder/test.log"
# Cases that could not run, and why.
grep -a '^skipped: ' build/python/Testing/Temporary/LastTest.log | sort | uniq -c || :
