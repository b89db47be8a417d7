# commands_test.py - runs the commands that a document shows, as they stand: commands_test.py PROGRAMS SOURCE DOCUMENT
#
# Commands are indented blocks and ```sh blocks, run in order by one `sh -e` in a new folder, with PROGRAMS first on
# PATH and SOURCE as ~/roofgs. A command must exit with 0, or with N where "# exit code N" follows it. Commands that
# match NOT_RUN, ```sbatch blocks, and blocks below "<!-- NAME -->", which tests/cluster runs, are not run but counted
# and listed. For commands within a sentence or a table, the options must exist.
# SPDX-License-Identifier: Apache-2.0
import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

NOT_RUN = [  # pattern at a command's start, and why it is not run here
    (r"(sudo )?apt-get |pip install ", "installs packages"),
    (r"sh (scripts|packaging|tests/cluster)/|cmake --preset ", "builds for minutes; a section of .ci/run"),
    (r"docker |vcpkg |conan |colmap |snakemake |sbatch ", "a program of others"),
    (r"ssh ", "needs another machine"),
    (r"rgs-bench |rgs-bench-opening |.*(--backend cuda|--device-memory)", "needs a GPU"),
    (r"rgs-\S+ .*https?://", "needs a web server"),
]
LANGUAGES = {"sh", "python", "python gpu", "cpp", "cmake", "json", "text", "html", "js", "yaml", "sbatch"}

# rgs-view serves until it is interrupted: here, once it has printed its address.
VIEW = """#!/usr/bin/python3
import signal, subprocess, sys
view = subprocess.Popen([{program!r}, *sys.argv[1:]], stdout=subprocess.PIPE, text=True,
                        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
line = view.stdout.readline()
print(line, end="")
if line.startswith("http://127.0.0.1:"):
    view.send_signal(signal.SIGINT)
print(view.communicate()[0], end="")
sys.exit(view.returncode)
"""


def blocks(text):
    """(line number, language, NAME of the comment above or "", lines) of each block of commands."""
    lines = text.split("\n")
    i, above = 0, ""
    while i < len(lines):
        if fence := re.fullmatch(r"```(.*)", lines[i]):
            first, i = i + 1, lines.index("```", i + 1)
            assert fence[1] in LANGUAGES, f"line {first}: a block in {fence[1] or 'no language'}"
            if fence[1] in ("sh", "sbatch"):
                yield first + 1, fence[1], above, lines[first:i]
            else:
                hidden = next((line for line in lines[first:i] if re.match(r"(rgs-[a-z-]+|sh|cmake|python3) ", line)), None)
                assert not hidden, f"line {first}: a command in {fence[1]}: {hidden}"
        elif lines[i].startswith("    ") and (i == 0 or not lines[i - 1] or lines[i - 1].startswith("<!--")):
            first = i
            while i < len(lines) and (lines[i].startswith("    ") or not lines[i]):
                i += 1
            i -= 1
            yield first + 1, "sh", above, [line[4:] for line in lines[first:i + 1]]
        else:
            assert not re.match(r"\s*(```|~~~)", lines[i]), f"line {i + 1}: a block that is neither ``` nor indented"
        if lines[i]:
            comment = re.fullmatch(r"<!-- ([\w-]+) -->", lines[i])
            above = comment[1] if comment else ""
        i += 1


def commands(lines):
    """(place, text) of each command of a block: lines are joined until the shell sees a complete command."""
    text, first = "", 0
    for i, line in enumerate(lines):
        first = first if text else i
        text += line + "\n"
        if re.fullmatch(r"\s*(#.*)?\s*", text):
            text = ""
        elif not line.endswith("\\") and subprocess.run(["sh", "-n"], input=text, text=True, stderr=subprocess.DEVNULL,
                                                       check=False).returncode == 0:
            yield first, text
            text = ""
    assert not text, f"no end of {text!r}"


def run_by_cluster(source, name):
    return any(f'page_block("{name}")' in test.read_text() for test in (source / "tests/cluster").glob("*.py"))


def unknown_options(text, programs):
    """(command, option) for each option of `rgs-... --option` within a line that the program's --help does not name."""
    for command in re.findall(r"`(rgs-[a-z-]+ [^`]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.S | re.M)):
        program = programs / command.split()[0]
        if program.name.startswith("rgs-bench") and not program.exists():
            print(f"not checked, {program.name} is not built: {command}")
            continue
        known = subprocess.run([program, "--help"], capture_output=True, text=True, check=True).stdout
        yield from ((command, option) for option in re.findall(r"(?<!\S)--[a-z][\w-]*", command)
                    if not re.search(rf"(?<![\w-]){option}(?![\w-])", known))


def main():
    programs, source, document = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve(), sys.argv[3]
    script, n_run, not_run = "set -e\n", 0, []
    page = (source / document).read_text()
    unknown = list(unknown_options(page, programs))
    assert not unknown, unknown
    for number, language, name, lines in blocks(page):
        for place, text in commands(lines):
            where = f"{document}:{number + place}"
            why = next((why for begin, why in NOT_RUN if re.match(begin, text)), None)
            if name:
                assert run_by_cluster(source, name), f"{where}: tests/cluster has no commands '{name}'"
                why = "run by tests/cluster"
            if language == "sbatch":
                why = "a job of Slurm"
            if why:
                not_run.append(f"not run, {why}: {where}: {text.strip()}")
                continue
            n_run += 1
            script += f"printf '%s\\n' {shlex.quote(where + ': ' + text.strip())}\n"
            if code := re.search(r"# exit code (\d+)\b", text):
                script += f"code=0\n{{\n{text}}} || code=$?\n[ $code = {code[1]} ] || {{ echo exit code $code; exit 1; }}\n"
            else:
                script += text
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("bin", "home", "page", "work"):
            (folder / part).mkdir()
        (folder / "home/roofgs").symlink_to(source)
        (folder / "bin/rgs-view").write_text(VIEW.format(program=str(programs / "rgs-view")))
        (folder / "bin/rgs-view").chmod(0o755)
        for page in ("index.html", "single.html"):
            (folder / "page" / page).write_text("<!doctype html><title>a page of the test</title><!-- rgs-view:insert -->")
        variables = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
        variables |= {"PATH": f"{folder}/bin:{programs}:{os.environ['PATH']}", "HOME": f"{folder}/home",
                      "RGS_VIEWER_DIR": f"{folder}/page"}
        done = subprocess.run(["sh", "-c", script], cwd=folder / "work", env=variables, stdin=subprocess.DEVNULL, check=False)
    outcome = f"exit code {done.returncode}; of " if done.returncode else ""
    print(*not_run, f"{document}: {outcome}{n_run} commands run, {len(not_run)} not run", sep="\n")
    sys.exit(done.returncode)


main()
