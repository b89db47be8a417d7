#!/bin/sh
# programs.sh - in a bare root: roofgs, roofgs-pictures and python3-roofgs install what they need, and work. SPDX-License-Identifier: Apache-2.0
set -eux
cd /tmp
if command -v c++; then exit 1; fi
apt-get -q update
apt-get -q -y install --no-install-recommends /project/build/deb/packages/roofgs_*.deb /project/build/deb/packages/libroofgs_*.deb
sh /project/tests/packaging/every_program.sh /usr/share/roofgs/viewer
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
