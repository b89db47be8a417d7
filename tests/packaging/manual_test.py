# manual_test.py - packaging/manual.py covers every option of the programs' --help: manual_test.py PROGRAM...
# SPDX-License-Identifier: Apache-2.0
import gzip
import re
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

MAKER = Path(__file__).resolve().parents[2] / "packaging" / "manual.py"
PROGRAMS = []
sys.path.insert(0, str(MAKER.parent))
import manual  # noqa: E402


def options_of(help_text):
    """Option names, found independently of manual.py: the first word of each line that starts with two spaces and a dash."""
    return [line.split()[0].split(",") for line in help_text.splitlines() if re.match(r"  -", line)]


class Made(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.out = Path(cls.folder.name)
        subprocess.run([sys.executable, MAKER, cls.out, *PROGRAMS], check=True)

    @classmethod
    def tearDownClass(cls):
        cls.folder.cleanup()

    def test_every_option_is_everywhere(self):
        self.assertGreaterEqual(len(PROGRAMS), 5)
        for program in PROGRAMS:
            name = Path(program).name
            options = options_of(subprocess.run([program, "--help"], check=True, capture_output=True, text=True).stdout)
            self.assertGreater(len(options), 8, name)
            page = gzip.decompress((self.out / "man1" / f"{name}.1.gz").read_bytes()).decode()
            bash = (self.out / "bash" / name).read_text()
            zsh = (self.out / "zsh" / f"_{name}").read_text()
            fish = (self.out / "fish" / f"{name}.fish").read_text()
            headings = [line.replace("\\-", "-") for line in re.findall(r"^\.TP\n(\\fB.*)", page, re.MULTILINE)]
            self.assertEqual(len(headings), len(options), name)
            for names, heading in zip(options, headings):
                self.assertEqual(re.findall(r"\\fB(\S+?)\\fR", heading), names, name)
                for option in names:
                    self.assertRegex(zsh, rf"['*)]{option}=?\[", name)
                    long, short = rf" -l {option[2:]}( |$)", rf" -s {option[1:]}( |$)"
                    self.assertRegex(fish, re.compile(long if option.startswith("--") else short, re.MULTILINE), name)
                    if option.startswith("--"):
                        self.assertRegex(bash, rf"[ ']{option}[ ']", name)

    def test_values_and_texts(self):
        render = next(program for program in PROGRAMS if program.endswith("rgs-render"))
        h, version = manual.ask(render)
        options = {option.names[-1]: option for option in h.options}
        self.assertEqual(options["--format"].choices, ["png", "jpg", "tif", "exr"])
        self.assertEqual(options["--format"].default, "png")
        self.assertEqual(options["--mode"].choices, ["baseline", "paper", "turbo"])  # as the program prints it
        self.assertEqual(options["--frames"].default, "120")
        self.assertEqual(options["--frames"].rest, "Needs: --path")
        self.assertEqual(options["--alpha"].value, "")
        self.assertEqual([what for what, _ in h.positionals], ["scene TEXT"])
        self.assertRegex(version, r"^\d+\.\d+\.\d+$")

    def test_what_is_not_understood_is_refused(self):
        good = "Does.\nUsage: p [OPTIONS]\n\nOptions:\n  -h,--help                   Help\n\nExit codes: 0 ok.\n"
        self.assertEqual([option.names for option in manual.parse_help("p", good).options], [["-h", "--help"]])
        for bad in (good.replace("Usage", "Use"), good.replace("Exit codes: 0 ok.", ""), good.replace("  -h,--help ", "  -h,,help   "),
                    good.replace("  -h,--help ", "    -h,--help "), ""):
            with self.assertRaises(manual.NotUnderstood):
                manual.parse_help("p", bad)


if __name__ == "__main__":
    PROGRAMS = sys.argv[1:]
    unittest.main(argv=sys.argv[:1])
