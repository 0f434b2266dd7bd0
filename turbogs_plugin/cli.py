"""The `turbogs` command. Its commands are in `turbogs_plugin.commands`, which need packages that the core does not."""

from __future__ import annotations

import atexit
import gc
import sys
import warnings

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
    for word in words:
        if not word or (word.startswith("--") and word.endswith("=")):  # an empty path would be the current folder
            raise InputError(f"'{word}' has no value: write one, as . for the current folder, or leave it out")
    try:
        from turbogs_plugin.commands import COMMANDS
        from turbogs_plugin.commands.parsing import help_text, parsed

        if words in ([], ["--help"], ["-h"]):
            print(help_text(COMMANDS))
            return 0
        return parsed(COMMANDS, words)()
    except (ImportError, AttributeError) as error:
        from turbogs_plugin.doctor import INSTALL_COMMANDS, diagnosis, lacking_packages

        if not (lacking := lacking_packages()):
            raise
        if words == ["doctor"]:  # which needs no package of the extra, but for the parser of its name
            print(diagnosis())
            return 0
        raise InputError(f"turbogs needs {', '.join(lacking)}: {INSTALL_COMMANDS} ({error})") from error


def _warning_line(message: Warning | str, *place: object) -> str:
    """A warning on one line, without the place in the source."""
    return f"turbogs: warning: {' '.join(str(message).split())}\n"
