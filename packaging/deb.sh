#!/bin/sh
# deb.sh - makes the Debian packages roofgs, libroofgs and libroofgs-dev: sh packaging/deb.sh [OPTION...]
# They lie in build/deb/packages. OPTIONs go to CMake, as -DRGS_ENABLE_CUDA=ON for packages that also render on NVIDIA GPUs.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
build=$PWD/build/deb
sh scripts/install-deps.sh packaging
mkdir -p "$build"
exec 3>&1
quietly() { "$@" >"$build/log" 2>&1 || { tail -n 50 "$build/log" >&3; echo "deb.sh: failed: $*" >&3; exit 1; }; }

# Libraries are where Debian has them, so nothing needs a path to them.
quietly cmake -S . -B "$build" -G Ninja -DCMAKE_BUILD_TYPE=Release -DCMAKE_INSTALL_PREFIX=/usr -DCMAKE_SKIP_INSTALL_RPATH=ON \
  -DBUILD_SHARED_LIBS=ON -DRGS_ENABLE_CUDA=OFF -DRGS_DEBIAN=ON -DRGS_MANUAL=ON \
  -DCMAKE_SHARED_LINKER_FLAGS=-Wl,-z,relro,-z,now -DCMAKE_EXE_LINKER_FLAGS=-Wl,-z,relro,-z,now "$@"
quietly cmake --build "$build" --parallel "${RGS_JOBS:-$(nproc)}"
rm -rf "$build/packages"
(cd "$build" && quietly cpack -G DEB)
lintian --fail-on error --tag-display-limit 0 "$build"/packages/*.deb
ls "$build"/packages/*.deb
