"""The command line: its commands, and the words after them. Modules of `turbogs_plugin.commands` say the rest."""

from __future__ import annotations

import atexit
import gc
import itertools
import sys
import warnings

from PIL import Image

from turbogs_plugin import __version__
from turbogs_plugin.commands import captures, machine, models, studies, training
from turbogs_plugin.commands.parsing import Command, help_text, parsed
from turbogs_plugin.errors import InputError, exit_code

COMMANDS: dict[str, Command] = {
    "train": training.train,
    "plan": training.plan,
    "eval": models.evaluate,
    "render": models.render,
    "export": models.export,
    "view": models.view,
    "reconstruct": captures.reconstruct,
    "ablate": studies.ablate,
    "report": studies.report,
    "bench": machine.bench,
    "demo": captures.demo,
    "doctor": machine.doctor,
}


def _require_usable(words: list[str]) -> None:
    """Raise `InputError` for an empty word, which as a path would be the current folder, and for one that is not UTF-8,
    which no report nor configuration can name."""
    for text in words:
        if any("\ud800" <= letter <= "\udfff" for letter in text):
            raise InputError(f"{text!a} is not UTF-8, in which reports and configurations are written: rename it")
    for before, text in itertools.pairwise(["", *words]):
        if text.startswith("--") and text.endswith("="):
            before, text = text[:-1], ""
        if not text:
            which = before if before.startswith("-") else "an argument is"
            raise InputError(f"{which} '': write a value, as . for the current folder, or leave it out")


def _warning_line(message: Warning | str, *place: object) -> str:
    """A warning on one line, without the place in the source."""
    return f"turbogs: warning: {' '.join(str(message).split())}\n"


def _command() -> int:
    words = sys.argv[1:]
    if words in ([], ["--help"], ["-h"]):
        print(help_text(COMMANDS))
        return 0
    if words == ["--version"]:
        print(f"turbogs {__version__}")
        return 0
    _require_usable(words)
    return parsed(COMMANDS, words)()


def main() -> None:
    """The `turbogs` command."""
    atexit.register(gc.freeze)  # or the collector walks through all of torch at the end, for a second
    setattr(warnings, "formatwarning", _warning_line)  # noqa: B010
    Image.MAX_IMAGE_PIXELS = None  # phones take 200 megapixels; photos are checked against cameras and memory
    sys.exit(exit_code(_command))


if __name__ == "__main__":
    main()
