#!/bin/sh
# install-deps.sh - installs the Debian 12 packages that RoofGS is built with; silent when all are there.
# `install-deps.sh packaging` adds those that packages are made and tested with.
# `install-deps.sh python` adds those that the Python module and its tests need.
# `install-deps.sh page` adds those that the viewer's page is built with: clang 19 and binaryen for WebAssembly, and npm where there is none.
# `install-deps.sh test` adds those that only tests need, a browser among them; `install-deps.sh web` adds both.
# `install-deps.sh windows` adds those that programs for Windows are built and tested with.
# `install-deps.sh site` adds those that scripts/site.sh makes pages with.
# Set RGS_SKIP_INSTALL=1 where the dependencies come from elsewhere.
# SPDX-License-Identifier: Apache-2.0
set -eu

packages="g++ clang clang-format clang-tidy llvm libclang-rt-14-dev cmake ninja-build ccache git ca-certificates
  libexpected-dev libfmt-dev libcli11-dev nlohmann-json3-dev libxxhash-dev libzstd-dev libdraco-dev libglm-dev
  zlib1g-dev libwebp-dev libzip-dev libpng-dev libturbojpeg0-dev libopenimageio-dev libtbb-dev libhwy-dev
  libcurl4-openssl-dev libssl-dev libboost-dev doctest-dev libbenchmark-dev
  python3 python3-numpy python3-zstandard python3-xxhash zstd"

[ "${1:-}" != packaging ] || packages="$packages dpkg-dev debootstrap lintian man-db zsh fish bash-completion pkgconf
  patchelf python3-pip libdlpack-dev g++-aarch64-linux-gnu qemu-user"
[ "${1:-}" != python ] || packages="$packages libdlpack-dev python3-venv python3-pytest mypy
  python3-nbformat python3-nbclient python3-ipykernel"
[ "${1:-}" != windows ] || packages="$packages dpkg-dev g++-mingw-w64-x86-64-posix libz-mingw-w64-dev wine wine64"
[ "${1:-}" != site ] || packages="$packages doxygen python3-sphinx python3-myst-parser python3-breathe python3-numpydoc furo
  libdlpack-dev"
case ${1:-} in test | web) packages="$packages chromium pkgconf nginx-light openssl valgrind" ;; esac
case ${1:-} in
  page | web)
    packages="$packages clang-19 lld-19 libc++-19-dev-wasm32 libc++abi-19-dev-wasm32 wasi-libc libclang-rt-19-dev-wasm32
      binaryen"
    ;;
esac
# A newer npm need not be a package.
case ${1:-} in page | site | web) command -v npm >/dev/null || packages="$packages npm" ;; esac

[ "${RGS_SKIP_INSTALL:-0}" = 1 ] && exit 0

if ! command -v dpkg-query >/dev/null || ! command -v apt-get >/dev/null; then
  echo "install-deps.sh knows Debian 12 only. Install what these packages hold, then set RGS_SKIP_INSTALL=1:" >&2
  echo "$packages" >&2
  exit 1
fi

missing=
for package in $packages; do
  [ "$(dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || missing="$missing $package"
done
[ -z "$missing" ] && exit 0

if ! grep -q '^VERSION_CODENAME=bookworm' /etc/os-release 2>/dev/null; then
  echo "install-deps.sh: this is not Debian 12; trying the same package names:$missing" >&2
fi
sudo=
if [ "$(id -u)" != 0 ]; then
  if ! command -v sudo >/dev/null; then
    echo "install-deps.sh: neither root nor sudo; as root run: apt-get install$missing" >&2
    exit 1
  fi
  sudo=sudo
fi

log=$(mktemp)
trap 'rm -f "$log"' EXIT
echo "installing packages:$missing"
# shellcheck disable=SC2086  # lists of words
if ! { $sudo apt-get -q update &&
  $sudo env DEBIAN_FRONTEND=noninteractive apt-get -q -y install --no-install-recommends $missing; } \
  >"$log" 2>&1 </dev/null; then
  tail -n 30 "$log" >&2
  echo "install-deps.sh: installation failed" >&2
  exit 1
fi
