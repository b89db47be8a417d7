# scene_index.py - one page and one JSON file about all scenes: from the audits' results, and from logs where there is none.
# `python3 scene_index.py scenes=... cameras=... leave_out=... out=...` says what failed, and then exits with 1.
# SPDX-License-Identifier: Apache-2.0
import html
import json
import os
import sys
import tempfile
import urllib.parse

from scene_folder import SceneFolder

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 80rem; padding: 0 1rem; color: #1d1d1f }
table { border-collapse: collapse; width: 100% } th, td { padding: .3rem .6rem; border-bottom: 1px solid #ddd }
th, td { text-align: right } th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left } td { vertical-align: top }
td pre { white-space: pre-wrap; text-align: left; margin: 0 } .passed { color: #176b2c } .failed { color: #a11; font-weight: 600 }
"""
COLUMNS = ["Scene", "Result", "Gaussians", "Source, MB", "Asset, MB", "Ratio", "PSNR, dB", "Worst view, dB"]


def read_json(path):
    try:
        with open(path, encoding="utf-8") as file:
            return json.load(file)
    except (OSError, ValueError):
        return None


def last_words(path):
    """The end of a log; None if the job never began."""
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            text = file.read()[-4000:]
    except OSError:
        return None
    lines = text.strip().splitlines()
    said = [i for i, line in enumerate(lines) if line.startswith("rgs-")]  # an error, perhaps with hints below
    return "\n".join(lines[said[0]:] if said else lines[-3:]) or "the job ended without a word: killed, or out of memory or time"


def row_of(out, name, source):
    row = {"scene": name, "source": source}
    asset = os.path.join(out, "assets", name + ".rgs")
    audit_path = os.path.join(out, "audits", name + ".json")
    audit = read_json(audit_path)
    if audit and os.path.exists(asset) and os.path.getmtime(audit_path) < os.path.getmtime(asset):
        return row | {"result": "not done", "error": "the audit is of an earlier asset"}
    if not os.path.exists(asset) or audit is None:
        step = "audit" if os.path.exists(asset) else "convert"
        error = last_words(os.path.join(out, "logs", step, name + ".log"))
        row["result"] = "not done" if error is None else f"{step} failed"
        row["error"] = error or ""
        return row
    failed = [c for c in audit["gate"]["conditions"] if not c["holds"]]
    rendered = audit.get("rendered", {})
    row["result"] = "passed" if audit["gate"]["holds"] else "gate failed"
    row["failed_conditions"] = [{k: c.get(k) for k in ("name", "sense", "limit", "found", "measured")} for c in failed]
    row["headline"] = audit["verdict"]["headline"]
    row["source_bytes"] = audit["source"]["bytes"]
    row["asset_bytes"] = audit["asset"]["bytes"]
    row["gaussians"] = audit["asset"]["gaussians"]
    row["ratio"] = audit["size"]["ratio"]
    for key in ("psnr", "worst_psnr"):
        if key in rendered:  # null: infinite
            row[key] = rendered[key]
    return row


def condition_text(condition):
    if not condition["measured"]:
        return f"{condition['name']} was not measured"
    found = "infinite" if condition["found"] is None else f"{condition['found']:.6g}"
    bound = "at least" if condition["sense"] == "at_least" else "at most"
    return f"{condition['name']} is {found}, {bound} {condition['limit']:g} wanted"


def why(row):
    conditions = [condition_text(c) for c in row.get("failed_conditions", [])]
    return "\n".join(conditions) or row.get("error") or row.get("headline", "")


def cells(row):
    link = html.escape(urllib.parse.quote(f"audits/{row['scene']}.html"))
    name = html.escape(row["scene"])
    yield f'<a href="{link}">{name}</a>' if "headline" in row else name
    good = row["result"] == "passed"
    yield (f'<span class="{"passed" if good else "failed"}">{html.escape(row["result"])}</span>'
           f"<pre>{html.escape(why(row))}</pre>")
    if "headline" not in row:
        yield from [""] * (len(COLUMNS) - 2)
        return
    yield f"{row['gaussians']:,}"
    yield f"{row['source_bytes'] / 1e6:.1f}"
    yield f"{row['asset_bytes'] / 1e6:.1f}"
    yield f"{row['ratio']:.2f}"
    for key in ("psnr", "worst_psnr"):
        yield "" if key not in row else "&infin;" if row[key] is None else f"{row[key]:.2f}"


def page(rows):
    n = sum(row["result"] == "passed" for row in rows)
    order = sorted(rows, key=lambda row: (row["result"] == "passed", row["scene"]))
    body = "\n".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells(row)) + "</tr>" for row in order)
    head = "".join(f"<th>{column}</th>" for column in COLUMNS)
    return (f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{n} of {len(rows)} scenes pass</title>'
            f"<style>{STYLE}</style></head><body>\n<h1>{n} of {len(rows)} scenes pass</h1>\n"
            f"<table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>\n</body></html>\n")


def replace(path, text):
    with tempfile.TemporaryDirectory(prefix=".", dir=os.path.dirname(path)) as folder:
        new = os.path.join(folder, "new")
        with open(new, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(new, path)


def write(out, folder):
    rows = [row_of(out, name, folder.source(name)) for name in folder.names()]
    rows += [{"scene": name, "result": "not usable", "error": problem} for name, problem in folder.unusable.items()]
    rows.sort(key=lambda row: row["scene"])
    os.makedirs(out, exist_ok=True)
    replace(os.path.join(out, "index.json"), json.dumps({"schema": "rgs-scenes/1", "scenes": rows}, indent=1) + "\n")
    replace(os.path.join(out, "index.html"), page(rows))
    return rows


def main(settings):
    out = settings["out"]
    rows = write(out, SceneFolder(settings["scenes"], settings["cameras"], settings["leave_out"], out))
    failed = [row for row in rows if row["result"] != "passed"]
    for row in failed:
        print(f"{row['scene']}: {row['result']}: {why(row)}", file=sys.stderr)
    print(f"{len(rows) - len(failed)} of {len(rows)} scenes pass: {out}/index.html", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(dict(argument.split("=", 1) for argument in sys.argv[1:])))
