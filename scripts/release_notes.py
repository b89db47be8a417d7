# release_notes.py - notes of the version that the checkout states, as Markdown: python3 scripts/release_notes.py
# They are its part of CHANGELOG.md, and what has changed since the last tag in the version of the file format, installed headers,
# the programs' options and the names of the Python module.
# SPDX-License-Identifier: Apache-2.0
import ast
import re
import subprocess
from pathlib import Path

import set_version

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = ("converter", "samples")


def git(*words):
    return subprocess.run(["git", "-C", ROOT, *words], check=True, capture_output=True, text=True).stdout


def at(revision, path):
    return git("show", f"{revision}:{path}")


def format_version(revision):
    return ".".join(re.search(rf"kVersion{part} = (\d+)", at(revision, "format/include/rgs/layout.hpp"))[1]
                    for part in ("Major", "Minor"))


def headers(revision):
    """The blob of each header by its path."""
    rows = (line.split(None, 3) for line in git("ls-tree", "-r", revision).splitlines())
    return {path: blob for _, _, blob, path in rows if re.search(r"/include/rgs/.*\.hpp$", path)}


def options(revision):
    """PROGRAM --NAME by what its folder declares."""
    found = git("grep", "-oE", r'"(-[a-zA-Z],)?--[a-z][a-z0-9-]*', revision, "--", *(f"{folder}/*.cpp" for folder in PROGRAMS))
    rows = (line.split(":", 2) for line in found.splitlines())
    return {f"{Path(path).parent}: --{text.partition('--')[2]}" for _, path, text in rows}


def python_names(revision):
    tree = ast.parse(at(revision, "python/roofgs/__init__.py"))
    return {name for node in tree.body if isinstance(node, ast.Assign) and node.targets[0].id == "__all__"
            for name in ast.literal_eval(node.value)}


def changes(title, before, after):
    changed = {name for name in before.keys() & after.keys() if before[name] != after[name]} if isinstance(before, dict) else ()
    rows = [("new", set(after) - set(before)), ("gone", set(before) - set(after)), ("changed", changed)]
    lines = [f"- {what}: {', '.join(f'`{name}`' for name in sorted(names))}" for what, names in rows if names]
    return [f"### {title}", "", *(lines or ["Unchanged."]), ""]


def main():
    version = set_version.stated()
    part = re.search(rf"^## {re.escape(version)} .*?\n(.*?)(?=^## |\Z)", set_version.CHANGELOG.read_text(), re.MULTILINE | re.DOTALL)
    lines = [f"# RoofGS {version}", "", part[1].strip() if part else "", "", "## Formats and interfaces", ""]
    tags = git("tag", "--merged", "HEAD", "--sort=-v:refname").split()
    last = next((tag for tag in tags if re.fullmatch(r"v\d+\.\d+\.\d+", tag) and tag != f"v{version}"), None)
    lines += [f"Files are written in version {format_version('HEAD')} of the format.", ""]
    if last is None:
        lines += ["No earlier version is tagged, so nothing is compared."]
    else:
        lines += [f"Compared with {last}, which wrote version {format_version(last)}:", ""]
        for title, of in (("Headers", headers), ("Options of programs, by folder", options), ("Python", python_names)):
            lines += changes(title, of(last), of("HEAD"))
    print("\n".join(lines).rstrip())


if __name__ == "__main__":
    main()
