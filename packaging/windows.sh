#!/bin/sh
# windows.sh - cross-builds the programs for 64-bit Windows by MinGW-w64: build/windows/roofgs-VERSION-windows.zip
# The libraries come from Debian's source packages, so that their versions, and the bytes they write, are those of Linux; those of
# headers alone are the system's own. build/windows/prefix holds them, and is made again only after this script changes.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
root=$PWD/build/windows
prefix=$root/prefix
jobs=${RGS_JOBS:-$(nproc)}
programs="rgs-audit rgs-convert rgs-diff rgs-info rgs-prune rgs-render"
sh scripts/install-deps.sh windows

# get NAME...: Debian's source packages as folders build/windows/source/NAME. Lists of sources are kept apart from the system's.
get() {
  apt=$root/apt
  mkdir -p "$apt/sources" "$apt/lists/partial" "$apt/cache/archives/partial" "$root/source"
  for list in /etc/apt/sources.list /etc/apt/sources.list.d/*.list /etc/apt/sources.list.d/*.sources; do
    [ -f "$list" ] && sed -E 's/^deb /deb-src /; s/^Types:.*/Types: deb-src/' "$list" >"$apt/sources/$(basename "$list")"
  done
  options="-q -o Dir::Etc::sourcelist=/dev/null -o Dir::Etc::sourceparts=$apt/sources -o Dir::State::lists=$apt/lists
    -o Dir::Cache=$apt/cache -o APT::Sandbox::User=root"
  # shellcheck disable=SC2086  # a list of options
  apt-get $options update || echo "windows.sh: some lists of sources are missing"
  for name in "$@"; do
    [ ! -d "$root/source/$name" ] || continue
    rm -rf "$apt/unpacked"
    mkdir "$apt/unpacked"
    # An update may be listed and not be there.
    # shellcheck disable=SC2086
    (cd "$apt/unpacked" && { apt-get $options source "$name" || apt-get $options source "$name/bookworm"; })
    mv "$apt/unpacked/$name"-*/ "$root/source/$name"
  done
}

# library NAME FOLDER [OPTION...]: builds one by its own CMake files, as static libraries.
library() {
  name=$1 folder=$2
  shift 2
  cmake -S "$root/source/$folder" -B "$root/libraries/$name" -G Ninja -DCMAKE_TOOLCHAIN_FILE="$PWD/cmake/mingw-w64.cmake" \
    -DRGS_WINDOWS_PREFIX="$prefix" -DCMAKE_BUILD_TYPE=Release -DCMAKE_INSTALL_PREFIX="$prefix" -DCMAKE_INSTALL_LIBDIR="$prefix/lib" \
    -DBUILD_SHARED_LIBS=OFF -DBUILD_TESTING=OFF -DCMAKE_C_COMPILER_LAUNCHER=ccache -DCMAKE_CXX_COMPILER_LAUNCHER=ccache "$@"
  cmake --build "$root/libraries/$name" --parallel "$jobs" --target install
}

# package NAME TARGET [PROPERTY VALUE]...: what find_package(NAME) finds, with the headers of prefix.
package() {
  name=$1 target=$2
  shift 2
  mkdir -p "$prefix/lib/cmake/$name"
  cat >"$prefix/lib/cmake/$name/${name}Config.cmake" <<END
if(NOT TARGET $target)
  add_library($target INTERFACE IMPORTED)
  set_target_properties($target PROPERTIES INTERFACE_INCLUDE_DIRECTORIES $prefix/include $*)
endif()
END
}

