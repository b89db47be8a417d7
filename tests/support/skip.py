# skip.py - a Python test that cannot run says so and ends with 77, by which ctest knows it as skipped; skip.hpp's counterpart.
# SPDX-License-Identifier: Apache-2.0
import os
import sys
from typing import NoReturn


def skip_without_tool(reason: str) -> NoReturn:
    """Ends the test; as a failure where RGS_REQUIRE_TOOLS=1 says that everything is installed."""
    if os.environ.get("RGS_REQUIRE_TOOLS", "0") not in ("", "0"):
        sys.exit(f"RGS_REQUIRE_TOOLS is set, but {reason}")
    print(f"skipped: {reason}")
    sys.exit(77)
