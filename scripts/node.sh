# node.sh - sourced by scripts that build and test web/: puts a Node that is new enough first on PATH.
# Vite needs 20.19 or 22.12, splat-transform, which tests run, 22, and Zstandard in tests 22.15. Debian 12 has 18; its npm then fetches the
# one that web/node locks, and runs on it.
# SPDX-License-Identifier: Apache-2.0
# shellcheck shell=sh
old_node=$(command -v node || :)
old_npm=$(command -v npm || :)
if [ -z "$old_npm" ]; then
  echo "no npm: sh scripts/install-deps.sh page" >&2
  exit 3
fi
if ! "$old_node" -e 'const [a, b] = process.versions.node.split("."); process.exit(a > 22 || (a == 22 && b >= 15) ? 0 : 1)'; then
  [ web/node/node_modules/.package-lock.json -nt web/node/package-lock.json ] || (cd web/node && npm ci --no-progress >&2)
  new_node=$(echo "$PWD"/web/node/node_modules/node-linux-*/bin/node)
  if ! "$new_node" --version >/dev/null; then
    echo "node.sh: no Node for this machine in web/node: install Node 22" >&2
    exit 3
  fi
  mkdir -p build/node
  ln -sf "$new_node" build/node/node
  # Debian's npm finds its parts where Debian's Node looks for modules.
  cat >build/node/npm <<END
#!/bin/sh
NODE_PATH=$("$old_node" -p 'require("module").globalPaths.join(":")') exec "$new_node" "$old_npm" "\$@"
END
  chmod +x build/node/npm
  PATH=$PWD/build/node:$PATH
  export PATH
fi
