#!/bin/sh
# site.sh - writes documentation as static pages, which open from a disk and from any server: sh scripts/site.sh [FOLDER], by default
# build/site/html. It holds the manual, the format, the records and the interfaces in C++, Python and TypeScript; docs/site has the
# index, the settings and the style. Every link within it is checked.
# SPDX-License-Identifier: Apache-2.0
set -eu
if [ $# != 0 ]; then
  mkdir -p "$1"
  folder=$(realpath "$1")
fi
cd "$(dirname "$0")/.."
preset=site
. scripts/quiet.sh
work=$PWD/build/site
source=$work/source
html=$work/html
rm -rf "$work" && mkdir -p "$source/api/cpp"

quiet packages sh scripts/install-deps.sh site
. scripts/node.sh
npm_packages() { [ web/node_modules/.package-lock.json -nt web/package-lock.json ] || (cd web && npm ci --no-progress); }
quiet npm npm_packages
quiet configure cmake --preset python
quiet module cmake --build build/python --parallel "$jobs"

# The pages that are in the repository, and all that they link to.
git ls-files -z '*.md' docs LICENSE samples converter/formats | xargs -0 cp --parents -t "$source"
cp docs/site/index.md docs/site/scoreboard.md "$source"

# C++: a page for each header that is installed; its head comment says what it is for.
headers=$(for folder in format runtime converter/formats kernels/math; do git ls-files "$folder/include/*.hpp"; done)
# shellcheck disable=SC2086  # lists of words
{
  printf '%s\n' GENERATE_HTML=NO GENERATE_LATEX=NO GENERATE_XML=YES XML_PROGRAMLISTING=NO "OUTPUT_DIRECTORY=$work" QUIET=YES \
    "INPUT=$(echo $headers)" JAVADOC_AUTOBRIEF=YES MACRO_EXPANSION=YES EXPAND_ONLY_PREDEF=YES 'PREDEFINED=RGS_API= RGS_HD=' \
    'EXCLUDE_SYMBOLS=*::detail' WARN_IF_UNDOCUMENTED=NO WARN_AS_ERROR=YES >"$work/Doxyfile"
  awk -v api="$source/api/cpp" '
    FNR == 1 { name = FILENAME; sub(/.*include\//, "", name); page = name; gsub(/\//, "_", page); sub(/\.hpp/, "", page)
               library = FILENAME; sub(/\/include.*/, "", library); text = ""; ended = 0 }
    ended { next }
    /^\/\/ SPDX/ || !/^\/\// {
      ended = 1; sub(/^[^ ]* - /, "", text); text = toupper(substr(text, 1, 1)) substr(text, 2)
      if (library != last) printf "\n## %s\n\n| header | |\n|---|---|\n", last = library
      printf "| [%s](%s.md) | %s |\n", name, page, text
      printf "# %s\n\n%s\n\n```{doxygenfile} %s\n```\n", name, text, FILENAME >(api "/" page ".md")
      close(api "/" page ".md"); next
    }
    { sub(/^\/\/ ?/, ""); text = text (text ? " " : "") $0 }' $headers >"$work/headers.md"
}
{
  printf '# C++\n\nAll is in namespace `rgs`. [How to link](../../docs/user/INSTALL.md).\n' && cat "$work/headers.md" &&
    printf '\n```{toctree}\n:hidden:\n:glob:\n*\n```\n'
} >"$source/api/cpp/index.md"
quiet doxygen doxygen "$work/Doxyfile"
# Sphinx would list namespaces on every page, and does not know lambda expressions.
sed -i -e '/<innernamespace /d' -e '/<initializer>= \[\]/d' "$work"/xml/*.xml

# Python and TypeScript.
cp docs/site/python.md docs/site/typescript.md "$source/api"
export RGS_SITE_PYTHON="$PWD/build/python/python/package" RGS_SITE_XML="$work/xml"
quiet sphinx sphinx-build -q -W --keep-going -j "$jobs" -c docs/site -d "$work/doctrees" "$source" "$html"
quiet typedoc sh -c 'cd web && node node_modules/typedoc/bin/typedoc --options typedoc.json --out "$1"' sh "$html/api/typescript"
sed -i 's|HOME/|../../|g' "$html"/api/typescript/*.html
sed -i 's|HOME/|../../../|g' "$html"/api/typescript/*/*.html
cp docs/records/scoreboard.json "$html/docs/records"
sed 's|\(href="[^":]*\)\.md|\1.html|g' docs/records/scoreboard.html >"$html/docs/records/scoreboard.html"
rm "$html/.buildinfo"
quiet links python3 scripts/check_links.py "$html"
[ -z "${folder:-}" ] || cp -R "$html/." "$folder"
echo "open ${folder:-$html}/index.html"
