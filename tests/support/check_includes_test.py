#!/usr/bin/python3
# check_includes_test.py - a small valid tree, then one breach of each kind.
# SPDX-License-Identifier: Apache-2.0
"""check_includes_test.py CHECK_INCLUDES"""
import subprocess
import sys
import tempfile
from pathlib import Path

GOOD = {
    "format/include/rgs/a.hpp": "#include <vector>",
    "format/src/file/a_io.hpp": '#include "rgs/a.hpp"',
    "format/src/file/a.cpp": '#include "a_io.hpp"\n#include "file/a_io.hpp"\n#include <zstd.h>',
    "kernels/math/include/rgs/math/vec.hpp": '#include "rgs/a.hpp"',
    "kernels/math/include/rgs/math/a.hpp": '#include "rgs/math/vec.hpp"',  # another header's name for rgs/a.hpp
    "kernels/src/sorted/sort.hpp": '#include "rgs/math/vec.hpp"',
    "kernels/src/sorted/sort.cu": '#include <cub/cub.cuh>\n#include "sorted/sort.hpp"',
    "runtime/include/rgs/camera.hpp": '#include "rgs/a.hpp"',
    "runtime/include/rgs/renderer.hpp": '#include "rgs/camera.hpp"\n#include "rgs/math/vec.hpp"',
    "runtime/src/cameras/camera.cpp": '#include "rgs/camera.hpp"\n#include "rgs/math/vec.hpp"',
    "runtime/src/cuda/cuda.cpp": '#include "sorted/sort.hpp"\n#include <cuda_runtime_api.h>',
    "runtime/src/parallel.hpp": "",
    "runtime/pages/scheduler.hpp": '#include "rgs/math/vec.hpp"',
    "runtime/src/stream/pool.cpp": '#include <mutex>\n#include "pages/scheduler.hpp"',
    "converter/formats/include/rgs/ply.hpp": '#include "rgs/a.hpp"',
    "converter/formats/ply_header.hpp": '#include "rgs/math/vec.hpp"',
    "converter/tool/console.hpp": '#include "rgs/renderer.hpp"',
    "converter/convert/convert.hpp": '#include "rgs/camera.hpp"\n#include "rgs/ply.hpp"\n#include "console.hpp"',
    "converter/inspect/info.hpp": '#include "rgs/ply.hpp"',
    "converter/audit/audit.hpp": '#include "info.hpp"\n#include "rgs/renderer.hpp"',
    "converter/prune/prune.hpp": '#include "convert.hpp"\n#include "rgs/renderer.hpp"',
    "python/src/scene.cpp": '#include "convert.hpp"\n#include "info.hpp"\n#include "console.hpp"',
    "samples/minimal/minimal.cpp": "#include <rgs/renderer.hpp>",
    "samples/render/render.cpp": '#include "console.hpp"\n#include "rgs/ply.hpp"',
    "samples/bench/report.hpp": "",
    "samples/bench/cost.cpp": '#include "report.hpp"\n#include "sorted/sort.hpp"',
    "tests/support/fixture.hpp": "",
    "tests/format/a_test.cpp": '#include "fixture.hpp"\n#include "file/a_io.hpp"',
    "tests/kernels/sort_test.cpp": '#include "sorted/sort.hpp"\n#include "report.hpp"',
    "build/generated.cpp": '#include "not looked at"',
}
# A line added to a file (new or not), and the expected message.
BREACHES = [
    ("format/src/file/a.cpp", '#include "rgs/math/vec.hpp"', "format may not include math"),
    ("kernels/math/include/rgs/math/vec.hpp", '#include "sorted/sort.hpp"', "installed headers only"),
    ("kernels/src/sorted/sort.hpp", '#include "rgs/renderer.hpp"', "kernels may not include runtime"),
    ("runtime/src/cameras/camera.cpp", '#include "rgs/renderer.hpp"', "cameras may not include runtime"),
    ("runtime/src/cpu/cpu.cpp", '#include "rgs/ply.hpp"', "runtime may not include formats"),
    ("runtime/pages/scheduler.hpp", '#include "parallel.hpp"', "runtime/src is private"),
    ("runtime/pages/scheduler.cpp", "#include <mutex>", "not in pages"),
    ("converter/formats/ply.cpp", '#include "rgs/camera.hpp"', "formats may not include cameras"),
    ("converter/formats/ply.cpp", '#include "console.hpp"', "formats may not include tool"),
    ("converter/convert/convert.cpp", '#include "rgs/renderer.hpp"', "convert may not include runtime"),
    ("converter/inspect/info.cpp", '#include "rgs/camera.hpp"', "inspect may not include cameras"),
    ("converter/audit/audit.cpp", '#include "convert.hpp"', "audit may not include convert"),
    ("converter/prune/prune.cpp", '#include "info.hpp"', "prune may not include inspect"),
    ("converter/tool/console.cpp", '#include "convert.hpp"', "tool may not include convert"),
    ("converter/inspect/info.cpp", '#include "fixture.hpp"', "inspect may not include what is in no room"),
    # Private headers of other rooms
    ("runtime/src/cpu/cpu.cpp", '#include "file/a_io.hpp"', "format/src is private"),
    ("runtime/src/cpu/cpu.cpp", '#include "sorted/sort.hpp"', "kernels/src is private"),
    ("converter/convert/convert.cpp", '#include "ply_header.hpp"', "converter/formats is private"),
    ("tests/runtime/parallel_test.cpp", '#include "file/a_io.hpp"', "format/src is private"),
    ("samples/render/render.cpp", '#include "sorted/sort.hpp"', "kernels/src is private"),
    ("samples/render/render.cpp", '#include "parallel.hpp"', "runtime/src is private"),
    # Installed headers and outside users
    ("runtime/include/rgs/renderer.hpp", '#include "parallel.hpp"', "installed headers only"),
    ("samples/render/render.cpp", '#include "convert.hpp"', "only installed headers"),
    ("samples/render/render.cpp", '#include "report.hpp"', "only installed headers"),
    ("samples/minimal/minimal.cpp", '#include "console.hpp"', "only installed headers"),
    ("web/server/rgs.cpp", '#include "console.hpp"', "only installed headers"),
    ("python/src/rgs.cpp", '#include "prune.hpp"', "python may not include prune"),
    # Third-party headers
    ("format/src/file/a.cpp", "#include <cuda_runtime_api.h>", "not in format"),
    ("kernels/math/include/rgs/math/vec.hpp", "  #  include <cub/block/block_scan.cuh>", "not in math"),
    ("converter/formats/ply.cpp", "#include <CLI/CLI.hpp>", "not in formats"),
    ("converter/formats/ply.cpp", "#include <OpenImageIO/imageio.h>", "not in formats"),
    # Names
    ("converter/audit/console.hpp", "", "is included as 'console.hpp' too"),
    ("converter/formats/include/rgs/a.hpp", "", "is included as 'rgs/a.hpp' too"),
    ("format/src/file/a.cpp", '#include "rgs/gone.hpp"', "no such header"),
]


sys.path.insert(0, str(Path(sys.argv[1]).parent))
import check_includes  # noqa: E402  (found through the line above)


def breaches(tree: dict[str, str]) -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        for path, text in tree.items():
            file = Path(folder, path)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text + "\n")
        return list(check_includes.check(Path(folder)))


assert breaches(GOOD) == []
for path, line, expected in BREACHES:
    said = breaches(GOOD | {path: GOOD.get(path, "") + "\n" + line})
    # Two headers of one name make other includes ambiguous; every other breach is a single one.
    lines = [found for found in said if path in found and expected in found]
    assert len(lines) == 1 and (not line or said == lines), f"{path}: {line}: {said}"

# The exit status, which CI relies on.
with tempfile.TemporaryDirectory() as folder:
    Path(folder, "samples").mkdir()
    for text, status in (("", 0), ('#include "rgs/gone.hpp"', 1)):
        Path(folder, "samples", "a.cpp").write_text(text)
        assert subprocess.run([sys.executable, sys.argv[1], folder], stdout=subprocess.DEVNULL,
                              check=False).returncode == status
print(f"{len(BREACHES)} breaches found")
