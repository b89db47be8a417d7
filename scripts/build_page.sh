#!/bin/sh
# build_page.sh - installs what the viewer's page needs and builds it, where rgs-view and `cmake --install` look for it:
# web/viewer/dist, and web/viewer/dist-single/page.html, which is one file.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
sh scripts/install-deps.sh page
. scripts/node.sh
cd web
[ node_modules/.package-lock.json -nt package-lock.json ] || npm ci --no-progress
npm run --silent build
