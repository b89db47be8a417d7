#!/bin/sh
# bare_root.sh - runs a command in a Debian with only its base system:
#   sh packaging/bare_root.sh [--release NAME] [--packages "P..."] [--offline] COMMAND...
# NAME is bookworm by default; P... are installed before. The checkout is mounted read-only as /project. Everything that the command
# writes is removed afterwards. Base systems, sets of packages and downloads are kept in build/roots. The mirror is apt's own for Debian, or
# RGS_DEBIAN_MIRROR. Needs root and debootstrap; without root it says so and exits with 77.
# SPDX-License-Identifier: Apache-2.0
set -eu
cd "$(dirname "$0")/.."
project=$PWD
release=bookworm packages= offline= network=
while :; do
  case ${1:-} in
    --release) release=$2; shift 2 ;;
    --packages) packages=$2; shift 2 ;;
    --offline) offline=--net; shift ;;
    "" | --*) sed -n '2,7s/^# //p' "$0" >&2; exit 2 ;;
    *) break ;;
  esac
done
if [ "$(id -u)" != 0 ]; then
  echo "skipped: a bare root needs root's rights"
  exit 77
fi
roots=$project/build/roots
mkdir -p "$roots/downloads/partial"
work=$(mktemp -d "$roots/work.XXXXXX")
# The mounts below end with their processes.
trap 'rm -rf --one-file-system "$work"' EXIT
trap 'exit 130' INT TERM

# within LOWER UPPER COMMAND...: runs the command on an overlay of LOWER (a:b, the upper one first) that writes to UPPER.
within() {
  lower=$1 upper=$2
  shift 2
  mkdir -p "$upper" "$work/work" "$work/root"
  # shellcheck disable=SC2016,SC2086  # expanded by the inner shell; empty or one option
  unshare --mount --pid --fork --kill-child $network sh -c '
    set -eu
    lower=$1 upper=$2 work=$3 root=$4 project=$5 downloads=$6
    shift 6
    mount -t overlay overlay -o "lowerdir=$lower,upperdir=$upper,workdir=$work" "$root"
    mkdir -p "$root/project"
    mount --bind "$project" "$root/project"
    mount -o remount,ro,bind "$root/project"
    mount --bind "$downloads" "$root/var/cache/apt/archives"
    mount -t proc proc "$root/proc"
    cp -L /etc/resolv.conf "$root/etc/resolv.conf"
    exec env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LC_ALL=C.UTF-8 DEBIAN_FRONTEND=noninteractive \
      ${http_proxy:+http_proxy="$http_proxy"} \
      /usr/sbin/chroot "$root" "$@"
  ' sh "$lower" "$upper" "$work/work" "$work/root" "$project" "$roots/downloads" "$@"
}

base=$roots/$release
if [ ! -d "$base" ]; then
  # Codenames with a hyphen, such as bookworm-security, are not whole releases.
  # shellcheck disable=SC2016  # apt expands them
  mirror=${RGS_DEBIAN_MIRROR:-$(apt-get indextargets --format '$(CODENAME) $(REPO_URI)' 'Origin: Debian' 'Component: main' |
    sed -n 's/^[a-z]* //p' | head -n 1)}
  if [ -z "$mirror" ]; then
    echo "bare_root.sh: apt knows no mirror of Debian here: run apt-get update, or set RGS_DEBIAN_MIRROR" >&2
    exit 3
  fi
  # debootstrap mounts file systems.
  if ! unshare --mount debootstrap --variant=minbase "$release" "$work/base" "$mirror" >"$roots/$release.log" 2>&1; then
    tail -n 20 "$roots/$release.log" >&2
    echo "bare_root.sh: debootstrap $release failed" >&2
    exit 3
  fi
  # Downloads are kept beside the roots.
  rm -f "$work/base/etc/apt/apt.conf.d/docker-clean" "$work"/base/var/cache/apt/archives/*.deb
  echo 'APT::Keep-Downloaded-Packages "true";' >"$work/base/etc/apt/apt.conf.d/keep"
  mv "$work/base" "$base"
fi
if [ -n "$packages" ]; then
  layer=$base-$(echo "$packages" | sha256sum | cut -c 1-12)
  if [ ! -d "$layer" ]; then
    if ! within "$base" "$work/layer" sh -c '
      apt-get -q update && apt-get -q -y install --no-install-recommends "$@"' sh $packages >"$layer.log" 2>&1 </dev/null; then
      tail -n 20 "$layer.log" >&2
      echo "bare_root.sh: installing $packages failed" >&2
      exit 3
    fi
    rm -rf "$work/work"
    mv "$work/layer" "$layer"
  fi
  base=$layer:$base
fi
network=$offline
within "$base" "$work/upper" "$@"
