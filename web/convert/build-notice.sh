#!/bin/sh
# build-notice.sh - writes LICENSE and NOTICE: the licences of everything in dist/rgs.wasm.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")"
cp ../../LICENSE LICENSE
{
  cat ../reader/NOTICE
  for package in libglm-dev libfmt-dev nlohmann-json3-dev; do
    printf '\n==== Debian %s\n\n' "$package"
    cat "/usr/share/doc/$package/copyright"
  done
} >NOTICE
