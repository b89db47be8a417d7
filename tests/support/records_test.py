#!/usr/bin/python3
# records_test.py - the documents of docs/records match the records beside them.
# SPDX-License-Identifier: Apache-2.0
"""records_test.py SOURCE_FOLDER

A document has each table that a record names; docs/images/flight.svg is plot_flight.py's output; shrinking a record again does not
change it.
"""
import json
import subprocess
import sys
import tempfile
from pathlib import Path

root = Path(sys.argv[1])
sys.path.insert(0, str(root / "scripts"))
import bench_tables  # noqa: E402  (found through the line above)
import plot_flight  # noqa: E402
import shrink_record  # noqa: E402

records = {path: json.loads(path.read_text()) for path in sorted((root / "docs/records").glob("*.json"))}
documents = "".join(path.read_text() for path in sorted((root / "docs/records").glob("*.md")))
failures = []
for path, record in records.items():
    if path.name not in documents:
        failures.append(f"no document names {path.name}")
    if path.read_text() != shrink_record.text(record) + "\n":
        failures.append(f"{path.name} differs from shrink_record.py's output")
    for words in bench_tables.tables(record) if "tables" in record else []:
        for table in words.split("\n\n"):
            if table.startswith("|") and table.strip() not in documents:
                failures.append(f"no document has this table of {path.name}:\n{table}")
if plot_flight.svg(records[root / "docs/records/flight.json"]) != (root / "docs/images/flight.svg").read_text():
    failures.append("docs/images/flight.svg differs from plot_flight.py's picture of flight.json")

with tempfile.TemporaryDirectory() as folder:
    run, out = Path(folder) / "run.json", Path(folder) / "out.json"
    result = {"mode": "turbo", "total_ms": 0.123456789, "speedup": 1.0, "blended": 7, "stages": {"sort": {"ms": 1.0}}}
    size = {"view": "empty", "width": 16, "height": 9, "results": [result, result | {"mode": "paper"}]}
    run.write_text(json.dumps({"inside": {"date": "today", "modes": [{"name": "turbo"}, {"name": "paper"}], "sizes": [size]}}))
    subprocess.run([sys.executable, root / "scripts/shrink_record.py", out, "--tables", "stress", "--command", "a command",
                    "--modes", "turbo", "--run", "abc", "name", f"{run}:inside"], check=True)
    wanted = {"tables": ["stress"], "command": "a command", "runs": [
        {"name": "name", "commit": "abc", "date": "today", "modes": [{"name": "turbo"}], "sizes": [
            {"view": "empty", "width": 16, "height": 9,
             "results": [{"mode": "turbo", "total_ms": 0.12345679, "speedup": 1}]}]}]}
    if json.loads(out.read_text()) != wanted:
        failures.append(f"a shrunk run is {out.read_text()}")
print("\n".join(failures))
sys.exit(1 if failures else 0)
