#!/bin/sh
# test.sh - makes each package and uses it in a bare root: sh packaging/test.sh [STEP...]
# Steps: deb libraries bundle wheel arm64 windows. Bare roots need root's rights, and a gigabyte in build/roots.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
sh scripts/install-deps.sh packaging
mkdir -p build/packaging
steps=${*:-deb libraries bundle wheel arm64 windows}
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

libraries() {
  for build in libraries libraries-small; do
    [ $build = libraries ] && options= || options=-DRGS_BUILD_RUNTIME=OFF
    # shellcheck disable=SC2086  # a list of options
    step $build-build sh -c '
      cmake -S . -G Ninja -DCMAKE_BUILD_TYPE=Release -DRGS_ENABLE_CUDA=OFF -DBUILD_SHARED_LIBS=ON -DRGS_PROGRAMS=OFF "$@" &&
        cmake --build "$2" --parallel "${RGS_JOBS:-$(nproc)}"' sh -B build/$build $options
  done
  step libraries-needed /usr/bin/python3 tests/packaging/needed_test.py build/libraries/lib
  step libraries-small-needed /usr/bin/python3 tests/packaging/needed_test.py build/libraries-small/lib --without-runtime
  step libraries-bare sh packaging/bare_root.sh --packages "g++ cmake ninja-build pkgconf libexpected-dev libxxhash-dev
    libzstd-dev libhwy-dev libglm-dev nlohmann-json3-dev zlib1g-dev libwebp-dev libzip-dev" sh /project/tests/packaging/libraries.sh
}

bundle() {
  rm -f build/packaging/roofgs.tar.gz
  step bundle-build sh -c '
    cmake -S . -B build/shared -G Ninja -DCMAKE_BUILD_TYPE=Release -DRGS_ENABLE_CUDA=OFF -DBUILD_SHARED_LIBS=ON &&
    cmake --build build/shared --parallel "${RGS_JOBS:-$(nproc)}" \
      --target rgs-audit rgs-convert rgs-diff rgs-info rgs-judge rgs-make-scene rgs-prune rgs-render rgs-view &&
    sh scripts/build_page.sh && sh scripts/bundle.sh build/shared build/packaging/roofgs.tar.gz'
  # The distribution of the build, and a newer one.
  for release in bookworm trixie; do
    step bundle-$release sh packaging/bare_root.sh --release $release --offline sh /project/tests/packaging/bundle.sh
  done
}

# RGS_WHEEL=--cuda: with kernels.
wheel() {
  rm -rf build/wheels
  step wheel-build sh packaging/wheel.sh ${RGS_WHEEL:-}
  # One wheel for the Python and NumPy of the build's distribution, and of a newer one.
  for release in bookworm trixie; do
    step wheel-$release sh packaging/bare_root.sh --release $release --packages "python3 python3-pip python3-numpy" --offline \
      sh -c 'sh /project/tests/packaging/wheel.sh /project/build/wheels/*.whl'
  done
  step wheel-source unshare --net sh tests/packaging/source.sh
}

# Programs for other machines do what those of this one do.
native() {
  step native sh -c '
    cmake --preset release && cmake --build build/release --parallel "${RGS_JOBS:-$(nproc)}" \
      --target rgs-audit rgs-convert rgs-diff rgs-info rgs-prune rgs-render'
}

arm64() {
  native
  step arm64-build sh packaging/arm64.sh
  step arm64 sh -c '/usr/bin/python3 tests/packaging/foreign_test.py \
    "qemu-aarch64 -L $(sed -n "s/^RGS_ROOT:.*=//p" build/arm64/CMakeCache.txt)" build/arm64/bin build/release/bin'
}

windows() {
  native
  step windows-page sh scripts/build_page.sh
  step windows-build sh packaging/windows.sh
  step windows /usr/bin/python3 tests/packaging/windows_test.py build/windows/programs/bin build/release/bin
  step windows-zip sh -c 'for name in viewer.html viewer-NOTICE.txt rgs-render.exe; do
    cmake -E tar tf build/windows/*.zip | grep -q "/$name\$" || { echo "no $name"; exit 1; }; done'
}

for each in $steps; do $each; done
[ -z "$failed" ] || { echo "failed:$failed"; exit 1; }
