#!/bin/sh
# test.sh - makes each package and uses it in a bare root: sh packaging/test.sh [STEP...]
# Steps: deb. Needs root for the bare roots; some minutes and a gigabyte in build/roots the first time.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
sh scripts/install-deps.sh packaging
mkdir -p build/packaging
steps=${*:-deb}
failed=

# step NAME COMMAND...: its log is build/packaging/NAME.log.
step() {
  name=$1 log=build/packaging/$1.log began=$(date +%s) status=0
  shift
  "$@" >"$log" 2>&1 </dev/null || status=$?
  case $status in
    0) echo "$name: ok, $(($(date +%s) - began)) s" ;;
    77) grep '^skipped: ' "$log" ;;
    *)
      tail -n 40 "$log"
      echo "$name: FAILED with status $status"
      failed="$failed $name"
      ;;
  esac
}

deb() {
  step deb sh packaging/deb.sh
  step deb-manual env PYTHONPATH=tests/support /usr/bin/python3 tests/packaging/completions_test.py build/deb/manual
  step deb-programs sh packaging/bare_root.sh sh /project/tests/packaging/programs.sh
  step deb-development sh packaging/bare_root.sh --packages "g++ cmake ninja-build pkgconf" \
    sh /project/tests/packaging/development.sh
}

for each in $steps; do $each; done
[ -z "$failed" ] || { echo "failed:$failed"; exit 1; }
