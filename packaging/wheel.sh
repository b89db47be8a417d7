#!/bin/sh
# wheel.sh - makes a wheel of the Python module: sh packaging/wheel.sh [--cuda] [--python PYTHON] [-DNAME=VALUE...]
# It is written to build/wheels. --cuda: with kernels and CUDA's runtime; it renders on the CPU where there is no driver. PYTHON is Debian's
# by default; any other with headers works. -D options go to CMake, as -DCMAKE_CUDA_ARCHITECTURES=90 for kernels that build faster and run
# only on Hopper.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
cuda=OFF python=/usr/bin/python3 local=
while [ $# -gt 0 ]; do
  case $1 in
    --cuda) cuda=ON local=+cuda; shift ;;
    --python) python=$2; shift 2 ;;
    -D*) break ;;
    *) sed -n '2,5s/^# //p' "$0" >&2; exit 2 ;;
  esac
done
sh scripts/install-deps.sh packaging
build=$PWD/build/wheel$local-$("$python" -c 'import sys; print("cp%d%d" % sys.version_info[:2])')
mkdir -p "$build"
quietly() { "$@" >"$build/log" 2>&1 </dev/null || { tail -n 50 "$build/log" >&2; echo "wheel.sh: failed: $*" >&2; exit 1; }; }
quietly cmake -S . -B "$build" -G Ninja -DCMAKE_BUILD_TYPE=Release -DRGS_ENABLE_CUDA=$cuda -DRGS_BUILD_PYTHON=ON \
  -DRGS_PYTHON="$python" -DRGS_BUILD_TESTS=OFF -DRGS_BUILD_SAMPLES=OFF "$@"
quietly cmake --build "$build" --parallel "${RGS_JOBS:-$(nproc)}" \
  --target rgs_python_package rgs-audit rgs-convert rgs-prune
quietly sh scripts/build_page.sh
version=$(sed -n 's/^CMAKE_PROJECT_VERSION:STATIC=//p' "$build/CMakeCache.txt")
wheel=$(/usr/bin/python3 packaging/make_wheel.py "$build" build/wheels "$version$local")
/usr/bin/python3 packaging/check_wheel.py "$wheel"
ls -l "$wheel" | awk '{ print $NF ": " $5 " bytes" }'
