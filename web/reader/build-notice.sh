#!/bin/sh
# build-notice.sh - writes LICENSE and NOTICE: the licences of everything in dist/rgs.wasm.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")"
cp ../../LICENSE LICENSE
{
  echo "dist/rgs.wasm holds RoofGS (LICENSE), and parts of the libraries below."
  printf '\n==== Zstandard\n\n'
  cat ../node_modules/zstd-napi/deps/zstd/LICENSE
  for package in libxxhash-dev libhwy-dev libexpected-dev libc++-19-dev-wasm32 wasi-libc; do
    printf '\n==== Debian %s\n\n' "$package"
    cat "/usr/share/doc/$package/copyright"
  done
} >NOTICE
