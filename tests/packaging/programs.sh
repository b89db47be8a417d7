#!/bin/sh
# programs.sh - in a bare root: roofgs, roofgs-pictures and python3-roofgs install what they need, and work. SPDX-License-Identifier: Apache-2.0
set -eux
cd /tmp
if command -v c++; then exit 1; fi
apt-get -q update
apt-get -q -y install --no-install-recommends /project/build/deb/packages/roofgs_*.deb /project/build/deb/packages/libroofgs_*.deb
rgs-make-scene --gaussians 2k --cameras cameras.json scene.ply
rgs-convert scene.ply scene.rgs
rgs-info --verify scene.rgs
rgs-render scene.rgs --cameras cameras.json --view 0 --size 320x180 --out picture.png
test "$(head -c 4 picture.png | tail -c 3)" = PNG
if rgs-render scene.rgs --out picture.exr 2>refused.txt; then exit 1; fi
grep roofgs-pictures refused.txt
rgs-audit scene.ply scene.rgs --cameras cameras.json --size 160x90 --fail-below psnr=40 --report audit.html
rgs-prune scene.ply small.rgs --cameras cameras.json --size 160x90 --keep 50%
rgs-diff scene.rgs scene.rgs
rgs-view scene.rgs --cameras cameras.json --export look.html
test -f /usr/share/roofgs/viewer/index.html
rgs-info --verify /usr/share/roofgs/viewer/sample.rgs
for program in /usr/bin/rgs-*; do
  name=${program##*/}
  for page in share/man/man1/$name.1.gz share/bash-completion/completions/$name share/zsh/vendor-completions/_$name \
    share/fish/vendor_completions.d/$name.fish; do
    dpkg -S "/usr/$page"
  done
done
apt-get -q -y install --no-install-recommends /project/build/deb/packages/roofgs-pictures_*.deb
rgs-render scene.rgs --out picture.exr
apt-get -q -y install --no-install-recommends /project/build/deb/packages/python3-roofgs_*.deb
python3 -c 'import roofgs; assert len(roofgs.load("scene.rgs")) == 2000'
apt-get -q -y purge roofgs roofgs-pictures libroofgs python3-roofgs
if find /usr /etc -name 'rgs*' -o -name '_rgs*' -o -name 'librgs*' -o -name '*roofgs*' | grep .; then exit 1; fi
