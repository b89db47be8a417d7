#!/usr/bin/python3
# skip_test.py - ctest reports skipped cases as skipped, and as failures if the environment requires everything.
# SPDX-License-Identifier: Apache-2.0
"""skip_test.py RGS_SKIP_SAMPLE CMAKE CTEST SOURCE_FOLDER"""
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

program, cmake, ctest, source = sys.argv[1:]
REQUIRE = ("RGS_REQUIRE_DATA", "RGS_REQUIRE_TOOLS")


def environment(**required: str) -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in REQUIRE} | required


def outcomes(folder: str, **required: str) -> dict[str, str]:
    """Each test's result in ctest's output."""
    run = subprocess.run([ctest, "--test-dir", folder], env=environment(**required), capture_output=True, text=True,
                         check=False)
    return dict(re.findall(r"sample: ([a-z ]+?) \.+\**\s*(Passed|Skipped|Failed)", run.stdout))


with tempfile.TemporaryDirectory() as folder:
    script = Path(folder, "sample.cmake")
    subprocess.run([cmake, "-D", f"PROGRAM={program}", "-D", "LABEL=sample", "-D", f"TESTS={script}", "-P",
                    f"{source}/cmake/RgsDiscoverTests.cmake"], check=True)
    # A test that uses skip.py, run like rgs_python_test.
    Path(folder, "python.py").write_text("from skip import skip_without_tool\nskip_without_tool('no package')\n")
    Path(folder, "CTestTestfile.cmake").write_text(
        f'include("{script}")\nadd_test("sample: python" "{sys.executable}" "{folder}/python.py")\n'
        f'set_tests_properties("sample: python" PROPERTIES ENVIRONMENT "PYTHONPATH={source}/tests/support"\n'
        f'  SKIP_RETURN_CODE 77)\n')
    skipped = dict.fromkeys(("device", "data", "tool", "python"), "Skipped") | {"a message is no skip": "Passed",
                                                                                   "a failure is no skip": "Failed"}
    for required, failing in (({}, ()), ({"RGS_REQUIRE_DATA": "0"}, ()), ({"RGS_REQUIRE_DATA": "1"}, ("data",)),
                              ({"RGS_REQUIRE_TOOLS": "1"}, ("tool", "python"))):
        expected = skipped | dict.fromkeys(failing, "Failed")
        found = outcomes(folder, **required)
        assert found == expected, f"{required}: {found}, not {expected}"

    # The lines that scripts/test.sh and .ci/run count.
    text = subprocess.run([ctest, "--test-dir", folder], env=environment(), capture_output=True, text=True,
                          check=False).stdout
    assert len(re.findall(r"^\s*\d+ - sample: .* \(Skipped\)$", text, re.MULTILINE)) == 4, text
    assert "83% tests passed, 1 tests failed out of 6" in text, text
