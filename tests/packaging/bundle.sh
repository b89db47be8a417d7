#!/bin/sh
# bundle.sh - in a bare root: the bundle's programs run from wherever the archive is unpacked. SPDX-License-Identifier: Apache-2.0
set -eux
mkdir /opt/moved
tar -C /opt/moved -xf /project/build/packaging/roofgs.tar.gz
cd /tmp
bin=/opt/moved/roofgs/bin
# Only libc comes from the system, also for indirect dependencies.
for program in "$bin"/*; do
  if ldd "$program" | grep '=>' | grep -v '=> /opt/moved/' | grep -vE '^\s*(libc|libm|libdl|librt|libpthread|libresolv|libmvec|libanl|libnsl|libutil)\.so'; then
    exit 1
  fi
done
PATH=$bin:$PATH sh /project/tests/packaging/every_program.sh "$bin/../share/roofgs/viewer"
