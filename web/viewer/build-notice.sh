#!/bin/sh
# build-notice.sh - writes NOTICE: the licences of everything in the built page.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")"
{
  cat ../convert/NOTICE
  echo
  echo "The PlayCanvas engine, https://playcanvas.com"
  echo
  cat ../node_modules/playcanvas/LICENSE
} >NOTICE
