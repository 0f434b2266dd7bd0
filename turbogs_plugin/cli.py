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
from turbogs_plugin.commands.options import OVERRIDE, PORT
from turbogs_plugin.commands.parsing import parsed
from turbogs_plugin.errors import InputError, exit_code

COMMANDS = {
    "train": training.train,
    "reconstruct": captures.reconstruct,
    "plan": training.plan,
    "view": models.view,
    "eval": models.evaluate,
    "render": models.render,
    "export": models.export,
    "ablate": studies.ablate,
    "compare": studies.compare,
    "report": studies.report,
    "bench": machine.bench,
    "demo": captures.demo,
    "doctor": machine.doctor,
}

FLAGS = ("--report", "--no-report", "--offload", "--no-offload")
"""Options without a value, of verbs that have overrides."""

SAY_THEMSELVES = ("--init", "--max-memory", "--time-budget")
"""Options that say what may stand in the place of an empty value."""


def _gathered(arguments: list[str]) -> list[str]:
    """Arguments with later overrides brought before the first option, where a word besides the verb stands there.

    What follows an option is its value, whatever it looks like, unless the option is one of `FLAGS`.
    """
    first = next((place for place, text in enumerate(arguments) if text.startswith("-")), 0)
    if first < 2:
        return arguments
    overrides, rest = [], arguments[first : first + 1]
    for before, text in itertools.pairwise(arguments[first:]):
        value = before.startswith("-") and before not in FLAGS
        (overrides if OVERRIDE.fullmatch(text) and not value else rest).append(text)
    return [*arguments[:first], *overrides, *rest]


def _with_port(arguments: list[str]) -> list[str]:
    """Arguments in which --viewer without a port has the usual one.

    Raises:
        InputError: a word after it that is no port, nor the capture, which is named already.
    """
    filled = []
    named = "--resume" in arguments or not "".join(arguments[1:2]).startswith("-")
    for text, following in itertools.zip_longest(arguments, arguments[1:], fillvalue=""):
        portless = text == "--viewer" and not following.lstrip("-").isdecimal()
        if portless and named and following[:1] not in ("", "-") and not OVERRIDE.fullmatch(following):
            raise InputError(f"--viewer '{following}': it takes a port, which is a number, or nothing for {PORT}")
        filled += [text, str(PORT)] if portless else [text]
    return filled


def _require_usable(arguments: list[str]) -> None:
    """Raise `InputError` for an empty argument, which as a path would be the current folder, and for one that is not
    UTF-8, which no report nor configuration can name."""
    for text in arguments:
        if any("\ud800" <= letter <= "\udfff" for letter in text):
            raise InputError(f"{text!a} is not UTF-8, in which reports and configurations are written: rename it")
    for before, text in itertools.pairwise(["", *arguments]):
        if text.startswith("--") and text.endswith("="):
            before, text = text[:-1], ""
        if not text and before not in SAY_THEMSELVES:
            which = before if before.startswith("-") else "an argument is"
            raise InputError(f"{which} '': write a value, as . for the current folder, or leave it out")


def _warning_line(message: Warning | str, *place: object) -> str:
    """A warning on one line, without the place in the source."""
    return f"turbogs: warning: {' '.join(str(message).split())}\n"


def main() -> None:
    """The `turbogs` command."""
    atexit.register(gc.freeze)  # or the collector walks through all of torch at the end, for a second
    warnings.formatwarning = _warning_line
    Image.MAX_IMAGE_PIXELS = None  # phones take 200 megapixels; photos are checked against cameras and memory
    about = "TurboGS: train 3D Gaussian Splatting on few, well chosen pixels. --version prints which."

    def command() -> int:
        if sys.argv[1:] == ["--version"]:
            print(f"turbogs {__version__}")
            return 0
        _require_usable(sys.argv[1:])
        words = _gathered(_with_port(sys.argv[1:]))
        return parsed(COMMANDS, words, about)()

    sys.exit(exit_code(command))


if __name__ == "__main__":
    main()