libraries() {
  get libzstd highway libzip libwebp onetbb libpng1.6 libjpeg-turbo
  library zstd libzstd/build/cmake -DZSTD_BUILD_PROGRAMS=OFF -DZSTD_BUILD_SHARED=OFF -DZSTD_LEGACY_SUPPORT=OFF
  library highway highway -DHWY_ENABLE_EXAMPLES=OFF -DHWY_ENABLE_CONTRIB=OFF
  library webp libwebp -DWEBP_BUILD_ANIM_UTILS=OFF -DWEBP_BUILD_CWEBP=OFF -DWEBP_BUILD_DWEBP=OFF -DWEBP_BUILD_GIF2WEBP=OFF \
    -DWEBP_BUILD_IMG2WEBP=OFF -DWEBP_BUILD_VWEBP=OFF -DWEBP_BUILD_WEBPINFO=OFF -DWEBP_BUILD_WEBPMUX=OFF -DWEBP_BUILD_EXTRAS=OFF
  library zip libzip -DENABLE_BZIP2=OFF -DENABLE_LZMA=OFF -DENABLE_ZSTD=OFF -DENABLE_GNUTLS=OFF -DENABLE_MBEDTLS=OFF \
    -DENABLE_OPENSSL=OFF -DENABLE_WINDOWS_CRYPTO=OFF -DBUILD_TOOLS=OFF -DBUILD_REGRESS=OFF -DBUILD_EXAMPLES=OFF -DBUILD_DOC=OFF
  library png libpng1.6 -DPNG_SHARED=OFF -DPNG_TESTS=OFF -DZLIB_USE_STATIC_LIBS=ON
  library jpeg libjpeg-turbo -DENABLE_SHARED=OFF -DWITH_SIMD=OFF
  library tbb onetbb -DTBB_TEST=OFF -DTBB_STRICT=OFF -DTBBMALLOC_BUILD=OFF
  package zstd zstd::libzstd_shared INTERFACE_LINK_LIBRARIES "$prefix/lib/libzstd.a"
  package xxHash xxHash::xxHash INTERFACE_COMPILE_DEFINITIONS XXH_INLINE_ALL
  package fmt fmt::fmt INTERFACE_COMPILE_DEFINITIONS FMT_HEADER_ONLY
  package tl-expected tl::expected
  package CLI11 CLI11::CLI11
  package nlohmann_json nlohmann_json::nlohmann_json
  package glm glm::glm
  for header in tl xxhash.h fmt glm nlohmann CLI; do
    cp -r "/usr/include/$header" "$prefix/include/"
  done
}

made_by=$(cat packaging/windows.sh cmake/mingw-w64.cmake | cksum)
[ "$(cat "$prefix/complete" 2>/dev/null)" = "$made_by" ] || {
  rm -rf "$prefix" "$root/libraries" "$root/source"
  libraries
  echo "$made_by" >"$prefix/complete"
}

cmake -S . -B "$root/programs" -G Ninja -DCMAKE_TOOLCHAIN_FILE="$PWD/cmake/mingw-w64.cmake" -DRGS_WINDOWS_PREFIX="$prefix" \
  -DCMAKE_BUILD_TYPE=Release -DRGS_ENABLE_CUDA=OFF -DRGS_ENABLE_HTTP=OFF -DRGS_ENABLE_OPENIMAGEIO=OFF -DRGS_ENABLE_VIEW=OFF \
  -DRGS_BUILD_TESTS=OFF -DRGS_INSTALL=OFF
# shellcheck disable=SC2086  # a list
cmake --build "$root/programs" --parallel "$jobs" --target $programs
# For the tests, whose other programs need what is not built here, such as Draco.
x86_64-w64-mingw32-g++-posix -std=gnu++20 -O2 -ffp-contract=off -static -Wa,-muse-unaligned-vector-move -Iformat/include -Itests/support \
  -I"$prefix/include" tests/golden/write_golden.cpp "$root/programs/format/librgs_format.a" "$prefix/lib/libhwy.a" "$prefix/lib/libzstd.a" \
  -o "$root/programs/bin/rgs_write_golden.exe"

version=$(sed -n 's/^CMAKE_PROJECT_VERSION:STATIC=//p' "$root/programs/CMakeCache.txt")
out=roofgs-$version-windows
rm -rf "${root:?}/$out"
mkdir -p "$root/$out/licenses"
for program in $programs; do
  x86_64-w64-mingw32-strip -o "$root/$out/$program.exe" "$root/programs/bin/$program.exe"
done
cp LICENSE "$root/$out/licenses/RoofGS"
# Of libraries from source those of their packages here, which have the same version.
for package in libz-mingw-w64-dev mingw-w64-x86-64-dev gcc-mingw-w64-base libexpected-dev libfmt-dev libcli11-dev nlohmann-json3-dev \
  libxxhash-dev libglm-dev libzstd1 libhwy-dev libzip-dev libwebp-dev libpng-dev libturbojpeg0-dev libtbb-dev; do
  cp -L "/usr/share/doc/$package/copyright" "$root/$out/licenses/$package"
done
# The viewer's page in one file, if it was built.
if [ -f web/viewer/dist-single/page.html ]; then
  cp web/viewer/dist-single/page.html "$root/$out/viewer.html"
  cp web/viewer/NOTICE "$root/$out/viewer-NOTICE.txt"
fi
# Not by cmake -E tar: its entries also hold when the files were read and changed.
[ -z "${SOURCE_DATE_EPOCH:-}" ] || find "$root/$out" -exec touch -d "@$SOURCE_DATE_EPOCH" {} +
(cd "$root" && TZ=UTC /usr/bin/python3 -m zipfile -c "$out.zip" "$out")
echo "build/windows/$out.zip"
