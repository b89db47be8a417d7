#!/bin/sh
# deb.sh - makes the Debian packages roofgs, roofgs-pictures, libroofgs, libroofgs-dev and python3-roofgs: sh packaging/deb.sh [OPTION...]
# They are written to build/deb/packages. OPTIONs go to CMake, as -DRGS_ENABLE_CUDA=ON for packages that also render on NVIDIA GPUs.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
build=$PWD/build/deb
sh scripts/install-deps.sh packaging
mkdir -p "$build"
exec 3>&1
quietly() { "$@" >"$build/log" 2>&1 || { tail -n 50 "$build/log" >&3; echo "deb.sh: failed: $*" >&3; exit 1; }; }

# make FOLDER TARGET OPTION...: configures, builds and packs. Libraries are in Debian's folders, so no run paths are needed.
make() {
  folder=$1 target=$2
  shift 2
  quietly cmake -S . -B "$folder" -G Ninja -DCMAKE_BUILD_TYPE=Release -DCMAKE_INSTALL_PREFIX=/usr -DCMAKE_SKIP_INSTALL_RPATH=ON \
    -DRGS_ENABLE_CUDA=OFF -DRGS_DEBIAN=ON -DRGS_BUILD_TESTS=OFF \
    "-DCMAKE_SHARED_LINKER_FLAGS=$hardened" "-DCMAKE_MODULE_LINKER_FLAGS=$hardened" "-DCMAKE_EXE_LINKER_FLAGS=$hardened" "$@"
  quietly cmake --build "$folder" --parallel "${RGS_JOBS:-$(nproc)}" --target "$target"
  (cd "$folder" && rm -rf packages && quietly cpack -G DEB)
}
quietly sh scripts/build_page.sh
hardened=-Wl,-z,relro,-z,now
make "$build" all -DBUILD_SHARED_LIBS=ON -DRGS_MANUAL=ON "$@"
# The module links the libraries statically.
make "$build-python" rgs_python_package -DRGS_BUILD_PYTHON=ON -DRGS_BUILD_SAMPLES=OFF "$@"
mv "$build-python"/packages/*.deb "$build/packages/"
lintian --fail-on error --tag-display-limit 0 "$build"/packages/*.deb
ls "$build"/packages/*.deb
