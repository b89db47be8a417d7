#!/bin/sh
# run.sh - samples/cluster on this machine, on a real Slurm, and the commands of docs/user/CLUSTER.md:
#   sh tests/cluster/run.sh [CTEST-ARGUMENTS...]
# Installs Snakemake, Slurm and GNU parallel (300 MB) unless RGS_SKIP_INSTALL=1; a test whose programs are missing is skipped, or with
# RGS_REQUIRE_TOOLS=1 fails. The programs under test are in RGS_BIN; without it build/release is built as far as needed.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/../.."

packages="snakemake slurm-wlm munge parallel"
if [ "${RGS_SKIP_INSTALL:-0}" != 1 ]; then
  missing=
  for package in $packages; do
    [ "$(dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || missing="$missing $package"
  done
  if [ -n "$missing" ]; then
    sudo=
    [ "$(id -u)" = 0 ] || sudo=sudo
    echo "installing packages:$missing"
    $sudo apt-get -q update >/dev/null
    # RUNLEVEL=1: Debian's own daemons are not started.
    # shellcheck disable=SC2086  # a list of words
    $sudo env RUNLEVEL=1 DEBIAN_FRONTEND=noninteractive apt-get -q -y install --no-install-recommends $missing \
      >/dev/null </dev/null
  fi
fi

if [ -z "${RGS_BIN:-}" ]; then
  [ -e build/release/CMakeCache.txt ] || cmake --preset release >/dev/null
  cmake --build build/release --parallel "${RGS_JOBS:-$(nproc)}" --target rgs-convert rgs-audit rgs-make-scene
  RGS_BIN=$PWD/build/release/bin
fi
export RGS_BIN
cmake -S tests/cluster -B build/cluster >/dev/null
status=0
ctest --test-dir build/cluster --no-tests=error --output-on-failure --parallel "${RGS_JOBS:-$(nproc)}" "$@" || status=$?
grep -a '^skipped: ' build/cluster/Testing/Temporary/LastTest.log | sort | uniq -c || :
exit "$status"
