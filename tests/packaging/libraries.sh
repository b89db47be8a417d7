#!/bin/sh
# libraries.sh - in a bare root with a compiler: RGS_PROGRAMS=OFF needs only the libraries' dependencies.
# The packages that bare_root.sh is told to install are those without TBB and libcurl. SPDX-License-Identifier: Apache-2.0
set -eux
cd /tmp
configure() { cmake -S /project -G Ninja -DRGS_PROGRAMS=OFF -DCMAKE_BUILD_TYPE=Debug -DCMAKE_CXX_FLAGS_DEBUG=-O0 "$@"; }
# A missing dependency is named.
if configure -B refused 2>refused.txt; then exit 1; fi
grep libtbb-dev refused.txt
configure -B small -DRGS_BUILD_RUNTIME=OFF
cmake --build small
cmake --install small --prefix installed
c++ -std=c++20 /project/samples/consumer/consumer.cpp -o consumer \
  $(PKG_CONFIG_PATH=installed/lib/x86_64-linux-gnu/pkgconfig:installed/lib/pkgconfig pkg-config --cflags --libs rgs-format)
./consumer scene.rgs
test -f installed/include/rgs/camera_file.hpp
if test -f installed/include/rgs/renderer.hpp; then exit 1; fi

apt-get -q update
apt-get -q -y install --no-install-recommends libtbb-dev libcurl4-openssl-dev
configure -B whole
# Only RGS_PROGRAMS adds programs, samples and tests.
if configure -B refused -DRGS_BUILD_TESTS=ON 2>refused.txt; then exit 1; fi
grep RGS_PROGRAMS=ON refused.txt
