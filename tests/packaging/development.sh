#!/bin/sh
# development.sh - in a bare root with a compiler: outside programs build against libroofgs-dev, through CMake and through
# pkg-config. SPDX-License-Identifier: Apache-2.0
set -eux
cd /tmp
apt-get -q update
apt-get -q -y install --no-install-recommends /project/build/deb/packages/libroofgs*.deb
cmake -S /project/samples/consumer -B cmake -G Ninja
cmake --build cmake
ctest --test-dir cmake --output-on-failure --no-tests=error
# The second one links every library, so that any missing symbol is found.
c++ -std=c++20 /project/samples/consumer/consumer.cpp -o consumer $(pkg-config --cflags --libs rgs-format)
c++ -std=c++20 /project/samples/minimal/minimal.cpp -o minimal -Wl,--no-as-needed \
  $(pkg-config --cflags --libs rgs-runtime rgs-cameras rgs-interchange)
./consumer scene.rgs
./minimal scene.rgs picture.ppm
