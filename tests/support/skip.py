# skip.py - ends a Python test that cannot run with 77, which ctest treats as skipped; skip.hpp's counterpart.
# SPDX-License-Identifier: Apache-2.0
import os
import sys
from typing import NoReturn


def skip_without_tool(reason: str) -> NoReturn:
    """Ends the test as skipped, or as failed if RGS_REQUIRE_TOOLS=1 requires all tools."""
    if os.environ.get("RGS_REQUIRE_TOOLS", "0") not in ("", "0"):
        sys.exit(f"RGS_REQUIRE_TOOLS is set, but {reason}")
    print(f"skipped: {reason}")
    sys.exit(77)
