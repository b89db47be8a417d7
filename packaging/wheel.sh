#!/bin/sh
# wheel.sh - makes the wheel of the Python module, one for Python 3.9 and all later ones: sh packaging/wheel.sh [--cuda] [-DNAME=VALUE...]
# It is written to build/wheels. --cuda: with kernels and CUDA's runtime; it renders on the CPU where there is no driver. -D options go to
# CMake, as -DCMAKE_CUDA_ARCHITECTURES=90 for kernels that build faster and run only on Hopper.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
cuda=OFF local=
case ${1:-} in
  --cuda) cuda=ON local=+cuda; shift ;;
  -D* | "") ;;
  *) sed -n '2,4s/^# //p' "$0" >&2; exit 2 ;;
esac
sh scripts/install-deps.sh packaging
build=build/wheel$local
mkdir -p "$build"
quietly() { "$@" >"$build/log" 2>&1 </dev/null || { tail -n 50 "$build/log" >&2; echo "wheel.sh: failed: $*" >&2; exit 1; }; }
quietly sh scripts/build_page.sh
version=$(/usr/bin/python3 -c 'import sys; sys.path.insert(0, "packaging"); import make_wheel; print(make_wheel.source_version())')
quietly /usr/bin/python3 packaging/make_wheel.py --bundle "$build" build/wheels "$version$local" -G Ninja -DRGS_ENABLE_CUDA=$cuda "$@"
wheel=$(tail -n 1 "$build/log")
/usr/bin/python3 packaging/check_wheel.py "$wheel"
ls -l "$wheel" | awk '{ print $NF ": " $5 " bytes" }'
