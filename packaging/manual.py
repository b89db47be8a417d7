#!/usr/bin/python3
# manual.py - man pages and completions for bash, zsh and fish from the programs' own --help:
#   python3 packaging/manual.py OUT PROGRAM...      writes OUT/man1, OUT/bash, OUT/zsh, OUT/fish
# Help is parsed strictly: a line that is not understood is an error.
# SPDX-License-Identifier: Apache-2.0
import gzip
import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

COLUMN = 30  # where CLI11 begins descriptions; a longer name has its description on the next line
NAMES = r"--?[A-Za-z][A-Za-z0-9-]*(?:,--?[A-Za-z][A-Za-z0-9-]*)*"
# Names, what the value is, its default, and what CLI11 says of other options.
OPTION = re.compile(
    rf"(?P<names>{NAMES})(?: (?P<value>(?!Needs:|Excludes:|REQUIRED)\S.*?))?"
    r"(?P<rest>(?: (?:REQUIRED|\.\.\.|Needs:(?: --\S+)+|Excludes:(?: --\S+)+))*)$")


class NotUnderstood(Exception):
    pass


@dataclass
class Option:
    names: list  # "-o", "--out"
    value: str  # "png|jpg" or as --help shows it, "INT:INT in [0 - 3]"; empty for a flag
    default: str
    rest: str  # "REQUIRED Excludes: --path"
    text: str
    choices: list = field(default_factory=list)  # the words that the value may be; empty where it is something else

    @property
    def value_name(self):
        """The value in a man page."""
        return re.sub(r"^([A-Z]+):(.*)", lambda m: m[2] if m[2].startswith(m[1] + " in ") else m[1], self.value)


@dataclass
class Help:
    name: str
    summary: str = ""
    usage: str = ""
    positionals: list = field(default_factory=list)  # (what, text)
    groups: list = field(default_factory=list)  # (title, [Option])
    notes: list = field(default_factory=list)  # lines after the options, without exit codes
    exit_codes: str = ""

    @property
    def options(self):
        return [option for _, options in self.groups for option in options]


def parse_option(name, text):
    match = OPTION.match(name)
    if not match:
        raise NotUnderstood(f"not understood: an option that reads '{name}'")
    value, default = match["value"] or "", ""
    # "TEXT:{a,b}=a", "INT=120", "FLOAT=[1,2] ..."; not the "=" inside "NAME=LIMIT,...".
    found = re.fullmatch(r"((?:TEXT|INT|UINT|FLOAT|ENUM)\S*(?: in \[.*?\])?)=(.*?)", value)
    if found:
        value, default = found[1], found[2]
    choices = []
    if listed := re.search(r"\{([^}]*)\}", value):
        choices = listed[1].split(",")
        value = "|".join(choices)
    elif re.fullmatch(r"[a-z0-9][a-z0-9:.-]*(\|[a-z0-9][a-z0-9:.-]*)+", value):
        choices = value.split("|")
    return Option(match["names"].split(","), value, default, match["rest"].strip(), text, choices)


def parse_help(name, text):
    """The output of `name --help` as a Help."""
    lines = text.rstrip("\n").split("\n")
    result = Help(name, summary=lines[0])
    if len(lines) < 3 or not lines[1].startswith("Usage: "):
        raise NotUnderstood(f"no usage in the second line of '{text}'")
    result.usage = lines[1].removeprefix("Usage: ")
    at, options, positionals = 2, None, False
    while at < len(lines):
        line = lines[at]
        at += 1
        if not line:
            continue
        if line.startswith("Exit codes: "):
            result.exit_codes = line.removeprefix("Exit codes: ")
        elif result.notes or not line.startswith(" ") and not (line.endswith(":") and is_item(lines, at)):
            result.notes.append(line)
        elif not line.startswith(" "):
            positionals = line == "Positionals:"
            if not positionals:
                options = []
                result.groups.append((line.removesuffix(":"), options))
        elif not re.match(r"  \S", line):
            raise NotUnderstood(f"not understood: '{line}'")
        else:
            what, described = line[2:COLUMN].rstrip(), line[COLUMN:]
            if at < len(lines) and lines[at].startswith(" " * COLUMN):
                what, described = line[2:].rstrip(), lines[at][COLUMN:]
                at += 1
            if positionals:
                result.positionals.append((re.sub(r"(:| REQUIRED).*", "", what), described))
            elif options is None:
                raise NotUnderstood(f"'{line}' before the options")
            else:
                options.append(parse_option(what, described))
    if not result.options or not result.exit_codes:
        raise NotUnderstood("no options, or no exit codes")
    return result


def is_item(lines, at):
    """Whether line `at` is an option or a positional, not the text of a note."""
    return lines[at].startswith("  -") or lines[at].startswith("  ") and lines[at - 1] == "Positionals:"


# Man page ------------------------------------------------------------------------------------------------------------


def roff(text):
    """Text that groff prints as it stands; a line may end after "|"."""
    text = text.replace("\\", "\\e").replace("-", "\\-").replace("^", "\\(ha").replace("~", "\\(ti").replace("|", "|\\:")
    return re.sub(r"^([.'])", r"\\&\1", text, flags=re.MULTILINE)


