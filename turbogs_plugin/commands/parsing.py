"""Words of a command line to what is called: what tyro refuses in a box becomes one line, as all other refusals."""

from __future__ import annotations

import functools
import io
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr

from tyro.extras import subcommand_cli_from_dict

from turbogs_plugin.errors import InputError, nearest

EDGE = re.compile(r"^[│|] ?|[ │|]+$")
RULE = re.compile(r"[ ─-]{8,}$")
"""Between the sections of a box."""
HELP_INDENT = 8 * " "
"""Of what a box says of an option that it names."""
TYPE = re.compile(r"Error parsing (?P<option>\S+): no type matching (?P<types>\S+) .* from \['?(?P<value>.*?)'?\]\.")
KINDS = {"INT": "an integer", "FLOAT": "a number"}
OPTION = re.compile(r"--[\w-]+")
HELP = re.compile(r"For full helptext, (?:run|see):? (?P<command>.*?--help)")
MISPLACED = re.compile(r"(\S+) \(applied to ([^)]+)\)")
"""A word that a command does not take, and the command."""
OWNER = re.compile(r"in (\S+ \S+) --help")
"""A command that takes an option that is similar, or the same."""


def parsed(commands: Mapping[str, Callable[..., int]], words: Sequence[str], about: str) -> Callable[[], int]:
    """What a command line calls. `--help` prints and leaves.

    Args:
        commands: verb -> function.
        words: after the program's name.
        about: what `--help` says first.

    Raises:
        InputError: words that no command takes.
    """
    if words and words[0] not in commands and not words[0].startswith("-"):
        raise InputError(f"no such command '{words[0]}': {nearest(words[0], commands)}")
    said = io.StringIO()
    later = {verb: _later(function) for verb, function in commands.items()}
    try:
        with redirect_stderr(said):
            call = subcommand_cli_from_dict(later, args=list(words), prog="turbogs", description=about)
    except SystemExit as end:
        if end.code != 2:
            raise
        raise InputError(refusal_line(said.getvalue())) from None
    sys.stderr.write(said.getvalue())
    return call


def _later(function: Callable[..., int]) -> Callable[..., Callable[[], int]]:
    """The function, which gives what would be called."""

    @functools.wraps(function)
    def given(*arguments, **options):
        return functools.partial(function, *arguments, **options)

    return given


def refusal_line(box: str) -> str:
    """The text of a box in a line: what is wrong, what may be meant, and where more is said."""
    sections = [""]
    for line in box.splitlines()[1:-1]:
        text = EDGE.sub("", line)
        if RULE.match(text):
            sections.append("")
        elif not (text.startswith(HELP_INDENT) and sections[-1].startswith("Missing from")):
            sections[-1] = f"{sections[-1]} {text.strip()}".strip()
    what, *others = filter(None, sections) if any(sections) else [" ".join(box.split())]
    if found := TYPE.match(what):
        kinds = [KINDS.get(kind, kind) for kind in found["types"].split("|") if kind != "{None}"]
        what = f"{found['option']} '{found['value']}': it takes {' or '.join(kinds)}"
    misplaced = dict(MISPLACED.findall(what))  # word -> command
    if misplaced:
        what = f"Unrecognized options of {next(iter(misplaced.values()))}: {', '.join(misplaced)}"
    hints = [what.partition(" Got errors:")[0].rstrip(".")]
    similar = [section for section in others if section.startswith("Arguments similar")]
    for section in sorted(similar) + [section for section in others if section not in similar]:  # tyro: any order
        if section.startswith(("Perhaps you meant", "Arguments similar")):
            option, owner = OPTION.search(section.partition(":")[2]), OWNER.search(section)
            if option and owner and option[0] in misplaced:
                hints.append(f"{owner[1]} takes {option[0]}")
            elif option:
                hints.append(f"did you mean {option[0]}?")
        elif section.startswith("Available subcommands"):
            hints.append(section)
        elif found := HELP.search(section):
            hints.append(f"see {next(iter(misplaced.values()))} --help" if misplaced else f"see {found['command']}")
    return "; ".join(hints)
