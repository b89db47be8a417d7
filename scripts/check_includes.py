#!/usr/bin/python3
# check_includes.py - who may include whom, and whether each header has one name: python3 scripts/check_includes.py [ROOT]
# Prints a line for each breach; exit status 1 if there is one. SPDX-License-Identifier: Apache-2.0
import re
import sys
from pathlib import Path, PurePosixPath

# The room of a path: the longest of these that it begins with.
ROOMS = {
    "format": "format",
    "kernels/math": "math",
    "kernels": "kernels",
    "runtime": "runtime",
    "runtime/pages": "pages",
    "runtime/src/cameras": "cameras",
    "runtime/include/rgs/camera.hpp": "cameras",
    "runtime/include/rgs/camera_file.hpp": "cameras",
    "runtime/include/rgs/camera_view.hpp": "cameras",
    "converter/formats": "formats",
    "converter/convert": "convert",
    "converter/lod": "lod",
    "converter/inspect": "inspect",
    "converter/audit": "audit",
    "converter/judge": "judge",
    "converter/prune": "prune",
    "converter/tool": "tool",
    "python": "python",
}
# Whom a room builds on. What those build on may be included too.
BUILDS_ON = {
    "format": [],
    "math": ["format"],
    "kernels": ["math"],
    "cameras": ["math"],
    "pages": ["math"],
    "runtime": ["kernels", "cameras", "pages"],
    "formats": ["format", "math"],
    "lod": ["kernels"],
    "convert": ["formats", "cameras", "lod"],
    "inspect": ["formats", "lod"],
    "audit": ["inspect", "formats", "runtime"],
    "judge": ["audit"],
    "prune": ["convert", "runtime"],
    "tool": ["formats", "runtime"],
    "python": ["convert", "inspect", "tool"],
}
# Rooms with programs; they may use what programs share, but not what that builds on.
TOOL_USERS = ["convert", "inspect", "audit", "judge", "prune"]
# Include folders that are installed: all that everybody else may use.
INSTALLED = ["format/include", "kernels/math/include", "runtime/include", "converter/formats/include"]
# Include folders whose headers are a room's own, and the other folders that may use them.
PRIVATE = {
    "format/src": ["tests/format", "tests/fuzz", "tests/memory"],
    "kernels/src": ["converter/lod", "runtime/src/cuda", "samples/bench", "tests/kernels", "tests/math", "tests/runtime/stream",
                    "tests/samples/bench"],
    "runtime": ["runtime/src", "tests/runtime", "web/reader/wasm"],  # pages/
    "runtime/src": ["tests/runtime", "tests/kernels", "samples/bench"],
    "converter/formats": ["tests/converter/formats", "web/reader/wasm", "web/viewer/wasm"],  # spz_header.hpp, spz_codes.hpp
}
# Further include folders. A header outside all of them has its own folder's.
SHARED = ["converter/convert", "converter/inspect", "converter/audit", "converter/judge", "converter/prune",
          "converter/lod", "converter/tool"]
OUTSIDERS = ["samples/minimal", "samples/consumer"]
# Programs outside the rooms that feed a room's library.
FEEDS = {"samples/make_scene": "convert", "web/convert/wasm": "convert"}

CUDA = r"cuda|cub/|thrust/|cooperative_groups|curand|mma\.h|nv/|device_|vector_types|.*\.cuh?$"
# What a scheduler without input, output, threads and locks does not need.
WORLD = r"thread|mutex|shared_mutex|condition_variable|future|atomic|[io]?f?stream|iostream|cstdio|filesystem|curl/|tbb/"
BANNED = {"format": CUDA, "math": CUDA, "pages": f"{CUDA}|{WORLD}", "formats": r"CLI/|CLI11|OpenImageIO/"}

SOURCE = {".hpp", ".cpp", ".cuh", ".cu", ".inc"}
HEADER = {".hpp", ".cuh", ".inc"}
INCLUDE = re.compile(r'^\s*#\s*include\s*([<"])([^">]+)[">]', re.MULTILINE)


def longest(path, folders):
    """The longest of `folders` that `path` is or lies in; None if it lies in none."""
    return max((f for f in folders if path == f or path.startswith(f + "/")), key=len, default=None)


def room_of(path):
    return ROOMS.get(longest(path, ROOMS))


def with_foundations(room):
    return {room}.union(*(with_foundations(below) for below in BUILDS_ON[room]))


def name_of(header):
    """How others include it."""
    root = longest(header, [*INSTALLED, *PRIVATE, *SHARED]) or str(PurePosixPath(header).parent)
    return header[len(root) + 1:]


def breach(source, header):
    """Why `source` may not include `header`, both of this repository; None if it may."""
    installed = longest(header, INSTALLED) is not None
    if longest(source, INSTALLED) and not installed:
        return "an installed header may include installed headers only"
    source_room, header_room = room_of(source), room_of(header)
    private = None if installed else longest(header, PRIVATE)
    if private and header_room != source_room and not longest(source, PRIVATE[private]):
        return f"{private} is private to its room"
    if source.startswith("tests/"):
        return None
    if source_room is None:  # samples, and whatever builds on the installed libraries
        own = str(PurePosixPath(source).parent) == str(PurePosixPath(header).parent)
        tool = header_room == "tool" and source.startswith("samples/") and not longest(source, OUTSIDERS)
        fed = header_room is not None and header_room == FEEDS.get(longest(source, FEEDS))
        return None if installed or own or tool or private or fed else "outside the rooms only installed headers are included"
    allowed = with_foundations(source_room) | ({"tool"} if source_room in TOOL_USERS else set())
    return None if header_room in allowed else f"{source_room} may not include {header_room or 'what is in no room'}"


def check(root):
    files = {p.relative_to(root).as_posix() for top in root.iterdir() if top.name[0] != "." and top.name != "build"
             for p in top.rglob("*") if p.suffix in SOURCE}
    headers = {}
    for header in (f for f in sorted(files) if PurePosixPath(f).suffix in HEADER):
        other = headers.setdefault(name_of(header), header)
        if other != header:
            yield f"{header}: {other} is included as '{name_of(header)}' too"
    for source in sorted(files):
        text = (root / source).read_text(encoding="utf-8")
        for match in INCLUDE.finditer(text):
            where = f"{source}:{text.count(chr(10), 0, match.start(2)) + 1}: {match[2]}"
            banned = BANNED.get(room_of(source))
            if banned and re.match(banned, match[2]):
                yield f"{where}: not in {room_of(source)}"
            beside = PurePosixPath(source).parent / match[2]
            header = beside.as_posix() if beside.as_posix() in files else headers.get(match[2])
            if header is None:
                if match[1] == '"':
                    yield f"{where}: no such header; others' include folders are not searched from here"
            elif why := breach(source, header):
                yield f"{where}: {why}"


if __name__ == "__main__":
    found = list(check(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent.parent).resolve()))
    print("\n".join(found) or "includes: in order")
    sys.exit(1 if found else 0)