def man_page(h, version, others):
    out = [f'.\\" Made by packaging/manual.py from {h.name} --help.',
           f'.TH {h.name.upper()} 1 "" "RoofGS {version}" "User Commands"', ".SH NAME",
           f"{roff(h.name)} \\- {roff(h.summary[0].lower() + h.summary[1:].removesuffix('.'))}",
           ".SH SYNOPSIS", f".B {roff(h.name)}", roff(h.usage.removeprefix(h.name).strip()),
           ".SH DESCRIPTION", roff(h.summary)]
    if h.positionals:
        for what, text in h.positionals:
            out += [".TP", f".I {roff(what)}", roff(text)]
    for title, options in h.groups:
        out += [".SH OPTIONS"] if title == "Options" else [f".SS {roff(title)}"]
        for option in options:
            names = ", ".join(f"\\fB{roff(name)}\\fR" for name in option.names)
            value = f" \\fI{roff(option.value_name)}\\fR" if option.value else ""
            stated = [option.text] if option.text else []
            if option.default:
                stated.append(f"[{option.default.strip('[]')}]")
            if option.rest:
                stated.append("(" + option.rest.replace("REQUIRED", "required").replace("Excludes:", "excludes")
                              .replace("Needs:", "needs").replace("...", "repeatable") + ")")
            out += [".TP", names + value, roff(" ".join(stated))]
    if h.notes:
        out += [".SH NOTES", ".nf"] + [roff(note) for note in h.notes] + [".fi"]
    out += [".SH EXIT STATUS", roff(h.exit_codes)]
    see = [f".BR {roff(other)} (1)" + ("," if other != others[-1] else "") for other in others]
    out += [".SH SEE ALSO"] + [line.replace(" (1),", " (1),") for line in see]
    return "\n".join(line for line in out if line) + "\n"


# Completions ---------------------------------------------------------------------------------------------------------


def bash(h):
    words = " ".join(name for option in h.options for name in option.names if name.startswith("--"))
    choices = [f"    {'|'.join(option.names)}) words={quoted(' '.join(option.choices))} ;;"
               for option in h.options if option.choices]
    files = "|".join(name for option in h.options if option.value and not option.choices for name in option.names)
    function = "_" + h.name.replace("-", "_")
    # Where a function leaves no replies, `-o default` completes names of files. A colon ends a word of bash.
    return "\n".join([
        f"# bash completion for {h.name}; made by packaging/manual.py", f"{function}() {{",
        "  local cur=${COMP_WORDS[COMP_CWORD]} prev=${COMP_WORDS[COMP_CWORD - 1]} words=",
        "  ! declare -F _get_comp_words_by_ref >/dev/null || _get_comp_words_by_ref -n : cur prev",
        "  case $prev in", *choices, f"    {files}) return ;;",
        f"    *) [[ $cur != -* ]] || words={quoted(words)} ;;", "  esac",
        '  [[ -z $words ]] || COMPREPLY=($(compgen -W "$words" -- "$cur"))',
        '  ! declare -F __ltrim_colon_completions >/dev/null || __ltrim_colon_completions "$cur"', "}",
        f"complete -o default -F {function} {h.name}", ""])


def quoted(text):
    """One word of a shell."""
    return "'" + text.replace("'", "'\\''") + "'"


def zsh(h):
    specs = []
    for option in h.options:
        text = re.sub(r"([\[\]:\\])", r"\\\1", option.text)
        action = ""
        if option.choices:
            action = ":value:(" + " ".join(choice.replace(":", "\\:") for choice in option.choices) + ")"
        elif option.value:
            action = ":value:_files"
        for name in option.names:
            equals = "=" if name.startswith("--") and option.value else ""
            others = [other for other in option.names if other != name]
            excluded = f"({' '.join(others)})" if others else ""
            repeat = "*" if "..." in option.rest else ""
            specs.append(quoted(f"{repeat}{'' if repeat else excluded}{name}{equals}[{text}]{action}"))
    specs.append("'*:file:_files'")
    joined = " \\\n  ".join(specs)
    return f"#compdef {h.name}\n# Made by packaging/manual.py\n_arguments -s \\\n  {joined}\n"


def fish(h):
    def escaped(text):
        return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"

    lines = [f"# fish completion for {h.name}; made by packaging/manual.py"]
    for option in h.options:
        names = " ".join(("-l " + name[2:]) if name.startswith("--") else ("-s " + name[1:]) for name in option.names)
        value = ""
        if option.choices:
            value = " -x -a " + escaped(" ".join(option.choices))
        elif option.value:
            value = " -r"
        lines.append(f"complete -c {h.name} {names}{value} -d {escaped(option.text)}")
    return "\n".join(lines) + "\n"


def ask(program):
    """What a program says of itself: its Help and its version."""
    def run(option):
        return subprocess.run([program, option], capture_output=True, text=True)

    printed = run("--help")
    if printed.returncode != 0:
        raise NotUnderstood(printed.stderr.strip())
    h = parse_help(Path(program).name, printed.stdout)
    # --help does not list the values of an enumeration, a refusal does.
    for option in h.options:
        if option.value.startswith("ENUM"):
            refusal = run(f"{option.names[-1]}=?").stderr
            listed = re.search(r"'\?' is not one of (.*)", refusal)
            if not listed:
                raise NotUnderstood(f"not understood: the refusal '{refusal}'")
            option.choices = listed[1].split(", ")
            option.value = "|".join(option.choices)
    return h, run("--version").stdout.split()[-1]


def main(out, programs):
    helps = []
    for program in programs:
        try:
            helps.append(ask(program))
        except NotUnderstood as error:
            sys.exit(f"manual.py: {program} --help: {error}")
    names = sorted(h.name for h, _ in helps)
    for folder in ("man1", "bash", "zsh", "fish"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    for h, version in helps:
        page = man_page(h, version, [name for name in names if name != h.name])
        (out / "man1" / f"{h.name}.1.gz").write_bytes(gzip.compress(page.encode(), mtime=0))
        (out / "bash" / h.name).write_text(bash(h))
        (out / "zsh" / f"_{h.name}").write_text(zsh(h))
        (out / "fish" / f"{h.name}.fish").write_text(fish(h))


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: manual.py OUT PROGRAM...")
    main(Path(sys.argv[1]), sys.argv[2:])
