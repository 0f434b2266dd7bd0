"""The `turbogs` command. Its commands are in `turbogs_plugin.commands`, which need packages that the core does not."""

from __future__ import annotations

import atexit
import gc
import itertools
import sys
import warnings
from types import ModuleType

from PIL import Image

from turbogs_plugin import __version__
from turbogs_plugin.errors import InputError, exit_code


def main() -> None:
    """Run the command line. Where the extra ``train`` is absent, one line says what the command lacks."""
    atexit.register(gc.freeze)  # or the collector walks through all of torch at the end, for a second
    setattr(warnings, "formatwarning", _warning_line)  # noqa: B010
    Image.MAX_IMAGE_PIXELS = None  # phones take 200 megapixels; photos are checked against cameras and memory
    sys.exit(exit_code(lambda: _run(sys.argv[1:])))


def _run(words: list[str]) -> int:
    if words == ["--version"]:
        print(f"turbogs {__version__}")
        return 0
    try:
        from turbogs_plugin.commands import COMMANDS
        from turbogs_plugin.commands.parsing import help_text, parsed

        if words in ([], ["--help"], ["-h"]):
            print(help_text(COMMANDS))
            return 0
        _require_usable(words)
        return parsed(COMMANDS, words)()
    except (ImportError, AttributeError) as error:
        from turbogs_plugin.doctor import COMMAND_PACKAGES, INSTALL_COMMANDS, diagnosis, lacking_packages

        lacking = lacking_packages()
        if not lacking or _package_of(error) not in COMMAND_PACKAGES:
            raise
        if words == ["doctor"]:  # which needs none of them, but for the parser of its name
            print(diagnosis())
            return 0
        verb = next((text for text in words[:1] if not text.startswith("-")), "")
        raise InputError(f"{f'turbogs {verb}'.strip()} needs {', '.join(lacking)}: {INSTALL_COMMANDS}") from error


def _package_of(error: ImportError | AttributeError) -> str:
    """The top package of the module that cannot be imported, or that is there and lacks a name (another version)."""
    if isinstance(error, ImportError):
        name = error.name
    else:
        name = error.obj.__name__ if isinstance(error.obj, ModuleType) else ""
    return (name or "").partition(".")[0]


def _require_usable(words: list[str]) -> None:
    """Raise `InputError` for an empty word, which as a path would be the current folder, and for one that is not UTF-8,
    which no report nor configuration can name."""
    for text in words:
        if any("\ud800" <= letter <= "\udfff" for letter in text):
            raise InputError(f"{text!a} is not UTF-8, in which reports and configurations are written: rename it")
    for before, text in itertools.pairwise(["", *words]):
        if text == "" or (text.startswith("--") and text.endswith("=")):
            which = text[:-1] or (before if before.startswith("-") else "an argument is")
            raise InputError(f"{which} '': write a value, as . for the current folder, or leave it out")


def _warning_line(message: Warning | str, *place: object) -> str:
    """A warning on one line, without the place in the source."""
    return f"turbogs: warning: {' '.join(str(message).split())}\n"


if __name__ == "__main__":
    main()
