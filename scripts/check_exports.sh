#!/bin/sh
# check_exports.sh - shared libraries export rgs:: and nothing else: sh scripts/check_exports.sh LIBRARY...
# Weak instances of the standard library's templates are let through: every C++ library has them.
# SPDX-License-Identifier: Apache-2.0
set -eu
[ $# -gt 0 ] || { sed -n '2s/^# //p' "$0" >&2; exit 2; }
failed=0
for library in "$@"; do
  # _ZN3rgs..., _ZNK3rgs..., _ZTVN3rgs... are rgs::'s own; S is std, 9__gnu_cxx its other namespace, 2tl tl::expected.
  unexpected=$(nm -D --defined-only "$library" | awk '
    $3 ~ /^_ZZ?(T[A-Z])?N?[KVRO]*3rgs/ { n++; next }
    $2 ~ /^[WVu]$/ && $3 ~ /^_ZZ?(T[A-Z])?(N[KVRO]*(S|9__gnu_cxx|2tl)|S)/ { next }
    { print }
    END { if (!n) print "nothing of rgs::" }' | c++filt)
  if [ -n "$unexpected" ]; then
    printf '%s exports:\n%s\n' "$library" "$unexpected" >&2
    failed=1
  fi
done
exit $failed
