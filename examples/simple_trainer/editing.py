"""Edits of gsplat's `examples/simple_trainer.py`, written as a diff and found by their own lines, not by numbers.

A script beside this one holds the edits of one swap. Run as ``python density.py SIMPLE_TRAINER.py``, it edits that file
in place; with ``--out COPY.py``, a copy. Each line that an edit stands on must be there once, or nothing is written.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from turbogs_plugin.errors import InputError

HOSTS = "gsplat's examples/simple_trainer.py of 1.5.3 or main"


@dataclass(frozen=True)
class Hunk:
    """A place in a file, as in a diff: lines that begin with a space stay, with - go, with + are new."""

    lines: tuple[str, ...]

    @property
    def old(self) -> str:
        return "".join(f"{line[1:]}\n" for line in self.lines if line[0] in " -")

    @property
    def new(self) -> str:
        return "".join(f"{line[1:]}\n" for line in self.lines if line[0] in " +")

    @property
    def changes(self) -> list[str]:
        """The lines that go and come, with their signs and without indentation."""
        return [line[0] + line[1:].strip() for line in self.lines if line[0] in "+-"]


def hunks_of(text: str) -> list[list[Hunk]]:
    """The places of a diff, each with its alternatives; the first is that of gsplat 1.5.3.

    Args:
        text: hunks, divided by lines ``@@``, or ``@@ or`` before another form of the same place.
    """
    found: list[list[Hunk]] = []
    for part in text.strip("\n").split("\n@@"):
        first, _, rest = part.partition("\n")
        alternative = first == " or"
        lines = tuple((rest if alternative or not first else part).split("\n"))
        if alternative:
            found[-1].append(Hunk(lines))
        else:
            found.append([Hunk(lines)])
    return found


def places_of(lines: str, source: str) -> list[int]:
    """Where whole lines begin in a source."""
    return [found.start() for found in re.finditer(rf"^{re.escape(lines)}", source, re.MULTILINE)]


def edited(source: str, edits: str) -> str:
    """`source` after the `edits`.

    Raises:
        InputError: the edits are there already, or a place is not there, or several times.
    """
    for alternatives in hunks_of(edits):
        adds = any(line.startswith("+") for line in alternatives[0].lines)
        if adds and any(places_of(hunk.new, source) for hunk in alternatives):
            raise InputError(f"already edited: it has {alternatives[0].changes[-1][1:]!r}")
        places = [(hunk, place) for hunk in alternatives for place in places_of(hunk.old, source)]
        if len(places) != 1:
            anchor = alternatives[0].old.splitlines()[0].strip()
            where = f"is there {len(places)} times" if places else "is not there"
            raise InputError(f"{anchor!r} and the lines beside it {where}: expected {HOSTS}")
        hunk, place = places[0]
        source = source[:place] + hunk.new + source[place + len(hunk.old) :]
    return source


def command_line(edits: str) -> None:
    """Apply one swap's edits to the file named on the command line."""

    def edit(trainer: Annotated[Path, tyro.conf.Positional], out: Path | None = None) -> None:
        """Edit gsplat's trainer.

        Args:
            trainer: gsplat's simple_trainer.py, of 1.5.3 or main, other swaps in it or not.
            out: write the result there in the place of it; beside it, as the trainer imports its neighbours.
        """
        try:
            text = edited(trainer.read_text(encoding="utf-8"), edits)
        except (InputError, OSError) as error:
            print(f"{trainer}: {error}", file=sys.stderr)
            sys.exit(2)
        (out or trainer).write_text(text, encoding="utf-8")

    tyro.cli(edit)
