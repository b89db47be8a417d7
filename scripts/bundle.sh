#!/bin/sh
# bundle.sh - copies programs and the libraries they need into a folder that runs on other machines:
#   sh scripts/bundle.sh [BUILD_FOLDER] OUT      BUILD_FOLDER is build/cuda by default; OUT.tar.gz becomes an archive
# OUT/bin/PROGRAM then needs a Linux of the same processor family with a glibc at least as new as this machine's, and
# for CUDA a driver; no toolkit, no LD_LIBRARY_PATH. rgs-render is left out: it needs OpenImageIO and its 60 libraries.
# SPDX-License-Identifier: Apache-2.0
set -eu
case $# in
  1) build=$(dirname "$0")/../build/cuda out=$1 ;;
  2) build=$1 out=$2 ;;
  *) sed -n '2,5s/^# //p' "$0" >&2; exit 2 ;;
esac
if [ -e "$out" ]; then
  echo "bundle.sh: $out exists; remove it or name another folder" >&2
  exit 3
fi
if ! ls "$build"/bin/rgs* >/dev/null 2>&1; then
  echo "bundle.sh: no programs in $build/bin; build them first" >&2
  exit 3
fi
archive=
case $out in
  *.tar.gz)
    archive=$out
    folder=$(mktemp -d)
    trap 'rm -rf "$folder"' EXIT
    out=$folder/$(basename "$archive" .tar.gz)
    ;;
esac
# What comes with glibc must be that of the machine that runs the programs.
glibc='^(linux-vdso|ld-linux[^/]*|libc|libm|libdl|librt|libpthread|libresolv|libutil)\.so'

mkdir -p "$out/bin" "$out/lib" "$out/licenses"
for program in rgs-bench rgs-bench-flight rgs-bench-opening rgs-convert rgs-info rgs-make-scene rgs-prune rgs_test_kernels; do
  if [ -x "$build/bin/$program" ]; then
    cp "$build/bin/$program" "$out/bin/"
  else
    echo "left out: $program is not in $build/bin"
  fi
done

# "libfmt.so.9 => /lib/x86_64-linux-gnu/libfmt.so.9 (0x...)", for libraries of libraries as well
ldd "$out"/bin/* | awk '$2 == "=>" && $3 ~ /^\// { print $1, $3 }' | sort -u | while read -r name path; do
  echo "$name" | grep -qE "$glibc" || cp -L "$path" "$out/lib/$name"
done
strip "$out"/bin/* "$out"/lib/*

cp "$(dirname "$0")/../LICENSE" "$out/licenses/roofgs"
for library in "$out"/lib/*; do
  name=$(basename "$library")
  package=$(dpkg -S "*/$name" 2>/dev/null | head -n 1 | cut -d: -f1) || package=
  [ -z "$package" ] || cp -L "/usr/share/doc/$package/copyright" "$out/licenses/$name"
done

# Every library is found in the bundle or belongs to glibc, in an empty environment.
for program in "$out"/bin/*; do
  env -i /usr/bin/ldd "$program" | awk -v lib="/bin/../lib/" -v glibc="$glibc" '
    $1 !~ glibc && $1 !~ /^\/lib.*\/ld-linux/ && index($3, lib) == 0 { print "bundle.sh: not bundled: " $0; bad = 1 }
    END { exit bad }' >&2
done
if [ -n "$archive" ]; then
  tar -C "$folder" --sort=name --owner=0 --group=0 --numeric-owner -czf "$archive" "$(basename "$out")"
  out=$archive
fi
du -sh "$out" | awk '{ print $2 ": " $1 }'
