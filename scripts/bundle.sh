#!/bin/sh
# bundle.sh - copies programs and the libraries they need into a folder that runs on other machines:
#   sh scripts/bundle.sh [BUILD_FOLDER] OUT    BUILD_FOLDER is build/cuda by default; OUT.tar.gz becomes an archive
# OUT/bin/PROGRAM runs on a Linux of the same processor family with the same or a newer glibc; CUDA needs a driver, but no toolkit. The
# folder may be moved; it is smallest from a build with -DBUILD_SHARED_LIBS=ON -DRGS_ENABLE_CUDA=OFF. Pictures are PNG and JPEG:
# OpenImageIO, for others, would bring 260 libraries. RGS_ROOT: a folder with the libraries of a build for arm64 (packaging/arm64.sh).
# SPDX-License-Identifier: Apache-2.0
set -eu
root=${RGS_ROOT:-}
strip='strip'
ldd=/usr/bin/ldd
if [ -n "$root" ]; then
  strip=aarch64-linux-gnu-strip
  ldd="/usr/bin/qemu-aarch64 -L $root $root/lib/ld-linux-aarch64.so.1 --list"
fi
programs="rgs-audit rgs-bench rgs-bench-flight rgs-bench-opening rgs-convert rgs-diff rgs-info rgs-judge rgs-make-scene rgs-prune
  rgs-render rgs-view rgs_test_kernels"
case $# in
  1) build=$(dirname "$0")/../build/cuda out=$1 ;;
  2) build=$1 out=$2 ;;
  *) sed -n '2,6s/^# //p' "$0" >&2; exit 2 ;;
esac
if [ -e "$out" ]; then
  echo "bundle.sh: $out exists; remove it or name another folder" >&2
  exit 3
fi
if ! ls "$build"/bin/rgs* >/dev/null 2>&1; then
  echo "bundle.sh: no programs in $build/bin; build them first" >&2
  exit 3
fi
page=$(dirname "$0")/../web/viewer/dist
if [ -x "$build/bin/rgs-view" ] && [ ! -f "$page-single/page.html" ]; then
  echo "bundle.sh: the page of rgs-view is not built: sh scripts/build_page.sh" >&2
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
# glibc must be that of the machine that runs the programs.
glibc='^(linux-vdso|(/lib[^/]*/)?ld-linux[^/]*|libc|libm|libdl|librt|libpthread|libresolv|libutil|libmvec|libanl|libnsl|libnss_[a-z]*)\.so'

mkdir -p "$out/bin" "$out/lib" "$out/licenses"
for program in $programs; do
  if [ -x "$build/bin/$program" ]; then
    cp "$build/bin/$program" "$out/bin/"
  else
    echo "left out: $program is not in $build/bin"
  fi
done

# "libfmt.so.9 => /lib/x86_64-linux-gnu/libfmt.so.9 (0x...)", for libraries of libraries as well
for program in "$out"/bin/*; do $ldd "$build/bin/${program##*/}"; done |
  awk '$2 == "=>" && $3 ~ /^\// { print $1, $3 }' | sort -u | while read -r name path; do
    echo "$name" | grep -qE "$glibc" || cp -L "$root$path" "$out/lib/$name"
  done
for library in "$out"/lib/librgs_*; do [ ! -e "$library" ] || $strip "$library"; done
$strip "$out"/bin/*

cp "$(dirname "$0")/../LICENSE" "$out/licenses/roofgs"
# "libfmt9:amd64: /usr/lib/x86_64-linux-gnu/libfmt.so.9"; in other folders are those of cross compilers.
for library in "$out"/lib/*.so*; do echo "*-linux-gnu/${library##*/}"; done |
  xargs dpkg-query --admindir="$root/var/lib/dpkg" -S 2>/dev/null | cut -d: -f1 | sort -u | while read -r package; do
    [ ! -e "$root/usr/share/doc/$package/copyright" ] || cp -L "$root/usr/share/doc/$package/copyright" "$out/licenses/$package"
  done
if [ -x "$out/bin/rgs-view" ]; then
  mkdir -p "$out/share/roofgs"
  cp -R "$page" "$out/share/roofgs/viewer"
  cp "$page-single/page.html" "$out/share/roofgs/viewer/single.html"
  sh "$(dirname "$0")/make_sample.sh" "$build/bin" "$out/share/roofgs/viewer/sample.rgs"
fi
# Man pages and completions, where they are built.
if [ -d "$build/manual" ]; then
  mkdir -p "$out/share"
  cp -R "$build/manual" "$out/share/man"
  rm -f "$out/share/man/made"
  for shell in bash zsh fish; do mv "$out/share/man/$shell" "$out/share/$shell"; done
fi

# In an empty environment every library is found in the bundle or belongs to glibc.
for program in "$out"/bin/*; do
  env -i $ldd "$program" | awk -v lib="/../" -v glibc="$glibc" '
    $2 == "=>" && $1 !~ glibc && index($3, lib) == 0 { print "bundle.sh: not bundled: " $0; bad = 1 }
    END { exit bad }' >&2
done
if [ -n "$archive" ]; then
  tar -C "$folder" --sort=name --owner=0 --group=0 --numeric-owner \
    ${SOURCE_DATE_EPOCH:+--mtime=@$SOURCE_DATE_EPOCH} -czf "$archive" "$(basename "$out")"
  out=$archive
fi
du -sh "$out" | awk '{ print $2 ": " $1 }'
