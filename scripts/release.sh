#!/bin/sh
# release.sh - makes the release VERSION of the last commit: sh scripts/release.sh VERSION
# Its commit "Release VERSION" is made in a clone, build/releasing, and all packages from that: nothing here is changed, tagged or
# sent. They are written to build/release-VERSION, with the site, notes, an SBOM and SHA256SUMS.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
refuse() { echo "release.sh: $1" >&2; exit "${2:-2}"; }
version=${1:-}
echo "$version" | grep -qE '^(0|[1-9][0-9]*)(\.(0|[1-9][0-9]*)){2}$' ||
  refuse "'$version' is no version: give MAJOR.MINOR.PATCH, such as 1.2.3"
[ -z "$(git status --porcelain)" ] || refuse "there are changes that are not committed: commit or remove them"
stated=$(/usr/bin/python3 scripts/set_version.py)
newest=$({ git tag | sed -nE 's/^v([0-9]+(\.[0-9]+){2})$/\1/p'; echo "$stated"; } | sort -V | tail -n 1)
# The version that the tree states may be released if it has no tag yet.
[ "$(printf '%s\n' "$version" "$newest" | sort -V | tail -n 1)" = "$version" ] &&
  ! git rev-parse -q --verify "refs/tags/v$version" >/dev/null || refuse "$version is not newer than $newest"
out=$PWD/build/release-$version
[ ! -e "$out" ] || refuse "build/release-$version is there already: remove it" 3

SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
export SOURCE_DATE_EPOCH
preset=release-$version
. scripts/quiet.sh
work=$PWD/build/releasing
made=$work/build/made
rm -rf "$work"
quiet clone git clone --quiet -c user.name="$(git config user.name)" -c user.email="$(git config user.email)" . "$work"
cd "$work"
mkdir -p "$log_folder" "$made"
/usr/bin/python3 scripts/set_version.py "$version"
date="@$SOURCE_DATE_EPOCH +0000"
quiet commit env GIT_COMMITTER_DATE="$date" git commit --all --date "$date" -m "Release $version"

quiet deb sh packaging/deb.sh
quiet bundle-configure cmake -S . -B build/shared -G Ninja -DCMAKE_BUILD_TYPE=Release -DRGS_ENABLE_CUDA=OFF \
  -DBUILD_SHARED_LIBS=ON -DRGS_MANUAL=ON
quiet bundle-build cmake --build build/shared --parallel "$jobs"
quiet bundle sh scripts/bundle.sh build/shared "$made/roofgs-$version-linux-$(uname -m).tar.gz"
quiet wheel sh packaging/wheel.sh
quiet sdist env PYTHONPATH=packaging /usr/bin/python3 -c 'import make_wheel, sys; make_wheel.build_sdist(sys.argv[1])' "$made"
. scripts/node.sh
quiet npm sh -c 'cd web && for package in reader convert playcanvas spark webgpu viewer; do
  npm pack --pack-destination "$1" "./$package" || exit; done' sh "$made"
for machine in arm64 windows; do quiet $machine sh packaging/$machine.sh; done
quiet site sh scripts/site.sh "$work/build/roofgs-$version-site"
tar -C build --sort=name --owner=0 --group=0 --numeric-owner "--mtime=@$SOURCE_DATE_EPOCH" \
  -czf "$made/roofgs-$version-site.tar.gz" "roofgs-$version-site"
for package in build/deb/packages/*.deb build/wheels/*.whl build/arm64/*.tar.gz build/windows/*.zip; do
  [ ! -f "$package" ] || mv "$package" "$made/"
done
/usr/bin/python3 scripts/release_notes.py >"$work/build/NOTES.md"
/usr/bin/python3 scripts/sbom.py "$made" "$version" >"$work/build/roofgs-$version.spdx.json"
mv "$work/build/NOTES.md" "$work/build/roofgs-$version.spdx.json" "$made/"
(cd "$made" && sha256sum -- * >"$work/build/SHA256SUMS")
mv "$work/build/SHA256SUMS" "$made/"
mv "$made" "$out"
ls -l "$out" | awk 'NF > 2 { printf "%12d  %s\n", $5, $NF }'
cat <<END
All is in build/release-$version; nothing is tagged or sent. Next, here, where the tests find their data:
  git fetch build/releasing && git merge --ff-only FETCH_HEAD && bash .ci/run
When all pass:
  git tag -a v$version --cleanup=whitespace -F build/release-$version/NOTES.md && git push origin HEAD v$version
END
