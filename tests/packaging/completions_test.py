# completions_test.py - man and the three shells accept the output of packaging/manual.py: completions_test.py FOLDER
# FOLDER is the build's manual/. SPDX-License-Identifier: Apache-2.0
import os
import pty
import re
import select
import shutil
import subprocess
import sys
import unittest
from pathlib import Path

from skip import skip_without_tool

FOLDER = Path()


def run(*command, text=None):
    result = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if result.returncode != 0 or result.stderr:
        raise AssertionError(f"{command}: {result.returncode}\n{result.stderr}")
    return result.stdout


class Completions(unittest.TestCase):
    def test_man_pages(self):
        pages = sorted((FOLDER / "man1").iterdir())
        self.assertGreaterEqual(len(pages), 6)
        for page in pages:
            shown = run("man", "--warnings", "--local-file", str(page))
            for heading in ("NAME", "SYNOPSIS", "OPTIONS", "EXIT STATUS"):
                self.assertRegex(shown, rf"(?m)^{heading}$", page.name)

    def bash(self, *words):
        """Bash's completions of a line, with Debian's bash-completion."""
        line = " ".join(words)
        program = words[0]
        script = f"""
          source /usr/share/bash-completion/bash_completion
          source {FOLDER / 'bash' / program}
          COMP_LINE={quoted(line)} COMP_POINT={len(line)}
          IFS=$'\\n' COMP_WORDS=($(printf '%s' {quoted(line)} | sed -E 's/:/ : /g; s/ +/\\n/g'))
          [[ $COMP_LINE != *[\\ :] ]] || COMP_WORDS+=('')
          unset IFS
          COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
          compopt() {{ :; }}
          _{program.replace('-', '_')}
          printf '%s\\n' "${{COMPREPLY[@]}}" """
        return run("bash", "-c", script).split()

    def test_bash(self):
        self.assertEqual(self.bash("rgs-render", "--bac"), ["--background", "--backend"])
        self.assertEqual(self.bash("rgs-render", "--backend", "c"), ["cpu", "cuda"])
        self.assertEqual(self.bash("rgs-render", "--out", "x"), [])  # left to file names
        self.assertEqual(self.bash("rgs-convert", "--profile", ""),
                         ["packed", "direct", "archive:high", "archive:small", "archive:tiny"])
        self.assertEqual(self.bash("rgs-convert", "--profile", "archive:s"), ["small"])
        self.assertEqual(self.bash("rgs-convert", "--target-"), ["--target-psnr", "--target-size"])

    def fish(self, line):
        name = line.split()[0]
        return [answer.split("\t")[0] for answer in
                run("fish", "--no-config", "-c", f"source {FOLDER}/fish/{name}.fish; complete -C{quoted(line)}").splitlines()]

    def test_fish(self):
        self.assertEqual(sorted(self.fish("rgs-render --bac")), ["--backend", "--background"])
        self.assertEqual(sorted(self.fish("rgs-render --backend ")), ["auto", "cpu", "cuda"])
        self.assertEqual(self.fish("rgs-convert --profile archive:s"), ["archive:small"])

    def zsh(self, line):
        """A line in an interactive zsh after the Tab key."""
        program = line.split()[0]
        pid, terminal = pty.fork()
        if pid == 0:
            os.environ["TERM"] = "dumb"
            os.execvp("zsh", ["zsh", "-f", "-i"])
        shown = ""

        def read_until(pattern):
            nonlocal shown
            while not (found := re.search(pattern, shown)):
                if not select.select([terminal], [], [], 60)[0]:
                    raise AssertionError(f"zsh shows no {pattern}, but {shown!r}")
                shown += os.read(terminal, 4096).decode()
            return found

        try:
            # The echo of this line contains no READY. Control-X shows the line being edited.
            os.write(terminal, f"fpath=({FOLDER}/zsh $fpath); autoload -U compinit; compinit -D -u; "
                     "show() { print -r -- \"<$BUFFER>\" }; zle -N show; bindkey '^X' show; print REA''DY\n".encode())
            read_until("READY")
            os.write(terminal, f"{line}\t\x18".encode())
            return read_until(rf"<({program}[^>]*)>")[1].split()
        finally:
            os.close(terminal)
            os.waitpid(pid, 0)

    def test_zsh(self):
        for file in sorted((FOLDER / "zsh").iterdir()):
            run("zsh", "-n", str(file))
        self.assertEqual(self.zsh("rgs-render --orb"), ["rgs-render", "--orbit="])
        self.assertEqual(self.zsh("rgs-render --format=e"), ["rgs-render", "--format=exr"])
        self.assertEqual(self.zsh("rgs-convert --profile=archive:s"), ["rgs-convert", "--profile=archive:small"])


def quoted(text):
    return "'" + text.replace("'", "'\\''") + "'"


if __name__ == "__main__":
    FOLDER = Path(sys.argv[1]).resolve()
    for tool in ("man", "bash", "zsh", "fish"):
        if not shutil.which(tool):
            skip_without_tool(f"{tool} is not installed")
    unittest.main(argv=sys.argv[:1])
