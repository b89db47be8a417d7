#!/bin/sh
# arm64.sh - cross-builds rgs-convert and rgs-info for 64-bit ARM, and packs them: build/arm64/roofgs-VERSION-linux-arm64.tar.gz
# The libraries are Debian's, unpacked in build/roots; this system's packages stay as they are. Lists their libraries with qemu-user.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
sh scripts/install-deps.sh packaging
packages="libexpected-dev libfmt-dev libcli11-dev nlohmann-json3-dev libxxhash-dev libzstd-dev libdraco-dev libglm-dev zlib1g-dev
  libwebp-dev libzip-dev libpng-dev libturbojpeg0-dev libtbb-dev libhwy-dev libssl-dev libstdc++-12-dev doctest-dev"
root=$PWD/build/roots/arm64-$(echo "$packages" | sha256sum | cut -c 1-12)

if [ ! -d "$root" ]; then
  rm -rf "$root.part"
  apt=$root.part/apt
  mkdir -p "$apt/lists/partial" "$apt/archives/partial" "$root.part/var/lib/dpkg/info"
  : >"$apt/status"
  options="-q -y -o APT::Architecture=arm64 -o APT::Architectures=arm64 -o APT::Install-Recommends=false
    -o APT::Sandbox::User=root -o Dir::State::status=$apt/status -o Dir::State::lists=$apt/lists -o Dir::Cache=$apt"
  # shellcheck disable=SC2086  # lists of words
  for command in update "install --download-only $packages"; do apt-get $options $command; done
  for package in "$apt"/archives/*.deb; do
    dpkg-deb -x "$package" "$root.part"
    # What dpkg-query looks up: whose a library is, and in which version.
    name=$(dpkg-deb -f "$package" Package)
    printf '%s\nStatus: install ok installed\n\n' "$(dpkg-deb -f "$package")" >>"$root.part/var/lib/dpkg/status"
    dpkg-deb --fsys-tarfile "$package" | tar -t | sed 's|^\.||; s|/$||; /^$/d' >"$root.part/var/lib/dpkg/info/$name.list"
  done
  # The one package that names its libraries by whole paths.
  sed -i "s|\"/usr/|\"$root/usr/|" "$root.part"/usr/lib/aarch64-linux-gnu/cmake/draco/*.cmake
  rm -r "$apt"
  mv "$root.part" "$root"
fi

cmake -S . -B build/arm64 -G Ninja -DCMAKE_BUILD_TYPE=Release "-DCMAKE_TOOLCHAIN_FILE=$PWD/cmake/aarch64.cmake" "-DRGS_ROOT=$root" \
  -DRGS_ENABLE_CUDA=OFF -DRGS_ENABLE_HTTP=OFF -DRGS_ENABLE_OPENIMAGEIO=OFF -DRGS_ENABLE_VIEW=OFF
cmake --build build/arm64 --parallel "${RGS_JOBS:-$(nproc)}" --target rgs-convert rgs-info rgs_write_golden
version=$(sed -n 's/^CMAKE_PROJECT_VERSION:STATIC=//p' build/arm64/CMakeCache.txt)
rm -f build/arm64/*.tar.gz
RGS_ROOT=$root sh scripts/bundle.sh build/arm64 "build/arm64/roofgs-$version-linux-arm64.tar.gz"
